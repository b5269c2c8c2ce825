"""Exposure to moving bodies: the average of the dynamic layer, what is expected before any body is seen, and
routes that keep out of both."""

import numpy as np
import pytest
import taichi as ti

from tests import planning_maps as maps
from tests.bundles import io_for
from tests.map_bits import words
from tests.planning_stage import CONFIG, N_BLOCK, N_ENV, clean, plan, put_ends, put_maps, stage, way_of
from tests.reference import exposure as oracle
from tests.reference import voronoi
from tests.test_voronoi import STRICT
from uuvtai.config import TankConfig
from uuvtai.kernels.core.signature import AnyTensor, Bundle
from uuvtai.kernels.perception.mapping import map_period_s
from uuvtai.kernels.planning.bundles import ExposureIO, VoronoiIO
from uuvtai.kernels.planning.exposure import BLOCK, average_traffic, dearness, deep_m, reset_exposure
from uuvtai.plan_codes import FAIL_NONE

QUIET = CONFIG.quiet.model_copy(update={"weight_seen": 3.0, "weight_prior": 2.0, "memory_s": 2.0})
PEN = TankConfig(shape="circle", x_m=(2.0, 10.0), y_m=(-1.0, 5.0))


@ti.kernel
def _factors(out: AnyTensor, env: int, io: Bundle[VoronoiIO]):
    for row, col in ti.ndrange(out.shape[0], out.shape[1]):
        out[row, col] = dearness(env, row, col, io)


def factors(env, tank, quiet=QUIET):
    """Factor of every cell of one env."""
    out = np.zeros(maps.SHAPE, np.float32)
    _factors(out, env, io_for(VoronoiIO, stage().exposure, quiet, tank, CONFIG.traffic, CONFIG.mapping))
    return out


def test_the_average_is_that_of_an_exact_one():
    rng, s = np.random.default_rng(0), clean()
    sections = (QUIET, CONFIG.mapping, CONFIG.sensors.sonar, CONFIG.episode)
    io = io_for(ExposureIO, s.exposure, s.clock, s.grid_map, *sections)
    period_s = map_period_s(CONFIG.mapping, CONFIG.sensors.sonar, CONFIG.episode)
    share = rng.random((N_ENV, *N_BLOCK))
    s.exposure.share.from_numpy(share.astype(np.float32))
    for step in range(4):
        occupied = rng.random((N_ENV, *maps.SHAPE)) < 0.01
        s.grid_map.dynamic_occupied.from_numpy(words(occupied))
        s.clock.step.fill(step)
        fresh = rng.random(N_ENV) < 0.7
        s.grid_map.map_step.from_numpy(np.where(fresh, step, step - 1).astype(np.int32))
        s.clock.awake.from_numpy((np.arange(N_ENV) != 3).astype(np.int32))
        average_traffic(io)
        for env in set(np.flatnonzero(fresh)) - {3}:
            share[env] = oracle.averaged(share[env], occupied[env], BLOCK, period_s, QUIET.memory_s)
    assert np.allclose(s.exposure.share.to_numpy(), share, atol=1e-6)
    reset_exposure(io)
    left = s.exposure.share.to_numpy()
    assert np.array_equal(left.any(axis=(1, 2)), np.arange(N_ENV) == 3)


@pytest.mark.parametrize("tank", [maps.TANK, PEN], ids=["rectangle", "circle"])
def test_a_metre_is_dearer_by_what_was_seen_and_what_is_expected(tank):
    rng, s = np.random.default_rng(1), clean()
    share = rng.random((N_ENV, *N_BLOCK)).astype(np.float32)
    s.exposure.share.from_numpy(share)
    row, col = np.mgrid[0 : maps.SHAPE[0], 0 : maps.SHAPE[1]]
    x0, y0 = maps.grid_origin(tank, maps.CELL_M)
    x, y = x0 + (col + 0.5) * maps.CELL_M, y0 + (row + 0.5) * maps.CELL_M
    gap = np.minimum.reduce([x - tank.x_m[0], tank.x_m[1] - x, y - tank.y_m[0], tank.y_m[1] - y])
    if tank is PEN:
        gap = 3.0 - np.hypot(x - 6.0, y - 2.0)
    expected = 1.0 - (1.0 - np.clip(gap / 3.0, 0, 1)) ** 2
    seen = [
        [oracle.between_blocks(share[5], BLOCK, r, c) for c in range(0, maps.SHAPE[1], 7)] for r in row[:, 0]
    ]
    found = factors(5, tank)
    assert np.allclose(found[:, ::7], 1.0 + 2.0 * expected[:, ::7] + 3.0 * np.array(seen), atol=1e-4)


def test_lines_that_fit_between_the_walls_pass_as_often_as_expected():
    y = np.arange(0.5, 3.01, 0.25)
    density = oracle.density_across(6.0, CONFIG.traffic.leg_m, y, np.random.default_rng(2))
    deep = deep_m(maps.TANK, CONFIG.traffic)
    assert deep == 3.0
    assert np.allclose(density / density[-1], 1.0 - (1.0 - y / deep) ** 2, atol=0.1)


def test_routes_go_around_busy_water_and_no_nearer_to_anything():
    s = clean()
    busy = np.hypot(maps.X - 10.0, maps.Y - 3.0) < 1.0
    rows, cols = np.nonzero(busy)
    share = np.zeros((N_ENV, *N_BLOCK), np.float32)
    share[0, rows // BLOCK, cols // BLOCK] = 1.0
    s.exposure.share.from_numpy(share)
    post = np.hypot(maps.X - 10.0, maps.Y - 5.4) < 0.5
    put_maps([post] * N_ENV)
    put_ends([(6.0, 3.0)] * N_ENV, [(14.0, 3.0)] * N_ENV)
    plan([0, 1], STRICT)
    clearance, _, _ = voronoi.clearance_of(post | maps.OUTSIDE, maps.CELL_M, 2.0)
    nearest, widest = [], []
    for env in (0, 1):
        assert s.route.fallback_reason[env] == FAIL_NONE
        points, _ = voronoi.line_points(way_of(env), 0.01)
        nearest.append(np.hypot(*(points - (10.0, 3.0)).T).min())
        col, row = np.floor((points - maps.ORIGIN) / maps.CELL_M).astype(int).T
        widest.append(clearance[row, col].min())
    assert nearest[0] > 1.0 > 0.4 > nearest[1]
    assert min(widest) >= STRICT.voronoi.min_clearance_m - 1e-5


def test_a_closed_way_stays_open_however_busy():
    """Exposure costs, it closes nothing."""
    s = clean()
    put_maps([(np.abs(maps.X - 10.0) < 0.3) & (np.abs(maps.Y - 3.0) > 0.5)] * N_ENV)
    s.exposure.share.fill(1.0)
    put_ends([(9.0, 3.0)] * N_ENV, [(11.0, 3.0)] * N_ENV)
    plan([0], STRICT)
    assert s.route.fallback_reason[0] == FAIL_NONE and s.route.n_way[0] > 2
