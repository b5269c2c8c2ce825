"""Threats, evasion and the tree's leaves in hand-made situations, and the packets against a NumPy oracle."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import taichi as ti
import torch

from tests import bundles
from tests.bundles import Stage
from tests.map_bits import away, room
from tests.oracles import behavior as oracle
from uuvtai.common.enums import NO_SITE, clearance_m
from uuvtai.common.tree_codes import MAX_NODES
from uuvtai.config import BehaviorConfig, Config
from uuvtai.config.behavior import TUNED
from uuvtai.kernels.behavior import avoidance, threats, tree
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.grid import grid_origin, grid_shape
from uuvtai.sim.behavior_tree import load_tree, parse_tree, read_tree

N_ENV, N_TRACK, N_RAY = 6, 4, 64
TEACHER = {
    "cruise_m_s": 0.6, "decide_period_steps": 5, "lag_s": 0.35, "horizon_s": 2.5,
    "n_heading": 12, "n_speed": 3, "evade_m_s": 0.8, "heave_m_s": 0.35, "n_heave_heading": 7, "burst_s": 0.75,
    "hull_reach_m": 0.22, "contact_m": 0.1, "margin_m": 0.25, "margin_growth_m_s": 0.1, "closing_s": 0.25,
    "vertical_weight": 1.4,
    "caution": 1.2, "patience_s": 2.0, "lost_edge_gap_m": 0.35,
    "static_margin_m": 0.1, "static_horizon_s": 1.5, "static_dt_s": 0.25, "weight_peak": 6.0,
    "weight_mean": 6.0,
    "weight_contact": 12.0, "weight_static": 12.0, "weight_static_contact": 30.0, "weight_deviation": 1.0,
    "weight_change": 0.3,
    "temperature": 0.05, "hysteresis_s": 0.5, "conflict_within_s": 2.5, "emergency_ttc_s": 0.35,
    "emergency_range_m": 0.12,
    "back_off_m_s": 0.85, "slow_clearance_m": 0.6, "slow_fraction": 0.5, "edge_gap_m": 0.26,
    "depth_gain": 1.0, "yaw_gain": 1.5,
    "heading_range_m": 3.0, "heading_level_m": 1.0, "heading_clearance_m": 0.6, "sideslip_clearance_m": 0.5,
    "place_sigmas": 2.5,
    "heading_off_deg": 25.0, "free_depth": False, "least_share": 0.02, "evade_probability": 0.2,
    "future_margin": 0.6,
}  # fmt: skip
"""Every number of the stage, so that tuning the defaults breaks nothing here. The dashes end between two
samples of the forecast."""
CFG = Config.model_validate(
    {
        "sensors": {"sonar": {"n_ray": N_RAY}},
        "tracking": {"n_track": N_TRACK, "horizon_s": 2.5, "forecast_dt_s": 0.1},
        "behavior": TEACHER,
    }
)
SLOW = CFG.behavior.model_copy(update={"evade_m_s": 0.1, "back_off_m_s": 0.1, "patience_s": 0.0})
"""evades slowly, with endless patience"""
TANK = CFG.world.tank
N_SAMPLE = round(CFG.tracking.horizon_s / CFG.tracking.forecast_dt_s) + 1
TIMES = np.arange(N_SAMPLE) * CFG.tracking.forecast_dt_s
CELL = CFG.mapping.cell_m
SIZES = {
    "n_env": N_ENV, "n_node": MAX_NODES, "n_candidate": CFG.behavior.n_candidate,
    "n_track": N_TRACK, "n_forecast": N_SAMPLE, "n_future": 2, "n_height": 16, "n_ray": N_RAY, "n_ahead": 16,
    "n_tuned": len(TUNED), "n_row": grid_shape(TANK, CELL)[0], "n_col": grid_shape(TANK, CELL)[1],
}  # fmt: skip
COST_TOLERANCE = 5e-3
"""Costs are up to 60: float32 positions of 20 m (2e-6 m) times weights of 30 per metre and some hundred
summed terms; and the kernel's distances are 1e-4 m too long at a mantle (a term under its root), which the
weights of a body (24 per metre) turn into 2.4e-3."""
CLOSE_M = 1e-4
"""A sample this close to a cell's border or to where an obstacle's height begins may fall on its other side
in float32; such candidates are not compared."""
OPEN_M = FAR_M
"""Height of free water that nothing bounds."""


@pytest.fixture(scope="module")
def stage():
    made = Rig()
    made.action = torch.zeros(N_ENV, 4)
    return made


class Rig(Stage):
    """Axes that this stage does not touch are short."""

    sizes = SIZES
    other = 1


@pytest.fixture
def scene(stage):
    """Every env alike: at (5, 3), facing +x, at rest, open water, look-ahead 1 m ahead, nothing around."""
    bundles.put(stage.clock, active=1, step=0)
    bundles.put(stage.ego, pos_w=(5.0, 3.0, -0.8), vel_b=0, rpy=0, pose_cov=0, given_up=0)
    bundles.put(stage.mission, goal_w=(15.0, 3.0, -0.8))
    bundles.put(stage.route, lookahead_w=(6.0, 3.0, -0.8), n_way=10, n_ahead=0, stuck_steps=0)
    bundles.put(stage.forecast, radius_m=-1.0, pos_w=0.0, above_w=-0.8, below_w=-0.8)
    stage.futures.share.fill(0.0)
    stage.tracks.alive.fill(0)
    bundles.put(stage.scan, fresh=1, hit=0, range_m=12.0, doppler_m_s=0.0, ping_yaw=0.0)
    bundles.put(stage.clearance, site=NO_SITE)
    use(stage, "bt")
    tree.reset_behavior(stage.io(BehaviorIO))
    return stage


def put(field, value, *index):
    """Overwrite entries of a field by a NumPy index."""
    values = field.to_numpy()
    values[index if index else ...] = value
    field.from_numpy(values)


def use(stage, name):
    stage.tree = read_tree(name)
    load_tree(stage.table, stage.tree)


def body(stage, env, track, pos, vel, radius=0.2, above=-0.8, below=-0.8):
    """A forecast obstacle in straight motion, at any height but the water from ``below`` to ``above``."""
    put(stage.forecast.pos_w, np.asarray(pos) + np.outer(TIMES, vel), env, track)
    put(stage.forecast.radius_m, radius, env, track)
    put(stage.forecast.above_w, above, env, track)
    put(stage.forecast.below_w, below, env, track)


def assess(stage, cfg=CFG.behavior, sonar=CFG.sensors.sonar):
    sensors = CFG.sensors.model_copy(update={"sonar": sonar})
    config = CFG.model_copy(update={"behavior": cfg, "sensors": sensors})
    threats.assess_threats(stage.io(BehaviorIO, config))


def plan(stage):
    avoidance.plan_evasion(stage.io(BehaviorIO, CFG))


def decide(stage):
    assess(stage)
    plan(stage)
    tick(stage)


def tick(stage, cfg=CFG.behavior, sonar=CFG.sensors.sonar):
    parts = (cfg, sonar, CFG.vehicle, TANK, CFG.episode)
    tree.tick_tree(stage.io(BehaviorIO, *parts), stage.action)
    ti.sync()


def acting(stage):
    """Type of the node that set each env's action."""
    return [stage.tree.types[node] if node >= 0 else None for node in stage.behavior.leaf.to_numpy()]


def step(stage, count=1):
    for _ in range(count):
        put(stage.clock.step, stage.clock.step.to_numpy() + 1)
        decide(stage)


# ----------------------------------------------------------------------------------------------------- oracle


def test_packets_equal_the_scalar_oracle(scene):
    """Costs of all candidates over random scenes; how depth is changed; what is made of the costs."""
    rng = np.random.default_rng(3)
    bests = []
    for _ in range(2):
        random_scene(scene, rng)
        assess(scene)
        scene.behavior.want_evade.fill(1)
        plan(scene)
        found, chosen, price = (
            getattr(scene.behavior, name).to_numpy().astype(float)
            for name in ("candidate_cost", "evade_vel_w", "evade_cost")
        )
        for env in range(N_ENV):
            view = View(scene, env)
            commands, bursts = view.candidates()
            wanted, doubt = np.array([view.cost(*pair) for pair in zip(commands, bursts, strict=True)]).T
            assert len(wanted) == CFG.behavior.n_candidate
            sure = doubt > CLOSE_M
            assert sure.sum() > 0.6 * len(wanted)
            np.testing.assert_allclose(found[env][sure], wanted[sure], atol=COST_TOLERANCE)
            best = found[env].argmin()
            mean = oracle.mean_velocity(commands, found[env], CFG.behavior.temperature)
            held = view.cost(mean, np.inf)[0]
            is_held = held <= found[env].min() + CFG.behavior.temperature
            taken = (mean, held) if is_held else (commands[best], found[env].min())
            np.testing.assert_allclose(chosen[env], taken[0], atol=1e-3)
            assert price[env] == pytest.approx(taken[1], abs=COST_TOLERANCE)
            bests.append(best)
    # dashes and level ones have both been best
    assert max(bests) >= CFG.behavior.first_burst and (np.array(bests) < 36).any()


def random_scene(scene, rng):
    """Random motion, velocities, maps, and obstacles level, above, below, or on both sides of free water."""
    put(scene.ego.pos_w, rng.uniform([3, 1.5, -1.3], [17, 4.5, -0.3], (N_ENV, 3)))
    put(scene.ego.vel_b, rng.uniform(-0.4, 0.4, (N_ENV, 3)))
    put(scene.ego.rpy, np.c_[np.zeros((N_ENV, 2)), rng.uniform(-3, 3, N_ENV)])
    zero, sigma = np.zeros(N_ENV), np.linspace(0.0, 0.05, N_ENV)
    put(scene.ego.pose_cov, np.c_[sigma**2, 0.3 * sigma**2, zero, 0.5 * sigma**2, zero, zero])
    pos = scene.ego.pos_w.to_numpy().astype(float)
    put(scene.mission.goal_w, pos + rng.uniform(-1, 1, (N_ENV, 3)))
    put(scene.route.lookahead_w, pos + rng.uniform(-1, 1, (N_ENV, 3)))
    put(scene.behavior.last_vel_w, rng.uniform(-0.5, 0.5, (N_ENV, 3)))
    put(scene.clearance.site, room(rng.uniform(0.2, 1.5, scene.clearance.site.shape)))
    start = pos[:, None, :2] + rng.uniform(-2.5, 2.5, (N_ENV, N_TRACK, 2))
    speed = rng.uniform(-0.8, 0.8, (N_ENV, N_TRACK, 2))
    put(scene.forecast.pos_w, start[:, :, None] + speed[:, :, None] * TIMES[:, None])
    radii = np.where(rng.random((N_ENV, N_TRACK)) < 0.75, rng.uniform(0.15, 0.4, (N_ENV, N_TRACK)), -1.0)
    put(scene.forecast.radius_m, np.repeat(radii[:, :, None], N_SAMPLE, 2))
    turned_s, angle = rng.uniform(0.2, 2.0, (N_ENV, N_TRACK, 2)), rng.uniform(-3, 3, (N_ENV, N_TRACK, 2))
    after = (speed[..., 0] + 1j * speed[..., 1])[..., None] * np.exp(1j * angle)
    before_s = np.minimum(TIMES, turned_s[..., None])[..., None]
    after_w = np.stack([after.real, after.imag], -1)[:, :, :, None]
    way = speed[:, :, None, None] * before_s + after_w * (TIMES[:, None] - before_s)
    put(scene.futures.pos_w, start[:, :, None, None] + way)
    put(scene.futures.share, rng.choice([0.0, 0.015, 0.1, 0.3], (N_ENV, N_TRACK, 2)))
    own_z, kind = pos[:, 2:], rng.integers(0, 4, (N_ENV, N_TRACK))
    above = own_z + rng.uniform(0, 0.8, (N_ENV, N_TRACK))
    below = own_z - rng.uniform(0, 0.8, (N_ENV, N_TRACK))
    put(scene.forecast.above_w, np.choose(kind, [own_z, above, OPEN_M, above]))
    put(scene.forecast.below_w, np.choose(kind, [own_z, -OPEN_M, below, below]))


def doubt(scene, env):
    """[m] by which walls and mapped obstacles are taken to be nearer."""
    xx, xy, _, yy, _, _ = scene.ego.pose_cov.to_numpy()[env].astype(float)
    return CFG.behavior.place_sigmas * np.sqrt(np.linalg.eigvalsh([[xx, xy], [xy, yy]])[1])


class View:
    """What one env's search sees, in float64, and the oracle's answers."""

    def __init__(self, scene, env):
        follow, last = (
            getattr(scene.behavior, name).to_numpy()[env].astype(float)
            for name in ("follow_vel_w", "last_vel_w")
        )
        yaw = float(scene.ego.rpy.to_numpy()[env, 2])
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        self.follow, self.last, self.yaw = follow, last, yaw
        self.pos = scene.ego.pos_w.to_numpy()[env].astype(float)
        self.vel = turn @ scene.ego.vel_b.to_numpy()[env].astype(float)
        self.forecast = [
            getattr(scene.forecast, name).to_numpy()[env].astype(float)
            for name in ("pos_w", "radius_m", "above_w", "below_w")
        ] + [getattr(scene.futures, name).to_numpy()[env].astype(float) for name in ("pos_w", "share")]
        self.clearance = clearance_m(scene.clearance.site.to_numpy()[env], CFG).astype(float) - doubt(
            scene, env
        )

    def candidates(self):
        return oracle.candidates(
            self.follow, self.last, self.yaw, self.pos[2], CFG.behavior, CFG.vehicle, TANK
        )

    def cost(self, command, burst_s):
        origin, dt = grid_origin(TANK, CELL), CFG.tracking.forecast_dt_s
        rest = (self.follow, self.last, self.forecast, self.clearance, origin, CELL, CFG.behavior, TANK, dt)
        return oracle.cost(self.pos, self.vel, command, burst_s, *rest)

    def depths(self, command):
        return oracle.obstacle_depths(
            self.pos, self.vel, np.asarray(command, float), self.forecast, CFG.behavior, TANK,
            CFG.tracking.forecast_dt_s,
        )  # fmt: skip


def test_follow_changes_depth_only_where_that_comes_no_nearer(scene):
    """Peaks with and without the heave towards the goal decide; the conflict is the chosen one's."""
    rng = np.random.default_rng(5)
    low, high = oracle.depth_band(TANK, CFG.behavior)
    heaves, held, seen = 0, 0, 0
    for _ in range(8):
        random_scene(scene, rng)
        assess(scene)
        found = (
            getattr(scene.behavior, name).to_numpy().astype(float)
            for name in ("follow_vel_w", "conflict_s", "hold_conflict_s")
        )
        follow, conflict, staying = found
        for env in range(N_ENV):
            view = View(scene, env)
            error = np.clip(scene.mission.goal_w.to_numpy()[env, 2], low, high) - view.pos[2]
            heave = np.clip(
                CFG.behavior.depth_gain * error, -CFG.vehicle.max_heave_m_s, CFG.vehicle.max_heave_m_s
            )
            level, changing = view.depths((*follow[env, :2], 0.0)), view.depths((*follow[env, :2], heave))
            if min(level[4], changing[4]) < CLOSE_M or 5e-4 < changing[0] - level[0] < 2e-3:
                continue
            stop = view.depths((0.0, 0.0, 0.0))
            assert stop[4] < CLOSE_M or staying[env] == (
                pytest.approx(stop[3], abs=1e-3) if np.isfinite(stop[3]) else FAR_M
            )
            taken = changing if changing[0] <= level[0] + 1e-3 else level
            assert follow[env, 2] == pytest.approx(heave if taken is changing else 0.0, abs=1e-5)
            assert conflict[env] == (pytest.approx(taken[3], abs=1e-3) if np.isfinite(taken[3]) else FAR_M)
            heaves, held = heaves + (taken is changing), held + (taken is level)
            seen += np.isfinite(taken[3])
    assert min(heaves, held, seen) > 5


# ------------------------------------------------------------------------------------------------- situations


def test_open_water_is_travelled_at_cruise_speed(scene):
    decide(scene)
    assert acting(scene) == ["FollowRoute"] * N_ENV
    np.testing.assert_allclose(
        scene.action[0], [CFG.behavior.cruise_m_s / CFG.vehicle.max_surge_m_s, 0, 0, 0], atol=1e-5
    )
    assert scene.behavior.conflict_s.to_numpy()[0] == scene.behavior.ttc_s.to_numpy()[0] == FAR_M


def test_head_on_obstacle_is_evaded_with_room(scene):
    """The follow velocity would be hit; the evasive one keeps more than contact over the horizon."""
    body(scene, 0, 0, (7.2, 3.05), (-0.6, 0.0))
    decide(scene)
    assert acting(scene) == ["Evade"] + ["FollowRoute"] * (N_ENV - 1)
    where = scene.forecast.pos_w.to_numpy()[0, 0].astype(float)

    def closest(command):
        at, _ = oracle.rolled_out(
            (5.0, 3.0), (0, 0), np.asarray(command, float), CFG.behavior.lag_s, 0.1, N_SAMPLE - 1
        )
        return (
            np.hypot(*(at - where).T).min() - 0.2 - CFG.vehicle.hull_radius_m - CFG.vehicle.hull_half_length_m
        )

    assert closest(scene.behavior.follow_vel_w.to_numpy()[0, :2]) < 0
    assert closest(scene.behavior.evade_vel_w.to_numpy()[0, :2]) > CFG.behavior.contact_m


def test_evasion_stays_off_the_wall(scene):
    """With a wall on one side the body is passed on the other."""
    low_wall = (np.arange(SIZES["n_row"]) * CELL - 2.0)[:, None].clip(0, 2)
    put(scene.clearance.site, np.broadcast_to(room(low_wall), scene.clearance.site.shape[1:]))
    for env, offset in enumerate((0.1, -0.1)):
        put(scene.ego.pos_w, (5.0, 2.2, -0.8), env)
        put(scene.route.lookahead_w, (6.0, 2.2, -0.8), env)
        body(scene, env, 0, (7.0, 2.2 + offset), (-0.6, 0.0))
    decide(scene)
    assert (scene.behavior.evade_vel_w.to_numpy()[:2, 1] > 0).all()


def test_last_command_breaks_the_tie(scene):
    """Hysteresis: of two mirror images the one that goes on with the last command is taken."""
    for env, side in enumerate((0.4, -0.4)):
        body(scene, env, 0, (7.0, 3.0), (-0.6, 0.0))
        put(scene.behavior.last_vel_w, (0.3, side, 0.0), env)
    decide(scene)
    sideways = scene.behavior.evade_vel_w.to_numpy()[:2, 1]
    assert sideways[0] > 0.1 and sideways[1] < -0.1


def test_evasion_holds_between_decisions_and_ends_when_calm(scene):
    body(scene, 0, 0, (7.0, 3.1), (-0.6, 0.0))
    decide(scene)
    held = scene.behavior.evade_vel_w.to_numpy()[0]
    scene.forecast.radius_m.fill(-1.0)
    step(scene, CFG.behavior.decide_period_steps - 1)
    np.testing.assert_array_equal(scene.behavior.evade_vel_w.to_numpy()[0], held)
    assert acting(scene)[0] == "Evade"
    assert scene.behavior.evading_steps.to_numpy()[0] == CFG.behavior.decide_period_steps
    step(
        scene, round(CFG.behavior.hysteresis_s / CFG.episode.control_dt_s) + CFG.behavior.decide_period_steps
    )
    assert acting(scene)[0] == "FollowRoute"


def closing_beams(scene, env, beams, range_m=0.45, speed=0.6):
    for beam in beams:
        put(scene.scan.hit, 1, env, beam)
        put(scene.scan.range_m, range_m, env, beam)
        put(scene.scan.doppler_m_s, -speed, env, beam)


def test_sensed_emergency_backs_off_from_it(scene):
    """Two neighbouring beams agree: retreat. One alone is an outlier. Turned since: still the same place."""
    left = N_RAY // 4
    closing_beams(scene, 0, (left, left + 1))
    closing_beams(scene, 1, (left,))
    closing_beams(scene, 2, (left, left + 1))
    put(scene.ego.rpy, (0, 0, 0.5), 2)
    closing_beams(scene, 3, (N_RAY - 1, 0))  # the ring closes
    decide(scene)
    assert acting(scene) == ["BackOff", "FollowRoute", "BackOff", "BackOff", "FollowRoute", "FollowRoute"]
    velocity = scene.behavior.last_vel_w.to_numpy()
    assert velocity[0, 1] < -0.8 and abs(velocity[0, 0]) < 0.15
    np.testing.assert_allclose(velocity[2], velocity[0], atol=1e-5)
    assert velocity[3, 0] < -0.8
    assert scene.behavior.ttc_s.to_numpy()[0] == pytest.approx(
        (0.45 - CFG.behavior.hull_reach_m - CFG.behavior.contact_m) / 0.6, rel=1e-4
    )
    assert scene.behavior.nearest_m.to_numpy()[1] == pytest.approx(0.45 - CFG.behavior.hull_reach_m, rel=1e-4)


def test_the_less_sure_of_its_place_the_nearer_are_walls(scene):
    """2.5 standard deviations of the worst direction, here and on the way."""
    scene.clearance.site.fill(int(room(1.0)))
    sigma, turn = np.array([0.0, 0.01, 0.05, 0.1, 0.2, 0.3]), np.linspace(0, 3, N_ENV)
    c, s = np.cos(turn), np.sin(turn)
    zero, worst, best = 0 * sigma, sigma**2, (0.3 * sigma) ** 2
    cov = [
        c * c * worst + s * s * best, c * s * (worst - best), zero, s * s * worst + c * c * best, zero, zero,
    ]  # fmt: skip
    put(scene.ego.pose_cov, np.stack(cov, 1))
    assess(scene)
    for found in (scene.behavior.clearance_m, scene.behavior.path_clearance_m):
        np.testing.assert_allclose(found.to_numpy(), 1.0 - 2.5 * sigma, atol=1e-5)


def test_retreat_does_not_run_into_a_wall(scene):
    """Threat ahead, wall behind: the retreat slides along instead."""
    closing_beams(scene, 0, (0, 1))
    scene.clearance.site.fill(int(away(0, -4)))
    put(scene.ego.pos_w, (5.0, 3.05, -0.8), 0)  # on the row of cells with the wall's
    decide(scene)
    assert acting(scene)[0] == "BackOff"
    assert scene.behavior.last_vel_w.to_numpy()[0, 0] > -0.1


def test_stuck_creeps_to_the_end_of_its_time(scene):
    """Unstick stands in a sequence with memory: it outlasts the condition that began it."""
    scene.clearance.site.fill(int(away(0, -6)))
    put(scene.route.stuck_steps, round(tree.STUCK_S / CFG.episode.control_dt_s), 0)
    decide(scene)
    assert acting(scene)[:2] == ["Unstick", "FollowRoute"]
    assert scene.behavior.last_vel_w.to_numpy()[0, 0] > 0.9 * tree.UNSTICK_M_S
    scene.route.stuck_steps.fill(0)
    step(scene, round(tree.UNSTICK_S / CFG.episode.control_dt_s) - 2)
    assert acting(scene)[0] == "Unstick"
    step(scene, 4)
    assert acting(scene)[0] == "FollowRoute"


def test_waits_without_a_route_and_before_a_blocked_one(scene):
    put(scene.route.n_way, 0, 0)
    x0, y0 = grid_origin(TANK, CELL)
    put(scene.clearance.site, room(0.1), 1, int((3.0 - y0) / CELL), int((5.62 - x0) / CELL))
    decide(scene)
    names = [scene.tree.names[node] for node in scene.behavior.leaf.to_numpy()]
    assert names[0] == "no route" and names[1] == "wait for a free way" and names[2] == "FollowRoute"
    np.testing.assert_array_equal(scene.action[:2], 0.0)


def test_yardsticks_do_not_avoid_obstacles(scene):
    body(scene, 0, 0, (7.0, 3.0), (-0.6, 0.0))
    put(scene.mission.goal_w, (5.0, 5.0, -0.4))
    for name, leaf in (("planner", "FollowRoute"), ("straight", "DriveStraight")):
        use(scene, name)
        decide(scene)
        assert acting(scene) == [leaf] * N_ENV
    # to port, up, turning there
    assert scene.action[0, 1] > 0.99 and scene.action[0, 2] == 1.0 and scene.action[0, 3] > 0.9


def test_depth_goes_to_the_goals_but_not_towards_a_obstacle(scene):
    """Following climbs and dives where nothing can be met there; a tree can ask for it all the same."""
    scene.mission.goal_w.from_numpy(np.tile(np.float32([15.0, 3.0, -1.2]), (N_ENV, 1)))
    near, still = (6.0, 3.0), (0.0, 0.0)
    body(scene, 1, 0, near, still, above=OPEN_M, below=-1.1)
    body(scene, 2, 0, near, still, above=-0.5, below=-OPEN_M)
    body(scene, 3, 0, (5.0, 5.8), still, above=OPEN_M, below=-1.1)
    put(scene.ego.pos_w, (5.0, 3.0, -1.2), 4)
    put(scene.mission.goal_w, (15.0, 3.0, -1.6), 4)
    body(scene, 5, 0, near, still, above=OPEN_M, below=-1.1)
    put(scene.mission.goal_w, (15.0, 3.0, -0.6), 5)
    lowest = TANK.z_m[0] + CFG.behavior.edge_gap_m
    for guard, wanted in (
        ("", (-0.4, 0.0, -0.4, -0.4, lowest + 1.2, 0.2)),
        (' depth_guard="0"', (-0.4, -0.4, -0.4, -0.4, -0.4, 0.2)),
    ):
        xml = f'<root BTCPP_format="4"><BehaviorTree ID="main"><FollowRoute{guard}/></BehaviorTree></root>'
        scene.tree = parse_tree(xml)
        load_tree(scene.table, scene.tree)
        decide(scene)
        assert acting(scene) == ["FollowRoute"] * N_ENV
        np.testing.assert_allclose(scene.action[:, 2] * CFG.vehicle.max_heave_m_s, wanted, atol=1e-5)


def corridor(scene, half_width):
    """Walls on both sides of y = 3."""
    y = grid_origin(TANK, CELL)[1] + (np.arange(SIZES["n_row"]) + 0.5) * CELL
    free = (half_width - np.abs(y - 3.0)).clip(0)
    put(scene.clearance.site, np.broadcast_to(room(free)[:, None], scene.clearance.site.shape[1:]))


def test_climbs_or_dives_past_what_fills_the_way(scene):
    """Something faster comes: over it if it is below, under it if above, not beyond the band."""
    corridor(scene, 0.5)
    top = TANK.z_m[1] - CFG.behavior.edge_gap_m - 0.05
    for env, (above, below) in enumerate(((OPEN_M, -0.8), (-0.8, -OPEN_M), (OPEN_M, top), (-0.8, -0.8))):
        body(scene, env, 0, (6.3, 3.0), (-0.8, 0.0), above=above, below=below)
    put(scene.ego.pos_w, (5.0, 3.0, top), 2)
    put(scene.mission.goal_w, (15.0, 3.0, top), 2)
    decide(scene)
    heave = scene.behavior.evade_vel_w.to_numpy()[:, 2]
    assert acting(scene) == ["Evade"] * 4 + ["FollowRoute"] * 2
    assert heave[0] > 0.9 * CFG.behavior.heave_m_s and heave[1] < -0.9 * CFG.behavior.heave_m_s
    assert abs(heave[2]) <= 0.05 + 1e-5
    scene.ego.given_up.fill(5)
    decide(scene)
    assert scene.behavior.evade_vel_w.to_numpy()[2, 2] < -0.01, "out of the wider gap"
    assert abs(heave[3]) < 0.1  # level with it at any depth: heave only leads away from the route


def test_patience_falls_while_it_does_not_come_on_and_comes_back(scene):
    """At rest, slow, at the speed that is no waiting, driving, going astern; its caution falls with it."""
    speeds = np.array([0.0, 0.1, 0.2, 0.6, -0.2, 0.0])
    put(scene.ego.vel_b, speeds, slice(None), 0)
    step_s = CFG.behavior.decide_period_steps * CFG.episode.control_dt_s
    for _ in range(50):
        assess(scene)
    waited = 50 * step_s * np.maximum(1 - speeds / threats.WAITING_M_S, 0)
    np.testing.assert_allclose(scene.behavior.waited_s.to_numpy(), waited, atol=1e-4)
    patience = np.minimum(1, CFG.behavior.patience_s / np.maximum(waited, 1e-3))
    np.testing.assert_allclose(scene.behavior.patience.to_numpy(), patience, atol=1e-4)
    put(scene.ego.vel_b, 0.5, slice(None), 0)
    for _ in range(100):
        assess(scene)
    assert np.all(scene.behavior.patience.to_numpy() == 1)
    bundles.put(scene.ego, vel_b=0)
    for _ in range(50):
        assess(scene, SLOW)
    assert np.all(scene.behavior.patience.to_numpy() == 1)


def test_margins_shrink_with_patience(scene):
    """What is no conflict any more for a vehicle that has waited."""
    body(scene, 0, 0, (7.0, 3.75), (0.0, 0.0))
    body(scene, 1, 0, (7.0, 3.75), (0.0, 0.0))
    assess(scene)
    assert np.all(scene.behavior.conflict_s.to_numpy()[:2] < FAR_M)
    put(scene.behavior.waited_s, 8 * CFG.behavior.patience_s, 1)
    assess(scene)
    assert scene.behavior.conflict_s[0] < FAR_M == scene.behavior.conflict_s[1]


def test_what_is_far_enough_below_is_no_conflict(scene):
    """The same obstacle on the way: level, a little below, well below."""
    for env, below in enumerate((-0.8, -0.9, -1.5)):
        body(scene, env, 0, (7.0, 3.0), (-0.6, 0.0), above=OPEN_M, below=below)
    decide(scene)
    conflict = scene.behavior.conflict_s.to_numpy()
    assert acting(scene)[:3] == ["Evade", "Evade", "FollowRoute"]
    assert conflict[0] <= conflict[1] < conflict[2] == FAR_M


def test_stopping_is_safe_beside_the_path_of_a_obstacle(scene):
    """It passes ahead: stop. It comes here: stopping does not help. A tree may ask for one second."""
    body(scene, 0, 0, (6.3, 5.0), (0.0, -0.9))
    body(scene, 1, 0, (6.6, 3.0), (-0.9, 0.0))
    body(scene, 2, 0, (7.6, 3.0), (-0.9, 0.0))
    for port, waiting in (("", ("Hold", None, None)), (' within_s="1"', ("Hold", None, "Hold"))):
        text = f"<ReactiveSequence><SafeHere{port}/><Hold/></ReactiveSequence>"
        scene.tree = parse_tree(
            f'<root BTCPP_format="4"><BehaviorTree ID="main">{text}</BehaviorTree></root>'
        )
        load_tree(scene.table, scene.tree)
        decide(scene)
        assert acting(scene) == [*waiting, *["Hold"] * (N_ENV - 3)]
    assert scene.behavior.conflict_s.to_numpy()[0] < FAR_M == scene.behavior.hold_conflict_s.to_numpy()[0]


def test_conflicts_are_foreseen_at_cruise_speed_even_if_evasion_is_slower(scene):
    """What no velocity reaches is not rolled out: following reaches farther than evading here."""
    body(scene, 0, 0, (6.7, 3.0), (0.0, 0.0))
    assess(scene)
    sooner = scene.behavior.conflict_s.to_numpy()[0]
    assess(scene, SLOW)
    assert scene.behavior.conflict_s.to_numpy()[0] == sooner < FAR_M


def test_a_dash_gets_out_of_the_way_in_a_narrow_place(scene):
    """Only a short dash clears what crosses fast and stops before the end of the water beside its path."""
    x = grid_origin(TANK, CELL)[0] + (np.arange(SIZES["n_col"]) + 0.5) * CELL
    free = (0.75 - np.abs(x - 5.0)).clip(0)
    put(scene.clearance.site, np.broadcast_to(room(free), scene.clearance.site.shape[1:]))
    body(scene, 0, 0, (5.0, 3.9), (0.0, -1.2), radius=0.25)
    decide(scene)
    cost = scene.behavior.candidate_cost.to_numpy()[0]
    best, first = cost.argmin(), CFG.behavior.first_burst
    assert acting(scene)[0] == "Evade"
    assert best >= first and cost[best] < cost[:first].min() - 0.3
    velocity, lasts = (pair[best] for pair in View(scene, 0).candidates())
    assert lasts == CFG.behavior.burst_s
    np.testing.assert_allclose(scene.behavior.evade_vel_w.to_numpy()[0], velocity, atol=1e-5)


def test_candidates_fill_whole_packets():
    """Stop, last command and follow are always there; climbing, diving and dashes can be left out."""
    level = {"n_heading": 5, "n_speed": 3, "n_heave_heading": 4}
    held, first, count = (
        [
            getattr(BehaviorConfig(**level, heave_m_s=heave, burst_s=burst), name)
            for heave, burst in ((0, 0), (0, 0.5), (0.4, 0), (0.4, 0.5))
        ]
        for name in ("n_held", "first_burst", "n_candidate")
    )
    assert held == [18, 18, 28, 28] and first == [32] * 4 and count == [32, 64, 32, 64]


def test_actions_point_along_the_wanted_velocity(scene):
    """At any attitude the scaled action is parallel to the velocity in the world, within its limits."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        rpy = rng.uniform([-0.2, -0.2, -3.1], [0.2, 0.2, 3.1], (N_ENV, 3))
        put(scene.ego.rpy, rpy)
        put(scene.route.lookahead_w, [5, 3, -0.8] + np.c_[rng.uniform(-1, 1, (N_ENV, 2)), np.zeros(N_ENV)])
        decide(scene)
        action = scene.action.numpy().astype(float)
        assert np.abs(action).max() <= 1
        velocity = scene.behavior.last_vel_w.to_numpy()
        for env in range(N_ENV):
            cr, cp, cy = np.cos(rpy[env])
            sr, sp, sy = np.sin(rpy[env])
            R_wb = np.array(
                [
                    [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                    [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                    [-sp, cp * sr, cp * cr],
                ]
            )
            driven = R_wb @ (
                action[env, :3]
                * [CFG.vehicle.max_surge_m_s, CFG.vehicle.max_sway_m_s, CFG.vehicle.max_heave_m_s]
            )
            np.testing.assert_allclose(driven, velocity[env], atol=2e-3)


def test_faster_than_the_axes_only_on_diagonals(scene):
    """In evasion the body turns a diagonal to its way."""
    body(scene, 0, 0, (6.6, 3.0), (-0.8, 0.0))
    decide(scene)
    velocity = scene.behavior.last_vel_w.to_numpy()[0]
    turn = scene.action[0, 3].item() * CFG.vehicle.max_yaw_rate_rad_s / CFG.behavior.yaw_gain
    off = (np.arctan2(velocity[1], velocity[0]) - turn) / (np.pi / 4)
    assert abs(turn) <= np.pi / 4 + 1e-4
    assert abs(off - round(off)) < 0.02 and round(off) % 2 == 1


# ---------------------------------------------------------------------------------------------- narrow places


def near_m(metres):
    """[m] of the site whose distance is nearest to ``metres``."""
    return float(clearance_m(room(metres), CFG))


def blocks(scene, env, *ways, clearance_m=0.2):
    """Little clearance in the cells at these ways from the vehicle."""
    x0, y0 = grid_origin(TANK, CELL)
    for x, y in scene.ego.pos_w.to_numpy()[env, :2] + np.array(ways):
        put(scene.clearance.site, room(clearance_m), env, int((y - y0) / CELL), int((x - x0) / CELL))


def route_ahead(scene, way, lookahead):
    """Own place off the borders of cells, points of the route at ``way`` [n, 2] from there, look-ahead."""
    own = np.array([5.05, 3.03])
    bundles.put(scene.ego, pos_w=(*own, -0.8))
    put(scene.route.ahead_w, own + way)
    scene.route.n_ahead.fill(len(way))
    put(scene.route.lookahead_w, (*(own + lookahead), -0.8))


def test_round_a_corner_a_nearer_point_of_the_route_is_steered_for(scene):
    """The farthest of the points at 0.6, 0.4 and 0.2 m is taken if only the straight way is narrow."""
    up, right = np.minimum(np.arange(16), 4), np.maximum(np.arange(16) - 4, 0)
    route_ahead(scene, 0.1 * np.stack([right, up], 1), (1.0, 0.4))
    put(scene.route.n_ahead, 5, 3)
    put(scene.route.n_way, 0, 5)
    straight, to_sixth = (0.375, 0.15), (0.15, 0.3)
    for env in (1, 2, 3, 5):
        blocks(scene, env, straight)
    blocks(scene, 2, to_sixth)
    blocks(scene, 4, straight, clearance_m=0.43)
    assess(scene)
    steer, nearest = scene.behavior.steer_w.to_numpy(), scene.behavior.path_clearance_m.to_numpy()
    np.testing.assert_allclose(
        steer, [(1.0, 0.4), (0.2, 0.4), (0.0, 0.4), (0.0, 0.4), (1.0, 0.4), (1.0, 0.4)], atol=1e-5
    )
    np.testing.assert_allclose(nearest, [2.0, 2.0, 2.0, 2.0, near_m(0.43), 2.0], atol=1e-6)
    follow = scene.behavior.follow_vel_w.to_numpy()[:, :2]
    np.testing.assert_allclose(np.arctan2(*follow[:5].T), np.arctan2(*steer[:5].T), atol=1e-5)
    np.testing.assert_allclose(
        np.hypot(*follow[[0, 1, 5]].T), [CFG.behavior.cruise_m_s, CFG.behavior.cruise_m_s, 0.0], atol=1e-5
    )


def test_where_every_way_is_narrow_the_widest_is_steered_for(scene):
    """Of equals the farthest, so the look-ahead point where no nearer one has more room."""
    route_ahead(scene, 0.1 * np.stack([np.zeros(16), np.arange(16)], 1), (1.0, 0.0))
    scene.clearance.site.fill(int(room(0.35)))
    narrow = ((0.1, 0.2, 0.25, 0.3), (0.1, 0.3, 0.32, 0.32), (0.3, 0.1, 0.2, 0.3), (0.1, 0.35, 0.35, 0.35))
    for env, rooms in enumerate(narrow):
        for way, room_m in zip(((0.5, 0.0), (0.0, 0.53), (0.0, 0.32), (0.0, 0.12)), rooms, strict=True):
            blocks(scene, env, way, clearance_m=room_m)
    assess(scene)
    np.testing.assert_allclose(
        scene.behavior.steer_w.to_numpy()[:4], [(0.0, 0.2), (0.0, 0.4), (1.0, 0.0), (0.0, 0.6)], atol=1e-5
    )
    np.testing.assert_allclose(
        scene.behavior.path_clearance_m.to_numpy()[:4], [0.3, near_m(0.32), 0.3, near_m(0.35)], atol=1e-6
    )


def test_a_narrow_way_is_entered_lengthwise(scene):
    """Across the way 0.4 of the speed is left; along it what clearance allows."""
    turned = np.radians([0, 90, 180, 30, -90, 90])
    put(scene.ego.rpy, np.stack([0 * turned, 0 * turned, turned], 1))
    scene.clearance.site.fill(int(room(0.45)))
    put(scene.clearance.site, room(0.51), 5)
    assess(scene)
    speed = np.hypot(*scene.behavior.follow_vel_w.to_numpy()[:, :2].T)
    here, wider = (0.6 * (0.5 + 0.5 * (near_m(metres) - 0.32) / 0.6) for metres in (0.45, 0.51))
    np.testing.assert_allclose(speed, [here, 0.4 * here, here, 0.7 * here, 0.4 * here, wider], atol=1e-5)


# ------------------------------------------------------------------------------------------------------- gaze


def test_who_is_looked_at(scene):
    """Above and below before level ones (1 m farther), the nearest first, nobody beyond 3 m or if narrow."""
    reach = 0.2 + CFG.behavior.hull_reach_m
    still, over, under = (0.0, 0.0), {"above": -0.3, "below": -OPEN_M}, {"above": OPEN_M, "below": -1.3}
    cases = [
        [((1.0, 0.0), {}), ((0.0, 1.9), over), ((0.0, -2.5), under)],
        [((1.0, 0.0), {}), ((0.0, 2.1), over)],
        [((0.0, 2.1), {}), ((-1.5, 0.0), {}), ((0.0, 2.6), over)],
        [((0.0, 1.95 + reach), {}), ((0.0, -2.05 - reach), {})],
        [((2.05 + reach, 0.0), {}), ((3.05 + reach, 0.0), over)],
        [((0.0, 2.95 + reach), under)],
    ]
    for env, obstacles in enumerate(cases):
        for track, (way, height) in enumerate(obstacles):
            body(scene, env, track, np.add((5.0, 3.0), way), still, **height)
    wanted = np.array(
        [(0.0, 1.9), (1.0, 0.0), (-1.5, 0.0), (0.0, 1.95 + reach), (0.0, 0.0), (0.0, 2.95 + reach)]
    )
    assess(scene)
    np.testing.assert_allclose(scene.behavior.heading_w.to_numpy(), wanted, atol=1e-5)
    nearest = np.array([1.0 - reach, 1.0 - reach, 1.5 - reach, 1.95, 2.05, 2.95])
    np.testing.assert_allclose(scene.behavior.obstacle_near_m.to_numpy(), nearest, atol=1e-5)
    put(scene.clearance.site, room(0.59), slice(0, 3))
    put(scene.clearance.site, room(0.61), 3)
    blocks(scene, 5, (0.55, 0.05))
    assess(scene)
    np.testing.assert_allclose(
        scene.behavior.heading_w.to_numpy(), [*np.zeros((3, 2)), wanted[3], *np.zeros((2, 2))], atol=1e-5
    )


def polar(degrees, length=1.0):
    return length * np.stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))], -1)


def turns(
    scene, xml, yaw: Any = 0.0, gaze: Any = None, way: Any = None, way_of="follow_vel_w", speed=0.5,
    room_m=2.0, sonar=CFG.sensors.sonar, **changes,
):  # fmt: skip
    """[degree] that the nose is told to turn by; bearings of the gaze and of the velocity, None = none."""
    for name, degrees, length in (("heading_w", gaze, 1.5), (way_of, way, speed)):
        field = getattr(scene.behavior, name)
        at = np.array(
            [np.zeros(2) if d is None else polar(d, length) for d in np.broadcast_to(degrees, N_ENV)]
        )
        put(field, np.pad(at, ((0, 0), (0, field.n - 2))))
    put(scene.behavior.path_clearance_m, room_m)
    put(
        scene.ego.rpy,
        np.stack([np.zeros(N_ENV), np.zeros(N_ENV), np.radians(np.broadcast_to(yaw, N_ENV))], 1),
    )
    scene.tree = parse_tree(f'<root BTCPP_format="4"><BehaviorTree ID="main">{xml}</BehaviorTree></root>')
    load_tree(scene.table, scene.tree)
    tick(scene, CFG.behavior.model_copy(update=changes), sonar)
    return np.degrees(scene.action[:, 3].numpy() * CFG.vehicle.max_yaw_rate_rad_s / CFG.behavior.yaw_gain)


MOST_DEG = np.degrees(CFG.vehicle.max_yaw_rate_rad_s / CFG.behavior.yaw_gain)
"""A larger angle saturates the yaw rate."""

ANGLE_TOLERANCE = 1e-3
"""[degree] float32 angles of up to 3 rad are good to 1e-5 degrees; the action stores them as a share of 38
degrees."""


def test_following_the_nose_looks_at_the_obstacle(scene):
    """Whatever the way; without one, along the way; the shorter way round."""
    found = turns(
        scene, "<FollowRoute/>", yaw=[0, 0, 0, 170, 0, 0], gaze=[20, -30, None, -170, 120, -120],
        way=[0, 90, 10, 0, 0, 0],
    )  # fmt: skip
    np.testing.assert_allclose(found, [20, -30, 10, 20, MOST_DEG, -MOST_DEG], atol=ANGLE_TOLERANCE)
    # the way itself stays
    np.testing.assert_allclose(np.hypot(*scene.behavior.last_vel_w.to_numpy()[:, :2].T), 0.5, atol=1e-6)


def test_with_a_fan_ahead_it_turns_before_it_drives(scene):
    """Full speed up to 45 degrees off, none beyond 65, and the nose turns until the way is 45 degrees off."""
    fan = CFG.sensors.sonar.model_copy(update={"horizontal_aperture_deg": 130.0})
    way = np.resize([0.0, 40.0, 55.0, 70.0, 180.0, -55.0], N_ENV)
    ahead = np.stack([np.cos(np.radians(way)), np.sin(np.radians(way)), 0 * way], 1)
    put(scene.route.lookahead_w, np.add(ahead, (5.0, 3.0, -0.8)))
    assess(scene, sonar=fan)
    tick(scene, sonar=fan)
    speed = np.hypot(*scene.behavior.last_vel_w.to_numpy()[:, :2].T)[:6]
    np.testing.assert_allclose(speed / speed[0], [1, 1, 0.5, 0, 0, 0.5], atol=1e-3)
    rate = scene.action.numpy()[:6, 3]
    assert (rate[2:4] > 0).all() and abs(rate[4]) > 0 and rate[5] < 0, "towards the way"
    assess(scene)
    assert scene.behavior.speed_share.to_numpy()[4] == scene.behavior.speed_share.to_numpy()[0], (
        "a ring sees all around"
    )


def test_waiting_the_nose_looks_at_the_obstacle(scene):
    np.testing.assert_allclose(
        turns(scene, "<Hold/>", yaw=[0, 10, 0, 0, -175, 0], gaze=[20, 20, None, -35, 175, 38], way=0),
        [20, 10, 0, -35, -10, 38],
        atol=ANGLE_TOLERANCE,
    )
    assert not scene.behavior.last_vel_w.to_numpy().any()


def test_in_danger_a_diagonal_goes_along_the_way_near_the_gaze(scene):
    """Gaze and way to turn: the diagonals are 45 degrees off the way (and 90 from each other); the nearest to
    the gaze, within 25 of it.

    20/30: diagonals at -15 and 75, the nearest is 35 off, so 20 - 25. 10/60: at 15, taken. 5/90: at 45, 40
    off, so 5 + 25. Without a gaze the nearest to the present heading: 20 gives -25, 100 gives -35.
    """
    gaze, way = [20, 10, 5, None, None, 0], [30, 60, 90, 20, 100, None]
    wanted = [-5, 15, 30, -25, -35, 0]
    np.testing.assert_allclose(
        turns(scene, "<Evade/>", 0, gaze, way, "evade_vel_w"), wanted, atol=ANGLE_TOLERANCE
    )
    again = turns(
        scene,
        "<Evade/>",
        150,
        [None if g is None else g + 150 for g in gaze],
        [None if w is None else w + 150 for w in way],
        "evade_vel_w",
    )
    np.testing.assert_allclose(again, wanted, atol=ANGLE_TOLERANCE)
    narrow = turns(scene, "<Evade/>", 0, None, [20, 100, 150, 200, -20, 0], "evade_vel_w", room_m=0.3)
    # no tail first: any diagonal is as good
    np.testing.assert_allclose(narrow[:5], [-25, -35, 15, -25, 25], atol=ANGLE_TOLERANCE)


def test_a_diagonal_goes_along_an_open_way_whatever_is_looked_at(scene):
    """The diagonals are 45 degrees off the way: 20 gives -25, 60 gives 15, 10 to the left gives -35."""
    way, gaze, yaw = [20, 60, 100, 20, None, 60], [90, -60, None, 20, 30, 0], [0, 0, 90, 0, 0, 0]
    wanted = [-25, 15, -35, -25, 30, 15]
    found = turns(scene, "<FollowRoute/>", yaw, gaze, way, travel_diagonal=True)
    np.testing.assert_allclose(found, wanted, atol=ANGLE_TOLERANCE)
    narrow = {"room_m": 0.59}
    for xml, more in (("<FollowRoute/>", narrow), ("<Evade/>", {"way_of": "evade_vel_w"})):
        as_ever = turns(scene, xml, yaw, gaze, way, **more)
        np.testing.assert_allclose(turns(scene, xml, yaw, gaze, way, **more, travel_diagonal=True), as_ever)
    fan = CFG.sensors.sonar.model_copy(update={"horizontal_aperture_deg": 130.0})
    ahead = [
        turns(scene, "<FollowRoute/>", yaw, gaze, way, sonar=fan, travel_diagonal=on) for on in (True, False)
    ]
    np.testing.assert_array_equal(*ahead, err_msg="who sees ahead alone looks ahead")


def test_backing_off_the_nose_keeps_to_the_diagonal_near_the_gaze(scene):
    """The retreat goes straight back, the nose 25 degrees towards the nearest diagonal."""
    bundles.put(scene.behavior, threat_bearing=0.0, clearance_m=2.0)
    np.testing.assert_allclose(
        np.abs(turns(scene, "<BackOff/>", gaze=[0, 0, 0, 5, 5, 5])),
        [25, 25, 25, 30, 30, 30],
        atol=ANGLE_TOLERANCE,
    )


def test_in_narrow_places_tail_first_is_as_slim(scene):
    """Following the route below 0.6 m of clearance, the nearer of nose and tail turns along the way."""
    way = [150, -150, 30, 80, 100, 180]
    nose = np.clip(way, -MOST_DEG, MOST_DEG)
    tail = turns(scene, "<FollowRoute/>", way=way, room_m=0.59)
    np.testing.assert_allclose(tail[:3], [-30, 30, 30], atol=ANGLE_TOLERANCE)
    np.testing.assert_allclose(tail[3:5], [MOST_DEG, -MOST_DEG], atol=ANGLE_TOLERANCE)
    assert abs(tail[5]) < ANGLE_TOLERANCE
    for room_m in (0.6, 2.0):
        np.testing.assert_allclose(
            np.abs(turns(scene, "<FollowRoute/>", way=way, room_m=room_m)), np.abs(nose), atol=ANGLE_TOLERANCE
        )
    put(scene.mission.goal_w, np.column_stack([np.array([5.0, 3.0]) + polar(way, 5.0), np.full(N_ENV, -0.8)]))
    straight = turns(scene, "<DriveStraight/>", way=way, room_m=0.3)
    np.testing.assert_allclose(straight[:5], nose[:5], atol=ANGLE_TOLERANCE)


def test_yardsticks_look_at_nobody(scene):
    """Without guarding the depth, and driving straight, the nose goes along the way."""
    way, gaze = [0, 10, 20, -10, 30, 0], [30, -30, 90, 180, 0, -5]
    np.testing.assert_allclose(
        turns(scene, '<FollowRoute depth_guard="0"/>', gaze=gaze, way=way), way, atol=ANGLE_TOLERANCE
    )
    put(scene.mission.goal_w, np.column_stack([np.array([5.0, 3.0]) + polar(way, 5.0), np.full(N_ENV, -0.8)]))
    np.testing.assert_allclose(turns(scene, "<DriveStraight/>", gaze=gaze), way, atol=ANGLE_TOLERANCE)
    np.testing.assert_allclose(
        turns(scene, '<FollowRoute depth_guard="1"/>', gaze=gaze, way=way)[[0, 1, 5]],
        [30, -30, -5],
        atol=ANGLE_TOLERANCE,
    )


# ------------------------------------------------------------------------------------------------- discipline


def contents(struct):
    return {f.name: getattr(struct, f.name).to_numpy() for f in dataclasses.fields(struct)}


def test_sleeping_rows_are_untouched_and_rows_do_not_meet(scene):
    """Row 0 gives the same bits whatever its neighbours do; inactive rows keep theirs; a reset forgets."""

    def drama(scene, others):
        bundles.put(scene.clock, active=1, step=0)
        scene.forecast.radius_m.fill(-1.0)
        tree.reset_behavior(scene.io(BehaviorIO))
        body(scene, 0, 0, (7.0, 3.1), (-0.6, 0.0))
        for env in range(1, N_ENV):
            if others:
                body(scene, env, 1, (6.0, 3.0), (-0.3 * env, 0.1))
        decide(scene)
        step(scene, 7)
        return {name: value[0] for name, value in contents(scene.behavior).items()}

    first, second = drama(scene, False), drama(scene, True)
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)
    put(scene.clock.active, 0, 1)
    before = contents(scene.behavior)
    put(scene.scan.hit, 1)
    put(scene.scan.range_m, 0.4)
    step(scene, 3)
    after = contents(scene.behavior)
    for name in before:
        np.testing.assert_array_equal(before[name][1], after[name][1], err_msg=name)
    assert (before["ticks"][0] != after["ticks"][0]).any()


def test_counts_say_who_acted(scene):
    decide(scene)
    step(scene, 4)
    acted, ticks = scene.behavior.acted.to_numpy(), scene.behavior.ticks.to_numpy()
    assert acted[0, scene.tree.types.index("FollowRoute")] == 5 and acted[0].sum() == 5
    assert ticks[0, 0] == 5 and ticks[0, scene.tree.types.index("BackOff")] == 0
