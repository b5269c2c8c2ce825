"""The oracle: could a vehicle that knows the whole future have reached the goal, and how early? A search
through space and time.

Obstacles do not react, so a scenario fixes what is forbidden where and when. Every node of a lattice that can
be reached alive is followed through time, step by step, until one lies within the goal's radius. What is
found is the earliest arrival of a kinematic point:

- Optimistic: no inertia (any velocity at once); the hull is a ball of its smallest radius; the level speed is
  that of the obstacle's diagonal in any direction, between the eight directions of the lattice up to 8 %
  more; obstacles are looked at once a time step (0.12 s).
- Pessimistic: positions are nodes (level 0.1 m apart) at whole time steps; moves along the lattice count as
  full speed for the time to collision, also in a slow approach; climbing and diving count as standing still
  for it.

So it bounds success from above but for the rounding to nodes; research/LOG.md says how often an agent arrived
where the oracle saw no way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from uuvtai.common.obstacle_motion import obstacle_positions, path_positions
from uuvtai.config import Config

# ---- Where the obstacles of a scenario are at given times, and how far points are from them.

_BEFORE_S = 1e-4  # Velocities are differences over this time: exact but for the moment of a sharp turn.


@dataclass(frozen=True)
class Obstacle:
    kind: str  # sphere, cylinder or box
    size: Array  # (3,) [m] as in ``WorldState``
    yaw: float
    pos_w: Array  # (n_t, 3) [m]; n_t = 1 for an obstacle at rest
    vel_w: Array  # (n_t, 2) [m/s] horizontal

    @property
    def moves(self) -> bool:
        return bool(np.any(self.vel_w))

    @property
    def radius_m(self) -> float:
        """Radius of the circle that holds its plan view."""
        return float(np.hypot(*self.size[:2]) if self.kind == "box" else self.size[0])


def obstacles_of(scenario: dict[str, Any], t_s: Array) -> list[Obstacle]:
    """Obstacles of a ``describe_scenario`` document at the times ``t_s`` (n_t,) [s] since the start."""
    return [_obstacle(obstacle, t_s) for obstacle in scenario["obstacles"]]


def _obstacle(obstacle: dict[str, Any], t_s: Array) -> Obstacle:
    pos, vel = np.array([obstacle["position"]], float), np.zeros((1, 2))
    path = obstacle["path"]
    if path is not None and path["speed_m_s"] > 0:
        pos = obstacle_positions(obstacle, t_s)
        vel = (pos[:, :2] - path_positions(path, t_s - _BEFORE_S)) / _BEFORE_S
    return Obstacle(obstacle["kind"], np.array(obstacle["size"], float), float(obstacle["yaw"]), pos, vel)


def level_excess(obstacle: Obstacle, dx: Array, dy: Array) -> tuple[Array, Array]:
    """(x, y) parts [m] of the way from the obstacle's core (a sphere's centre) to points at (dx, dy)."""
    if obstacle.kind == "sphere":
        return dx, dy
    if obstacle.kind == "cylinder":
        share = np.maximum(1.0 - obstacle.size[0] / np.maximum(np.hypot(dx, dy), 1e-9), 0.0)
        return dx * share, dy * share
    c, s = np.cos(obstacle.yaw), np.sin(obstacle.yaw)
    x, y = c * dx + s * dy, c * dy - s * dx
    x = x - np.clip(x, -obstacle.size[0], obstacle.size[0])
    y = y - np.clip(y, -obstacle.size[1], obstacle.size[1])
    return c * x - s * y, s * x + c * y


def upright_excess(obstacle: Obstacle, dz: Array) -> Array:
    """z part [m] of that way."""
    return dz if obstacle.kind == "sphere" else dz - np.clip(dz, -obstacle.size[2], obstacle.size[2])


def rounding_m(obstacle: Obstacle) -> float:
    """[m] from the core to the surface."""
    return float(obstacle.size[0]) if obstacle.kind == "sphere" else 0.0


# ---- Nodes at which a kinematic point may be, and which of them the termination check's rules forbid at a
# time. The hull is a ball of its own radius: the slimmest that the capsule can look, whatever its heading.

CELL_M = 0.1  # Level distance of neighbouring nodes.

HEAVE_EVERY = 2  # Nodes above each other lie as far apart as full heave goes in so many time steps.

STAY, AXES, DIAGONALS = slice(0, 1), slice(1, 5), slice(5, 9)
MOVES = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)])
"""(n, 2) level steps [nodes in x, y]: stay, along the axes, along the diagonals."""


@dataclass(frozen=True)
class Lattice:
    """Nodes (z, y, x) of the free water, one of which is the start. Masks have shape (n_z, n_y, n_x)."""

    x_m: Array
    y_m: Array
    z_m: Array
    dt_s: float  # one level step at full speed
    speed_m_s: float
    inside: Array  # far enough from side walls, floor and surface
    start: tuple[int, int, int]  # node of the start (z, y, x)

    def near(self, point: Array, reach_m: float) -> Array:
        x, y, z = self.x_m - point[0], self.y_m - point[1], self.z_m - point[2]
        return x**2 + y[:, None] ** 2 + z[:, None, None] ** 2 <= reach_m**2


def lattice_of(start: Array, config: Config) -> Lattice:
    """Lattice around a start (3,) [m] whose time step is one node at the vehicle's full speed.

    Full speed is that along the diagonal of the body axes, surge and sway together, plus the current with 3
    sigma: nothing is faster.
    """
    vehicle, water, tank = config.vehicle, config.disturbance, config.world.tank
    speed = float(
        np.hypot(vehicle.max_surge_m_s, vehicle.max_sway_m_s)
        + np.hypot(*water.current_m_s[:2])
        + 3 * water.current_sigma_m_s
    )
    dt = CELL_M / speed
    wall = vehicle.hull_radius_m + config.episode.collision_clearance_m
    x, col = _axis(start[0], tank.x_m, CELL_M, wall)
    y, row = _axis(start[1], tank.y_m, CELL_M, wall)
    z, layer = _axis(
        start[2],
        tank.z_m,
        (vehicle.max_heave_m_s + abs(water.current_m_s[2])) * dt * HEAVE_EVERY,
        vehicle.hull_radius_m,
    )
    inside = np.ones((len(z), len(y), len(x)), bool)
    if tank.shape == "circle":
        middle = 0.5 * (tank.x_m[0] + tank.x_m[1]), 0.5 * (tank.y_m[0] + tank.y_m[1])
        inside &= np.hypot(x - middle[0], (y - middle[1])[:, None]) <= tank.radius_m - wall
    return Lattice(x, y, z, dt, speed, inside, (layer, row, col))


def _axis(start: float, bounds: tuple[float, float], step: float, margin: float) -> tuple[Array, int]:
    """(coordinates of the nodes within the bounds less a margin, index of the start)."""
    below, above = (
        max(0, int(np.floor((gap - margin) / step + 1e-9))) for gap in (start - bounds[0], bounds[1] - start)
    )
    return start + step * np.arange(-below, above + 1), below


class Termination:
    """Which nodes a hull may not be at, per move: ``blocked`` (n_move, n_z, n_y, n_x) bool.

    A node is forbidden to who leaves or reaches it by a move if the clearance there is below the collision
    clearance, or lasts for less than the time to collision at the speed with which that move at full speed,
    and the obstacle, close it.
    """

    def __init__(self, lattice: Lattice, still: list[Obstacle], config: Config) -> None:
        """``still``: the static obstacles."""
        self._grid, self._rules, self._hull_m = lattice, config.episode, config.vehicle.hull_radius_m
        length = np.maximum(np.linalg.norm(MOVES, axis=1), 1.0)[:, None]
        self._velocity = lattice.speed_m_s * MOVES / length
        self._base = np.repeat(~lattice.inside[None], len(MOVES), axis=0)
        for obstacle in still:
            self._forbid(self._base, obstacle, 0, None)

    def blocked(self, moving: list[Obstacle], step: int, near: Array) -> Array:
        """Masks at a time step, right wherever ``near`` (n_z, n_y, n_x) and its neighbours are."""
        out = self._base.copy()
        for obstacle in moving:
            self._forbid(out, obstacle, step, near)
        return out

    def _forbid(self, out: Array, obstacle: Obstacle, step: int, near: Array | None) -> None:
        box = self._box(obstacle, step)
        wider = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in box)
        if any(part.start >= part.stop for part in box) or (near is not None and not near[wider].any()):
            return
        grid, at, vel = self._grid, obstacle.pos_w[step], obstacle.vel_w[step]
        ox, oy = level_excess(obstacle, grid.x_m[box[2]] - at[0], (grid.y_m[box[1]] - at[1])[:, None])
        oz = upright_excess(obstacle, grid.z_m[box[0]] - at[2])[:, None, None]
        away = np.sqrt(ox**2 + oy**2 + oz**2)
        gap = away - rounding_m(obstacle) - self._hull_m
        # closing speed = -(move - body) . (ox, oy) / away; both sides times ``away``
        rules = self._rules
        fastest = np.maximum(gap / rules.ttc_s, rules.ttc_closing_m_s) if rules.ttc_s > 0 else np.inf
        allowed = fastest * away - (vel[0] * ox + vel[1] * oy)
        allowed = np.where(gap < rules.collision_clearance_m, -np.inf, allowed)
        for move, velocity in enumerate(self._velocity):
            out[(move, *box)] |= -(velocity[0] * ox + velocity[1] * oy) > allowed

    def _box(self, obstacle: Obstacle, step: int) -> tuple[slice, slice, slice]:
        """(z, y, x) ranges of the nodes that the obstacle may forbid."""
        fastest = self._grid.speed_m_s + float(np.hypot(*obstacle.vel_w[step]))
        reach = self._hull_m + max(self._rules.collision_clearance_m, self._rules.ttc_s * fastest)
        spans = (obstacle.size[2] + reach, obstacle.radius_m + reach, obstacle.radius_m + reach)
        axes = (self._grid.z_m, self._grid.y_m, self._grid.x_m)
        low_high = zip(axes, obstacle.pos_w[step][::-1], spans, strict=True)
        z, y, x = (
            slice(int(np.searchsorted(axis, at - span)), int(np.searchsorted(axis, at + span)))
            for axis, at, span in low_high
        )
        return z, y, x


Array = np.ndarray

_DIAGONAL_SHARE = math.sqrt(2.0) - 1.0
"""Share of the time steps that allow diagonal moves, which then are as fast: the reach is an octagon."""


def earliest_arrival(scenario: dict[str, Any], config: Config) -> float | None:
    """[s] Earliest arrival in a scenario (``describe_scenario``'s document) under the rules of ``config``:
    goal radius, horizon, safety. None = the goal cannot be reached within the horizon."""
    rules = config.episode
    grid = lattice_of(np.array(scenario["start"]), config)
    n_step = int(rules.horizon_steps * rules.control_dt_s / grid.dt_s)
    obstacles = obstacles_of(scenario, grid.dt_s * np.arange(n_step + 1))
    termination = Termination(grid, [obstacle for obstacle in obstacles if not obstacle.moves], config)
    moving = [obstacle for obstacle in obstacles if obstacle.moves]
    goal = grid.near(np.array(scenario["goal"]), rules.goal_radius_m)
    reached = np.zeros_like(grid.inside)
    reached[grid.start] = True
    blocked = termination.blocked(moving, 0, reached)
    reached &= ~blocked[0]
    for step in range(n_step + 1):
        if (reached & goal).any():
            return step * grid.dt_s
        if step == n_step or not reached.any():
            break
        after = termination.blocked(moving, step + 1, reached)
        reached = _moved(reached, blocked, after, step)
        blocked = after
    return None


def _moved(reached: Array, blocked: Array, after: Array, step: int) -> Array:
    """Nodes in reach a step later; ``blocked`` and ``after``: the termination check's masks at both its
    ends."""
    out = np.zeros_like(reached)
    for move in _moves_of(step):
        here, there = _shifted(MOVES[move])
        out[there] |= (reached[here] & ~blocked[move][here]) & ~after[move][there]
    if step % HEAVE_EVERY == HEAVE_EVERY - 1:
        level = out.copy()
        out[1:] |= level[:-1] & ~after[0][1:]
        out[:-1] |= level[1:] & ~after[0][:-1]
    return out


def _moves_of(step: int) -> list[int]:
    kinds = [STAY, AXES]
    if math.floor((step + 1) * _DIAGONAL_SHARE) > math.floor(step * _DIAGONAL_SHARE):
        kinds.append(DIAGONALS)
    return [move for kind in kinds for move in range(kind.start, kind.stop)]


def _shifted(move: Array) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """(nodes that a level move leaves, nodes it reaches), pairwise."""
    pairs = [
        (slice(max(0, -d), -d if d > 0 else None), slice(max(0, d), d if d < 0 else None))
        for d in (0, move[1], move[0])
    ]
    return tuple(leave for leave, _ in pairs), tuple(reach for _, reach in pairs)
