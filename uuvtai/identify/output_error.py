"""Least squares on the output: parameters whose motion, driven by the logged rotor speeds, comes closest to
the measured velocities (Gauss-Newton); intervals by a bootstrap over stretches.

Each stretch has an initial velocity of its own, fitted anew for each trial of the parameters. Noise of the
readings does not enter the regressors, as it does where measured velocities are differentiated. A stretch is
drawn as a whole, so errors may be correlated within it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uuvtai.config import VehicleConfig
from uuvtai.identify.linearised import SCALE, linearised
from uuvtai.identify.motion_model import AXES, LAG, SIZE, Stretches, motion, readings, undelayed
from uuvtai.identify.stretch_starts import first_readings, grown_starts, settled_starts

_ROUNDS = 25
_WEIGHED = (1, 3)
"""rounds after which readings are weighed anew, by what is left"""
_NOTHING, _LITTLE, _KEPT = 0.01, 1.0, 0.1
"""falls of the sum of squares that a step promises, in units of noise: below the first it is the last one,
for no parameter moves by more than a tenth of its standard deviation; below the second it is if it keeps less
than this share of its promise, for the dead band's edges make that sum rough"""
_DRAWS = 2000
_LEVEL = (2.5, 97.5)
_NOISE = 0.02


@dataclass(frozen=True)
class Fit:
    """What least squares found."""

    value: np.ndarray
    """(17,)"""
    low: np.ndarray
    """(17,) of the 95 % interval; where nothing was fitted, the value itself"""
    high: np.ndarray
    start: np.ndarray
    """(s, 4) initial velocity of each stretch"""
    noise: np.ndarray
    """(4,) rms of what is left [m/s, rad/s]"""


def fitted(given: Stretches, vehicle_cfg: VehicleConfig, first: np.ndarray, free: np.ndarray) -> Fit:
    """Fit the parameters ``free`` (17, bool), from ``first`` (17,) on; the others stay."""
    value, start = first.copy(), first_readings(given)
    noise = np.full(len(AXES), _NOISE)
    fault = np.inf
    back = (value, start)
    shrink, promised = 1.0, np.inf
    for i in range(_ROUNDS):
        given = given.at_lag(value[LAG], vehicle_cfg)
        if i <= _WEIGHED[-1]:
            start = grown_starts(given, vehicle_cfg, value, noise)
        else:
            start = settled_starts(given, vehicle_cfg, value, start, noise)
        jacobian, own, rest = linearised(given, vehicle_cfg, value, start, free, noise)
        now = float(np.sum(rest**2))
        if i > _WEIGHED[-1] + 1 and promised < _LITTLE and now > fault - _KEPT * promised:
            break
        if now > fault * (1 + 1e-9) and shrink > 0.1:
            shrink *= 0.5
            value, start = (old + 0.5 * (new - old) for old, new in zip(back, (value, start), strict=True))
            continue
        fault, back, shrink = now, (value, start), 1.0
        step, moved, promised = _step(jacobian, own, rest)
        settled = promised < _NOTHING
        value = value.copy()
        value[free] += step * SCALE[free]
        start = start + moved
        if settled or i in _WEIGHED:
            given = given.at_lag(value[LAG], vehicle_cfg)
            noise = _left(given, vehicle_cfg, value, start)
            fault = np.inf
        if settled and i > _WEIGHED[-1]:
            break
    given = given.at_lag(value[LAG], vehicle_cfg)
    start = settled_starts(given, vehicle_cfg, value, start, noise)
    jacobian, own, rest = linearised(given, vehicle_cfg, value, start, free, noise)
    low, high = _bootstrap(jacobian, own, rest)
    apart = _left_open(given, vehicle_cfg, (value, start), noise, jacobian, own)
    low, high = low - apart, high + apart
    bounds = [value.copy(), value.copy()]
    for bound, apart in zip(bounds, (low, high), strict=True):
        bound[free] += apart * SCALE[free]
    return Fit(value, bounds[0], bounds[1], start, _left(given, vehicle_cfg, value, start))


def _left(given: Stretches, vehicle_cfg: VehicleConfig, value: np.ndarray, start: np.ndarray) -> np.ndarray:
    away = given.velocity - readings(value[None], start[None], given, vehicle_cfg)[0]
    seen = ~np.isnan(away)
    count = np.maximum(1, seen.sum(axis=(0, 1)))
    return np.maximum(1e-5, np.sqrt(np.square(np.where(seen, away, 0.0)).sum(axis=(0, 1)) / count))


def _apart(jacobian: np.ndarray, own: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of each stretch, (s, k, k) and (s, k), with its initial velocity eliminated."""
    basis = np.linalg.qr(own)[0]
    turned = np.swapaxes(basis, 1, 2)
    free = jacobian - basis @ (turned @ jacobian)
    left = rest - (basis @ (turned @ rest[..., None]))[..., 0]
    across = np.swapaxes(free, 1, 2)
    return across @ free, (across @ left[..., None])[..., 0]


def _step(jacobian: np.ndarray, own: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """(of the parameters, of the initial velocities, fall of the sum of squares that they promise)"""
    square, right = (part.sum(axis=0) for part in _apart(jacobian, own, rest))
    step = _solved(square, right)
    left = rest - (jacobian @ step)
    return step, (np.linalg.pinv(own) @ left[..., None])[..., 0], float(step @ right)


def _solved(square: np.ndarray, right: np.ndarray) -> np.ndarray:
    ridge = 1e-10 * np.trace(square) / max(1, len(square)) + 1e-12
    return np.linalg.solve(square + ridge * np.eye(len(square)), right)


def _left_open(
    given: Stretches,
    vehicle_cfg: VehicleConfig,
    fit: tuple[np.ndarray, np.ndarray],
    noise: np.ndarray,
    jacobian: np.ndarray,
    own: np.ndarray,
) -> np.ndarray:
    """(k,) by how much the fit moves by the other reading of the logs, ``Drive.otherwise``: they do not say
    which is right, and no bootstrap of their stretches shows it, for it is the same in all of them."""
    other = given.otherwise(vehicle_cfg)
    if other is None:
        return np.zeros(jacobian.shape[2])
    value, start = fit
    said = [readings(value[None], start[None], one, vehicle_cfg)[0] for one in (given, other)]
    moved = np.where(np.isnan(given.velocity), 0.0, (said[0] - said[1]) / noise)
    square, right = _apart(jacobian, own, moved.reshape(len(moved), -1))
    return np.abs(_solved(square.sum(axis=0), right.sum(axis=0)))


def _bootstrap(jacobian: np.ndarray, own: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(low, high) (k,) about the fit: one Gauss-Newton step for each draw of stretches, widened for the
    parameters that were spent."""
    square, right = _apart(jacobian, own, rest)
    count, size = right.shape
    if not size:
        return np.zeros(0), np.zeros(0)
    rng = np.random.default_rng(0)
    draws = np.empty((_DRAWS, size))
    for i in range(_DRAWS):
        weight = np.bincount(rng.integers(0, count, count), minlength=count).astype(float)
        draws[i] = _solved(np.tensordot(weight, square, 1), weight @ right)
    wider = np.sqrt(count / max(1.0, count - size))
    low, high = np.percentile(draws, _LEVEL, axis=0)
    return wider * low, wider * high


def horizon_errors(
    given: Stretches, vehicle_cfg: VehicleConfig, theta: np.ndarray, horizons: tuple[int, ...]
) -> dict[int, list[float | None]]:
    """Rms error (surge, sway, heave, yaw) of what is predicted that many steps ahead of a reading, by
    ``theta`` (17,), whose delays tell when it was so; None where no reading stands there. Horizons longer
    than a stretch are left out."""
    steps = given.wrench.shape[1]
    assert theta.shape == (SIZE,)
    given = given.at_lag(theta[LAG], vehicle_cfg)
    inputs = ("tilt_rate", "up", "wrench", "slope")
    early = undelayed(given, theta)
    if not np.isnan(early).any(axis=2).all():
        given = replace(given, velocity=early)
    whole = np.asarray(~np.isnan(given.velocity).any(axis=2))
    found = {}
    for ahead in (h for h in horizons if h <= steps):
        errors, last = [], np.full(len(whole), -steps)
        ready: np.ndarray = whole[:, : steps + 1 - ahead]
        both: np.ndarray = ready & whole[:, ahead:]
        ready = both if both.any() else ready
        for begin in range(steps + 1 - ahead):
            picked = np.flatnonzero(ready[:, begin] & (begin - last >= max(ahead, steps // 10)))
            last[picked] = begin
            if len(picked):
                cut = {name: getattr(given, name)[:, begin : begin + ahead] for name in inputs}
                part = replace(given, velocity=given.velocity[:, begin : begin + ahead + 1], **cut).some(
                    picked
                )
                end = motion(theta[None], part.velocity[None, :, 0], part, vehicle_cfg)[0, :, -1]
                errors.append(end - part.velocity[:, -1])
        if errors:
            away = np.concatenate(errors)
            seen = ~np.isnan(away)
            count = seen.sum(axis=0)
            rms = np.sqrt(np.square(np.where(seen, away, 0.0)).sum(axis=0) / np.maximum(1, count))
            found[ahead] = [float(value) if n else None for value, n in zip(rms, count, strict=True)]
    return found
