"""The oracle on hand-made scenarios: distances, what the termination check forbids, earliest arrivals."""

import math

import numpy as np
import pytest

from tests.oracles.world import path_position
from uuvtai.common.obstacle_motion import path_positions
from uuvtai.config import Config, DisturbanceConfig
from uuvtai.evaluation import failure_facts, oracle
from uuvtai.kernels.core.geometry import BOX, CYLINDER, SPHERE

CONFIG = Config()
TOP_SPEED = math.hypot(0.6, 0.6)
STEP_S = oracle.CELL_M / TOP_SPEED
GOAL_M = 1.0


def line(a, b, speed, phase=0.0):
    """Path document of an obstacle that goes back and forth."""
    return {
        "shape": "polyline", "corners": [list(a), list(b)], "length_m": 2 * math.dist(a, b), "phase_m": phase,
        "speed_m_s": speed,
    }  # fmt: skip


def obstacle(kind, position, size, path=None, yaw=0.0):
    return {"slot": 0, "kind": kind, "position": list(position), "size": list(size), "yaw": yaw, "path": path}


def column(x, y, radius=0.25, path=None):
    return obstacle("cylinder", (x, y, -0.8), (radius, radius, 0.8), path)


def scenario(start, goal, *obstacles):
    return {"start": list(start), "goal": list(goal), "obstacles": list(obstacles)}


def arrival(start, goal, *obstacles, config=CONFIG):
    return oracle.earliest_arrival(scenario(start, goal, *obstacles), config)


# -------------------------------------------------------------------------------------------------- obstacles


@pytest.mark.parametrize(
    "path",
    [
        {
            "shape": "circle", "center": [5.0, 3.0], "radius_m": -1.5, "length_m": 3 * math.pi,
            "phase_m": 2.0, "speed_m_s": 0.7,
        },
        {
            "shape": "polyline", "corners": [[1, 1], [4, 1], [4, 5]], "length_m": 12.0,
            "phase_m": 6.5, "speed_m_s": 1.5,
        },
        line((2, 2), (6, 5), 0.6, phase=9.0),
    ],
)  # fmt: skip
def test_many_positions_of_a_path_are_those_of_one_by_one(path):
    t = np.linspace(0.0, 40.0, 123)
    assert path_positions(path, t) == pytest.approx(np.array([path_position(path, s) for s in t]), abs=1e-9)


def test_obstacles_move_with_the_speed_of_their_path():
    moving, still = oracle.obstacles_of(
        scenario((2, 2, -0.8), (9, 2, -0.8), column(5, 1, path=line((5, 1), (5, 5), 0.5)), column(7, 2)),
        np.arange(0.1, 12.0, 0.5),
    )
    assert moving.moves and not still.moves
    assert np.linalg.norm(moving.vel_w, axis=1) == pytest.approx(np.full(24, 0.5), abs=1e-6)
    assert moving.vel_w[0] == pytest.approx([0.0, 0.5], abs=1e-6)
    assert moving.vel_w[-1] == pytest.approx([0.0, -0.5], abs=1e-6)


@pytest.mark.parametrize(("name", "kind"), [("sphere", SPHERE), ("cylinder", CYLINDER), ("box", BOX)])
def test_distances_are_those_of_the_hindsight(name, kind):
    """``hindsight.hull_gaps`` is tested against the kernel; a capsule without length is our ball."""
    points = np.random.default_rng(3).uniform([3, 1, -1.6], [7, 5, 0], (500, 3))
    at, size, yaw = np.array([5.0, 3.0, -0.9]), np.array([0.4, 0.4 if kind != BOX else 0.7, 0.3]), 0.6
    shape = oracle.Obstacle(name, size, yaw, at[None], np.zeros((1, 2)))
    off = points - at
    ox, oy = oracle.level_excess(shape, off[:, 0], off[:, 1])
    gaps = (
        np.sqrt(ox**2 + oy**2 + oracle.upright_excess(shape, off[:, 2]) ** 2)
        - oracle.rounding_m(shape)
        - 0.17
    )
    axis = np.tile([1.0, 0.0, 0.0], (500, 1))
    expected, _, _ = failure_facts.hull_gaps(
        points, axis, np.array([kind]), np.tile(at, (500, 1, 1)), size[None], np.array([yaw]), 0.17, 0.0
    )
    assert gaps == pytest.approx(expected[:, 0], abs=1e-9)


def test_the_referee_forbids_what_closes_too_fast_and_lets_flee():
    """A column (0.25 m) comes at 1.5 m/s: standing needs 0.27 m (0.18 s x 1.5), fleeing at 0.85 0.117 m."""
    start = (6.0, 3.0, -0.8)
    grid = oracle.lattice_of(np.array(start), CONFIG)
    moves = {tuple(move): index for index, move in enumerate(oracle.MOVES)}
    for gap, may_stay, may_flee, may_approach in (
        (0.09, 0, 0, 0), (0.2, 0, 1, 0), (0.35, 1, 1, 0), (0.5, 1, 1, 1),
    ):  # fmt: skip
        coming = oracle.Obstacle(
            "cylinder", np.array([0.25, 0.25, 0.8]), 0.0, np.array([[6.0 + 0.42 + gap, 3.0, -0.8]]),
            np.array([[-1.5, 0.0]]),
        )  # fmt: skip
        blocked = oracle.Termination(grid, [], CONFIG).blocked([coming], 0, np.ones_like(grid.inside))[
            (slice(None), *grid.start)
        ]
        found = [not blocked[moves[move]] for move in ((0, 0), (-1, 0), (1, 0))]
        assert found == [bool(may_stay), bool(may_flee), bool(may_approach)], gap


# ----------------------------------------------------------------------------------------------------- oracle


def test_in_open_water_the_oracle_takes_distance_over_speed():
    for goal in ((14.0, 3.0, -0.8), (2.5, 3.0 + 2.5, -0.8)):
        expected = (math.dist((2.0, 3.0, -0.8), goal) - GOAL_M) / TOP_SPEED
        if goal[0] == 14.0:
            assert arrival((2.0, 3.0, -0.8), goal) == pytest.approx(expected, abs=STEP_S)
        assert 0.92 * expected - STEP_S <= arrival((2.0, 3.0, -0.8), goal) <= expected + 3 * STEP_S
    diagonal = (math.hypot(3.0, 3.0) - GOAL_M) / TOP_SPEED
    assert arrival((5.0, 1.0, -0.8), (8.0, 4.0, -0.8)) == pytest.approx(diagonal, abs=3 * STEP_S)


def test_height_takes_time_and_a_current_carries():
    config = CONFIG.model_copy(update={"episode": CONFIG.episode.model_copy(update={"goal_radius_m": 0.2})})
    found = arrival((5.0, 3.0, -1.4), (5.0, 3.0, -0.2), config=config)
    assert found == pytest.approx((1.2 - 0.2) / 0.4, abs=4 * STEP_S)
    carried = CONFIG.model_copy(update={"disturbance": DisturbanceConfig(current_m_s=(0.4, 0.0, 0.0))})
    assert arrival((2.0, 3.0, -0.8), (14.0, 3.0, -0.8), config=carried) == pytest.approx(
        11.0 / (TOP_SPEED + 0.4), abs=STEP_S
    )


DOOR = [obstacle("box", (8, y, -0.8), (0.1, 1.2, 0.8)) for y in (1.2, 4.8)]
"""what a wall leaves open: 1.2 m in the middle"""


def test_a_wall_without_a_gap_cannot_be_passed_and_a_door_can():
    left, right = ((2.0, 3.0, -0.8), (14.0, 3.0, -0.8))
    assert arrival(left, right, obstacle("box", (8, 3, -0.8), (0.1, 3.0, 0.8))) is None
    assert arrival(left, right, *DOOR) == pytest.approx(11.0 / TOP_SPEED, abs=2 * STEP_S)
    slit = [obstacle("box", (8, y, -0.8), (0.1, 1.25, 0.8)) for y in (1.5, 4.5)]
    assert arrival(left, right, *slit) is None, "0.5 m is less than the hull and its clearances"


def test_a_low_wall_is_passed_above():
    low = obstacle("box", (8, 3, -1.35), (0.1, 3.0, 0.25))
    assert arrival((2.0, 3.0, -1.2), (14.0, 3.0, -0.8), low) is not None


def test_the_oracle_waits_for_a_door_that_a_obstacle_blocks():
    """A column creeps out of a 1.2 m door at 2 cm/s and leaves room from 9.5 to 11 s on (by hand)."""
    start, goal = (6.0, 3.0, -0.8), (12.0, 3.0, -0.8)
    assert arrival(start, goal, *DOOR) == pytest.approx(5.0 / TOP_SPEED, abs=2 * STEP_S)
    rest_s = 3.0 / TOP_SPEED
    waited = arrival(start, goal, *DOOR, column(8.0, 3.0, path=line((8.0, 3.0), (8.0, 6.0), 0.02)))
    assert 9.5 + rest_s - 0.6 <= waited <= 11.0 + rest_s + 0.6
    short = CONFIG.model_copy(update={"episode": CONFIG.episode.model_copy(update={"horizon_steps": 600})})
    assert (
        arrival(start, goal, *DOOR, column(8.0, 3.0, path=line((8.0, 3.0), (8.0, 6.0), 0.02)), config=short)
        is None
    )


def test_who_is_run_over_in_a_corner_does_not_arrive():
    """Columns side by side sweep the whole width of the tank at 3 m/s before anybody could be through."""
    sweep = [column(18.0, y, path=line((18.0, y), (0.5, y), 3.0)) for y in np.arange(0.25, 6.0, 0.5)]
    assert arrival((2.0, 3.0, -0.8), (16.0, 3.0, -0.8), *sweep) is None
