"""OMPL's RRT as the fallback: repeatable whatever ran before, safe, whenever Voronoi fails."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from tests import planning_maps as maps
from tests.bundles import io_for
from tests.kernels.planning.test_voronoi import wall
from tests.oracles.voronoi import clearance_of, line_points
from tests.planning_stage import CONFIG, N_ENV, clean, plan, put_ends, put_maps, room_m, way_of
from uuvtai.common import enums as codes
from uuvtai.kernels.planning.io import RouteIO
from uuvtai.sim import rrt

pytest.importorskip("ompl")

FLOOR_M = CONFIG.route.rrt_clearance_m
EDGE_M = 1e-5


def grid_of(occ, start, floor_m=FLOOR_M):
    return rrt.ClearanceGrid(
        clearance_of(occ | maps.OUTSIDE, maps.CELL_M, 2.0)[0], tuple(maps.ORIGIN), maps.CELL_M, floor_m, start
    )


def cluttered(seed):
    return maps.scene(np.random.default_rng(seed), 16)


def free_ends(rng, occ):
    cells = np.argwhere(clearance_of(occ | maps.OUTSIDE, maps.CELL_M, 2.0)[0] >= 0.3)
    a, b = cells[rng.integers(len(cells), size=2)]
    return tuple(maps.centre_of(*a)), tuple(maps.centre_of(*b))


def crossed_cells(way):
    points, _ = line_points(way, 0.002)
    col, row = np.floor((points - maps.ORIGIN) / maps.CELL_M).astype(int).T
    return row, col


@pytest.mark.parametrize("seed", range(8))
def test_a_path_keeps_to_open_cells_and_joins_the_ends(seed):
    occ = cluttered(seed)
    start, goal = free_ends(np.random.default_rng(seed), occ)
    grid = grid_of(occ, start)
    path = rrt.plan_rrt(start, goal, grid, 4000, seed)
    assert path is not None
    assert np.allclose(path[0], start) and np.allclose(path[-1], goal)
    assert grid.open[crossed_cells(path)].all()
    assert not occ[crossed_cells(path)].any()


def test_a_path_depends_on_its_seed_only():
    from ompl import util

    occ = cluttered(2)
    start, goal = free_ends(np.random.default_rng(2), occ)
    grid = grid_of(occ, start)
    first = rrt.plan_rrt(start, goal, grid, 4000, 7)
    other = rrt.plan_rrt(start, goal, grid, 4000, 8)
    draws = [util.RNG().uniform01() for _ in range(23)]  # somebody else uses OMPL in between
    again = rrt.plan_rrt(start, goal, grid_of(occ, start), 4000, 7)
    assert first is not None and other is not None and len(draws) == 23
    assert np.array_equal(first, again)
    assert not (first.shape == other.shape and np.array_equal(first, other))


def test_no_way_no_path():
    occ = np.abs(maps.X - 10.0) < 0.2
    assert rrt.plan_rrt((2.0, 3.0), (18.0, 3.0), grid_of(occ, (2.0, 3.0)), 500, 1) is None


def test_ends_that_are_closed_give_no_path():
    occ = np.hypot(maps.X - 15.0, maps.Y - 3.0) < 0.5
    assert rrt.plan_rrt((2.0, 3.0), (15.0, 3.0), grid_of(occ, (2.0, 3.0)), 500, 1) is None
    assert rrt.plan_rrt((2.0, 3.0), (40.0, 3.0), grid_of(occ, (2.0, 3.0)), 500, 1) is None


def test_iterations_bound_the_search():
    occ = np.zeros(maps.SHAPE, bool)
    for i in range(5):
        maps.box(occ, 3.0 + 3 * i, 2.6 if i % 2 == 0 else 3.4, 0.1, 2.6)
    grid = grid_of(occ, (1.0, 3.0))
    assert rrt.plan_rrt((1.0, 3.0), (19.0, 3.0), grid, 20, 1) is None
    assert rrt.plan_rrt((1.0, 3.0), (19.0, 3.0), grid, 20000, 1) is not None


def test_the_start_may_touch_an_obstacle():
    occ = np.hypot(maps.X - 5.0, maps.Y - 3.0) < 0.5
    start = (5.0, 3.55)
    assert clearance_of(occ | maps.OUTSIDE, maps.CELL_M, 2.0)[0][maps.cell_of(start)] <= 0.1
    path = rrt.plan_rrt(start, (5.0, 1.0), grid_of(occ, start, 0.2), 4000, 5)
    assert path is not None and not occ[crossed_cells(path)].any()


def test_straightening_never_costs_more():
    occ = cluttered(5)
    start, goal = (1.0, 3.0), (19.0, 3.0)
    grid = grid_of(occ, start)
    raw = rrt.solve_rrt(start, goal, grid, grid.checker((start, goal)), 4000, 11, 1.0)
    assert raw is not None
    own = [
        sum(grid.line_cost(a, b, 0.1) for a, b in pairwise(p))
        for p in (raw, rrt._straightened(raw, grid, 0.1))
    ]
    assert own[1] <= own[0] and len(rrt._straightened(raw, grid, 0.1)) < len(raw)


def serve(s, config=CONFIG, seed=1):
    fallback = rrt.RouteFallback(config)
    parts = (s.route, s.clearance, s.grid_map, s.mask, s.mission, s.ego, s.clock, config)
    return fallback.serve(
        SimpleNamespace(route=io_for(RouteIO, *parts), voronoi=io_for(RouteIO, *parts)),
        lambda env: seed + env,
        lambda field, envs=slice(None): field.to_numpy()[envs],
        lambda field: int(field[None]),
    )


CASES = {
    "start_outside": (np.hypot(maps.X - 2.0, maps.Y - 3.6) < 0.4, (2.0, 3.0), (18.0, 3.0)),
    "goal_outside": (np.hypot(maps.X - 18.0, maps.Y - 3.6) < 0.4, (2.0, 3.0), (18.0, 3.0)),
    # 5 cells: 0.3 m at best, below d_min and above the floor
    "disconnected": (wall(10.05, 2.8, 3.3), (2.0, 3.0), (18.0, 3.0)),
}


@pytest.mark.parametrize("reason", CASES)
def test_rrt_takes_over(reason):
    occ, start, goal = CASES[reason]
    s = clean()
    put_maps([occ] * N_ENV)
    put_ends([start] * N_ENV, [goal] * N_ENV)
    plan([2, 5])
    code = codes.REASONS.index(reason) + 1
    assert [s.route.fallback_reason[env] for env in (2, 5)] == [code, code]
    assert s.route.fallbacks[2, code - 1] == 1
    assert s.route.n_way[2] == 0
    assert serve(s) == 2
    for env in (2, 5):
        way = way_of(env)
        assert np.allclose(way[0], start, atol=EDGE_M) and np.allclose(way[-1], goal, atol=EDGE_M)
        assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() <= CONFIG.route.spacing_m * (1 + 2e-4)
        clearance = room_m(s)[env]
        assert (clearance[crossed_cells(way)] >= FLOOR_M - EDGE_M).all()
        assert s.route.planner[env] == codes.PLANNER_RRT and s.route.planned_by[env, 1] == 1
        assert s.route.kept[env] == 0
    assert s.route.n_way[0] == 0


def test_both_fail_keeps_the_last_route_and_never_draws_a_straight_line():
    s = clean()
    put_ends([(2.0, 3.0)] * N_ENV, [(18.0, 3.0)] * N_ENV)
    plan([0])
    before = way_of(0)
    put_maps([np.abs(maps.X - 10.0) < 0.2] * N_ENV)
    plan([0, 1])
    small = CONFIG.model_copy(update={"route": CONFIG.route.model_copy(update={"rrt_iterations": 200})})
    assert serve(s, small) == 2
    assert np.array_equal(way_of(0), before) and s.route.planner[0] == codes.PLANNER_VORONOI
    assert s.route.n_way[1] == 0 and s.route.planner[1] == codes.PLANNER_NONE
    assert [s.route.kept[env] for env in (0, 1)] == [1, 1]


def test_without_ompl_the_last_route_is_kept_with_a_warning(monkeypatch):
    s = clean()
    plan([0])
    before = way_of(0)
    put_ends([(2.0, 0.2)] * N_ENV, [(18.0, 3.0)] * N_ENV)
    plan([0])
    rrt._has_ompl.cache_clear()
    monkeypatch.setattr(rrt.importlib.util, "find_spec", lambda name: None)
    with pytest.warns(UserWarning, match="OMPL is not installed"):
        assert serve(s) == 1
    monkeypatch.undo()
    rrt._has_ompl.cache_clear()
    assert s.route.kept[0] == 1 and np.array_equal(way_of(0), before)


def test_the_fallback_of_an_env_does_not_depend_on_its_company():
    occ, start, goal = CASES["disconnected"]
    ways = []
    for envs in ([0, 1, 2, 3, 4], [3], [4, 3]):
        s = clean()
        put_maps([occ] * N_ENV)
        put_ends([start] * N_ENV, [goal] * N_ENV)
        plan(envs)
        serve(s)
        ways.append(way_of(3))
    assert np.array_equal(ways[0], ways[1]) and np.array_equal(ways[0], ways[2])
