"""The tree's numbers as a training changes them: factors in the kernels, the search, resuming, refusals."""

import math

import numpy as np
import pytest
import taichi as ti
import torch

from tests.bundles import Stage, put
from tests.conftest import configure
from uuvtai.common.errors import UserError
from uuvtai.config import FastConfig, SlowConfig
from uuvtai.config.behavior import (
    DEVIATION,
    FAST,
    HEADING_RANGE,
    HORIZON,
    HYSTERESIS,
    RANGE,
    SLOW,
    TTC,
    TUNED,
    log_bounds,
)
from uuvtai.config.loader import load_config, load_training, with_stack
from uuvtai.evaluation.episodes import jobs_of, run_episodes
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.kernels.behavior.rollout import tuned
from uuvtai.kernels.core.stage import AnyTensor, Bundle
from uuvtai.learning import checkpoint, parameter_search
from uuvtai.learning.agents import TunedAgent, load_tuned, tuned_sections
from uuvtai.learning.checkpoint import CheckpointError
from uuvtai.learning.policy_agent import load_agent
from uuvtai.sim.setup import fill_constants

SMALL = {
    "train.num_envs": 8,
    "train.iterations": 4,
    "train.evaluate_episodes": 4,
    "parameter_search.scenes": [["pool", 8, 6, 0.6], ["pool", 8, 6, 1.5]],
    "parameter_search.warm_up": 0.5,
}


@pytest.fixture(scope="module")
def config():
    return load_training("best", overrides=SMALL)


@pytest.fixture(scope="module")
def trainer(config, small):
    """After three iterations: slow obstacles, fast ones, slow ones; ``centres``: before and after each."""
    made = parameter_search.ParameterSearchTrainer(config, {"pool": small.sim})
    made.centres = [made.centre]
    for _ in range(3):
        made.iterate()
        made.centres.append(made.centre)
    return made


# ------------------------------------------------------------------------------------------- response surface


def test_the_surface_finds_what_made_the_scores():
    rng = np.random.default_rng(0)
    spread = np.array([0.5, 1.0, 2.0])
    way = rng.uniform(-1, 1, (10000, 3)) * spread
    place = np.stack([way, -way], 1).reshape(20000, 3)
    x, group = place / spread, np.repeat(rng.integers(0, 2, 10000), 2)
    score = 0.6 + 0.1 * group + 0.04 * x[:, 0] - 0.02 * (x[:, 1] - 0.3) ** 2 + rng.normal(0, 0.03, 20000)
    score += np.repeat(rng.normal(0, 0.03, 10000), 2)  # what makes an episode easy, for both of its trials
    slope, bend = parameter_search.fitted(place, score, group, spread)
    assert slope == pytest.approx([0.04, 0.012, 0.0], abs=0.004)
    assert bend == pytest.approx([0.0, -0.02, 0.0], abs=0.004)
    found = parameter_search.best_near(np.zeros(3), slope, bend, spread, -2 * spread, 2 * spread)
    assert found[0] == pytest.approx(0.25), "a slope: as far as a step goes"
    assert found[1] == pytest.approx(0.3, abs=0.08), "a top within the step"


def test_a_step_stays_within_the_bounds():
    one = np.ones(1)
    assert parameter_search.best_near(0 * one, one, 0 * one, one, -one, 0.2 * one) == pytest.approx(0.2)
    assert parameter_search.best_near(0 * one, -one, one, one, -0.1 * one, one) == pytest.approx(-0.1)


def test_few_trials_are_not_believed():
    rng = np.random.default_rng(1)
    place = rng.uniform(-1, 1, (200, 2))
    slope, bend = parameter_search.fitted(
        place, rng.integers(0, 2, 200).astype(float), np.zeros(200, int), np.ones(2)
    )
    assert np.abs(slope).max() < 0.03 and np.abs(bend - parameter_search.BEND_MEAN).max() < 0.02


# ------------------------------------------------------------------------------------------------ the numbers


def test_every_number_is_one_of_the_config(config):
    for number in TUNED:
        assert getattr(config.behavior, number.name) > 0
        assert getattr(config.slow, number.name) == getattr(config.fast, number.name) == 1.0
        assert 0 < number.least < 1 <= number.most
    assert [TUNED[i].name for i in (DEVIATION, HORIZON, TTC, RANGE, HEADING_RANGE)] == [
        "weight_deviation", "horizon_s", "emergency_ttc_s", "emergency_range_m", "heading_range_m",
    ]  # fmt: skip
    low, high = log_bounds()
    assert low[TTC] == pytest.approx(math.log(0.15)) and high[HORIZON] == 0.0


def ends(sim, log_factor=None):
    """(outcome, time) of eight episodes, by the tree or with factors on its numbers."""
    agent = None if log_factor is None else TunedAgent(log_factor, sim)
    results, _ = run_episodes(sim, jobs_of([77], 8), agent=agent)
    return [(result.outcome, result.time_s, result.path_length_m) for result in results]


@ti.kernel
def _factors(out: AnyTensor, io: Bundle[BehaviorIO]):
    for env in out:
        out[env] = tuned(env, HYSTERESIS, io)


def test_what_holds_follows_from_the_speed_of_the_obstacles():
    stage, out = Stage(n_env=4, n_node=1, n_candidate=16, n_tuned=len(TUNED)), np.zeros(4, np.float32)
    factors = np.zeros((4, len(TUNED), 2), np.float32)
    factors[:, HYSTERESIS] = np.log([4.0, 0.25])
    put(stage.behavior, tuned=factors, alert=[-1.0, 0.0, 0.5, 1.0])
    _factors(out, stage.io(BehaviorIO))
    assert out == pytest.approx([4.0, 4.0, 1.0, 0.25]), "nothing tracked, slow, between, fast"


def test_factors_hold_among_the_obstacles_that_they_are_for(small, monkeypatch):
    """Ten seconds tell."""
    sim, alike = small.sim, {}
    episode = small.config.episode.model_copy(update={"horizon_steps": 500})
    configure(monkeypatch, sim, small.config.model_copy(update={"episode": episode}))
    for obstacles, speed in ((SLOW, 0.6), (FAST, 1.5)):
        sim.set_scenes([(8, 6, speed)])
        usual = ends(sim)
        for part in (SLOW, FAST):
            other = torch.zeros(len(TUNED), 2)
            other[DEVIATION, part] = math.log(TUNED[DEVIATION].least)
            found = zip(ends(sim, other), usual, strict=True)
            alike[part, obstacles] = sum(a == b for a, b in found)
        if obstacles == SLOW:
            assert ends(sim) == usual, "a reset sets the numbers back"
        else:
            assert ends(sim, torch.zeros(len(TUNED), 2)) == usual, "factors of one change nothing"
    assert alike[SLOW, SLOW] <= 2 and alike[FAST, FAST] <= 2, f"{alike} of 8"
    assert alike[FAST, SLOW] >= 4, f"{alike} of 8: a slow obstacle is now and then thought to be fast"
    sim.set_scenes()


def test_every_row_has_its_own_numbers(small):
    sim = small.sim
    rows = torch.arange(sim.num_envs, dtype=torch.int32)
    sim.sleep()
    sim.reset(torch.ones_like(rows), torch.full_like(rows, 77), rows)
    pilot = TunedAgent(torch.zeros(len(TUNED), 2), sim)
    pilot.log_factor[1, TTC, FAST] = -1.0
    pilot.reset(torch.ones_like(rows))
    held = sim.rows(sim.s.behavior.tuned)
    assert held[1, TTC, FAST] == -1.0 and np.count_nonzero(held) == 1
    assert torch.equal(pilot.decide(sim.action).action, sim.action)
    sim.sleep()


# ----------------------------------------------------------------------------------------------- the training


def test_a_training_moves_the_numbers_within_their_bounds(trainer):
    low, high = (torch.tensor(side)[:, None] for side in log_bounds())
    assert [search.trials for search in trainer.searches] == [16, 8] and trainer.env_steps > 24
    assert bool((trainer.centre != 0).any(0).all())
    assert bool(((trainer.centre >= low - 1e-6) & (trainer.centre <= high + 1e-6)).all())
    names = {f"{part}/{number.name}" for number in TUNED for part in ("slow", "fast")}
    assert set(trainer.factors()) == names


def test_trials_come_in_mirrored_pairs():
    search = parameter_search.NumberSearch(torch.zeros(len(TUNED)), torch.tensor(log_bounds()), 0.3, 2000, 0)
    drawn = search.drawn(2000)
    inside = (drawn > search.low) & (drawn < search.high)
    both = inside[0::2] & inside[1::2]
    assert bool(both.float().mean() > 0.5)
    assert torch.equal(drawn[0::2][both], -drawn[1::2][both])
    assert bool((drawn.abs() <= search.spread + 1e-6).all())


def test_trials_of_one_kind_of_obstacles_leave_the_other_s_numbers_alone(trainer):
    began, first, second, _ = trainer.centres
    assert torch.equal(first[:, FAST], began[:, FAST])
    assert torch.equal(second[:, SLOW], first[:, SLOW])
    assert not torch.equal(second[:, FAST], began[:, FAST])


def test_a_search_goes_on_from_the_config_s_numbers(small):
    config = load_training("best", overrides=SMALL | {"slow.hysteresis_s": 2.0, "fast.hysteresis_s": 0.5})
    made = parameter_search.ParameterSearchTrainer(config, {"pool": small.sim})
    assert made.centre[HYSTERESIS].tolist() == pytest.approx([math.log(2.0), math.log(0.5)])


def test_a_scene_that_is_neither_slow_nor_fast_is_refused():
    config = load_training("best", overrides=SMALL | {"parameter_search.scenes": [["pool", 8, 6, 1.0]]})
    with pytest.raises(UserError, match=r"1 m/s, in pool, are neither slow \(fast\.from_m_s, 0\.8"):
        parameter_search.ParameterSearchTrainer(config)


def test_arrivals_count_and_early_ones_more(trainer):
    from uuvtai.common.enums import COLLISION, SUCCESS

    outcome, steps = torch.tensor([SUCCESS, SUCCESS, COLLISION]), torch.tensor([500, 1000, 100])
    assert trainer._scored(outcome, steps, FAST).tolist() == pytest.approx([1 - 0.05, 1 - 0.1, 0.0])
    assert trainer._scored(outcome, steps, SLOW).tolist() == pytest.approx([1 - 0.1, 1 - 0.2, 0.0])


def test_an_evaluation_changes_nothing(trainer):
    before = trainer.state()
    metrics = trainer.evaluate()
    assert {"eval/success_rate", "eval/success_pool_6_0.6", "eval/success_pool_6_1.5"} <= set(metrics)
    after = trainer.state()
    for own, other in zip(before["searches"], after["searches"], strict=True):
        assert torch.equal(own["generator"], other["generator"])
    assert before["counters"] == after["counters"]


def test_a_resumed_training_has_the_same_bits(trainer, config, small, tmp_path):
    path = checkpoint.save(tmp_path / "checkpoints", 3, trainer.state(), config, trainer.observation_table)
    found = checkpoint.open_checkpoint(path)
    other = parameter_search.ParameterSearchTrainer(config, {"pool": small.sim})
    other.load_state(found.state(like=other.state()))
    first = parameter_search.ParameterSearchTrainer(config, {"pool": small.sim})
    first.load_state(trainer.state())
    assert first.iterate()["rollout/success_rate"] == other.iterate()["rollout/success_rate"]
    assert torch.equal(first.centre, other.centre)


# --------------------------------------------------------------------------------------------- what it leaves


@pytest.fixture
def saved(trainer, config, tmp_path):
    """Function: a checkpoint with these factors (logarithms)."""

    def save(log_factor):
        state = trainer.state() | {"tree": {"log_factor": log_factor}}
        path = checkpoint.save(tmp_path / "checkpoints", 3, state, config, trainer.observation_table)
        return checkpoint.open_checkpoint(path)

    return save


def test_a_checkpoint_drives(saved, trainer, small):
    pilot = load_tuned(saved(trainer.centre), small.sim)
    assert torch.equal(torch.from_numpy(pilot.log_factor[0]), trainer.centre)
    assert pilot.log_factor.shape[0] >= small.sim.num_envs


def test_a_checkpoint_from_before_a_number_leaves_it_as_it_is(saved, trainer, small):
    older = trainer.centre[:-1].clone()
    pilot = load_tuned(saved(older), small.sim)
    assert torch.equal(torch.from_numpy(pilot.log_factor[0, :-1]), older)
    assert not pilot.log_factor[:, -1].any()


@pytest.mark.parametrize(
    "wrong",
    [
        torch.zeros(3, 2),
        torch.zeros(len(TUNED) + 1, 2),
        torch.full((len(TUNED), 2), 5.0),
        torch.full((len(TUNED), 2), float("nan")),
    ],
    ids=["too few", "too many", "beyond the bounds", "not finite"],
)
def test_numbers_that_no_training_leaves_are_refused(saved, small, wrong):
    with pytest.raises(CheckpointError, match="holds no numbers of the tree"):
        load_tuned(saved(wrong), small.sim)


def test_an_export_says_what_to_do_instead(saved, trainer):
    with pytest.raises(UserError, match=r"stack\.yaml"):
        load_agent(saved(trainer.centre), 1)


def test_a_stack_holds_the_factors():
    log_factor = torch.full((len(TUNED), 2), math.log(0.51234))
    log_factor[:, FAST] = math.log(2.0)
    sections = tuned_sections(log_factor)
    assert sections["slow"] == {number.name: 0.5123 for number in TUNED}
    assert SlowConfig(**sections["slow"]).temperature == 0.5123
    assert FastConfig(**sections["fast"]).temperature == 2.0


def test_the_config_s_factors_are_what_a_reset_sets(small):
    """As a run with them would be, without another simulator: what they are in the arrays."""
    sim, config = (
        small.sim,
        load_config("pool", overrides=[("fast.hysteresis_s", 2.0), ("slow.hysteresis_s", 3.0)]),
    )
    put, factor = {}, sim.s.table.factor
    assert not factor.to_numpy().any()
    fill_constants(sim.s, config, lambda field, values: put.setdefault(id(field), values))
    assert put[id(factor)][HYSTERESIS] == pytest.approx(np.log([3.0, 2.0]))
    assert np.count_nonzero(put[id(factor)]) == 2


def test_the_shipped_stack_holds_factors_that_a_training_can_find():
    usual = load_config("pool")
    ours = with_stack(usual, "best")
    for number in TUNED:
        for section in (ours.slow, ours.fast):
            assert number.least <= getattr(section, number.name) <= number.most, number.name
    changed = ("slow", "fast", "tracking", "forecast", "quiet", "route", "behavior")
    own = {name: getattr(usual, name) for name in changed}
    assert ours.model_copy(update=own) == usual
    brisk = {"heading_clearance_m": 0.48, "slow_fraction": 1.0, "patience_s": 0.0, "travel_diagonal": True}
    assert ours.behavior == usual.behavior.model_copy(update=brisk)
    assert ours.route == usual.route.model_copy(update={"lookahead_m": 0.8})
    assert ours.quiet == usual.quiet.model_copy(update={"room_m": 0.8})
    assert ours.tracking == usual.tracking.model_copy(update={"partial_sigmas": 2.0})
    assert ours.forecast == usual.forecast.model_copy(update={"learned": "built-in"})
