"""Switches of the training in the twin: warm start from the tree, anchor, floor under the deviation, starts
before failures."""
import pytest
import torch

from tests.test_twin import SMALL
from uuvtai.learn.set_policy import SetCritic
from uuvtai.learn.twin_trainer import TwinTrainer, joined, least_std
from uuvtai.loader import load_training
from uuvtai.outcomes import COLLISION, RUNNING, SUCCESS
from uuvtai.twin import failure_states
from uuvtai.twin.failure_states import ARRAYS, FailureStarts
from uuvtai.twin.scenario_bank import ScenarioBank
from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS
from uuvtai.twin.twin_arrays import TRUTH_WIDTH
from uuvtai.twin.twin_world import Twin


@pytest.fixture(scope="module")
def bank(small):
    return small.scenario_bank()


@pytest.fixture(scope="module")
def config():
    return load_training("twin", overrides=SMALL)


def test_the_floor_falls_at_the_end():
    config = load_training("twin", overrides=SMALL | {"twin.last_std": 0.05})
    shares = (0.0, 0.8, 0.9, 1.0)
    assert [least_std(config, share) for share in shares] == pytest.approx([0.25, 0.25, 0.15, 0.05])
    assert least_std(load_training("twin", overrides=SMALL), 1.0) == 0.25


# ------------------------------------------------------------------------------------- curriculum and critic


def test_slow_scenarios_come_first_and_worlds_take_turns():
    path, origin = torch.zeros(8, 2, 16), torch.arange(4).repeat_interleave(2).int()
    path[:, 0, 4] = torch.tensor([1.5, 1.5, 0.6, 0.6, 1.5, 1.5, 0.6, 0.6])
    bank = ScenarioBank(torch.zeros(8, 2, 8), path, torch.zeros(8, 8), origin, ("a", "b", "c", "d"))
    assert bank.slow_first().tolist() == [2, 6, 3, 7, 0, 4, 1, 5]
    config = load_training("twin", overrides=SMALL | {"twin.curriculum_until": 0.4})
    parts = [joined(config, share, 2) for share in (0.0, 0.2, 0.4, 1.0)]
    assert parts == pytest.approx([0.5, 0.75, 1.0, 1.0])


def test_a_curriculum_deals_out_what_has_joined(bank):
    scenes = {"train.scenes": [[8, 6, 0.6], [8, 6, 0.9]], "train.iterations": 4}
    trainer = TwinTrainer(
        load_training("twin", overrides=SMALL | scenes | {"twin.curriculum_until": 1.0}), bank
    )
    slow = set(bank.slow_first()[: len(bank.body) // 2].tolist())
    dealt = [set(), set()]
    for number, iteration in enumerate((0, 4)):
        trainer.iteration = iteration
        for _ in range(40):
            dealt[number] |= set(trainer._next_scenarios().tolist())
    assert dealt[0] == slow and len(dealt[1]) == len(bank.body)


@pytest.mark.parametrize("sees", [True, False])
def test_the_critic_may_be_blind(sees):
    config = load_training("twin", overrides=SMALL | {"twin.critic_sees_truth": sees})
    critic = SetCritic(BODY_WIDTH, EGO_COLUMNS, TRUTH_WIDTH, config, torch.Generator().manual_seed(1))
    bodies, own, truth = (
        torch.rand(5, 3, BODY_WIDTH),
        torch.rand(5, EGO_COLUMNS),
        torch.rand(5, 3, TRUTH_WIDTH),
    )
    assert torch.equal(critic(bodies, own, truth), critic(bodies, own, 2 * truth)) != sees


# ------------------------------------------------------------------------------------- starts before failures


def test_episodes_begin_where_others_were_a_few_seconds_before_they_failed(config, bank):
    twin = Twin(config, bank, 16, 0)
    starts, generator = FailureStarts(twin, 1.0), torch.Generator().manual_seed(3)
    every = torch.ones(16, dtype=torch.bool)
    twin.begin(every, torch.arange(16) % len(bank.body))
    been, begun = [], 0
    outcome = torch.zeros(16, dtype=torch.int32)
    for step in range(70):
        been.append({name: getattr(twin, name).clone() for name in ARRAYS})  # not looked yet
        starts.advance()
        twin.look()
        twin.step(torch.full((16, 3), 0.2))
        outcome.fill_(RUNNING)
        if step in (5, 60):
            outcome[:4], outcome[4:6] = COLLISION, SUCCESS
            ended, before = outcome != RUNNING, twin.ego.clone()
            starts.begin(ended, outcome, torch.zeros(16, dtype=torch.int64), generator)
            if step == 5:
                assert starts.count == 0, "too young to have been anywhere 1 s ago"
                assert bool((twin.time_s[ended] == 0).all())
            else:
                assert starts.count == 4
                assert torch.equal(twin.ego[~ended], before[~ended])
                for row in ended.nonzero().flatten():
                    age = [
                        len(been) - at
                        for at, then in enumerate(been)
                        for other in range(4)
                        if all(torch.equal(then[n][other], getattr(twin, n)[row]) for n in ARRAYS)
                    ]
                    assert len(age) == 1 and failure_states.LEAST_AGE <= age[0] <= failure_states.MOST_AGE
                    begun += 1
    assert begun == 6


def test_the_ring_keeps_the_newest(config, bank, monkeypatch):
    monkeypatch.setattr(failure_states, "KEPT", 8)
    twin = Twin(config, bank, 16, 0)
    starts, generator = FailureStarts(twin, 0.0), torch.Generator().manual_seed(3)
    twin.begin(torch.ones(16, dtype=torch.bool), torch.zeros(16, dtype=torch.int64))
    for _ in range(20):
        starts.advance()
        twin.ego[:, 8] += 0.1
    outcome = torch.full((16,), COLLISION, dtype=torch.int32)
    starts.begin(outcome != RUNNING, outcome, torch.zeros(16, dtype=torch.int64), generator)
    assert starts.count == 8 and bool((twin.time_s == 0).all())
