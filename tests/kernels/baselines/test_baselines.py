"""Local planners of the literature in hand-made situations with known answers, and in an evaluation."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti

from tests.command import uuv
from tests.conftest import launch_one_by_one
from tests.map_bits import room
from tests.small_sim import SmallSim
from uuvtai.common.enums import NO_SITE
from uuvtai.config.planning import ACCELERATION_M_S2
from uuvtai.kernels.baselines.dwa import plan_dynamic_window
from uuvtai.kernels.baselines.mppi import plan_path_integral
from uuvtai.kernels.core.grid import grid_origin
from uuvtai.sim.behavior_tree import read_tree

PLANNERS = {"dwa": plan_dynamic_window, "mppi": plan_path_integral}
HERE = np.array([8.0, 3.0, -0.8])
OPEN_M = 1e6
"""Height of free water that nothing bounds."""


@pytest.fixture
def scene(small):
    """The session's simulator: at rest at ``HERE``, nose along x, wanted 0.6 m/s along x, open water."""
    memory = small.sim.memory()
    before = memory.read().copy()
    views = memory.views(memory.read(), scratch=True)
    views["clock.active"][:], views["clock.step"][:] = 1, 0
    views["ego.pos_w"][:], views["ego.vel_b"][:], views["ego.rpy"][:] = HERE, 0, 0
    views["mission.goal_w"][:] = HERE + np.array([8, 0, 0])
    views["mission.start_w"][:] = HERE
    views["behavior.follow_vel_w"][:] = [0.6, 0, 0]
    views["behavior.away_w"][:] = 0
    views["forecast.radius_m"][:] = -1
    views["clearance.site"][:] = NO_SITE
    yield SimpleNamespace(sim=small.sim, views=views, config=small.config, n=small.N)
    memory.read()[:] = before


def near(*way):
    """A place (x, y) [m] that is so far from ``HERE``."""
    return HERE[:2] + np.array(way)


def body(scene, row, track, pos, vel, radius=0.2, above=-0.8, below=-0.8):
    """An obstacle in straight motion, at any height but the free water from ``below`` to ``above``."""
    times = np.arange(scene.views["forecast.pos_w"].shape[2]) * scene.config.tracking.forecast_dt_s
    scene.views["forecast.pos_w"][row, track] = np.asarray(pos) + np.outer(times, vel)
    scene.views["forecast.radius_m"][row, track] = radius
    scene.views["forecast.above_w"][row, track], scene.views["forecast.below_w"][row, track] = above, below
    scene.views["tracks.state"][row, track] = [*pos, *vel]


def decide(scene, name):
    """Velocities [m/s] that a planner chooses, shape (n, 3)."""
    PLANNERS[name](scene.sim.io.local_planner)
    ti.sync()
    return scene.views["baselines.vel_w"].astype(float)


def drive(scene, name, around):
    """Places (4 s, one per decision, x, y, z) [m] of row 0 from rest; ``around(time_s)`` puts what is
    there."""
    dt, lag = scene.config.baselines.period_steps * 0.02, scene.config.behavior.lag_s
    at, speed, places, decay = HERE.copy(), np.zeros(3), [], np.exp(-dt / lag)
    for k in range(40):
        around(k * dt)
        scene.views["clock.step"][:] = scene.config.baselines.period_steps * k
        scene.views["ego.pos_w"][:], scene.views["ego.vel_b"][:] = at, speed
        found = decide(scene, name)[0]
        at = at + found * dt + (speed - found) * lag * (1 - decay)
        speed = found + (speed - found) * decay
        places.append(at)
    return np.array(places)


def touch_m(scene):
    return scene.config.behavior.hull_reach_m + scene.config.behavior.contact_m


@pytest.mark.parametrize("name", PLANNERS)
def test_free_water_is_driven_as_wanted(scene, name):
    scene.views["behavior.follow_vel_w"][1] = [0, -0.6, 0]
    scene.views["behavior.follow_vel_w"][2] = 0
    scene.views["mission.goal_w"][3] = HERE + np.array([8, 0, 0.3])
    for _ in range(10):  # MPPI's plan converges
        found = decide(scene, name)
        scene.views["clock.step"][:] += scene.config.baselines.period_steps
    np.testing.assert_allclose(found[0], [0.6, 0, 0], atol=0.1)
    np.testing.assert_allclose(found[1], [0, -0.6, 0], atol=0.1)
    np.testing.assert_allclose(found[2], 0, atol=0.1)
    assert found[3, 2] > 0.1, "it climbs to the goal's depth"


@pytest.mark.parametrize("name", PLANNERS)
def test_a_head_on_obstacle_is_given_way_to(scene, name):
    start, vel = near(2.4, 0.05), np.array([-0.6, 0.0])
    places = drive(scene, name, lambda time: body(scene, 0, 0, start + vel * time, vel))
    obstacles = start + np.outer((np.arange(len(places)) + 1) * 0.1, vel)
    assert np.linalg.norm(places[:, :2] - obstacles, axis=1).min() > 0.2 + touch_m(scene)
    assert places[-1, 0] > max(obstacles[-1, 0], HERE[0]) + 0.5


@pytest.mark.parametrize("name", PLANNERS)
def test_a_obstacle_that_is_known_to_be_above_or_below_is_passed(scene, name):
    over = HERE[2] + 0.9
    body(scene, 0, 0, near(1.0, 0.0), [-0.3, 0.0], above=over, below=-OPEN_M)
    for _ in range(10):
        found = decide(scene, name)
        scene.views["clock.step"][:] += scene.config.baselines.period_steps
    assert found[0, 0] > 0.45 and abs(found[0, 1]) < 0.15


@pytest.mark.parametrize("name", PLANNERS)
def test_no_velocity_leads_into_a_wall(scene, name):
    """A wall along y, 0.75 m ahead, on the way that is wanted: what is driven stops before contact."""
    tank, cell = scene.config.world.tank, scene.config.mapping.cell_m
    n_col = scene.views["clearance.site"].shape[2]
    x = grid_origin(tank, cell)[0] + (np.arange(n_col) + 0.5) * cell
    wall = HERE[0] + 0.75
    scene.views["clearance.site"][:] = room(np.clip(wall - x, 0, 2))
    scene.views["behavior.away_w"][:] = [-1, 0]
    places = drive(scene, name, lambda _time: None)
    assert (wall - places[:, 0]).min() > touch_m(scene), "it has not touched the wall"
    assert places[:, 0].min() > HERE[0] - 0.3, "nor fled"


def test_the_dynamic_window_is_what_can_be_reached(scene):
    """Whatever is around: within the acceleration's reach of the own velocity, and within the limits."""
    rng = np.random.default_rng(5)
    own = rng.uniform(-0.5, 0.5, (scene.n, 2))
    scene.views["ego.vel_b"][:, :2] = own
    for row in range(scene.n):
        for track in range(3):
            body(scene, row, track, HERE[:2] + rng.uniform(-1.5, 1.5, 2), rng.uniform(-1, 1, 2))
    found = decide(scene, "dwa")
    reach = ACCELERATION_M_S2 * scene.config.baselines.dwa.window_s
    assert (np.abs(found[:, :2] - own) <= reach + 1e-5).all()
    assert (np.abs(found[:, :2]) <= 0.6 + 1e-5).all()
    assert len(np.unique(found.round(3), axis=0)) > 2


def test_mppi_is_the_same_in_any_row_and_beside_any_others(scene):
    """Random numbers come from start, goal and step; rows that do not decide keep what they have."""

    def drama(rows, others):
        scene.views["forecast.radius_m"][:] = -1
        scene.views["mission.start_w"][:] = HERE + np.array([0, 0.1, 0]) * np.arange(scene.n)[:, None]
        scene.views["mission.start_w"][rows] = HERE
        for row in range(scene.n):
            if row in rows:
                body(scene, row, 0, near(1.5, 0.1), [-0.5, 0.0])
            elif others:
                body(scene, row, 2, near(1.0, 0.1 * row), [0.0, -0.3])
        found = []
        for step in (0, 5, 10):
            scene.views["clock.step"][:] = step
            found.append(decide(scene, "mppi"))
        return np.stack(found)

    one, other = drama([0, 3], True), drama([5], False)
    np.testing.assert_array_equal(one[:, 0], one[:, 3])
    np.testing.assert_array_equal(one[:, 0], other[:, 5])
    assert (one[:, 0] != one[:, 1]).any() and len(np.unique(one[:, 0], axis=0)) == 3
    scene.views["clock.active"][0], scene.views["clock.step"][1:4] = 0, 12
    scene.views["clock.step"][4:] = 15
    last = decide(scene, "mppi")
    np.testing.assert_array_equal(last[:4], other[-1, :4])
    assert (last[4:] != other[-1, 4:]).any()


# ------------------------------------------------------------------------------------------------------ whole


@pytest.fixture
def borrowed(small, monkeypatch):
    """``uuv eval`` plays on the session's small simulator."""
    monkeypatch.setattr("uuvtai.sim.sim.Sim", lambda *_: small.sim)
    yield small
    small.sim.use_tree(small.trees["bt"])


def test_all_of_them_are_rows_of_an_evaluation(borrowed, capfd, tmp_path):
    names = list(PLANNERS)
    command = ("eval", "--episodes", "2", "--seeds", "77", *SmallSim.OPTIONS, "--agent", ",".join(names))
    code, out, err = uuv(capfd, *command, "--run-dir", str(tmp_path / "run"), "--json")
    assert code == 0, err
    agents = json.loads(out)["agents"]
    assert [m["name"] for m in agents] == names and not any(m["privileged"] for m in agents)
    times = [[d["time_s"] for d in m["episodes_detail"]] for m in agents]
    assert len({tuple(t) for t in times}) == 2, "each drives in its own way"
    assert max(m["outcomes"]["success"] for m in agents) == 2


def test_nothing_of_them_runs_under_another_tree(small, monkeypatch):
    """Kernels are launched, and their arrays written, only where the tree has their leaf."""
    launched = []
    launch_one_by_one(monkeypatch, small.sim)
    for name, kernel in PLANNERS.items():
        monkeypatch.setattr(
            f"uuvtai.sim.stack.{name}.{kernel.__name__}", lambda io, name=name: launched.append(name)
        )
    for name in ("bt", "planner", "straight", *PLANNERS):
        small.sim.use_tree(read_tree(name))
        small.begin([3])
        small.sim.step()
    small.sim.use_tree(small.trees["bt"])
    assert launched == [name for name in PLANNERS for _ in range(2)]
