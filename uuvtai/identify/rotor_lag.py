"""From rotor speeds to thrust: speeds as turned, or as commanded and followed with a lag of first order."""

from __future__ import annotations

import numpy as np

from uuvtai.config import VehicleConfig
from uuvtai.identify.drive_log import Drive
from uuvtai.kernels.vehicle.rotor import KGF, edge_rpm

LEAST_LAG_S = 1e-3
_INSTANTS = (0.03, 0.1025, 0.20125, 0.3325, 0.50375, 0.7, 0.9)
_SHARES = (0.06, 0.085, 0.1125, 0.15, 0.1925, 0.2, 0.2)
"""of a step, at which thrust is taken, and for how much of it: denser where a lagging rotor turns quickest"""
_WEIGHTS = np.array([_SHARES, np.multiply(_SHARES, np.subtract(1, _INSTANTS))])
_WEIGHTS /= _WEIGHTS.sum(axis=1, keepdims=True)
_NEAREST_RPM = 1e-3
"""A lagging rotor never quite arrives: one that comes to the dead band's edge from within does not push."""

_STRAIGHT = 1e-6
"""of a step to a lag, at which what decays runs straight"""


def mean_wrench(drive: Drive, vehicle_cfg: VehicleConfig, lags_s: np.ndarray) -> np.ndarray:
    """(2, lags, n - 1, thrusters) [N] mean thrust of each step with each lag: the plain mean, and that
    weighted by the time left of the step, which says how early it came. Speeds as turned approach the next
    one as the vehicle's own lag has it, or straight, whatever ``lags_s`` says."""
    if drive.is_asked:
        lag = drive.dt_s / lags_s[:, None, None]
        risen = _risen(drive)
        off = _behind(drive, risen, lags_s)
        speeds = (
            drive.rpm[:-1] + (instant - 1 / lag) * risen + np.exp(-instant * lag) * (off + risen / lag)
            for instant in _INSTANTS
        )
    else:
        lag = np.full((len(lags_s), 1, 1), drive.dt_s / vehicle_cfg.rotor_tau_s)
        before, goal = drive.rpm[None, :-1], drive.rpm[None, 1:]
        if drive.straight:
            lag = np.full_like(lag, _STRAIGHT)
        ways = [np.expm1(-instant * lag) / np.expm1(-lag) for instant in _INSTANTS]
        speeds = (before + way * (goal - before) for way in ways)
    found = np.zeros((2, len(lags_s), len(drive.rpm) - 1, drive.rpm.shape[1]))
    for weights, speed in zip(_WEIGHTS.T, speeds, strict=True):
        pushed = thrust_of(speed, vehicle_cfg)
        for row, weight in enumerate(weights):
            found[row] += weight * pushed
    return found


def _risen(drive: Drive) -> np.ndarray:
    """(n - 1, thrusters) [rpm] by how much the command rises during each step."""
    return np.diff(drive.rpm, axis=0) if drive.command == "line" else np.zeros_like(drive.rpm[:-1])


def _behind(drive: Drive, risen: np.ndarray, lags_s: np.ndarray) -> np.ndarray:
    """(lags, n - 1, thrusters) [rpm] by how much the rotors are beyond the command at the begin of each step:
    a lag of first order behind a straight line (speed = line - slope * lag + what decays)."""
    kept = np.exp(-drive.dt_s / lags_s)[:, None]
    behind = (lags_s / drive.dt_s)[:, None, None] * risen
    jumps = np.diff(drive.rpm, axis=0) - risen
    off = np.zeros((len(risen), len(lags_s), drive.rpm.shape[1]))
    off[1:] = np.moveaxis((kept[:, None] - 1) * behind - jumps, 0, 1)[:-1]
    for k in range(1, len(off)):
        off[k] += kept * off[k - 1]
    off = np.moveaxis(off, 0, 1)
    return np.where(np.abs(off) < _NEAREST_RPM, np.copysign(_NEAREST_RPM, off), off)


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
