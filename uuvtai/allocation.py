"""Thruster geometry: which wrench each thruster gives, and the least-squares way back over the axes that the
frame can command."""

from __future__ import annotations

import numpy as np

from uuvtai.config import VehicleConfig
from uuvtai.errors import SettingError

_AXIS_ORDER = (0, 1, 2, 5, 3, 4)
"""Who comes first where a frame cannot command all axes: surge, sway, heave, yaw, then roll, then pitch."""

_RANK_TOLERANCE = 0.02
"""An axis whose lever over the axes before it is smaller than this (m, or 1 for forces) would ask for absurd
thrusts: left out."""


def allocation_matrices(vehicle_cfg: VehicleConfig) -> tuple[np.ndarray, np.ndarray]:
    """(wrench_of_thrust (6, n), thrust_of_wrench (n, 6)), float64; columns of axes that cannot be commanded
    are zero.

    The 6-thruster frame cannot pitch: its moment about y is always -0.0725 F_x - 0.0025 F_z.
    """
    position = np.array([t.position_m for t in vehicle_cfg.thrusters])
    direction = np.array([t.direction for t in vehicle_cfg.thrusters])
    lengths = np.linalg.norm(direction, axis=1, keepdims=True)
    if (lengths < 1e-6).any():
        raise SettingError(
            f"vehicle.thrusters.{int(np.argmin(lengths))}.direction is zero: give the way positive thrust "
            "pushes"
        )
    direction = direction / lengths
    wrench_of_thrust = np.vstack([direction.T, np.cross(position, direction).T])
    axes = controllable_axes(wrench_of_thrust)
    thrust_of_wrench = np.zeros((len(vehicle_cfg.thrusters), 6))
    thrust_of_wrench[:, axes] = np.linalg.pinv(wrench_of_thrust[axes])
    return wrench_of_thrust, thrust_of_wrench


def controllable_axes(wrench_of_thrust: np.ndarray) -> list[int]:
    """Axes (0-5) that can be commanded independently, chosen one by one in the order of importance."""
    axes: list[int] = []
    for axis in _AXIS_ORDER:
        row = wrench_of_thrust[axis]
        if axes:
            basis = wrench_of_thrust[axes]
            row = row - np.linalg.lstsq(basis.T, row, rcond=None)[0] @ basis
        if np.linalg.norm(row) > _RANK_TOLERANCE:
            axes.append(axis)
    return sorted(axes)
