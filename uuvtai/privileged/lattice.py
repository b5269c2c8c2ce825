"""Nodes in space at which a kinematic point may be, and which of them the referee's rules forbid at a time,
for every way to leave them.

The hull is a ball of its own radius: the slimmest that the capsule can look, whatever its heading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uuvtai.config import Config
from uuvtai.privileged.obstacles import Obstacle, level_excess, rounding_m, upright_excess

Array = np.ndarray

CELL_M = 0.1
"""Level distance of neighbouring nodes."""

HEAVE_EVERY = 2
"""Nodes above each other lie as far apart as full heave goes in so many time steps."""

STAY, AXES, DIAGONALS = slice(0, 1), slice(1, 5), slice(5, 9)
MOVES = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)])
"""(n, 2) level steps [nodes in x, y]: stay, along the axes, along the diagonals."""


@dataclass(frozen=True)
class Lattice:
    """Nodes (z, y, x) of the free water, one of which is the start. Masks have shape (n_z, n_y, n_x)."""

    x_m: Array
    y_m: Array
    z_m: Array
    dt_s: float
    """one level step at full speed"""
    speed_m_s: float
    inside: Array
    """far enough from side walls, floor and surface"""
    start: tuple[int, int, int]
    """node of the start (z, y, x)"""

    def near(self, point: Array, reach_m: float) -> Array:
        """Mask of the nodes within ``reach_m`` of a point."""
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


class Referee:
    """Which nodes a hull may not be at, per move: ``blocked`` (n_move, n_z, n_y, n_x) bool.

    A node is forbidden to who leaves or reaches it by a move if the clearance there is below the collision
    clearance, or lasts for less than the time to collision at the speed with which that move at full speed,
    and the body, close it.
    """

    def __init__(self, lattice: Lattice, still: list[Obstacle], config: Config) -> None:
        """``still``: the bodies at rest."""
        self._grid, self._rules, self._hull_m = lattice, config.episode, config.vehicle.hull_radius_m
        length = np.maximum(np.linalg.norm(MOVES, axis=1), 1.0)[:, None]
        self._velocity = lattice.speed_m_s * MOVES / length
        self._base = np.repeat(~lattice.inside[None], len(MOVES), axis=0)
        for body in still:
            self._forbid(self._base, body, 0, None)

    def blocked(self, moving: list[Obstacle], step: int, near: Array) -> Array:
        """Masks at a time step, right wherever ``near`` (n_z, n_y, n_x) and its neighbours are; elsewhere
        bodies may be left out."""
        out = self._base.copy()
        for body in moving:
            self._forbid(out, body, step, near)
        return out

    def _forbid(self, out: Array, body: Obstacle, step: int, near: Array | None) -> None:
        box = self._box(body, step)
        if any(part.start >= part.stop for part in box) or (
            near is not None and not near[_widened(box)].any()
        ):
            return
        grid, at, vel = self._grid, body.pos_w[step], body.vel_w[step]
        ox, oy = level_excess(body, grid.x_m[box[2]] - at[0], (grid.y_m[box[1]] - at[1])[:, None])
        oz = upright_excess(body, grid.z_m[box[0]] - at[2])[:, None, None]
        away = np.sqrt(ox**2 + oy**2 + oz**2)
        gap = away - rounding_m(body) - self._hull_m
        # closing speed = -(move - body) . (ox, oy) / away; both sides times ``away``
        fastest = (
            np.maximum(gap / self._rules.ttc_s, self._rules.ttc_closing_m_s)
            if self._rules.ttc_s > 0
            else np.inf
        )
        allowed = np.where(
            gap < self._rules.collision_clearance_m, -np.inf, fastest * away - (vel[0] * ox + vel[1] * oy)
        )
        for move, velocity in enumerate(self._velocity):
            out[(move, *box)] |= -(velocity[0] * ox + velocity[1] * oy) > allowed

    def _box(self, body: Obstacle, step: int) -> tuple[slice, slice, slice]:
        """(z, y, x) ranges of the nodes that the body may forbid."""
        fastest = self._grid.speed_m_s + float(np.hypot(*body.vel_w[step]))
        reach = self._hull_m + max(self._rules.collision_clearance_m, self._rules.ttc_s * fastest)
        spans = (body.size[2] + reach, body.radius_m + reach, body.radius_m + reach)
        axes = (self._grid.z_m, self._grid.y_m, self._grid.x_m)
        low_high = zip(axes, body.pos_w[step][::-1], spans, strict=True)
        z, y, x = (
            slice(int(np.searchsorted(axis, at - span)), int(np.searchsorted(axis, at + span)))
            for axis, at, span in low_high
        )
        return z, y, x


def _widened(box: tuple[slice, slice, slice]) -> tuple[slice, ...]:
    """The ranges with one node more on every side."""
    return tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in box)
