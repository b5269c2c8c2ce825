"""Threats, evasion and the tree's leaves in hand-made situations, and the packets against a NumPy oracle."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti
import torch

from tests.reference import teacher as oracle
from uuvtai import state
from uuvtai.config import Config
from uuvtai.kernels import evasion, teacher, threats
from uuvtai.kernels.geometry import FAR_M
from uuvtai.kernels.grid import grid_origin, grid_shape
from uuvtai.tree import load_tree, read_tree

N_ENV, N_TRACK, N_RAY = 6, 4, 64
CFG = Config.model_validate({"sensors": {"sonar": {"n_ray": N_RAY}}, "tracking": {"n_track": N_TRACK}})
N_SAMPLE = round(CFG.tracking.horizon_s / CFG.tracking.forecast_dt_s) + 1
TIMES = np.arange(N_SAMPLE) * CFG.tracking.forecast_dt_s
CELL = CFG.mapping.cell_m
SIZES = {
    "n_env": N_ENV,
    "n_node": CFG.teacher.max_node,
    "n_candidate": CFG.teacher.n_candidate,
    "n_track": N_TRACK,
    "n_forecast": N_SAMPLE,
    "n_ray": N_RAY,
    "n_row": grid_shape(CFG.world.tank, CELL)[0],
    "n_col": grid_shape(CFG.world.tank, CELL)[1],
}
COST_TOLERANCE = 2e-3
"""Costs are up to 60: float32 positions of 20 m (2e-6 m) times weights of 30 per metre and about 150 summed terms."""
BORDER_M = 1e-4
"""A sample this close to a cell border may fall into the other cell in float32; such candidates are not compared."""
STRUCTS = {
    "t": state.TeacherState,
    "route": state.RouteState,
    "forecast": state.ForecastState,
    "scan": state.SonarScan,
    "clearance": state.ClearanceState,
    "ego": state.Proprioception,
    "clock": state.ClockState,
    "mission": state.MissionState,
    "table": state.TreeTable,
}


class Sizes(dict):
    """Axes that this stage does not touch are short."""

    def __missing__(self, name):
        return 1


@pytest.fixture(scope="module")
def stage():
    made = SimpleNamespace(**{name: state.allocate(struct, Sizes(SIZES)) for name, struct in STRUCTS.items()})
    made.action = torch.zeros(N_ENV, 4)
    return made


@pytest.fixture
def scene(stage):
    """Every env alike: at (5, 3), facing +x, at rest, open water, look-ahead 1 m ahead, nothing around."""
    stage.clock.awake.fill(1)
    stage.clock.step.fill(0)
    fill(stage.ego.pos_w, (5.0, 3.0, -0.8))
    fill(stage.ego.vel_b, (0, 0, 0))
    fill(stage.ego.rpy, (0, 0, 0))
    fill(stage.mission.goal_w, (15.0, 3.0, -0.8))
    fill(stage.route.lookahead_w, (6.0, 3.0, -0.8))
    stage.route.n_way.fill(10)
    stage.route.stuck_steps.fill(0)
    stage.forecast.radius_m.fill(-1.0)
    stage.forecast.pos_w.fill(0.0)
    stage.scan.fresh.fill(1)
    stage.scan.hit.fill(0)
    stage.scan.range_m.fill(12.0)
    stage.scan.doppler_m_s.fill(0.0)
    stage.scan.ping_yaw.fill(0.0)
    stage.clearance.clearance_m.fill(2.0)
    stage.clearance.site_row.fill(-1)
    stage.clearance.site_col.fill(-1)
    use(stage, "bt")
    teacher.reset_teacher(stage.t, stage.clock)
    return stage


def fill(field, value):
    field.from_numpy(np.broadcast_to(np.asarray(value, np.float32), (*field.shape, field.n)).copy())


def put(field, value, *index):
    """Overwrite entries of a field by a NumPy index."""
    values = field.to_numpy()
    values[index if index else ...] = value
    field.from_numpy(values)


def use(stage, name):
    stage.tree = read_tree(name)
    load_tree(stage.table, stage.tree)


def body(stage, env, track, pos, vel, radius=0.2):
    """A forecast body in straight motion."""
    put(stage.forecast.pos_w, np.asarray(pos) + np.outer(TIMES, vel), env, track)
    put(stage.forecast.radius_m, radius, env, track)


def decide(stage):
    threats.assess_threats(
        stage.t,
        stage.route,
        stage.forecast,
        stage.scan,
        stage.clearance,
        stage.ego,
        stage.clock,
        CFG.teacher,
        CFG.tracking,
        CFG.world.tank,
        CFG.mapping,
        CFG.episode,
    )
    evasion.plan_evasion(
        stage.t,
        stage.forecast,
        stage.clearance,
        stage.ego,
        stage.clock,
        CFG.teacher,
        CFG.vehicle,
        CFG.tracking,
        CFG.world.tank,
        CFG.mapping,
    )
    teacher.tick_tree(
        stage.t,
        stage.action,
        stage.table,
        stage.route,
        stage.ego,
        stage.mission,
        stage.clock,
        CFG.teacher,
        CFG.vehicle,
        CFG.world.tank,
        CFG.episode,
    )
    ti.sync()


def acting(stage):
    """Type of the node that set each env's action."""
    return [stage.tree.types[node] if node >= 0 else None for node in stage.t.leaf.to_numpy()]


def step(stage, count=1):
    for _ in range(count):
        put(stage.clock.step, stage.clock.step.to_numpy() + 1)
        decide(stage)


# -------------------------------------------------------------------------------------------------------------------- oracle


def test_packets_equal_the_scalar_oracle(scene):
    """Costs of all candidates over random bodies, maps and motions; the choice is the least cost or as good a mean."""
    rng = np.random.default_rng(3)
    for _ in range(3):
        put(scene.ego.pos_w, rng.uniform([3, 1.5, -1], [17, 4.5, -0.5], (N_ENV, 3)))
        put(scene.ego.vel_b, rng.uniform(-0.4, 0.4, (N_ENV, 3)))
        put(scene.ego.rpy, np.c_[np.zeros((N_ENV, 2)), rng.uniform(-3, 3, N_ENV)])
        pos = scene.ego.pos_w.to_numpy().astype(float)
        put(scene.route.lookahead_w, pos + rng.uniform(-1, 1, (N_ENV, 3)))
        put(scene.t.last_vel_w, rng.uniform(-0.5, 0.5, (N_ENV, 3)))
        put(scene.clearance.clearance_m, rng.uniform(0.2, 1.5, scene.clearance.clearance_m.shape))
        start = pos[:, None, :2] + rng.uniform(-2.5, 2.5, (N_ENV, N_TRACK, 2))
        speed = rng.uniform(-0.8, 0.8, (N_ENV, N_TRACK, 2))
        put(scene.forecast.pos_w, start[:, :, None] + speed[:, :, None] * TIMES[:, None])
        radii = np.where(rng.random((N_ENV, N_TRACK)) < 0.75, rng.uniform(0.15, 0.4, (N_ENV, N_TRACK)), -1.0)
        put(scene.forecast.radius_m, np.repeat(radii[:, :, None], N_SAMPLE, 2))
        threats.assess_threats(
            scene.t,
            scene.route,
            scene.forecast,
            scene.scan,
            scene.clearance,
            scene.ego,
            scene.clock,
            CFG.teacher,
            CFG.tracking,
            CFG.world.tank,
            CFG.mapping,
            CFG.episode,
        )
        scene.t.want_evade.fill(1)
        evasion.plan_evasion(
            scene.t,
            scene.forecast,
            scene.clearance,
            scene.ego,
            scene.clock,
            CFG.teacher,
            CFG.vehicle,
            CFG.tracking,
            CFG.world.tank,
            CFG.mapping,
        )
        found = scene.t.candidate_cost.to_numpy()
        for env in range(N_ENV):
            wanted, border, commands, cost_of, first = expected(scene, env)
            sure = border > BORDER_M
            assert sure.sum() > 80
            np.testing.assert_allclose(found[env, : len(wanted)][sure], wanted[sure], atol=COST_TOLERANCE)
            conflict = scene.t.conflict_s.to_numpy()[env]
            assert conflict == pytest.approx(first, abs=1e-3) if np.isfinite(first) else conflict == FAR_M
            chosen = scene.t.evade_vel_w.to_numpy()[env, :2].astype(float)
            assert cost_of(chosen)[0] <= wanted.min() + CFG.teacher.softness + 2 * COST_TOLERANCE or not sure.all()
            assert np.hypot(*(commands - chosen).T).min() < CFG.teacher.evade_m_s


def expected(scene, env):
    """Costs, distances to cell borders and candidates of one env by the oracle; its cost function; the follow velocity's conflict."""
    read = {name: getattr(scene.t, name).to_numpy()[env].astype(float) for name in ("follow_vel_w", "last_vel_w")}
    follow, last = read["follow_vel_w"][:2], read["last_vel_w"][:2]
    yaw = float(scene.ego.rpy.to_numpy()[env, 2])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    pos = scene.ego.pos_w.to_numpy()[env, :2].astype(float)
    vel = turn @ scene.ego.vel_b.to_numpy()[env, :2].astype(float)
    bodies, radii = (getattr(scene.forecast, name).to_numpy()[env].astype(float) for name in ("pos_w", "radius_m"))
    clearance = scene.clearance.clearance_m.to_numpy()[env].astype(float)
    dt = CFG.tracking.forecast_dt_s

    def cost_of(command):
        return oracle.cost(
            pos, vel, command, follow, last, bodies, radii, clearance, grid_origin(CFG.world.tank, CELL), CELL, CFG.teacher, dt
        )

    commands = oracle.candidates(follow, last, yaw, CFG.teacher, CFG.vehicle)
    wanted, border = np.array([cost_of(command) for command in commands]).T
    first = oracle.body_depths(pos, vel, follow, bodies, radii, CFG.teacher, dt)[3]
    return wanted, border, commands, cost_of, first


# ---------------------------------------------------------------------------------------------------------------- situations


def test_open_water_is_travelled_at_cruise_speed(scene):
    decide(scene)
    assert acting(scene) == ["FollowRoute"] * N_ENV
    np.testing.assert_allclose(scene.action[0], [CFG.teacher.cruise_m_s / CFG.vehicle.max_surge_m_s, 0, 0, 0], atol=1e-5)
    assert scene.t.conflict_s.to_numpy()[0] == scene.t.ttc_s.to_numpy()[0] == FAR_M


def test_head_on_body_is_evaded_with_room(scene):
    """The follow velocity would be hit; the evasive velocity keeps more than contact over the whole horizon."""
    body(scene, 0, 0, (7.2, 3.05), (-0.6, 0.0))
    decide(scene)
    assert acting(scene) == ["Evade"] + ["FollowRoute"] * (N_ENV - 1)
    where = scene.forecast.pos_w.to_numpy()[0, 0].astype(float)

    def closest(command):
        at, _ = oracle.rolled_out((5.0, 3.0), (0, 0), np.asarray(command, float), CFG.teacher.lag_s, 0.1, N_SAMPLE - 1)
        return np.hypot(*(at - where).T).min() - 0.2 - CFG.vehicle.hull_radius_m - CFG.vehicle.hull_half_length_m

    assert closest(scene.t.follow_vel_w.to_numpy()[0, :2]) < 0
    assert closest(scene.t.evade_vel_w.to_numpy()[0, :2]) > CFG.teacher.contact_m


def test_evasion_stays_off_the_wall(scene):
    """With a wall on one side the body is passed on the other."""
    rows = np.arange(SIZES["n_row"])
    low_wall = (rows * CELL - 2.0)[:, None].clip(0, 2)
    put(scene.clearance.clearance_m, np.broadcast_to(low_wall, scene.clearance.clearance_m.shape[1:]))
    for env, offset in enumerate((0.1, -0.1)):
        put(scene.ego.pos_w, (5.0, 2.2, -0.8), env)
        put(scene.route.lookahead_w, (6.0, 2.2, -0.8), env)
        body(scene, env, 0, (7.0, 2.2 + offset), (-0.6, 0.0))
    decide(scene)
    assert (scene.t.evade_vel_w.to_numpy()[:2, 1] > 0).all()


def test_last_command_breaks_the_tie(scene):
    """Hysteresis: of two mirror images the one that goes on with the last command is taken."""
    for env, side in enumerate((0.4, -0.4)):
        body(scene, env, 0, (7.0, 3.0), (-0.6, 0.0))
        put(scene.t.last_vel_w, (0.3, side, 0.0), env)
    decide(scene)
    sideways = scene.t.evade_vel_w.to_numpy()[:2, 1]
    assert sideways[0] > 0.1 and sideways[1] < -0.1


def test_evasion_holds_between_decisions_and_ends_when_calm(scene):
    body(scene, 0, 0, (7.0, 3.1), (-0.6, 0.0))
    decide(scene)
    held = scene.t.evade_vel_w.to_numpy()[0]
    scene.forecast.radius_m.fill(-1.0)
    step(scene, CFG.teacher.decide_period_steps - 1)
    np.testing.assert_array_equal(scene.t.evade_vel_w.to_numpy()[0], held)
    assert acting(scene)[0] == "Evade"
    assert scene.t.evading_steps.to_numpy()[0] == CFG.teacher.decide_period_steps
    step(scene, round(CFG.teacher.calm_s / CFG.episode.control_dt_s) + CFG.teacher.decide_period_steps)
    assert acting(scene)[0] == "FollowRoute"


def closing_beams(scene, env, beams, range_m=0.45, speed=0.6):
    for beam in beams:
        put(scene.scan.hit, 1, env, beam)
        put(scene.scan.range_m, range_m, env, beam)
        put(scene.scan.doppler_m_s, -speed, env, beam)


def test_sensed_emergency_backs_off_from_it(scene):
    """Two neighbouring beams agree: retreat from them. One alone is an outlier. Turned since the ping: still the same place."""
    left = N_RAY // 4
    closing_beams(scene, 0, (left, left + 1))
    closing_beams(scene, 1, (left,))
    closing_beams(scene, 2, (left, left + 1))
    put(scene.ego.rpy, (0, 0, 0.5), 2)
    closing_beams(scene, 3, (N_RAY - 1, 0))  # the ring closes
    decide(scene)
    assert acting(scene) == ["BackOff", "FollowRoute", "BackOff", "BackOff", "FollowRoute", "FollowRoute"]
    velocity = scene.t.last_vel_w.to_numpy()
    assert velocity[0, 1] < -0.8 and abs(velocity[0, 0]) < 0.15
    np.testing.assert_allclose(velocity[2], velocity[0], atol=1e-5)
    assert velocity[3, 0] < -0.8
    assert scene.t.ttc_s.to_numpy()[0] == pytest.approx((0.45 - CFG.teacher.hull_reach_m - CFG.teacher.contact_m) / 0.6, rel=1e-4)
    assert scene.t.nearest_m.to_numpy()[1] == pytest.approx(0.45 - CFG.teacher.hull_reach_m, rel=1e-4)


def test_retreat_does_not_run_into_a_wall(scene):
    """Threat ahead, wall behind: the retreat slides along instead."""
    closing_beams(scene, 0, (0, 1))
    scene.clearance.clearance_m.fill(0.45)
    row, col = 32, 40
    put(scene.clearance.site_row, row)
    put(scene.clearance.site_col, col)
    x0, y0 = grid_origin(CFG.world.tank, CELL)
    assert x0 + (col + 0.5) * CELL < 5.0 and abs(y0 + (row + 0.5) * CELL - 3.0) < 0.1
    decide(scene)
    assert acting(scene)[0] == "BackOff"
    assert scene.t.last_vel_w.to_numpy()[0, 0] > -0.1


def test_stuck_creeps_to_the_end_of_its_time(scene):
    """Unstick stands in a sequence with memory: it outlasts the condition that began it."""
    put(scene.clearance.site_row, 32)
    put(scene.clearance.site_col, 40)
    scene.clearance.clearance_m.fill(0.6)
    put(scene.route.stuck_steps, round(CFG.teacher.stuck_s / CFG.episode.control_dt_s), 0)
    decide(scene)
    assert acting(scene)[:2] == ["Unstick", "FollowRoute"]
    assert scene.t.last_vel_w.to_numpy()[0, 0] > 0.9 * CFG.teacher.unstick_m_s
    scene.route.stuck_steps.fill(0)
    lasts = round(CFG.teacher.unstick_s / CFG.episode.control_dt_s)
    step(scene, lasts - 2)
    assert acting(scene)[0] == "Unstick"
    step(scene, 4)
    assert acting(scene)[0] == "FollowRoute"


def test_waits_without_a_route_and_before_a_blocked_one(scene):
    put(scene.route.n_way, 0, 0)
    x0, y0 = grid_origin(CFG.world.tank, CELL)
    put(scene.clearance.clearance_m, 0.1, 1, int((3.0 - y0) / CELL), int((5.62 - x0) / CELL))
    decide(scene)
    names = [scene.tree.names[node] for node in scene.t.leaf.to_numpy()]
    assert names[0] == "no route" and names[1] == "wait for a free way" and names[2] == "FollowRoute"
    np.testing.assert_array_equal(scene.action[:2], 0.0)


def test_yardsticks_do_not_avoid_bodies(scene):
    body(scene, 0, 0, (7.0, 3.0), (-0.6, 0.0))
    put(scene.mission.goal_w, (5.0, 5.0, -0.4))
    for name, leaf in (("planner", "FollowRoute"), ("straight", "DriveStraight")):
        use(scene, name)
        decide(scene)
        assert acting(scene) == [leaf] * N_ENV
    assert scene.action[0, 1] > 0.99 and scene.action[0, 2] == 1.0 and scene.action[0, 3] > 0.9  # to port, up, turning there


def test_depth_changes_only_in_open_water(scene):
    put(scene.mission.goal_w, (15.0, 3.0, -1.2))
    body(scene, 0, 0, (5.0, 4.0), (0.0, 1.0))
    decide(scene)
    assert acting(scene) == ["FollowRoute"] * N_ENV
    assert scene.action[0, 2] == 0 and scene.action[1, 2] < -0.5


def test_actions_point_along_the_wanted_velocity(scene):
    """At any attitude the action, scaled by the limits and turned into the world, is parallel to the velocity, never beyond a limit."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        rpy = rng.uniform([-0.2, -0.2, -3.1], [0.2, 0.2, 3.1], (N_ENV, 3))
        put(scene.ego.rpy, rpy)
        put(scene.route.lookahead_w, [5, 3, -0.8] + np.c_[rng.uniform(-1, 1, (N_ENV, 2)), np.zeros(N_ENV)])
        decide(scene)
        action = scene.action.numpy().astype(float)
        assert np.abs(action).max() <= 1
        velocity = scene.t.last_vel_w.to_numpy()
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
            driven = R_wb @ (action[env, :3] * [CFG.vehicle.max_surge_m_s, CFG.vehicle.max_sway_m_s, CFG.vehicle.max_heave_m_s])
            np.testing.assert_allclose(driven, velocity[env], atol=2e-3)


def test_faster_than_the_axes_only_on_diagonals(scene):
    """In evasion the body turns a diagonal to its way."""
    body(scene, 0, 0, (6.6, 3.0), (-0.8, 0.0))
    decide(scene)
    velocity = scene.t.last_vel_w.to_numpy()[0]
    turn = scene.action[0, 3].item() * CFG.vehicle.max_yaw_rate_rad_s / CFG.teacher.yaw_gain
    off = (np.arctan2(velocity[1], velocity[0]) - turn) / (np.pi / 4)
    assert abs(turn) <= np.pi / 4 + 1e-4
    assert abs(off - round(off)) < 0.02 and round(off) % 2 == 1


# ---------------------------------------------------------------------------------------------------------------- discipline


def contents(struct):
    return {f.name: getattr(struct, f.name).to_numpy() for f in dataclasses.fields(struct)}


def test_sleeping_rows_are_untouched_and_rows_do_not_meet(scene):
    """Row 0 gives the same bits whatever its neighbours do; rows that sleep keep theirs; a reset forgets the last episode."""

    def drama(scene, others):
        scene.clock.awake.fill(1)
        scene.clock.step.fill(0)
        scene.forecast.radius_m.fill(-1.0)
        teacher.reset_teacher(scene.t, scene.clock)
        body(scene, 0, 0, (7.0, 3.1), (-0.6, 0.0))
        for env in range(1, N_ENV):
            if others:
                body(scene, env, 1, (6.0, 3.0), (-0.3 * env, 0.1))
        decide(scene)
        step(scene, 7)
        return {name: value[0] for name, value in contents(scene.t).items()}

    first, second = drama(scene, False), drama(scene, True)
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)
    put(scene.clock.awake, 0, 1)
    before = contents(scene.t)
    put(scene.scan.hit, 1)
    put(scene.scan.range_m, 0.4)
    step(scene, 3)
    after = contents(scene.t)
    for name in before:
        np.testing.assert_array_equal(before[name][1], after[name][1], err_msg=name)
    assert (before["ticks"][0] != after["ticks"][0]).any()


def test_counts_say_who_acted(scene):
    decide(scene)
    step(scene, 4)
    acted, ticks = scene.t.acted.to_numpy(), scene.t.ticks.to_numpy()
    follow = scene.tree.types.index("FollowRoute")
    assert acted[0, follow] == 5 and acted[0].sum() == 5
    assert ticks[0, 0] == 5 and ticks[0, scene.tree.types.index("BackOff")] == 0
