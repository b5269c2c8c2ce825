"""A decision held for several steps is one transition: rewards add up, endings are kept."""

import pytest
import torch

from tests.learning.test_policy_agent import N_OBS, networks
from tests.learning.test_train import config_of, same, trainer_of
from tests.point_env import PointEnv
from uuvtai.learning.networks import NUM_ACTIONS
from uuvtai.learning.policy_agent import PolicyAgent
from uuvtai.learning.rollout import RolloutSums


class Scripted(PointEnv):
    """An env that pays 1, 2, 3, ... and ends row 1 in its second step; the teacher says the step's number."""

    def __init__(self):
        super().__init__(3)
        self.steps, self.actions = 0, []

    def step(self, action):
        self.steps += 1
        self.actions.append(action.clone())
        ended = torch.tensor([False, self.steps == 2, False])
        _, info = self.restore(self.capture())
        info |= {
            "final_obs": torch.full((3, self.num_obs), float(self.steps)),
            "teacher_action": torch.full((3, NUM_ACTIONS), float(self.steps)),
            "outcome": torch.where(ended, 3, 0).to(torch.int32),
            "episode_return": torch.zeros(3),
            "episode_steps": torch.ones(3, dtype=torch.int32),
        }
        obs, reward = torch.full((3, self.num_obs), 100.0 + self.steps), torch.full((3,), float(self.steps))
        return obs, reward, ended, torch.zeros_like(ended), info


def held(steps):
    """The env after a decision of so many steps, its view, what came of it, and what was counted."""
    env = Scripted()
    made = trainer_of(env, config_of(policy={"hidden": [4], "hold_steps": steps})).env
    sums = RolloutSums(len(env.outcomes), len(env.reward_terms), env.device)
    came = made.step(torch.full((3, NUM_ACTIONS), 0.5), sums)
    return env, made.view, came, sums


def test_rewards_add_up_and_an_ending_on_the_way_is_kept():
    _, view, end, sums = held(4)
    assert end.reward.tolist() == [10.0, 3.0, 10.0]
    assert end.final["x"][:, 0].tolist() == [4.0, 2.0, 4.0]
    assert end.ended.tolist() == end.terminated.tolist() == [False, True, False]
    assert view["x"][:, 0].tolist() == [104.0] * 3
    assert sums.samples == 4 * 3 and sums.outcomes.tolist() == [0, 0, 0, 1, 0, 0]


def test_what_is_held_is_the_action():
    actions = held(4)[0].actions
    assert [action[0, 0].item() for action in actions] == [0.5] * 4
    assert [action[1, 0].item() for action in actions] == [0.5, 0.5, 2.0, 3.0], (
        "a new episode is driven by the tree until the next decision"
    )


def test_one_step_is_a_step_of_the_env():
    env, _, end, _ = held(1)
    assert (env.steps, end.reward.tolist()) == (1, [1.0] * 3)
    assert env.actions[0].unique().tolist() == [0.5]


def test_a_training_counts_control_steps_and_goes_on_bit_for_bit():
    config = config_of(policy={"hidden": [16, 16], "hold_steps": 3})
    whole, first = trainer_of(PointEnv(), config), trainer_of(PointEnv(), config)
    answer = [whole.iterate() for _ in range(4)]
    assert answer[-1]["time/env_steps"] == 5 * 16 * 3 * 16, "four rollouts and one of the teacher's"
    for _ in range(2):
        first.iterate()
    second = trainer_of(PointEnv(), config)
    second.load_state(first.state())
    for _ in range(2):
        second.iterate()
    same(whole.state(), second.state())


@pytest.mark.parametrize("hold", [1, 4])
def test_the_pilot_asks_its_networks_when_a_decision_is_due_and_after_a_reset(hold):
    policy, model = networks(hold_steps=hold)
    pilot, rng = PolicyAgent(policy, model, 2), torch.Generator().manual_seed(3)
    actions = []
    for step in range(9):
        if step == 6:
            pilot.reset(torch.tensor([0, 1]))
        actions.append(pilot.act(3.0 * torch.randn(2, N_OBS, generator=rng)))
    changed = [(actions[i] != actions[i - 1]).any(dim=1).tolist() for i in range(1, 9)]
    due = [[i % hold == 0, (i if i < 6 else i - 6) % hold == 0] for i in range(1, 9)]
    assert changed == due
    assert pilot.decide(3.0 * torch.randn(2, N_OBS, generator=rng)).value.shape == (2,)
