"""Hull distances against dense sampling in float64, their direction, and the closing speed they imply."""

import numpy as np
import pytest
import taichi as ti

from tests.oracles import hull as reference
from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.kernels.core import geometry
from uuvtai.kernels.core.geometry import BOX, CYLINDER, SPHERE
from uuvtai.kernels.core.stage import Const

N = 1024
DISTANCE_TOL_M = 1e-3
"""required; float32 and 16 bisections give about 3e-6"""
FLOAT_TOL_M = 2e-5
"""float32 at coordinates of a few metres, and the oracle's sampling"""
SPEED_TOL_M_S = 5e-3
"""central differences over 2 ms; where the axis is almost parallel to a face the nearest place jumps along it
within that time"""

VEHICLE = VehicleConfig()
POOL = TankConfig()
PEN = TankConfig(shape="circle", x_m=(0.0, 16.0), y_m=(0.0, 16.0))


@ti.kernel
def measure(
    obstacles: ti.template(),
    hulls: ti.template(),
    kinds: ti.template(),
    out: ti.template(),
    vehicle: Const[VehicleConfig],
    pool: Const[TankConfig],
    pen: Const[TankConfig],
):
    for i in kinds:
        pos = ti.Vector([hulls[i, 0], hulls[i, 1], hulls[i, 2]])
        axis = ti.Vector([hulls[i, 3], hulls[i, 4], hulls[i, 5]])
        center = ti.Vector([obstacles[i, 0], obstacles[i, 1], obstacles[i, 2]])
        size = ti.Vector([obstacles[i, 3], obstacles[i, 4], obstacles[i, 5]])
        gap, normal, along = geometry.hull_to_obstacle(
            pos, axis, kinds[i], center, size, obstacles[i, 6], vehicle
        )
        out[i, 0] = gap
        for j in ti.static(range(3)):
            out[i, 1 + j] = normal[j]
        out[i, 4] = along
        out[i, 5] = geometry.hull_to_side_wall(pos, axis, vehicle, pool)
        out[i, 6] = geometry.hull_to_side_wall(pos, axis, vehicle, pen)
        out[i, 7] = geometry.hull_to_floor_or_surface(pos, axis, vehicle, pool)
        out[i, 8] = geometry.is_in_tank(pos, pool)
        out[i, 9] = geometry.is_in_tank(pos, pen)


@pytest.fixture(scope="module")
def measured():
    """f(hulls (n, 6), kinds (n,), obstacles (n, 7)) -> (n, 10) of ``measure``, n <= N."""
    fields = (
        ti.field(ti.f32, (N, 7)), ti.field(ti.f32, (N, 6)), ti.field(ti.i32, N), ti.field(ti.f32, (N, 10)),
    )  # fmt: skip

    def run(hulls, kinds, obstacles):
        for field, values in zip(fields, (obstacles, hulls, kinds), strict=False):
            padded = np.ones(field.shape, np.int32 if field.dtype == ti.i32 else np.float32)
            padded[: len(values)] = values
            field.from_numpy(padded)
        measure(*fields, VEHICLE, POOL, PEN)
        return fields[3].to_numpy()[: len(kinds)].astype(float)

    return run


def random_scenes(seed, level=False):
    """Hulls and obstacles near each other, some touching; float32-exact."""
    rng = np.random.default_rng(seed)
    pos = rng.uniform([2, 1, -1.4], [18, 5, -0.2], (N, 3))
    axis = rng.normal(size=(N, 3)) * [1, 1, 0 if level else 0.4]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    kinds = rng.choice([SPHERE, CYLINDER, BOX], N)
    center = pos + rng.normal(size=(N, 3)) * [0.8, 0.8, 0.4]
    size = rng.uniform(0.05, 0.6, (N, 3))
    size[kinds != BOX, 1] = size[kinds != BOX, 0]
    size[kinds == SPHERE, 2] = size[kinds == SPHERE, 0]
    yaw = rng.uniform(-7, 7, (N, 1))
    hulls = np.hstack([pos, axis]).astype(np.float32)
    obstacles = np.hstack([center, size, yaw]).astype(np.float32)
    return hulls, kinds, obstacles


def oracle(hull_row, kind, obstacle):
    return reference.clearance(
        hull_row[:3], hull_row[3:], kind, obstacle[:3], obstacle[3:6], float(obstacle[6])
    )


@pytest.mark.parametrize("level", [False, True])
def test_clearance_equals_dense_sampling(measured, level):
    hulls, kinds, obstacles = random_scenes(1, level)
    got = measured(hulls, kinds, obstacles)
    for i in range(N):
        assert got[i, 0] == pytest.approx(
            oracle(hulls[i].astype(float), kinds[i], obstacles[i].astype(float)), abs=DISTANCE_TOL_M
        )


def test_the_hull_s_nearest_place_and_direction_reach_the_obstacle(measured):
    hulls, kinds, obstacles = random_scenes(2)
    got = measured(hulls, kinds, obstacles)
    place = hulls[:, :3] + got[:, 4:5] * hulls[:, 3:]
    for i in np.flatnonzero(got[:, 0] > -0.1):
        surface = place[i] + (got[i, 0] + VEHICLE.hull_radius_m) * got[i, 1:4]
        obstacle = obstacles[i].astype(float)
        at_surface = reference.point_distances(
            surface[None], kinds[i], obstacle[:3], obstacle[3:6], obstacle[6]
        )[0]
        assert abs(at_surface) < FLOAT_TOL_M
        assert np.linalg.norm(got[i, 1:4]) == pytest.approx(1.0, abs=1e-5)
    assert np.all(np.abs(got[:, 4]) <= VEHICLE.hull_half_length_m + 1e-7)


def test_closing_speed_is_the_rate_at_which_clearance_shrinks(measured):
    """Hull translating and turning, body moving: central differences of the oracle."""
    hulls, kinds, obstacles = (part[:200] for part in random_scenes(3))
    hulls, obstacles = hulls.astype(float), obstacles.astype(float)
    got = measured(hulls, kinds, obstacles)
    rng = np.random.default_rng(4)
    vel, rate = rng.uniform(-0.6, 0.6, (200, 3)), rng.uniform(-1, 1, (200, 3))
    obstacle_vel = rng.uniform(-1, 1, (200, 3))
    dt = 1e-3
    checked = 0
    for i in range(200):
        smooth = got[i, 0] > 0.05  # the normal is ill-conditioned at contact
        if not smooth:
            continue
        ends = []
        for sign in (-1, 1):
            moved, obstacle = hulls[i].copy(), obstacles[i].copy()
            moved[:3] += sign * dt * vel[i]
            moved[3:] += sign * dt * np.cross(rate[i], hulls[i, 3:])
            obstacle[:3] += sign * dt * obstacle_vel[i]
            ends.append(oracle(moved, kinds[i], obstacle))
        hull_point_vel = vel[i] + got[i, 4] * np.cross(rate[i], hulls[i, 3:])
        closing = -(obstacle_vel[i] - hull_point_vel) @ got[i, 1:4]
        slopes = (ends[0] - ends[1]) / (2 * dt)
        checked += 1
        assert closing == pytest.approx(slopes, abs=SPEED_TOL_M_S)
    assert checked > 100


def test_a_obstacle_that_swallows_the_hull_gives_finite_numbers(measured):
    hulls = np.array([[5, 3, -0.8, 1, 0, 0]] * 3)
    obstacles = np.array([[5, 3, -0.8, 0.5, 0.5, 0.5, 0.3]] * 3)
    got = measured(hulls, np.array([SPHERE, CYLINDER, BOX]), obstacles)
    assert np.isfinite(got).all()
    assert got[:, 0] == pytest.approx([-0.67, -0.17, -0.17], abs=FLOAT_TOL_M)


def test_side_walls_floor_and_surface(measured):
    rng = np.random.default_rng(5)
    hulls, kinds, obstacles = random_scenes(5)
    hulls[:, :2] = rng.uniform([-1, -1], [21, 17], (N, 2))
    hulls[:, 2] = rng.uniform(-2, 0.4, N)
    hulls = hulls.astype(np.float32)
    got = measured(hulls, kinds, obstacles)
    for i in range(N):
        pos, axis = hulls[i, :3].astype(float), hulls[i, 3:].astype(float)
        flat = reference.wall_clearance(pos, axis, "rectangle", POOL.x_m, POOL.y_m)
        pen = reference.wall_clearance(pos, axis, "circle", PEN.x_m, PEN.y_m)
        assert got[i, 5] == pytest.approx(flat, abs=DISTANCE_TOL_M)
        assert got[i, 6] == pytest.approx(pen, abs=DISTANCE_TOL_M)
        ends = pos[2] + np.array([-0.1, 0.1]) * axis[2]
        assert got[i, 7] == pytest.approx(min((ends + 1.6).min(), (-ends).min()) - 0.17, abs=FLOAT_TOL_M)
        in_depth = -1.6 <= pos[2] <= 0
        assert got[i, 8] == (0 <= pos[0] <= 20 and 0 <= pos[1] <= 6 and in_depth)
        assert got[i, 9] == (np.hypot(pos[0] - 8, pos[1] - 8) <= 8 and in_depth)


def test_a_position_that_is_not_finite_is_outside(measured):
    hulls = np.array([[np.nan, 3, -0.8, 1, 0, 0], [5, 3, np.nan, 1, 0, 0], [5, np.inf, -0.8, 1, 0, 0]])
    assert not measured(hulls, np.array([SPHERE] * 3), np.ones((3, 7)))[:, 8:].any()
