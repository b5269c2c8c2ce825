"""The velocity that each stretch begins with: a first guess, and the one that suits the readings best."""

from __future__ import annotations

import numpy as np

from uuvtai.config import VehicleConfig
from uuvtai.identify.linearised import linearised
from uuvtai.identify.motion_model import AXES, SIZE, Stretches

_TRIES = 12
_SHARES = (0.2, 0.5, 1.0)
_DAMPING, _LESS, _MORE, _MOST = 1e-3, 0.1, 10.0, 1e9
_NOTHING = 1e-3
"""fall of the sum of squares, in units of noise, that is not worth a step"""


def first_readings(given: Stretches) -> np.ndarray:
    """(s, 4) the first reading of each axis from the begin of each stretch on; 0 where there is none."""
    steps = given.wrench.shape[1]
    read = np.stack([drive.velocity[begin : begin + steps + 1] for drive, begin in given.cuts])
    first = np.argmax(~np.isnan(read), axis=1)
    return np.nan_to_num(np.take_along_axis(read, first[:, None], axis=1)[:, 0])


def grown_starts(
    given: Stretches, vehicle_cfg: VehicleConfig, value: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """(s, 4) as ``settled_starts``, from the first readings on: fitted to the begin of each stretch, then to
    more and more of it. Where motion is unstable, a first reading is too far away for all of it at once."""
    start, steps = first_readings(given), given.wrench.shape[1]
    for share in _SHARES:
        start = settled_starts(given.begins(round(share * steps)), vehicle_cfg, value, start, noise)
    return start


def settled_starts(
    given: Stretches, vehicle_cfg: VehicleConfig, value: np.ndarray, start: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """(s, 4) initial velocities that suit the readings best with the parameters ``value`` (17,), from
    ``start`` on: steps of Levenberg and Marquardt, each stretch damped by itself. A vehicle that moves ahead
    is unstable in yaw (Munk's moment): undamped steps of a few stretches run away, and those few then
    outweigh all others."""
    count = len(start)
    best, fault, damping = start.copy(), np.full(count, np.inf), np.full(count, _DAMPING)
    square, right = np.zeros((count, len(AXES), len(AXES))), np.zeros((count, len(AXES)))
    trial, at_hand = start.copy(), np.arange(count)
    for _ in range(_TRIES):
        part = given.some(at_hand)
        _, own, rest = linearised(part, vehicle_cfg, value, trial[at_hand], np.zeros(SIZE, bool), noise)
        now = np.square(rest).sum(axis=1)
        better = now < fault[at_hand]
        won, lost = at_hand[better], at_hand[~better]
        best[won], fault[won] = trial[won], now[better]
        across = np.swapaxes(own[better], 1, 2)
        square[won], right[won] = across @ own[better], (across @ rest[better][..., None])[..., 0]
        damping[won] *= _LESS
        damping[lost] *= _MORE
        heavier = 1.0 + damping[:, None, None] * np.eye(len(AXES))
        step = np.linalg.solve(square * heavier + 1e-9 * np.eye(len(AXES)), right[..., None])[..., 0]
        trial = best + step
        at_hand = at_hand[((step * right).sum(axis=1) > _NOTHING)[at_hand] & (damping[at_hand] < _MOST)]
        if not len(at_hand):
            break
    return best
