"""The kinematic surrogate against the simulator and against oracles, and the policy that learns in it."""

import copy

import numpy as np
import pytest
import taichi as ti
import torch

from tests.learning.test_train import comparable, same
from tests.oracles import hull_rule as reference
from tests.oracles.world import plan_distances
from tests.repository.test_architecture import TRUTH
from tests.small_sim import SmallSim
from uuvtai.common.enums import (
    COLLISION,
    EGO_COLUMNS,
    N_RAY,
    OBSTACLE_WIDTH,
    OWN_WIDTH,
    RUNNING,
    SUCCESS,
    TIMEOUT,
)
from uuvtai.common.errors import UserError
from uuvtai.common.obstacle_motion import describe_scenario, path_positions
from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.config.loader import ConfigError, load_config, load_training
from uuvtai.evaluation.episodes import jobs_of, run_episodes
from uuvtai.kernels.core.geometry import BOX, CYLINDER, FAR_M, NONE
from uuvtai.kernels.core.noise import episode_key
from uuvtai.kernels.core.stage import AnyTensor, Bundle, Const, FloatMatrix, FloatVector, IntVector
from uuvtai.kernels.task.episode import verdict
from uuvtai.learning import checkpoint, distillation, runner
from uuvtai.learning.agents import load_set_agent
from uuvtai.learning.checkpoint import CheckpointError
from uuvtai.learning.distillation import Student, imitate, imitation_error, regress, wish_of
from uuvtai.learning.environments import InSurrogate
from uuvtai.learning.policy_agent import load_agent
from uuvtai.learning.runner import TrainRequest, train
from uuvtai.learning.set_networks import SetActor
from uuvtai.learning.trainer import Trainer
from uuvtai.sim.stages import bind, members_of
from uuvtai.surrogate import arrays, motion, observation, safety, sensing, world
from uuvtai.surrogate.arrays import At, Rules
from uuvtai.surrogate.world import scenario_rows

CLEARANCE_TOL_M = 0.01
"""the simulator's hull leans by a few degrees, the surrogate's does not"""
TTC_TOL_S = 0.1
"""the same, at closing speeds of 0.1 m/s and more"""
SOON_S = 0.6
"""obstacles that hit within it are near enough for the surrogate to look at"""
FLOAT_TOL = 2e-5
SMALL = {
    "train.num_envs": 16, "ppo.rollout_steps": 8, "ppo.minibatches": 2, "surrogate.obstacle_hidden": 8,
    "surrogate.head_hidden": 8, "train.evaluate_episodes": 8, "train.scenes": [[8, 6, 0.6]],
    "surrogate.worlds": ["pool"], "train.iterations": 4, "surrogate.warm_start_waves": 0,
}  # fmt: skip


@ti.kernel
def lay(wishes: FloatMatrix, vehicle: Const[VehicleConfig], tank: Const[TankConfig], out: FloatMatrix):
    for i in range(wishes.shape[0]):
        wish = ti.Vector([wishes[i, 0], wishes[i, 1], wishes[i, 2]])
        command = motion.hull_command(wish, wishes[i, 3], wishes[i, 4], 0.25, vehicle, tank)
        for j in ti.static(range(4)):
            out[i, j] = command[j]


@ti.kernel
def places(path: AnyTensor, times: AnyTensor, out: AnyTensor):
    for row, lane in ti.ndrange(path.shape[0], path.shape[1]):
        place = motion.path_places(row, lane, ti.Vector([times[row]]), path)
        for i in ti.static(range(4)):
            out[row, lane, i] = place[0, i]


@ti.kernel
def look_along(place: FloatMatrix, body: AnyTensor, io: Bundle[Rules], ray: FloatMatrix):
    for i in range(place.shape[0]):
        sensing.write_rays(i, i, body.shape[1], motion.part(place, i, 0, 2), body, ray, io)


@ti.kernel
def judge(
    io: Bundle[Rules],
    pose: FloatMatrix,
    body: AnyTensor,
    path: AnyTensor,
    seen: FloatMatrix,
    outcome: IntVector,
):
    """Clearance [m] and time to collision [s] into ``seen`` (n, 2), and the verdict, of states (n, 12): x, y,
    z, yaw, velocity in the world, yaw rate, time, goal. State i is judged in scenario i."""
    for i in range(pose.shape[0]):
        pos_w, vel_w, goal_w = (
            motion.part(pose, i, 0, 3),
            motion.part(pose, i, 4, 3),
            motion.part(pose, i, 9, 3),
        )
        axis_w = ti.Vector([ti.cos(pose[i, 3]), ti.sin(pose[i, 3]), 0.0])
        threat = motion.nearest_of(i, pos_w, axis_w, vel_w, pose[i, 7], pose[i, 8], body, path, io)
        seen[i, 0], seen[i, 1] = threat[0], threat[1]
        outcome[i] = verdict(pos_w, axis_w, goal_w, threat, 0, io.episode_cfg, io.vehicle_cfg, io.tank_cfg)


@ti.kernel
def watch(at: FloatMatrix, is_seen: int, steps: int, bend_m: float, track: AnyTensor):
    """Obstacles that stay at (x, y) with a velocity, each a row, for so many decisions, seen from (0, 0)."""
    for i in range(at.shape[0]):
        place = ti.Vector([at[i, 0], at[i, 1], at[i, 2], at[i, 3]])
        for step in range(steps):
            key = episode_key(step // sensing.SPELL, i)
            old = ti.Vector([track[i, 0, k] for k in ti.static(range(arrays.TRACK_WIDTH))])
            new = sensing.updated_track(
                old, 0, place, bend_m, 1.0, ti.Vector([0.0, 0.0]), is_seen == 1, 0, 1, key
            )
            for k in ti.static(range(arrays.TRACK_WIDTH)):
                track[i, 0, k] = new[k]


@ti.kernel
def tracked(track: AnyTensor, out: AnyTensor):
    for i in range(track.shape[0]):
        row = ti.Vector([track[i, 0, k] for k in ti.static(range(arrays.TRACK_WIDTH))])
        out[i] = sensing.is_tracked(row)


@ti.kernel
def velocities(wish: FloatMatrix, flip: FloatMatrix, vehicle: Const[VehicleConfig], out: FloatMatrix):
    for i in range(wish.shape[0]):
        found = motion.wished_velocity(motion.part(wish, i, 0, 3), motion.part(flip, i, 0, 2), vehicle)
        for j in ti.static(range(3)):
            out[i, j] = found[j]


@ti.kernel
def earn(nearer: AnyTensor, nearest: AnyTensor, ended: IntVector, io: Bundle[Rules], out: FloatVector):
    for i in range(out.shape[0]):
        out[i] = motion.earned(nearer[i], nearest[i], ended[i], io)


@ti.kernel
def follow(io: Bundle[Rules], route: AnyTensor, ego: FloatMatrix):
    """The terms of the route of vehicles that have moved on, each on its own."""
    for i in range(ego.shape[0]):
        at = ti.Vector([ego[i, At.POS], ego[i, At.POS + 1]])
        ego[i, At.ARC] = motion.advanced_arc(i, ego[i, At.ARC], at, route)
        ego[i, At.LEFT] = motion.length_left(i, ego[i, At.ARC], route)
        motion.aim(i, i, route, ego, io)


@pytest.fixture(scope="module")
def config():
    return load_training("policy", overrides=SMALL)


@pytest.fixture(scope="module")
def bank(small):
    """Scenarios that the small simulator has drawn."""
    return small.scenario_bank()


@pytest.fixture(scope="module")
def trainer(config, bank):
    """After two iterations."""
    made = Trainer(InSurrogate(config, bank), config)
    made.iterate()
    made.iterate()
    return made


@pytest.fixture
def saved(trainer, config, tmp_path):
    """Function: checkpoint of the trainer after ``change`` (None = none) of its state."""

    def save(change=None):
        state = copy.deepcopy(trainer.state())
        if change:
            change(state["policy"])
        path = checkpoint.save(tmp_path / "checkpoints", 2, state, config, trainer.observation_table)
        return checkpoint.open_checkpoint(path)

    return save


# ------------------------------------------------------------------------------------------------- the
# surrogate


def test_the_hull_rule_is_that_of_the_oracle():
    rng = np.random.default_rng(0)
    low, high = [-0.85, -0.85, -0.4, -np.pi, -1.6], [0.85, 0.85, 0.4, np.pi, 0.0]
    wishes = rng.uniform(low, high, (300, 5)).astype(np.float32)
    wishes[:20, :2] *= 0.05  # too slow to turn for
    out = torch.zeros(300, 4)
    lay(torch.from_numpy(wishes), VehicleConfig(), TankConfig(), out)
    expected = [
        reference.hull_command(
            row[:3].astype(float), *map(float, row[3:]), 0.25, VehicleConfig(), TankConfig()
        )
        for row in wishes
    ]
    np.testing.assert_allclose(out.numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("easing_m", [0.0, 0.4])
def test_obstacles_move_as_in_closed_form(small, bank, easing_m):
    small.begin(range(small.N), seed=5)
    times, path = torch.linspace(0.0, 50.0, small.N), bank.path.clone()
    path[..., 15] = easing_m
    out = torch.zeros(*bank.path.shape[:2], 4)
    places(path, times, out)
    checked = 0
    for row in range(small.N):
        arrays = {k: v[row] for k, v in small.arrays("world", "path", "mission").items()}
        first = bank.obstacle.shape[1] - bank.path.shape[1]
        for body in describe_scenario(lambda name, arrays=arrays: arrays[name])["obstacles"]:
            if body["path"]:
                near = np.array([times[row] - 1e-3, times[row], times[row] + 1e-3])
                way = path_positions({**body["path"], "easing_m": easing_m}, near)
                found = out[row, body["slot"] - first].numpy()
                np.testing.assert_allclose(found[:2], way[1], atol=1e-3)  # float32 after 50 s
                if easing_m:
                    np.testing.assert_allclose(found[2:], (way[2] - way[0]) / 2e-3, atol=2e-3)
                else:
                    np.testing.assert_allclose(np.hypot(*found[2:]), body["path"]["speed_m_s"], rtol=1e-4)
                checked += 1
    assert checked == 6 * small.N


def states_of(sim):
    """(n, 12) rows for ``judge``."""
    rows, s = sim.rows, sim.s
    w, x, y, z = rows(s.vehicle.quat_wb).T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    axis, vel_b = np.stack([x, y, z], axis=1), rows(s.vehicle.vel_b)
    vel = vel_b + 2 * np.cross(axis, np.cross(axis, vel_b) + w[:, None] * vel_b)
    time_s = rows(s.clock.step) * sim.config.episode.control_dt_s
    rate, goal = rows(s.vehicle.rate_b)[:, 2], rows(s.mission.goal_w)
    pose = np.column_stack([rows(s.vehicle.pos_w), yaw, vel, rate, time_s, goal])
    return torch.from_numpy(np.ascontiguousarray(pose, np.float32))


def test_the_referee_is_the_simulators(small, bank, config):
    """Clearance, time to collision and verdict, along rides through whatever is in the way."""
    small.sim.use_tree(small.trees["straight"])
    small.begin(range(small.N), seed=5)
    rules, compared, verdicts = bind(Rules, config), 0, set()
    for step in range(500):
        small.sim.step()
        if step % 5:
            continue
        rows, termination = small.sim.rows, small.sim.s.termination
        seen, outcome = torch.zeros(small.N, 2), torch.zeros(small.N, dtype=torch.int32)
        judge(rules, states_of(small.sim), bank.obstacle, bank.path, seen, outcome)
        clearance, ttc, ended = (
            rows(termination.clearance_m),
            rows(termination.ttc_s),
            rows(termination.outcome),
        )
        near, soon = clearance < motion.NEAR_M, (ttc < SOON_S) & (ttc > 0.0)
        np.testing.assert_allclose(seen[near, 0], clearance[near], atol=CLEARANCE_TOL_M)
        np.testing.assert_allclose(seen[soon, 1], ttc[soon], atol=TTC_TOL_S)
        edge = (abs(clearance - 0.1) < CLEARANCE_TOL_M) | (abs(ttc - 0.18) < TTC_TOL_S)
        assert (outcome.numpy()[near & ~edge] == ended[near & ~edge]).all()
        compared, verdicts = compared + int(soon.sum()), verdicts | set(ended[near & ~edge])
    small.sim.use_tree(small.trees["bt"])
    assert compared > 5 and len(verdicts) >= 3


NO_WALL = 1.0 / 4.3 - 0.5
"""a ray that meets nothing"""


def told(way=(9.0, 9.0), velocity=(0.0, 0.0), water_m=0.0):
    """Columns (1, 1, OBSTACLE_WIDTH) of an obstacle of 0.6 m that goes straight."""
    row, way, velocity = np.zeros(OBSTACLE_WIDTH), np.array(way), np.array(velocity)
    row[0], row[7], row[8:10] = 1.0, 0.6, water_m
    for first, at in ((1, way), (12, way + velocity), (14, way + 2 * velocity)):
        row[first : first + 2] = at / 4
    return torch.tensor(row, dtype=torch.float32)[None, None]


@pytest.mark.parametrize(
    ("obstacle", "wall_m", "is_safe"),
    [
        (told((1.6, 0.0), (-1.5, 0.0)), None, False),
        (told((1.6, 0.0), (1.5, 0.0)), None, True),
        (told((1.6, 1.6), (-1.5, 0.0)), None, True),
        (told((1.6, 0.0), (-1.5, 0.0), water_m=0.6), None, True),
        (told((1.6, 0.0), (-1.5, 0.0), water_m=0.1), None, False),
        (told(), 0.5, False),
        (told(), 1.3, True),
    ],
)
def test_an_unsafe_wish_gives_way_and_a_safe_one_does_not(config, obstacle, wall_m, is_safe):
    """Straight on at full speed: towards an obstacle, beside, behind or below it, and towards a wall."""
    own, wish = torch.full((1, EGO_COLUMNS), NO_WALL), torch.tensor([[1.0, 0.0, 0.4]])
    own[0, 6:8] = torch.tensor([0.6, 0.0])
    if wall_m:
        own[0, OWN_WIDTH] = 1.0 / (0.3 + wall_m - 0.22) - 0.5
    found, rules = wish.clone(), bind(Rules, config)
    safety.filter_wishes(rules, 1.8, torch.zeros(1, dtype=torch.int32), obstacle, own, found)
    assert torch.equal(found, wish), "not due"
    safety.filter_wishes(rules, 1.8, torch.ones(1, dtype=torch.int32), obstacle, own, found)
    assert found[0, 2] == wish[0, 2] and torch.equal(found, wish) == is_safe
    again = found.clone()
    safety.filter_wishes(rules, 1.8, torch.ones(1, dtype=torch.int32), obstacle, own, again)
    torch.testing.assert_close(again, found)  # what is left is safe, or the least unsafe


@pytest.fixture
def as_small(monkeypatch):
    """Scenarios are drawn by simulators with the sensors, of which no route knows, and as many envs and
    obstacles as the small one: their kernels are compiled."""
    more = list(SmallSim.CHANGES.items())
    monkeypatch.setattr(world, "BATCH", SmallSim.N)
    monkeypatch.setattr(
        world, "load_config", lambda name, overrides: load_config(name, "paper", overrides=overrides + more)
    )


def test_who_goes_straight_on_arrives_more_often_by_the_filter(bank, as_small, monkeypatch):
    """A policy at birth goes along its route whatever comes: with the filter it makes way."""
    config = load_training("policy", overrides=SMALL | {"train.evaluate_episodes": 32})
    trainer = Trainer(InSurrogate(config, bank), config)
    filtered = trainer.evaluate()["eval/success_rate"]
    monkeypatch.setattr(safety, "filter_wishes", lambda *_arguments: None)
    assert filtered > trainer.evaluate()["eval/success_rate"] + 0.1


def test_far_obstacles_are_left_out(config):
    rules, far = bind(Rules, config), torch.zeros(1, 1, 8)
    far[0, 0] = torch.tensor([1.0, 15.0, 3.0, -0.8, 0.2, 0.2, 0.2, 0.0])
    pose = torch.tensor([[5.0, 3.0, -0.8, 0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 18.0, 3.0, -0.8]])
    seen, outcome = torch.zeros(1, 2), torch.zeros(1, dtype=torch.int32)
    judge(rules, pose, far, torch.zeros(1, 0, 16), seen, outcome)
    assert seen[0, 1] == FAR_M and outcome[0] == 0
    assert seen[0, 0] == pytest.approx(3.0 - 0.17, abs=FLOAT_TOL)  # the side walls


def test_a_route_is_followed_as_in_the_simulator(small, config):
    """Foot, look-ahead point, length left and the place beside it, while no new one is planned."""
    small.sim.use_tree(small.trees["bt"])
    small.begin(range(small.N), seed=5)
    s, rows, rules, compared = small.sim.s, small.sim.rows, bind(Rules, config), 0
    io = bind(arrays.ObserverIO, s, small.sim.config)
    for _ in range(400):
        planned, arc = rows(s.route.plan_step), rows(s.route.arc)
        small.sim.step()
        ego, seen = torch.zeros(small.N, arrays.EGO_WIDTH), torch.zeros(small.N, arrays.EGO_WIDTH)
        raw, ray = torch.zeros(small.N, 9, 14), torch.zeros(small.N, N_RAY)
        observation.observe_obstacles(io, torch.ones(small.N, dtype=torch.int32), seen, raw, ray)
        ego[:, At.POS : At.POS + 3] = torch.from_numpy(rows(s.ego.pos_w))
        ego[:, At.ARC] = torch.from_numpy(arc)
        follow(rules, torch.from_numpy(scenario_rows(small.sim)[2]), ego)
        same = (planned == rows(s.route.plan_step)) & (rows(s.clock.running) == 1)
        at_corner = abs(ego[:, At.ARC] - ego[:, At.ARC].round()).numpy() < 1e-3
        ego[at_corner, At.ASIDE] = seen[at_corner, At.ASIDE] = 0.0  # on either side
        for column in (At.AHEAD, At.AHEAD + 1, At.LEFT, At.ASIDE):
            np.testing.assert_allclose(ego[same, column], seen[same, column], atol=1e-4)
        compared += int((same & ~at_corner).sum())
    assert compared > 200 * small.N


def test_routes_are_planned_around_all_that_does_not_move(config, as_small):
    bank = world.draw_bank(config, ((16, 6, 0.6),), 3, 8)
    rest = bank.obstacle.shape[1] - bank.path.shape[1]
    assert (bank.route[:, 0, :2] - bank.mission[:, :2]).norm(dim=1).max() < 0.3, "begin at the start"
    torch.testing.assert_close(bank.route[:, -1, :2], bank.mission[:, 3:5])
    assert bool((bank.route[:, -1, 2] == 0).all()) and bool((bank.route[..., 2].diff(dim=1) <= 0).all())
    straight = (bank.mission[:, 3:5] - bank.mission[:, :2]).norm(dim=1)
    assert bool((bank.route[:, 0, 2] > straight + 0.1).any()), "around what stands in the way"
    for route, obstacles in zip(bank.route.double().numpy(), bank.obstacle[:, :rest].double(), strict=True):
        for kind, *body in obstacles.numpy():
            pos, size, yaw = body[:3], np.array(body[3:6]), body[6]
            far = plan_distances(route[:, :2], int(kind), pos, size, yaw)
            assert kind == NONE or far.min() > config.vehicle.hull_radius_m


def free_m(x, y, obstacles, tank):
    """Along 24 rays, in float64, each ray against each obstacle."""
    angle = np.arange(N_RAY) * 2 * np.pi / N_RAY
    u = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    with np.errstate(divide="ignore"):
        ends = [np.where(u[:, a] > 0, (bound[1] - at) / u[:, a], (bound[0] - at) / u[:, a])
                for a, (at, bound) in enumerate(((x, tank.x_m), (y, tank.y_m)))]  # fmt: skip
        out = np.minimum(*[np.where(abs(u[:, a]) < 1e-6, 99.0, end) for a, end in enumerate(ends)])
    for kind, bx, by, _, wide, deep, _, yaw in obstacles:
        d = np.array([bx - x, by - y])
        if kind == BOX:
            c, s = np.cos(yaw), np.sin(yaw)
            turn = np.array([[c, s], [-s, c]])
            with np.errstate(divide="ignore"):
                a, b = ((turn @ d + side)[:, None] / (turn @ u.T) for side in ([-wide, -deep], [wide, deep]))
            enter, leave = np.minimum(a, b).max(0), np.maximum(a, b).min(0)
            hit = np.where((leave >= enter) & (leave > 0), np.maximum(enter, 0.0), 99.0)
        elif kind != NONE:
            along = u @ d
            inside = along**2 - d @ d + wide**2
            hit = np.where((inside > 0) & (along > 0), along - np.sqrt(np.maximum(inside, 0)), 99.0)
        else:
            continue
        out = np.minimum(out, hit)
    return out


def test_rays_meet_what_stands_in_their_way(config):
    rng, count = np.random.default_rng(0), 400
    tank = config.world.tank
    place = np.column_stack([rng.uniform(*tank.x_m, count), rng.uniform(*tank.y_m, count)])
    body = np.zeros((count, 5, 8))
    body[..., 0] = rng.choice([NONE, CYLINDER, BOX], (count, 5))
    body[..., 1:3] = place[:, None] + rng.uniform(-4, 4, (count, 5, 2))
    body[..., 4:6], body[..., 7] = rng.uniform(0.1, 0.8, (count, 5, 2)), rng.uniform(-7, 7, (count, 5))
    ray = torch.zeros(count, N_RAY)
    place, body = (torch.from_numpy(a.astype(np.float32)) for a in (place, body))
    look_along(place, body, bind(Rules, config), ray)
    wanted = [
        free_m(*at, row, tank) for at, row in zip(place.double().numpy(), body.double().numpy(), strict=True)
    ]
    off = abs(ray.numpy() - wanted) > 1e-3
    assert off.mean() < 1e-3, "but for rays that touch an edge"
    bare = [free_m(*at, [], tank) for at in place.double().numpy()]
    assert (np.array(bare) > np.array(wanted) + 0.1).mean() > 0.1, "obstacles are in the way"


def test_rewards_by_hand(config):
    nearer, nearest = torch.tensor([0.08, 0.0, -0.02, 0.1]), torch.tensor([9.0, 0.25, 0.05, 2.0])
    ended = torch.tensor([RUNNING, TIMEOUT, COLLISION, SUCCESS], dtype=torch.int32)
    reward, surrogate = torch.zeros(4), config.surrogate
    earn(nearer, nearest, ended, bind(Rules, config), reward)
    close = (1.0 - nearest / surrogate.soft_clearance_m).clamp(0.0, 1.0)
    expected = surrogate.progress * nearer - 0.1 * (surrogate.time_cost + surrogate.closeness_cost * close)
    assert torch.allclose(reward, expected + torch.tensor([0.0, 0.0, -1.0, 1.0]), atol=1e-6)


def watched(far_m, steps, is_seen=1, count=4000, radius_m=None, track=None):
    """Tracks (count, 9) of far obstacles that go across at 1 m/s, on a circle where they have a radius."""
    at = torch.tensor([[far_m, 0.0, 0.0, 1.0]]).repeat(count, 1)
    track = torch.zeros(count, 1, arrays.TRACK_WIDTH) if track is None else track
    watch(at, is_seen, steps, radius_m or 0.0, track)
    return track[:, 0]


def test_errors_of_tracks_grow_with_distance_and_have_a_long_tail():
    near, far = watched(1.0, 30), watched(4.0, 30)
    errors = [(track[:, :2] - torch.tensor([at, 0.0])).norm(dim=1) for track, at in ((near, 1.0), (far, 4.0))]
    middle, tail = (np.array([np.quantile(error, q) for error in errors]) for q in (0.5, 0.95))
    assert middle[1] / middle[0] == pytest.approx(4.0, rel=0.15)
    assert (tail / middle).min() > 5 and (tail / middle).max() < 20, (
        "of a normal distribution it would be two"
    )
    assert 0.015 < middle[1] < 0.025, "centimetres"
    assert abs(far[:, 3].median() - 1.0) < 0.01, "what goes across is known by then"


def test_a_track_out_of_sight_follows_a_circle_and_else_goes_straight():
    for radius_m, turned in ((1.0, 1.0), (-1.0, -1.0), (None, 0.0)):
        track = watched(2.0, 30, radius_m=radius_m)[:, None].contiguous()
        before = torch.atan2(track[:, 0, 3], track[:, 0, 2])
        hidden = watched(2.0, 1, is_seen=0, radius_m=radius_m, track=track.clone())
        track = watched(2.0, 11, is_seen=0, radius_m=radius_m, track=track)
        moved = torch.atan2(track[:, 3], track[:, 2]) - before
        assert float(torch.remainder(moved + np.pi, 2 * np.pi).median() - np.pi) == pytest.approx(
            1.1 * turned, abs=0.05
        )
        assert float((hidden[:, 2:4] - track[:, 2:4]).norm(dim=1).median()) > 0.5 or turned == 0.0
        assert float(track[:, 5].min()) == pytest.approx(1.1)


def test_what_is_seen_badly_is_born_late_or_missed():
    told = []
    for steps in (1, 3, 5, 9):
        track = watched(2.0, steps)
        tracked(track[:, None].contiguous(), born := np.zeros(len(track), np.int32))
        told.append(born.mean())
    assert 0.7 < told[0] < told[1] < told[2] < told[3] < 0.99


# ----------------------------------------------------------------------------------------------- the policy


def test_neither_order_nor_empty_rows_matter(config):
    actor = SetActor(config, torch.Generator().manual_seed(1))
    for parameter in actor.parameters():  # biases too: an empty row must not count for what it gives
        torch.nn.init.normal_(parameter, std=0.3, generator=torch.Generator().manual_seed(2))
    obstacles, own = torch.randn(5, 4, OBSTACLE_WIDTH), torch.randn(5, EGO_COLUMNS)
    obstacles[..., 0] = 1.0
    said = actor(obstacles, own)
    assert torch.allclose(actor(obstacles[:, [2, 0, 3, 1]], own), said, atol=1e-5)
    padded = torch.cat([obstacles, torch.zeros(5, 5, OBSTACLE_WIDTH)], dim=1)
    assert torch.allclose(actor(padded, own), said, atol=1e-5)
    assert not torch.allclose(actor(obstacles[:, :3], own), said, atol=1e-3)


def test_what_drives_knows_nothing_that_only_the_simulator_knows(saved):
    assert not set(members_of(arrays.ObserverIO).values()) & TRUTH
    found = saved()
    assert list(found.model()) == ["policy"]
    own = SetActor(found.config, torch.Generator()).state_dict()
    assert {n: t.shape for n, t in found.model()["policy"].items()} == {n: t.shape for n, t in own.items()}
    assert max(row["stop"] for row in found.manifest.observation_table) == EGO_COLUMNS + 9 * OBSTACLE_WIDTH


def test_the_critic_alone_feels_the_truth(trainer):
    view, policy = trainer.env.view, trainer.policy
    truth = view["truth"] + torch.randn(view["truth"].shape) * (view["truth"][..., 2:3] > 0)
    other = view | {"truth": truth}
    assert not torch.equal(policy.value_of(other), policy.value_of(view))
    assert torch.equal(policy.mean_of(other), policy.mean_of(view))


def test_learning_goes_on_from_a_state_bit_for_bit(trainer, config, bank):
    other = Trainer(InSurrogate(config, bank), config)
    other.load_state(copy.deepcopy(trainer.state()))
    kept = copy.deepcopy(trainer.state())
    ours, theirs = trainer.iterate(), other.iterate()
    same(trainer.state(), other.state())
    trainer.load_state(kept)
    assert comparable(ours) == comparable(theirs)
    assert theirs["train/std"] >= config.policy.min_std


def test_another_runs_policy_goes_on_learning(bank, saved):
    """``--start RUN``, with networks as wide as its own."""
    found = saved()
    _, config = runner._started(
        found.path, load_training("policy", SMALL | {"surrogate.obstacle_hidden": 9}), print
    )
    assert config.surrogate.obstacle_hidden == 8
    trainer = Trainer(InSurrogate(config, bank), config)
    trainer.start(found)
    wanted = found.model()["policy"]
    assert all(torch.equal(part, wanted[name]) for name, part in trainer.policy.actor.state_dict().items())
    assert trainer.iterate()["train/invalid_samples"] == 0


def test_what_cannot_be_begun_with_is_refused(bank, saved, tmp_path):
    with pytest.raises(UserError, match="policies alone"):
        runner._started(saved().path, load_training("best"), print)
    with pytest.raises(UserError, match="learned in the surrogate and goes on there alone"):
        runner._started(saved().path, load_training("ppo"), print)
    with pytest.raises(UserError, match="is no trained policy"):
        runner._started(tmp_path / "none", load_training("ppo"), print)


# ------------------------------------------------------------------------------------- warm start


def test_a_command_becomes_the_wish_with_its_velocity():
    rng, vehicle = np.random.default_rng(0), VehicleConfig()
    command = torch.from_numpy(rng.uniform(-1, 1, (200, 4)).astype(np.float32))
    yaw = torch.from_numpy(rng.uniform(-np.pi, np.pi, 200).astype(np.float32))
    flip = torch.from_numpy(rng.choice([-1.0, 1.0], (200, 2)).astype(np.float32))
    out = torch.zeros(200, 3)
    ego = torch.zeros(200, arrays.EGO_WIDTH)
    ego[:, At.YAW], ego[:, At.FLIP : At.FLIP + 2] = yaw, flip
    velocities(wish_of(command, ego, vehicle), flip, vehicle, out)
    surge, sway = vehicle.max_surge_m_s * command[:, 0], vehicle.max_sway_m_s * command[:, 1]
    expected = [
        yaw.cos() * surge - yaw.sin() * sway,
        yaw.sin() * surge + yaw.cos() * sway,
        vehicle.max_heave_m_s * command[:, 2],
    ]
    np.testing.assert_allclose(out, torch.stack(expected, dim=1), atol=1e-5)


def test_it_learns_what_the_tree_says(small, monkeypatch):
    samples, told = [], []
    small.begin_late(monkeypatch, 600)

    def kept(actor, learner, sample, passes, generator):
        samples.append(sample)
        return regress(actor, learner, sample, passes, generator)

    monkeypatch.setattr(distillation, "regress", kept)
    monkeypatch.setattr(distillation, "LAST_PASSES", 20)
    config = load_training(
        "policy", overrides=SMALL | {"train.num_envs": small.N, "surrogate.warm_start_waves": 2}
    )
    actor = SetActor(config, torch.Generator().manual_seed(1))
    born = copy.deepcopy(actor)
    monkeypatch.setattr(distillation, "simulator_of", lambda *_: small.sim)
    found = imitate(actor, config, ((8, 6, 0.6),), told.append)
    obstacles, own, wish = samples[1]
    with torch.no_grad():
        errors = [imitation_error(who(obstacles, own), wish).mean() for who in (born, actor)]
    assert errors[1] < 0.9 * errors[0] and found["warm_start/decisions"] == len(wish) > 100 * small.N / 2
    assert torch.equal(actor.log_std, born.log_std), "its mean alone is fitted"
    assert len(told) == 2 and told[1].startswith("imitating the tree, wave 2 of 2: ")


def test_the_tree_alone_drives_as_without_a_student(small):
    config = load_training("policy", overrides=SMALL)
    actor = SetActor(config, torch.Generator().manual_seed(1))
    student = Student(actor, small.sim, config, torch.Generator().manual_seed(0))
    small.begin(range(small.N), seed=9)
    student.reset(torch.ones(small.N))
    for share, agent in ((1.0, small.sim.action), (0.0, None)):
        student.tree_share = share
        said = student.decide(small.sim.action).action
        expected = student.decision.action if agent is None else agent
        assert torch.equal(said, expected)
    assert len(student.samples) == 2 and len(student.samples[0][-1]) == small.N


# ------------------------------------------------------------------------------------------ in the simulator


def test_it_drives_whatever_the_order_of_the_episodes(small, saved, monkeypatch):
    small.begin_late(monkeypatch, 400)
    pilot = load_set_agent(saved(), small.sim)
    jobs = jobs_of([3], 5)
    forth, _ = run_episodes(small.sim, jobs, agent=pilot)
    back, _ = run_episodes(small.sim, jobs[::-1], agent=pilot)
    assert [(r.outcome, r.time_s, r.path_length_m) for r in forth] == [
        (r.outcome, r.time_s, r.path_length_m) for r in back[::-1]
    ]
    assert max(r.path_length_m for r in forth) > 1.0


def test_asking_again_changes_nothing(small, saved):
    pilot = load_set_agent(saved(), small.sim)
    small.begin(range(small.N), seed=9)
    pilot.reset(torch.ones(small.N))
    first = pilot.decide(torch.zeros(0)).action
    assert torch.equal(pilot.decide(torch.zeros(0)).action, first) and bool((first.abs() <= 1.0).all())


def test_rays_end_at_the_walls(small):
    small.begin(range(small.N), seed=5)
    io = bind(arrays.ObserverIO, small.sim.s, small.sim.config)
    ego, raw, ray = (torch.zeros(small.N, *shape) for shape in ((arrays.EGO_WIDTH,), (9, 14), (24,)))
    observation.observe_obstacles(io, torch.ones(small.N, dtype=torch.int32), ego, raw, ray)
    y = small.sim.rows(small.sim.s.ego.pos_w)[:, 1]
    assert (ray[:, 6].numpy() <= 6.0 - y + 0.2).all() and (ray[:, 18].numpy() <= y + 0.2).all()
    assert bool((ray > 0.3).all())


# --------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda part: part.pop("log_std"), "not those of its config"),
        (lambda part: part.update({"net.obstacle.0.weight": torch.zeros(9, OBSTACLE_WIDTH)}), "instead of"),
        (lambda part: part.update(log_std=torch.full((3,), float("nan"))), "log_std is not finite"),
    ],
)
def test_networks_that_cannot_drive_are_refused(small, saved, change, says):
    with pytest.raises(CheckpointError, match=says):
        load_set_agent(saved(change), small.sim)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("world_model.enabled", True, "over a set of obstacles has none"),
        ("policy.hold_steps", 4, "decides every 0.1 s"),
        ("episode.control_dt_s", 0.01, "decides every 0.1 s"),
        ("ppo.minibatches", 200, "only 128 samples"),
    ],
)
def test_what_the_surrogate_lacks_is_refused(bank, key, value, says):
    with pytest.raises(UserError, match=says):
        config = load_training("policy", overrides=SMALL | {key: value})
        Trainer(InSurrogate(config, bank), config)


def test_it_is_no_policy_of_one_observation(saved):
    with pytest.raises(CheckpointError, match="looks at the simulator itself"):
        load_agent(saved(), 1)


def test_worlds_of_another_tank_are_refused():
    other = load_training("policy", overrides=SMALL | {"surrogate.worlds": ["netpen"]})
    with pytest.raises(ConfigError, match="netpen has another tank"):
        world.draw_bank(other, ((8, 6, 0.6),), 0, 1)


def test_a_gpu_is_refused_before_anything_is_written(config, tmp_path):
    request = TrainRequest(config=config, device="cuda", run_dir=tmp_path / "run")
    watch = type("Watch", (), {"note": lambda self, text: None})()
    with pytest.raises(UserError, match="on the CPU"):
        train(request, watch, lambda trainer, config: {})
    assert not (tmp_path / "run").exists()
