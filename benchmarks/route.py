"""Plans of the Voronoi route against OMPL's RRT and a compiled A* on the same maps, with the same traversable
cells."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pyastar2d

from benchmarks.common import Job, Row, seconds_per_call
from tests import planning_maps as maps
from tests.map_bits import sites
from tests.oracles.voronoi import clearance_of
from uuvtai import state
from uuvtai.common.enums import FAIL_NONE, FULL, N_PLANNER, N_REASON, N_TRIGGER
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config
from uuvtai.kernels.planning import route, voronoi
from uuvtai.kernels.planning.io import RouteIO
from uuvtai.sim import rrt
from uuvtai.sim.stages import bind

THREADS = 1
FLOOR = 4.0
_START, _GOAL, _Z_M = (1.55, 3.05), (18.45, 3.05), -0.8
"""[m] along the tank, as the missions of ``pool``"""
_N_OBSTACLE = 14


def measure(job: Job) -> list[Row]:
    """Plans per second of one core, both from a clearance map that is there already."""
    n_env = 16 if job.quick else 256
    start_taichi(job.device)
    config = Config()
    found = _maps(n_env, config)
    s = _structs(n_env, config, found)

    io = bind(RouteIO, *s.values(), config, partial=True)

    def ours():
        voronoi.plan_routes(io)

    floor_m, origin = config.voronoi.min_clearance_m, (float(maps.ORIGIN[0]), float(maps.ORIGIN[1]))
    grids = [
        rrt.ClearanceGrid(clearance, origin, maps.CELL_M, floor_m, _START)
        for _occ, clearance, _row, _col in found
    ]
    pairs = [(grid, grid.checker((_START, _GOAL))) for grid in grids]

    def theirs():
        return [
            rrt.solve_rrt(_START, _GOAL, grid, check, 20_000, i, 1.0) for i, (grid, check) in enumerate(pairs)
        ]

    weights = [_weights(grid) for grid in grids]

    def shortest():
        return [
            pyastar2d.astar_path(cells, maps.cell_of(_START), maps.cell_of(_GOAL), allow_diagonal=True)
            for cells in weights
        ]

    ours()
    mine = _our_cost(s["route"], grids)
    cost = seconds_per_call({"ours": ours, "OMPL RRT": theirs, "pyastar2d": shortest}, job.seconds)
    notes = {
        "OMPL RRT": "OMPL calls a validity checker in Python",
        "pyastar2d": "C++, eight neighbours, weights 1/clearance made beforehand",
    }
    rows = []
    for name, ways in (("OMPL RRT", theirs()), ("pyastar2d", map(_way, shortest()))):
        others = _peer_cost(name, ways, grids)
        row = Row(
            what=f"plans over {_N_OBSTACLE} obstacles, grid {maps.SHAPE[1]} x {maps.SHAPE[0]}",
            ours=n_env / cost["ours"],
            peer=n_env / cost[name],
            peer_name=name,
            unit="plans/s per core",
            note=f"{1e6 * cost['ours'] / n_env:.0f} against {1e6 * cost[name] / n_env:.0f} us a plan; "
            f"cost of the way {mine:.1f} against {others:.1f}; {notes[name]}",
            details={"num_envs": n_env, "way_cost": mine, "peer_way_cost": others},
        )
        rows.append(row)
    rows[0].floor, rows[0].floor_on = FLOOR, "ratio"
    return rows


def _weights(grid: rrt.ClearanceGrid) -> np.ndarray:
    """Cost of a cell for A*: 1 where there is most room, in proportion to 1/clearance, infinite where the way
    is closed."""
    room = grid.clearance_m
    costs = (float(room.max()) / np.maximum(room, 0.1)).astype(np.float32)
    costs[~grid.open] = np.inf
    return costs


def _way(cells: np.ndarray | None) -> list | None:
    """Way through the cells' centres [m], None where there is none."""
    if cells is None:
        return None
    return [_START, *((cells[1:-1, ::-1] + 0.5) * maps.CELL_M + np.asarray(maps.ORIGIN[:2])), _GOAL]


def _maps(n: int, config: Config) -> list[tuple]:
    """(occupied, clearance [m], site row, site col) of maps in which start and goal are joined by traversable
    cells."""
    from scipy.ndimage import label

    out, rng = [], np.random.default_rng(0)
    while len(out) < n:
        occ = maps.scene(rng, _N_OBSTACLE)
        found = clearance_of(occ | maps.OUTSIDE, maps.CELL_M, config.clearance.max_m)
        wide = found[0] >= config.voronoi.min_clearance_m - 1e-5
        regions, _count = label(wide & ~occ)  # type: ignore[misc]
        ends = regions[maps.cell_of(_START)], regions[maps.cell_of(_GOAL)]
        if ends[0] == ends[1] != 0:
            out.append((occ * FULL, *found))
    return out


def _structs(n_env: int, config: Config, found: list[tuple]) -> dict:
    names = {
        "voronoi": "VoronoiState", "route": "RouteState", "clearance": "ClearanceState",
        "grid_map": "MapState", "mask": "GridMask", "mission": "MissionState", "ego": "Proprioception",
        "clock": "ClockState",
    }  # fmt: skip
    n_row, n_col = maps.SHAPE
    sizes = {
        "n_env": n_env, "n_plan": min(n_env, 64), "n_row": n_row, "n_col": n_col, "n_heap": n_row * n_col,
        "n_path": 2048, "n_way": config.route.n_way, "n_ahead": 32, "n_trigger": N_TRIGGER,
        "n_planner": N_PLANNER, "n_reason": N_REASON,
    }  # fmt: skip
    s = {name: state.allocate(getattr(state, struct), sizes) for name, struct in names.items()}
    s["mask"].outside.from_numpy(maps.OUTSIDE.astype(np.int32))
    s["clock"].active.fill(1)
    route.reset_route(bind(RouteIO, s["route"], s["clock"], partial=True))
    occ, _room, row, col = (np.array([f[i] for f in found]) for i in range(4))
    s["grid_map"].static_occ.from_numpy(occ.astype(np.uint16))
    s["clearance"].site.from_numpy(sites(row, col))
    s["ego"].pos_w.from_numpy(np.tile(np.array([*_START, _Z_M], np.float32), (n_env, 1)))
    s["mission"].goal_w.from_numpy(np.tile(np.array([*_GOAL, _Z_M], np.float32), (n_env, 1)))
    s["route"].queue.from_numpy(np.arange(n_env, dtype=np.int32))
    s["route"].n_queue[None] = n_env
    return s


def _our_cost(ours: state.RouteState, grids: list[rrt.ClearanceGrid]) -> float:
    """Mean cost of our ways. Raises RuntimeError where a map is without one: all of them have ways."""
    if failed := sum(ours.fallback_reason.to_numpy() != FAIL_NONE):
        raise RuntimeError(f"{failed} maps without our route; all of them have one")
    ways, counts = ours.way_w.to_numpy(), ours.n_way.to_numpy()
    return float(np.mean([_cost(ways[i, : counts[i]], grid) for i, grid in enumerate(grids)]))


def _peer_cost(name: str, theirs: Iterable, grids: list[rrt.ClearanceGrid]) -> float:
    """Mean cost of a peer's ways. Raises RuntimeError as ``_our_cost``."""
    theirs = list(theirs)
    if lost := sum(path is None for path in theirs):
        raise RuntimeError(f"{lost} maps without {name}'s route; all of them have one")
    return float(np.mean([_cost(np.array(path), grid) for path, grid in zip(theirs, grids, strict=True)]))


def _cost(way: np.ndarray, grid: rrt.ClearanceGrid) -> float:
    """Length over clearance, summed along a way at a twentieth of a metre."""
    total = 0.0
    for a, b in pairwise(way):
        length = float(np.hypot(*(b - a)))
        pieces = max(1, int(np.ceil(length / 0.05)))
        at = a + (b - a) * ((np.arange(pieces) + 0.5) / pieces)[:, None]
        room = [max(grid.clearance_m[grid.cell_of((p[0], p[1]))], 0.1) for p in at]
        total += length / pieces * float(np.sum(1.0 / np.array(room)))
    return total
