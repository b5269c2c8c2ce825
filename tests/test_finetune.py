"""Fine-tuning in the full simulator: what the actor is shown, what the critic knows, the reward, where it
begins, going on bit for bit."""

import copy
import dataclasses
import shutil

import numpy as np
import pytest
import torch

from tests.test_architecture import TRUTH
from tests.test_training import Quiet, content_of, notes
from uuvtai.binding import bind, members_of
from uuvtai.closed_form import body_positions, describe_scenario
from uuvtai.config.learning import LearningConfig
from uuvtai.errors import UserError
from uuvtai.learn import checkpoint, simulated_world, starting_policy
from uuvtai.learn.held_out import play_held_out
from uuvtai.learn.manifest import CheckpointError
from uuvtai.learn.pilot import by_chunk
from uuvtai.learn.run import TrainRequest, train
from uuvtai.learn.set_pilot import SetPilot, actor_of
from uuvtai.learn.set_policy import SetActor, SetCritic
from uuvtai.learn.simulated_world import SIMULATOR_SEED, SimulatedWorld
from uuvtai.learn.twin_trainer import TwinTrainer
from uuvtai.loader import load_training
from uuvtai.measure.episodes.playing import jobs_of, run_episodes
from uuvtai.measure.evaluate.while_training import evaluate_now
from uuvtai.outcomes import COLLISION, OUTCOMES, RUNNING, SUCCESS, TIMEOUT
from uuvtai.twin.observer import SET_TABLE
from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, N_BODY
from uuvtai.twin.simulator_truth import SAME_M, reward_decisions, see_truth
from uuvtai.twin.twin_arrays import EGO_WIDTH, RAW_WIDTH, TRUTH_WIDTH, ObserverIO, TrueBodiesIO, TwinRules

SCENES = ((8, 6, 0.6),)
NET = {"twin.body_hidden": 8, "twin.head_hidden": 8}
SMALL = NET | {
    "train.num_envs": 8,
    "ppo.rollout_steps": 12,
    "ppo.minibatches": 2,
    "train.evaluate_episodes": 8,
    "train.scenes": [list(SCENES[0])],
    "train.iterations": 4,
    "twin.worlds": ["pool"],
    "twin.critic_warmup_iterations": 1,
}
PLACE_TOL_M = 2e-3
"""of a body's place in float32, some tens of seconds after the begin"""
EVERY = torch.ones(8, dtype=torch.bool)


@torch.no_grad()
def said(actor, view):
    """(8, 3) what an actor wishes."""
    return by_chunk(actor, view.bodies, view.own)


@pytest.fixture(scope="module")
def config():
    return load_training("finetune", overrides=SMALL)


@pytest.fixture(scope="module")
def actor(config):
    """Straight to the goal, a little up and down and aside with what it sees."""
    made = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator().manual_seed(1))
    for parameter in made.net.parameters():
        torch.nn.init.normal_(parameter, std=0.08, generator=torch.Generator().manual_seed(2))
    return made


@pytest.fixture
def world(config, small):
    return SimulatedWorld(config, SCENES, {"pool": small.sim})


@pytest.fixture
def start(actor, tmp_path):
    """Function: a checkpoint to begin with, with a critic or without, of a config with ``changes``."""

    def save(with_critic=True, **changes):
        keys = {name.replace("__", "."): value for name, value in changes.items()}
        config = load_training("twin", overrides=NET | keys)
        critic = SetCritic(BODY_WIDTH, EGO_COLUMNS, TRUTH_WIDTH, config, torch.Generator().manual_seed(3))
        state = {"policy": actor.state_dict(), "env": {}}
        state |= {"critic": critic.state_dict()} if with_critic else {}
        path = checkpoint.save(tmp_path / "start" / "checkpoints", 1, state, config, SET_TABLE)
        return path, critic

    return save


# ------------------------------------------------------------------------------------------ what it is shown


def test_the_actor_is_shown_what_the_pilot_is_shown(world, small, actor):
    """Column for column, decision for decision, from the same states; the commands are the same too."""
    pilot = SetPilot(actor, small.sim, world._parts[0]._hold, world._parts[0].wheel._gap_m)
    world.begin(EVERY, torch.arange(8))
    pilot.reset(EVERY)
    seen = 0.0
    for decision in range(12):
        if decision == 7:  # others than the first ones begin
            rows = torch.arange(8) % 3 == 0
            world.begin(rows, torch.arange(8) + 100)
            pilot.reset(rows.int())
        view = world.look()
        command = pilot.decide(torch.zeros(0)).action
        assert torch.equal(view.bodies, pilot.bodies) and torch.equal(view.own, pilot.own)
        told = world._parts[0].wheel
        told.wish.copy_(pilot.wish)
        assert torch.equal(told.command(), command)
        world.step(said(actor, view))
        assert torch.equal(told.wish, pilot.wish)
        for _ in range(5):
            pilot.advance()
        seen += float(view.bodies[..., 0].sum())
    assert seen > 8, "tracks were among it"


def test_it_drives_as_the_pilot_does(world, small, actor):
    outcome, time_s, origin = play_held_out(world, actor, 31, 9)
    pilot = SetPilot(actor, small.sim, 5, world._parts[0].wheel._gap_m)
    results, _ = run_episodes(small.sim, jobs_of([31], 9), driver=pilot)
    assert [OUTCOMES[code] for code in outcome] == [result.outcome for result in results]
    np.testing.assert_allclose(time_s, [result.time_s for result in results], atol=1e-3)
    assert set(origin.tolist()) == {0} and len(set(outcome.tolist())) > 1


def test_what_drives_knows_nothing_that_only_the_simulator_knows():
    assert not set(members_of(ObserverIO).values()) & TRUTH
    assert set(members_of(TrueBodiesIO).values()) & TRUTH


# -------------------------------------------------------------------------------------- what the critic knows


def test_the_truth_is_that_of_the_closed_form(world, small, actor):
    """Every body once, where it is now and in 1, 2 and 3 s, in the mirrored frame, beside its track."""
    world.begin(EVERY, torch.arange(8))
    for _ in range(25):
        view = world.look()
        world.step(said(actor, view))
    view, rows, sim = world.look(), small.sim.rows, small.sim
    goal, begun, own = rows(sim.s.mission.goal_w), rows(sim.s.mission.start_w), rows(sim.s.vehicle.pos_w)
    flip, paired = np.where(goal[:, :2] >= begun[:, :2], 1.0, -1.0), 0
    for row in range(8):
        arrays = {k: v[row] for k, v in small.arrays("world", "path", "mission").items()}
        now_s = float(rows(sim.s.clock.step)[row]) * sim.config.episode.control_dt_s
        ways = [
            (body_positions(body, now_s + np.arange(4.0))[:, :2], body)
            for body in describe_scenario(lambda name, arrays=arrays: arrays[name])["bodies"]
            if body["path"]
        ]
        found = view.truth[row].numpy()
        there = found[found[:, 2] > 0]
        assert len(there) == len(ways) == 6
        left = list(ways)
        for lane in there:
            at = np.stack([lane[0:2], lane[4:6], lane[6:8], lane[8:10]]) * 4 * flip[row] + own[row, :2]
            way = min(left, key=lambda pair: abs(pair[0] - at).max())
            left = [pair for pair in left if pair is not way]
            np.testing.assert_allclose(at, way[0], atol=PLACE_TOL_M)
            over = way[1]["position"][2] - way[1]["size"][2] - own[row, 2]
            assert lane[3] == pytest.approx(np.clip(over, -1.6, 1.6), abs=PLACE_TOL_M)
        tracked = (view.bodies[row, :, 0] > 0).numpy() & (found[:, 2] > 0)
        paired += int(tracked.sum())
        gap = 4 * abs(view.bodies[row].numpy()[tracked, 1:3] - found[tracked, :2])
        assert (gap <= SAME_M + 0.3).all()
    assert paired > 8, "bodies that are tracked share a lane with their tracks"


def test_lanes_by_hand(small, world):
    """A track takes the body nearest to it; the others fill lanes without a track, the nearest first."""
    world.begin(EVERY, torch.arange(8))
    sim, part = small.sim, world._parts[0]
    world.look()
    first = sim.rows(sim.s.world.kind).shape[1] - part._path.shape[1]
    places = sim.rows(sim.s.world.pos_w)[0, first : first + 6, :2]
    own = sim.rows(sim.s.vehicle.pos_w)[0, :2]
    raw = torch.zeros(8, N_BODY, RAW_WIDTH)
    raw[0, 0, :2], raw[0, 0, 13] = torch.from_numpy(places[4] + [0.05, 0.0]), 1.0
    raw[0, 1, :2], raw[0, 1, 13] = torch.tensor([-50.0, 0.0]), 1.0  # nothing is there
    truth, known = torch.zeros(8, N_BODY, TRUTH_WIDTH), torch.zeros(8, part._path.shape[1], TRUTH_WIDTH)
    see_truth(bind(TrueBodiesIO, sim.s, sim.config), part._path, raw, torch.zeros(8, EGO_WIDTH), known, truth)
    order = sorted((n for n in range(6) if n != 4), key=lambda n: float(np.linalg.norm(places[n] - own)))
    assert torch.equal(truth[0, 0], known[0, 4]) and not truth[0, 1].any()
    assert [int((known[0] == lane).all(-1).nonzero()[0]) for lane in truth[0, 2:7]] == order
    assert not truth[0, 7:].any()


# --------------------------------------------------------------------------------------------------- rewards


def test_rewards_by_hand(config):
    rules = bind(TwinRules, config)
    twin = config.twin
    nearer, nearest = torch.tensor([0.08, 0.0, -0.02, 0.1]), torch.tensor([9.0, 0.25, 0.05, 2.0])
    ended = torch.tensor([RUNNING, TIMEOUT, COLLISION, SUCCESS], dtype=torch.int32)
    reward = torch.zeros(4)
    reward_decisions(rules, nearer, nearest, ended, reward)
    close = (1.0 - nearest / twin.soft_clearance_m).clamp(0.0, 1.0)
    expected = twin.progress * nearer - 0.1 * (twin.time_cost + twin.closeness_cost * close)
    assert torch.allclose(reward, expected + torch.tensor([0.0, 0.0, -1.0, 1.0]), atol=1e-6)


def test_rewards_are_of_the_simulators_truth(world, small, actor):
    """Progress and the smallest clearance of the steps of a decision, as the referee keeps them."""
    world.begin(EVERY, torch.arange(8))
    sim, twin = small.sim, world._rules.twin_cfg
    kept, step, differ = [], sim.step, 0

    def noting(action):
        step(action)
        kept.append(sim.rows(sim.s.referee.clearance_m).copy())

    sim.step = noting
    try:
        for _ in range(60):
            view, kept[:] = world.look(), []
            way = sim.rows(sim.s.mission.goal_w) - sim.rows(sim.s.vehicle.pos_w)
            reward, outcome = world.step(said(actor, view))
            after = sim.rows(sim.s.mission.goal_w) - sim.rows(sim.s.vehicle.pos_w)
            nearer = np.linalg.norm(way, axis=1) - np.linalg.norm(after, axis=1)
            close = np.clip(1.0 - np.min(kept, axis=0) / twin.soft_clearance_m, 0.0, 1.0)
            expected = twin.progress * nearer - 0.1 * (twin.time_cost + twin.closeness_cost * close)
            running = outcome.numpy() == RUNNING
            nearest_before_the_end = (kept[-1] > np.min(kept, axis=0)) & (close > 0.0) & running
            differ += int(nearest_before_the_end.sum())
            assert len(kept) == 5 and running.any()
            np.testing.assert_allclose(reward.numpy()[running], expected[running], atol=1e-5)
    finally:
        del sim.step
    assert differ > 0


# ------------------------------------------------------------------------------------------ where it begins


def test_it_begins_as_the_policy_that_it_is_given(start, config):
    path, critic = start()
    for place in (path, path.parent.parent):
        run = load_training("finetune", overrides=SMALL | {"twin.start": str(place)})
        found = starting_policy.starting_policy(run)
        own = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator().manual_seed(9))
        judge = SetCritic(BODY_WIDTH, EGO_COLUMNS, TRUTH_WIDTH, config, torch.Generator().manual_seed(9))
        found.give(own, judge)
        given = actor_of(checkpoint.open_checkpoint(path)).state_dict()
        for name, tensor in own.state_dict().items():
            if name == "log_std":
                assert torch.allclose(tensor.exp(), torch.full((3,), config.policy.initial_std))
            else:
                assert torch.equal(tensor, given[name])
        assert all(torch.equal(tensor, critic.state_dict()[n]) for n, tensor in judge.state_dict().items())


def test_without_a_critic_one_begins_anew(start, config):
    path, _ = start(with_critic=False)
    run = load_training("finetune", overrides=SMALL | {"twin.start": str(path)})
    judge = SetCritic(BODY_WIDTH, EGO_COLUMNS, TRUTH_WIDTH, config, torch.Generator().manual_seed(9))
    before = copy.deepcopy(judge.state_dict())
    own = SetActor(BODY_WIDTH, EGO_COLUMNS, config, torch.Generator())
    starting_policy.starting_policy(run).give(own, judge)
    assert all(torch.equal(tensor, before[n]) for n, tensor in judge.state_dict().items())


def test_the_twin_may_begin_with_a_policy_too(start):
    path, _ = start()
    given = NET | {"twin.start": str(path), "twin.warm_start_waves": 0}
    assert starting_policy.starting_policy(load_training("twin", overrides=given))
    assert starting_policy.starting_policy(load_training("twin", overrides=NET)) is None


# --------------------------------------------------------------------------------------------------- learning


@pytest.fixture(scope="module")
def learnt(config, small, actor):
    """After two iterations, the first of the critic alone."""
    made = TwinTrainer(config, sims={"pool": small.sim})
    made.actor.load_state_dict(actor.state_dict())
    made.nets = [copy.deepcopy((made.actor.state_dict(), made.critic.state_dict()))]
    for _ in range(2):
        made.iterate()
        made.nets.append(copy.deepcopy((made.actor.state_dict(), made.critic.state_dict())))
    made.kept = copy.deepcopy(made.state())
    return made


def same(one, other):
    return all(torch.equal(tensor, other[name]) for name, tensor in one.items())


def test_the_critic_learns_first(learnt):
    actors, critics = zip(*learnt.nets, strict=True)
    assert same(actors[0], actors[1]) and not same(actors[1], actors[2])
    assert not same(critics[0], critics[1])


def test_going_on_from_a_state_is_the_same_bit_for_bit(learnt, config, small):
    learnt.load_state(copy.deepcopy(learnt.kept))
    ours, after = learnt.iterate(), copy.deepcopy(learnt.state())
    small.forget()
    other = TwinTrainer(config, sims={"pool": small.sim})
    other.load_state(copy.deepcopy(learnt.kept))
    theirs = other.iterate()
    told = [name for name in ours if not name.startswith("time/")]
    assert {n: ours[n] for n in told} == {n: theirs[n] for n in told}
    assert same(after["policy"], other.state()["policy"])
    assert all(np.array_equal(array, other.twin.capture()[name]) for name, array in after["env"].items())


def test_a_run_that_was_stopped_goes_on_bit_for_bit(start, small, tmp_path, monkeypatch):
    """Also where the policy that it began with is gone."""
    monkeypatch.setattr(simulated_world, "simulator_of", lambda *_: small.sim)
    path, _ = start()
    changes = {"twin.start": str(path), "train.iterations": 2, "train.evaluate_every": 1}
    config = load_training("finetune", overrides=SMALL | changes)

    def play(run, **what):
        small.forget()
        train(TrainRequest(run_dir=run, **what), Quiet(), evaluate_now)

    play(tmp_path / "whole", config=config)
    play(tmp_path / "half", config=config, iterations=1)
    shutil.rmtree(path)
    small.forget()
    train(TrainRequest(resume=tmp_path / "half"), Quiet(), evaluate_now)
    assert notes(tmp_path / "whole") == notes(tmp_path / "half")
    ends = [content_of(tmp_path / run / "checkpoints" / "step_000002") for run in ("whole", "half")]
    assert ends[0] == ends[1] and len(ends[0]) == 3


def test_an_evaluation_leaves_no_trace(learnt):
    learnt.load_state(copy.deepcopy(learnt.kept))
    before, seen = learnt.twin.capture(), [tensor.clone() for tensor in learnt.twin.view]
    first = learnt.evaluate()
    assert learnt.evaluate() == first and {"eval/success_rate", "eval/success_pool_6_0.6"} <= set(first)
    after = learnt.twin.capture()
    assert all(np.array_equal(array, after[name]) for name, array in before.items())
    assert all(torch.equal(one, other) for one, other in zip(seen, learnt.twin.view, strict=True))


def test_a_checkpoint_of_it_drives(learnt, config, small, tmp_path):
    learnt.load_state(copy.deepcopy(learnt.kept))
    path = checkpoint.save(tmp_path / "checkpoints", 2, learnt.state(), config, learnt.observation_table)
    found = checkpoint.open_checkpoint(path)
    assert list(found.model()) == ["policy"]
    assert same(actor_of(found).state_dict(), learnt.kept["policy"])
    state = found.state(like=learnt.state())
    learnt.iterate()
    learnt.load_state(state)
    held = learnt.twin.capture()
    assert all(np.array_equal(array, held[name]) for name, array in learnt.kept["env"].items())


# --------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"train.num_envs": 9, "twin.worlds": ["pool", "gauntlet"]}, "give a multiple of 2"),
        ({"train.evaluate_seed": SIMULATOR_SEED}, "learns from in the simulator"),
        ({"policy.hold_steps": 4}, "decides every 0.1 s"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(changes, says):
    with pytest.raises(UserError, match=says):
        TwinTrainer(load_training("finetune", overrides=SMALL | changes))


def test_starts_that_do_not_fit_are_refused(start, tmp_path):
    def asked(preset="finetune", **changes):
        return starting_policy.starting_policy(load_training(preset, overrides=SMALL | changes))

    with pytest.raises(UserError, match="names no policy to begin with"):
        asked()
    with pytest.raises(CheckpointError):
        asked(**{"twin.start": str(tmp_path / "nothing")})
    path, _ = start()
    with pytest.raises(UserError, match=r"has twin\.body_hidden=8, this run 16: --set twin\.body_hidden=8"):
        asked(**{"twin.start": str(path), "twin.body_hidden": 16})
    with pytest.raises(UserError, match=r"has twin\.goal_gain"):
        asked(**{"twin.start": str(path), "twin.goal_gain": 0.5})
    path, _ = start(twin__enabled=False)
    with pytest.raises(UserError, match="was not trained in the twin"):
        asked(**{"twin.start": str(path)})


def test_the_defaults_are_off():
    twin = LearningConfig().twin
    assert not twin.simulator and not twin.start and twin.critic_warmup_iterations == 0
    assert {field.name for field in dataclasses.fields(ObserverIO)} & {"world", "vehicle", "path"} == set()
