"""Routes that the host plans: RRT (OMPL) where the Voronoi planner fails, with the paper's lower clearance
floor, or a planner that the user brought in place of both.

Deterministic per call: OMPL draws the seed of every generator it creates from one global sequence.
``RNG.setSeed`` restarts that sequence (OMPL logs an error when it is not the first call, because older
generators keep their state), and everything below is created after it, so a path depends on nothing that ran
before. Bounded by iterations, never by time, so it does not depend on the machine either. OMPL is imported
lazily: it has no Windows wheel.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from uuvtai.common.enums import PLANNER_OWN, PLANNER_RRT
from uuvtai.config import Config
from uuvtai.kernels.core.grid import grid_origin, grid_shape
from uuvtai.sim.stages import Stages

if TYPE_CHECKING:
    import torch

Point = tuple[float, float]

RANGE_M = 1.0  # longest edge of the tree
_STEP_CELLS = 0.5  # States along a motion are checked this often [cells].

_PAD = 0.51 * _STEP_CELLS
"""A state is valid when all cells within this [cells] are: so no cell between two checked states is
missed."""

_GOAL_M = 1e-3  # The goal counts as reached within this.

_MAX_SEED = 0x7FFFFFFF


class ClearanceGrid:
    """Where the fallback may pass: cells with at least ``floor_m``, and the free cells next to the start, so
    that it can leave.

    clearance_m: (n_row, n_col) [m], 0 where occupied or outside; origin: world (x, y) [m] of the outer corner
    of cell [0, 0].
    """

    def __init__(
        self, clearance_m: np.ndarray, origin: Point, cell_m: float, floor_m: float, start_xy: Point
    ) -> None:
        self.clearance_m = np.asarray(clearance_m, dtype=np.float64)
        self.origin, self.cell_m = (float(origin[0]), float(origin[1])), float(cell_m)
        self.open = self.clearance_m >= floor_m - 1e-5
        n_row, n_col = self.open.shape
        row, col = self.cell_of(start_xy)
        rows, cols = np.ogrid[0:n_row, 0:n_col]
        near = (rows - row) ** 2 + (cols - col) ** 2 <= (floor_m / cell_m + 1.0) ** 2
        self.open |= near & (self.clearance_m > 0)
        if 0 <= row < n_row and 0 <= col < n_col:
            self.open[row, col] = True
        self._rows = self.open.tolist()
        self._size = (n_row, n_col)

    def cell_of(self, at: Point) -> tuple[int, int]:
        """(row, col) of a position."""
        x0, y0 = self.origin
        return int((at[1] - y0) // self.cell_m), int((at[0] - x0) // self.cell_m)

    def bounds(self) -> tuple[Point, Point]:
        """((low x, low y), (high x, high y)) [m] of the open cells."""
        rows, cols = np.nonzero(self.open)
        x0, y0 = self.origin
        low = (x0 + self.cell_m * float(cols.min()), y0 + self.cell_m * float(rows.min()))
        return low, (x0 + self.cell_m * float(cols.max() + 1), y0 + self.cell_m * float(rows.max() + 1))

    def checker(self, ends: Sequence[Point]) -> Callable:
        """OMPL validity function of a state; the ends themselves are judged by their own cell only. Plain
        Python inside: 0.6 us a call."""
        rows, (n_row, n_col), (x0, y0) = self._rows, self._size, self.origin
        scale, pad = 1.0 / self.cell_m, _PAD
        near2 = (2.0 * pad * self.cell_m) ** 2
        (ax, ay), (bx, by) = ends

        def is_valid(state) -> bool:
            x, y = state[0], state[1]
            u, v = (x - x0) * scale, (y - y0) * scale
            if (x - ax) ** 2 + (y - ay) ** 2 < near2 or (x - bx) ** 2 + (y - by) ** 2 < near2:
                row, col = int(v), int(u)
                return 0 <= row < n_row and 0 <= col < n_col and rows[row][col]
            low_row, low_col, high_row, high_col = int(v - pad), int(u - pad), int(v + pad), int(u + pad)
            if low_row < 0 or low_col < 0 or high_row >= n_row or high_col >= n_col:
                return False
            low, high = rows[low_row], rows[high_row]
            return low[low_col] and low[high_col] and high[low_col] and high[high_col]

        return is_valid

    def line_cost(self, a: np.ndarray, b: np.ndarray, epsilon_m: float) -> float:
        """Integral of 1 / max(clearance, eps) along a straight line, infinite where it meets a closed
        cell."""
        length = float(np.hypot(*(b - a)))
        n = max(1, int(np.ceil(length / (_STEP_CELLS * self.cell_m))))
        points = (a + (b - a) * ((np.arange(n) + 0.5) / n)[:, None] - self.origin) / self.cell_m
        for d_row in (-_PAD, _PAD):
            for d_col in (-_PAD, _PAD):
                if not self.open[
                    (points[:, 1] + d_row).astype(int), (points[:, 0] + d_col).astype(int)
                ].all():
                    return np.inf
        clearance = self.clearance_m[points[:, 1].astype(int), points[:, 0].astype(int)]
        return length / n * float(np.sum(1.0 / np.maximum(clearance, epsilon_m)))


def plan_rrt(
    start_xy: Point,
    goal_xy: Point,
    grid: ClearanceGrid,
    iterations: int,
    seed: int,
    range_m: float = 1.0,
    epsilon_m: float = 0.1,
) -> np.ndarray | None:
    """Corners (n, 2) [m] of a path from start to goal through open cells, or None where ``iterations`` found
    none.

    The same arguments give the same path, whatever was planned before. Raises ImportError where OMPL is
    missing.
    """
    start, goal = (float(start_xy[0]), float(start_xy[1])), (float(goal_xy[0]), float(goal_xy[1]))
    is_valid = grid.checker((start, goal))
    if not (is_valid(start) and is_valid(goal)):
        return None
    path = solve_rrt(start, goal, grid, is_valid, iterations, seed, range_m)
    return None if path is None else _straightened(path, grid, epsilon_m)


def solve_rrt(
    start: Point,
    goal: Point,
    grid: ClearanceGrid,
    is_valid: Callable,
    iterations: int,
    seed: int,
    range_m: float,
) -> np.ndarray | None:
    """OMPL's RRT from a fresh state of its random numbers: its path (n, 2) [m] as it is, or None."""
    from ompl import base, geometric, util

    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(1 + seed % _MAX_SEED)  # 0 would mean "any seed"
    space = base.RealVectorStateSpace(2)
    bounds = base.RealVectorBounds(2)
    for axis, (low, high) in enumerate(zip(*grid.bounds(), strict=True)):
        bounds.setLow(axis, low)
        bounds.setHigh(axis, high)
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(is_valid)
    information.setStateValidityCheckingResolution(_STEP_CELLS * grid.cell_m / space.getMaximumExtent())
    information.setup()
    problem = base.ProblemDefinition(information)
    ends = information.allocState(), information.allocState()
    for state, at in zip(ends, (start, goal), strict=True):
        state[0], state[1] = at  # type: ignore[index]
    problem.setStartAndGoalStates(*ends, _GOAL_M)
    planner = geometric.RRT(information)
    planner.setRange(range_m)
    planner.setProblemDefinition(problem)
    planner.setup()
    left = iterations

    def out_of_iterations() -> bool:
        nonlocal left
        left -= 1
        return left < 0

    planner.solve(base.PlannerTerminationCondition(out_of_iterations))
    if not problem.hasExactSolution():
        return None
    path = np.array([(state[0], state[1]) for state in problem.getSolutionPath().getStates()])
    path[-1] = goal
    return path


def _straightened(path: np.ndarray, grid: ClearanceGrid, epsilon_m: float) -> np.ndarray:
    """Best choice among the path's corners by dynamic programming over chords of 1, 2, 4, ... corners: never
    costs more than the path."""
    n = len(path)
    cost, following = np.zeros(n), np.zeros(n, dtype=int)
    for i in reversed(range(n - 1)):
        spans = {min(1 << k, n - 1 - i) for k in range(n.bit_length() + 1)}
        options = [(cost[i + s] + grid.line_cost(path[i], path[i + s], epsilon_m), -s) for s in sorted(spans)]
        cost[i], span = min(options)
        if np.isinf(cost[i]):  # at the start's own cell the planner is more lenient than line_cost
            cost[i], span = cost[i + 1] + 1e6, -1
        following[i] = i - span
    corners = [0]
    while corners[-1] != n - 1:
        corners.append(following[corners[-1]])
    return path[corners]


@lru_cache(maxsize=1)
def _has_ompl() -> bool:
    if importlib.util.find_spec("ompl") is None:
        warnings.warn(
            "OMPL is not installed: where the Voronoi planner fails, the last route is kept", stacklevel=2
        )
        return False
    return True


class PlanRequest(NamedTuple):
    """What a planner of the user is told for one env; lengths and places in metres from the grid's corner, x
    along its columns, y along its rows."""

    env: int
    clearance_m: np.ndarray
    """(n_row, n_col) float32 distance to the nearest occupied cell, 0 = occupied or outside"""
    start: np.ndarray
    """(2,) own position"""
    goal: np.ndarray
    """(2,)"""
    obstacle: np.ndarray
    """(B, K, 2) where the moving obstacles are expected"""
    radius_m: np.ndarray
    """(B, K) their radii with what the uncertainty adds"""


class RoutePlanner(Protocol):
    """Plans routes on the host in place of the simulator's own planners (``plugins.loading``)."""

    def reset(self, mask: torch.Tensor) -> None:
        """New episodes begin in the rows (n_env,) where this is not 0."""

    def plan(self, asked: PlanRequest) -> np.ndarray | None:
        """Corners (n >= 2, 2) [m] from start to goal, from the grid's corner; None = no way, so the old route
        stays."""
        ...


class RouteFallback:
    """Serves the envs that the kernels did not plan for: fetch one clearance grid, run the host's planner,
    load the route or keep the old one."""

    def __init__(self, config: Config) -> None:
        self.config = config
        tank, cell_m = config.world.tank, config.mapping.cell_m
        self.overlay = np.zeros(grid_shape(tank, cell_m), dtype=np.float32)
        self.origin = grid_origin(tank, cell_m)

    def serve(
        self,
        stages: Stages,
        seed_of: Callable[[int], int],
        read: Callable[..., np.ndarray],
        count: Callable[[Any], int],
        planner: RoutePlanner | None = None,
    ) -> int:
        """Plan for ``route.failed``; returns how many there were. Or have ``planner`` plan for the whole
        queue, in place of the Voronoi planner and of RRT.

        ``seed_of(env)`` gives the env's number of (seed, episode, step), ``read(field, envs)`` rows of a
        field (``Sim.rows``), ``count(field)`` its one number.
        """
        io = stages.route
        queue, length = (
            (io.route.failed, io.route.n_failed) if planner is None else (io.route.queue, io.route.n_queue)
        )
        n_asked = count(length)
        if n_asked == 0:
            return 0
        from uuvtai.kernels.planning.route import keep_route, load_route
        from uuvtai.kernels.planning.voronoi import overlay_clearance

        envs = sorted(read(queue)[:n_asked].tolist())
        ends = [read(field, envs)[:, :2] for field in (io.ego.pos_w, io.mission.goal_w)]
        known = () if planner is None else (io.forecast.pos_w, io.forecast.radius_m)
        moving = [read(field, envs) for field in known]
        for i, env in enumerate(envs):
            overlay_clearance(io, self.overlay, env)
            if planner is None:
                start, goal = (end[i].tolist() for end in ends)
                corners = self.plan((start[0], start[1]), (goal[0], goal[1]), seed_of(env))
                by = PLANNER_RRT
            else:
                corners = self._ask(planner, env, *(end[i] for end in ends), *(part[i] for part in moving))
                by = PLANNER_OWN
            if corners is None:
                keep_route(io, env)
            else:
                load_route(io, corners.astype(np.float32), env, by)
        return n_asked

    def _ask(
        self,
        planner: RoutePlanner,
        env: int,
        start_w: np.ndarray,
        goal_w: np.ndarray,
        forecast_w: np.ndarray,
        radius_m: np.ndarray,
    ) -> np.ndarray | None:
        """Corners (n, 2) [m] in the world; None = no way."""
        moves = radius_m[:, 0] >= 0
        start, goal, forecast = (place - self.origin for place in (start_w, goal_w, forecast_w[moves]))
        corners = planner.plan(PlanRequest(env, self.overlay.copy(), start, goal, forecast, radius_m[moves]))
        return None if corners is None else corners + self.origin

    def plan(self, start_xy: Point, goal_xy: Point, seed: int) -> np.ndarray | None:
        """RRT on ``self.overlay`` with the config's floor and budget; None (with one warning) where OMPL is
        not installed."""
        r = self.config.route
        if not _has_ompl():
            return None
        grid = ClearanceGrid(
            self.overlay, self.origin, self.config.mapping.cell_m, r.rrt_clearance_m, start_xy
        )
        return plan_rrt(
            start_xy, goal_xy, grid, r.rrt_iterations, seed, RANGE_M, self.config.voronoi.cost_epsilon_m
        )
