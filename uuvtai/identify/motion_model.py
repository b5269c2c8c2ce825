"""The motion that is fitted: Fossen's equation in surge, sway, heave and yaw, with measured roll, pitch and
thrust as inputs (T. Fossen, Handbook of Marine Craft, 2011). NumPy, many parameter sets at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uuvtai.allocation import allocation_matrices
from uuvtai.config import VehicleConfig
from uuvtai.identify.drive_log import Drive, DriveError
from uuvtai.kernels.vehicle.rotor import KGF, edge_rpm

AXES = ("surge", "sway", "heave", "yaw")
_OF_SIX = (0, 1, 2, 5)
"""where those stand among six"""
NET, GAIN = 12, 13
"""places of net buoyancy and gain, behind added mass, linear and quadratic damping of the four axes"""
SIZE = 14
_LONGEST_STEP_S = 0.025
_FAST = 20.0
"""[m/s, rad/s] a trial's motion ends here"""
_INSTANTS = (0.125, 0.375, 0.625, 0.875)
"""of a step, at which thrust is taken"""


@dataclass(frozen=True)
class Stretches:
    """Stretches of equal length cut from drives: s of them, n steps each."""

    dt_s: float
    velocity: np.ndarray
    """(s, n + 1, 4), NaN = no reading"""
    tilt_rate: np.ndarray
    """(s, n, 2) in the middle of each step"""
    up: np.ndarray
    """(s, n, 3) likewise"""
    wrench: np.ndarray
    """(s, n, 4) mean of each step by the vehicle's own thrust curve [N, N m]"""

    def some(self, which: np.ndarray) -> Stretches:
        """These of them."""
        return Stretches(
            self.dt_s, self.velocity[which], self.tilt_rate[which], self.up[which], self.wrench[which]
        )


def parameters_of(vehicle_cfg: VehicleConfig) -> np.ndarray:
    """(14,) of a vehicle."""
    rows = (vehicle_cfg.added_mass, vehicle_cfg.linear_damping, vehicle_cfg.quadratic_damping)
    net = vehicle_cfg.gravity_m_s2 * (
        vehicle_cfg.water_density_kg_m3 * vehicle_cfg.volume_m3 - vehicle_cfg.mass_kg
    )
    return np.array([*(row[i] for row in rows for i in _OF_SIX), net, 1.0])


def changed(vehicle_cfg: VehicleConfig, found: np.ndarray) -> dict[str, object]:
    """Keys of the vehicle section that ``found`` (14,) changes; negative damping and added mass become 0."""
    keys: dict[str, object] = {}
    for row, name in enumerate(("added_mass", "linear_damping", "quadratic_damping")):
        values = list(getattr(vehicle_cfg, name))
        for i, place in enumerate(_OF_SIX):
            values[place] = max(0.0, round(float(found[4 * row + i]), 5))
        keys[name] = values
    heavy = vehicle_cfg.mass_kg + float(found[NET]) / vehicle_cfg.gravity_m_s2
    keys["volume_m3"] = round(heavy / vehicle_cfg.water_density_kg_m3, 8)
    keys["thrust_scale"] = round(vehicle_cfg.thrust_scale * float(found[GAIN]), 5)
    return keys


def stretches(drives: list[Drive], vehicle_cfg: VehicleConfig, seconds: float) -> Stretches:
    """All whole stretches of ``seconds`` in the drives. Raises DriveError."""
    dt_s = drives[0].dt_s
    n = max(2, round(seconds / dt_s))
    parts: list[tuple[np.ndarray, ...]] = []
    for drive in drives:
        if abs(drive.dt_s / dt_s - 1) > 0.02:
            raise DriveError(
                f"one log has a sample every {dt_s:g} s, another every {drive.dt_s:g} s: identify them apart"
            )
        wrench = _wrench(drive, vehicle_cfg)
        middle = [0.5 * (a[1:] + a[:-1]) for a in (drive.tilt_rate, drive.up)]
        for begin in range(0, len(wrench) - n + 1, n):
            cut = slice(begin, begin + n)
            parts.append((drive.velocity[begin : begin + n + 1], *(a[cut] for a in (*middle, wrench))))
    if not parts:
        raise DriveError(f"no log lasts {seconds:g} s without a gap: drive for five minutes")
    return Stretches(dt_s, *(np.stack(rows) for rows in zip(*parts, strict=True)))


def _wrench(drive: Drive, vehicle_cfg: VehicleConfig) -> np.ndarray:
    """(n - 1, 4) mean force and moment of each step: rotors approach their next speed as their lag has it."""
    count = drive.rpm.shape[1]
    if count != len(vehicle_cfg.thrusters):
        raise DriveError(
            f"the log has {count} thrusters, the vehicle {len(vehicle_cfg.thrusters)}: name the one that was "
            "driven, --vehicle NAME"
        )
    lag = drive.dt_s / vehicle_cfg.rotor_tau_s
    before, after = drive.rpm[:-1], drive.rpm[1:]
    thrust = np.zeros_like(before)
    for instant in _INSTANTS:
        share = -np.expm1(-instant * lag) / -np.expm1(-lag)
        thrust += thrust_of(before + share * (after - before), vehicle_cfg) / len(_INSTANTS)
    geometry, _ = allocation_matrices(vehicle_cfg)
    return thrust @ geometry[list(_OF_SIX)].T


def thrust_of(rpm: np.ndarray, vehicle_cfg: VehicleConfig) -> np.ndarray:
    """[N] of rotors, as the simulator has it."""
    ahead = edge_rpm(vehicle_cfg.thrust_forward, vehicle_cfg.dead_band_rpm[0], 1.0)
    astern = edge_rpm(vehicle_cfg.thrust_reverse, vehicle_cfg.dead_band_rpm[1], -1.0)
    forward, reverse = (np.polyval(c, rpm) for c in (vehicle_cfg.thrust_forward, vehicle_cfg.thrust_reverse))
    return (
        KGF
        * vehicle_cfg.thrust_scale
        * np.where(rpm >= ahead, forward, np.where(rpm <= astern, reverse, 0.0))
    )


def motion(theta: np.ndarray, start: np.ndarray, given: Stretches, vehicle_cfg: VehicleConfig) -> np.ndarray:
    """Velocities (runs, s, n + 1, 4) of each parameter set ``theta`` (runs, 14), from ``start`` (runs, s, 4)
    on."""
    steps = given.wrench.shape[1]
    parts = max(1, int(np.ceil(given.dt_s / _LONGEST_STEP_S)))
    dt = given.dt_s / parts
    out = np.empty((*start.shape[:2], steps + 1, 4))
    x = out[:, :, 0] = start
    for k in range(steps):
        inputs = (given.wrench[:, k], given.tilt_rate[:, k], given.up[:, k])
        for _ in range(parts):
            half = x + 0.5 * dt * _acceleration(theta, x, inputs, vehicle_cfg)
            x = np.clip(x + dt * _acceleration(theta, half, inputs, vehicle_cfg), -_FAST, _FAST)
        out[:, :, k + 1] = x
    return out


def _acceleration(
    theta: np.ndarray, x: np.ndarray, inputs: tuple[np.ndarray, ...], vehicle_cfg: VehicleConfig
) -> np.ndarray:
    wrench, tilt, up = inputs
    added, linear, quadratic = (theta[:, None, i : i + 4] for i in (0, 4, 8))
    inertia = added + np.array([vehicle_cfg.mass_kg] * 3 + [vehicle_cfg.inertia_kg_m2[2]])
    load = theta[:, None, GAIN, None] * wrench - (linear + quadratic * np.abs(x)) * x
    load[..., :3] += theta[:, None, NET, None] * up
    p, q, r = tilt[:, 0], tilt[:, 1], x[..., 3]
    mu, mv, mw = (inertia[..., i] * x[..., i] for i in range(3))
    load[..., 0] -= q * mw - r * mv
    load[..., 1] -= r * mu - p * mw
    load[..., 2] -= p * mv - q * mu
    six, spin = vehicle_cfg.added_mass, vehicle_cfg.inertia_kg_m2
    load[..., 3] -= (added[..., 1] - added[..., 0]) * x[..., 0] * x[..., 1]
    load[..., 3] -= p * q * (spin[1] + six[4] - spin[0] - six[3])
    return load / inertia
