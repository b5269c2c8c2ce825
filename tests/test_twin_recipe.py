"""Switches of the training in the twin: warm start from the tree, anchor, floor under the deviation, starts
before failures."""

import copy

import numpy as np
import pytest
import taichi as ti
import torch
from docs.writers.twin_recipe import ARMS, entry_of, gain_of

from tests.test_twin import SMALL
from uuvtai.config import VehicleConfig
from uuvtai.errors import UserError
from uuvtai.kernels.core.signature import Const, FloatMatrix
from uuvtai.learn import checkpoint, warm_start
from uuvtai.learn.anchor import Anchor, gaussian_kl
from uuvtai.learn.set_pilot import load_set_pilot
from uuvtai.learn.set_policy import SetActor, SetCritic
from uuvtai.learn.starting_policy import starting_policy
from uuvtai.learn.twin_trainer import TwinTrainer, joined, least_std
from uuvtai.learn.warm_start import Student, imitate, wish_of_command
from uuvtai.loader import load_training
from uuvtai.outcomes import COLLISION, RUNNING, SUCCESS
from uuvtai.twin import failure_states, hull_rule
from uuvtai.twin.failure_states import ARRAYS, FailureStarts
from uuvtai.twin.observer import SET_TABLE
from uuvtai.twin.scenario_bank import ScenarioBank
from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS
from uuvtai.twin.twin_arrays import TRUTH_WIDTH
from uuvtai.twin.twin_world import Twin

SWITCHES = {
    "twin.anchor": 0.5,
    "twin.anchor_until": 1.0,
    "twin.last_std": 0.1,
    "twin.explore_until": 0.25,
    "twin.failure_starts": 0.5,
    "twin.curriculum_until": 0.5,
    "twin.critic_sees_truth": False,
    "ppo.rollout_steps": 32,
}


@ti.kernel
def velocities(wish: FloatMatrix, flip: FloatMatrix, vehicle: Const[VehicleConfig], out: FloatMatrix):
    for i in range(wish.shape[0]):
        found = hull_rule.wished_velocity(wish[i, 0], wish[i, 1], wish[i, 2], flip[i, 0], flip[i, 1], vehicle)
        for j in ti.static(range(3)):
            out[i, j] = found[j]


@pytest.fixture(scope="module")
def bank(small):
    return small.scenario_bank()


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Checkpoint of a policy of the twin."""
    config = load_training("twin", overrides=SMALL)
    actor = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator().manual_seed(1))
    state = {"policy": actor.state_dict(), "counters": {}, "env": {}}
    return checkpoint.save(tmp_path_factory.mktemp("policy") / "checkpoints", 1, state, config, SET_TABLE)


@pytest.fixture(scope="module")
def config(policy):
    return load_training("twin", overrides=SMALL | SWITCHES | {"twin.start": str(policy)})


@pytest.fixture(scope="module")
def trainer(config, bank):
    """With every switch on, after two iterations."""
    made = TwinTrainer(config, bank)
    made.begin_with(starting_policy(config))
    made.iterate()
    made.iterate()
    return made


# ----------------------------------------------------------------------------------------------- all of them


def test_it_goes_on_bit_for_bit_without_the_file_it_began_with(trainer, config, bank):
    gone = config.model_copy(update={"twin": config.twin.model_copy(update={"start": "gone"})})
    other = TwinTrainer(gone, bank)
    other.load_state(copy.deepcopy(trainer.state()))
    kept = copy.deepcopy(trainer.state())
    ours, theirs = trainer.iterate(), other.iterate()
    after, found = trainer.state(), other.state()
    trainer.load_state(kept)
    same = [name for name in ours if not name.startswith("time/")]
    assert {n: ours[n] for n in same} == {n: theirs[n] for n in same}
    for part in ("policy", "critic", "anchor"):
        assert all(torch.equal(after[part][name], found[part][name]) for name in after[part])
    assert all(np.array_equal(after["env"][name], found["env"][name]) for name in after["env"])
    assert kept["env"]["failures.counts"][1] > 0, "nobody failed: nothing was compared"


def test_what_drives_has_no_part_of_it(trainer, config, small, tmp_path):
    path = checkpoint.save(tmp_path / "checkpoints", 2, trainer.state(), config, trainer.observation_table)
    found = checkpoint.open_checkpoint(path)
    assert list(found.model()) == ["policy"]
    own = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator()).state_dict()
    assert {n: t.shape for n, t in found.model()["policy"].items()} == {n: t.shape for n, t in own.items()}
    assert trainer.observation_table == SET_TABLE
    assert load_set_pilot(found, small.sim).decide(torch.zeros(0)).action.shape == (small.N, 4)


def test_a_saved_training_goes_on_with_its_anchor(trainer, config, bank, policy, tmp_path):
    path = checkpoint.save(tmp_path / "checkpoints", 2, trainer.state(), config, trainer.observation_table)
    other = TwinTrainer(config, bank)
    other.load_state(checkpoint.open_checkpoint(path).state(like=other.state()))
    first = checkpoint.open_checkpoint(policy).model()["policy"]
    anchor = other.state()["anchor"]
    assert all(torch.equal(anchor[name], first[name]) for name in first)
    assert not torch.equal(other.state()["policy"]["log_std"], first["log_std"])


def test_switched_off_nothing_is_kept(bank):
    state = TwinTrainer(load_training("twin", overrides=SMALL), bank).state()
    assert "anchor" not in state and not [name for name in state["env"] if "failures" in name]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"twin.anchor": 0.5}, "anchor needs a policy"),
        ({"twin.start": "a", "twin.warm_start_waves": 2}, "exclude each other"),
        ({"twin.last_std": 0.3}, "twin.last_std=0.3"),
        ({"twin.failure_starts": 1.0}, "failure_starts"),
        ({"twin.failure_starts": 0.2, "twin.simulator": True}, "twin.failure_starts"),
        ({"twin.curriculum_until": 0.2, "twin.simulator": True}, "twin.curriculum_until"),
        ({"twin.curriculum_until": 1.1}, "curriculum_until"),
        ({"twin.explore_until": 1.0}, "explore_until"),
        ({"twin.anchor_until": 0.0}, "anchor_until"),
    ],
)
def test_values_without_a_meaning_are_refused(bank, changes, says):
    with pytest.raises(UserError, match=says):
        TwinTrainer(load_training("twin", overrides=SMALL | changes), bank)


def test_what_clearly_pays_is_the_presets():
    twin, quick = load_training("twin").twin, load_training("quick").twin
    assert twin.warm_start_waves > 0 and twin.anchor > 0
    assert (quick.warm_start_waves, quick.anchor) == (0, 0), "it learns from nothing"
    assert (twin.failure_starts, twin.last_std, twin.curriculum_until) == (0, 0, 0)
    assert twin.critic_sees_truth


# ---------------------------------------------------------------------------------------------- a trained one


def test_it_begins_as_the_policy_that_is_named(config, bank, policy):
    trainer = TwinTrainer(config, bank)
    critic = copy.deepcopy(trainer.critic.state_dict())
    trainer.begin_with(starting_policy(config))
    named = checkpoint.open_checkpoint(policy).model()["policy"]
    assert all(torch.equal(tensor, named[name]) for name, tensor in trainer.actor.state_dict().items())
    assert all(torch.equal(tensor, critic[name]) for name, tensor in trainer.critic.state_dict().items())


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"twin.start": "nowhere"}, "nowhere"),
        ({"twin.body_hidden": 16}, "twin.body_hidden=8, this run 16"),
        ({"twin.goal_gain": 0.5}, "twin.goal_gain=0.7"),
        ({"vehicle.max_surge_m_s": 0.5}, "action table"),
    ],
)
def test_a_start_that_does_not_fit_is_refused(policy, changes, says):
    options = SMALL | {"twin.start": str(policy)} | changes
    with pytest.raises(UserError, match=says):
        starting_policy(load_training("twin", overrides=options))


# --------------------------------------------------------------------------------------------------- the tree


def test_a_command_becomes_the_wish_with_its_velocity():
    rng, vehicle = np.random.default_rng(0), VehicleConfig()
    command = torch.from_numpy(rng.uniform(-1, 1, (200, 4)).astype(np.float32))
    yaw = torch.from_numpy(rng.uniform(-np.pi, np.pi, 200).astype(np.float32))
    flip = torch.from_numpy(rng.choice([-1.0, 1.0], (200, 2)).astype(np.float32))
    out = torch.zeros(200, 3)
    velocities(wish_of_command(command, yaw, flip, vehicle), flip, vehicle, out)
    surge, sway = vehicle.max_surge_m_s * command[:, 0], vehicle.max_sway_m_s * command[:, 1]
    expected = [
        yaw.cos() * surge - yaw.sin() * sway,
        yaw.sin() * surge + yaw.cos() * sway,
        vehicle.max_heave_m_s * command[:, 2],
    ]
    np.testing.assert_allclose(out, torch.stack(expected, dim=1), atol=1e-5)


def test_it_learns_what_the_tree_says(small, monkeypatch):
    monkeypatch.setattr(warm_start, "PASSES", 1)
    losses, decisions = [], []
    config = load_training("twin", overrides=SMALL | {"train.num_envs": small.N, "twin.warm_start_waves": 2})
    for passes in (1, 20):
        monkeypatch.setattr(warm_start, "LAST_PASSES", passes)
        actor = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator().manual_seed(1))
        std = actor.log_std.detach().clone()
        found = imitate(actor, config, ((8, 6, 0.6),), {"pool": small.sim})
        losses.append(found["warm_start/loss"])
        decisions.append(found["warm_start/decisions"])
        assert torch.equal(actor.log_std, std), "its mean alone is fitted"
    assert losses[1] < 0.9 * losses[0] and decisions[0] > 100 * small.N / 2


def test_the_tree_alone_drives_as_without_a_student(small):
    config = load_training("twin", overrides=SMALL)
    actor = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator().manual_seed(1))
    student = Student(actor, small.sim, config, torch.Generator().manual_seed(0))
    small.begin(range(small.N), seed=9)
    student.reset(torch.ones(small.N))
    for share, driver in ((1.0, small.sim.action), (0.0, None)):
        student.tree_share = share
        said = student.decide(small.sim.action).action
        expected = student.decision.action if driver is None else driver
        assert torch.equal(said, expected)
    assert len(student.samples) == 2 and len(student.samples[0].wish) == small.N


# ------------------------------------------------------------------------------------------- anchor and floor


def test_the_divergence_is_that_of_the_distributions():
    mean, other = torch.randn(50, 3), torch.randn(50, 3)
    log_std, other_log_std = 0.3 * torch.randn(3), 0.3 * torch.randn(3)
    ours, theirs = (
        torch.distributions.Normal(m, s.exp()) for m, s in ((mean, log_std), (other, other_log_std))
    )
    expected = torch.distributions.kl_divergence(ours, theirs).sum(-1)
    assert torch.allclose(gaussian_kl(mean, log_std, other, other_log_std), expected, atol=1e-5)
    assert torch.allclose(gaussian_kl(mean, log_std, mean, log_std), torch.zeros(50))


def test_the_anchor_holds_and_fades(config, bank):
    @torch.no_grad()
    def gap(actor, other, view):
        return float((actor(view.bodies, view.own) - other(view.bodies, view.own)).square().mean())

    def moved(weight):
        twin = config.twin.model_copy(update={"anchor": weight, "failure_starts": 0.0})
        trainer = TwinTrainer(config.model_copy(update={"twin": twin}), bank)
        trainer.begin_with(starting_policy(config))
        first = copy.deepcopy(trainer.actor)
        trainer.iterate()
        return gap(trainer.actor, first, trainer.twin.view)

    assert moved(1e4) < 0.5 * moved(1e-6)
    anchor = Anchor(SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator()), 0.4, 0.5)
    assert [anchor.weight(share) for share in (0.0, 0.25, 0.5, 0.9)] == [0.4, 0.2, 0.0, 0.0]


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


# ------------------------------------------------------------------------------------------------ the figures


def test_a_gain_has_students_interval():
    assert gain_of([1.0, 2.0, 3.0]) == "+2.0 [-0.5, +4.5]"  # 4.303 / sqrt 3


def test_a_run_counts_once_its_end_is_evaluated():
    row = {"time/env_steps": 10.0, "time/simulate_s": 1.0, "time/learn_s": 2.0, "train/std": 0.3}
    last = row | {"eval/success_rate": 0.5, "eval/success_pool_9_1.5": 0.4}
    assert entry_of(ARMS[1], 2, [row]) is None
    entry = entry_of(ARMS[1], 2, [row, last])
    assert entry is not None and entry["success"] == {"all": 0.5, "pool_9_1.5": 0.4}
    assert entry["seconds"] == 6 and entry["command"].startswith("uuv train twin --seed 2 ")
