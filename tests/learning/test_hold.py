"""A decision held for several steps is one transition: rewards add up, endings are kept."""

import pytest
import torch

from tests.learning.test_policy_agent import N_OBS, networks
from tests.learning.test_train import config_of, same, trainer_of
from uuvtai.learning.environments import Hold
from uuvtai.learning.networks import NUM_ACTIONS
from uuvtai.learning.policy_agent import PolicyAgent

N = 3


class Scripted:
    """An env that pays 1, 2, 3, ... and ends row 1 in its second step; the teacher says the step's number."""

    def __init__(self):
        self.steps, self.actions = 0, []

    def step(self, action):
        self.steps += 1
        self.actions.append(action.clone())
        ended = torch.tensor([False, self.steps == 2, False])
        info = {
            "final_obs": torch.full((N, 1), float(self.steps)),
            "teacher_action": torch.full((N, NUM_ACTIONS), float(self.steps)),
            "outcome": torch.where(ended, 3, 0).to(torch.int32),
        }
        return (
            torch.full((N, 1), 100.0 + self.steps),
            torch.full((N,), float(self.steps)),
            ended,
            torch.zeros_like(ended),
            info,
        )


def test_rewards_add_up_and_an_ending_on_the_way_is_kept():
    watched = []
    end = Hold(Scripted(), 4).drive(
        torch.ones(N, NUM_ACTIONS), lambda ended, info: watched.append(ended.tolist())
    )
    assert end.reward.tolist() == [10.0, 3.0, 10.0]
    assert end.final_obs.flatten().tolist() == [4.0, 2.0, 4.0]
    assert end.ended.tolist() == end.terminated.tolist() == [False, True, False]
    assert end.outcome[1] == 3
    assert end.obs.flatten().tolist() == [104.0] * 3
    assert watched == [[False] * 3, [False, True, False], [False] * 3, [False] * 3]


def test_what_is_held_is_the_action():
    env = Scripted()
    Hold(env, 4).drive(torch.full((N, NUM_ACTIONS), 0.5))
    assert [action[0, 0].item() for action in env.actions] == [0.5] * 4
    assert [action[1, 0].item() for action in env.actions[2:]] == [2.0, 3.0], (
        "a new episode is driven by the tree until the next decision"
    )


def test_one_step_is_a_step_of_the_env():
    env = Scripted()
    end = Hold(env, 1).drive(torch.full((N, NUM_ACTIONS), 0.5))
    assert (env.steps, end.reward.tolist()) == (1, [1.0] * 3)
    assert env.actions[0].unique().tolist() == [0.5]


def test_a_training_counts_control_steps_and_goes_on_bit_for_bit():
    from tests.point_env import PointEnv

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
