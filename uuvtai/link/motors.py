"""From ArduSub's channels to our thrusters: which is which, by geometry, and how fast a pulse turns one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uuvtai.allocation import allocation_matrices
from uuvtai.config import VehicleConfig
from uuvtai.errors import SettingError

NEUTRAL_US, SPAN_US = 1500.0, 400.0
_SPEED_OF_PULSE = np.array(
    [
        (-400, -3465), (-360, -3282), (-320, -3003), (-280, -2736), (-240, -2440), (-200, -2140),
        (-160, -1807), (-120, -1448), (-80, -1016), (-40, -450), (-32, -317), (-28, 0), (28, 0), (32, 308),
        (40, 441), (80, 1007), (120, 1444), (160, 1802), (200, 2129), (240, 2446), (280, 2735), (320, 3042),
        (360, 3308), (400, 3533),
    ],
    float,
)  # fmt: skip
"""[us beyond neutral, rpm] of a T200 at 16 V (the maker's table, docs/data/t200.csv)"""
_LEVEL = ((0, 0, 1, 0, -1, 1), (0, 0, -1, 0, -1, -1), (0, 0, -1, 0, 1, 1), (0, 0, 1, 0, 1, -1))
_FRAMES = {
    6: (*_LEVEL, (1, 0, 0, -1, 0, 0), (-1, 0, 0, -1, 0, 0)),
    8: (*_LEVEL, (1, -1, 0, -1, 0, 0), (-1, -1, 0, -1, 0, 0), (1, 1, 0, -1, 0, 0), (-1, 1, 0, -1, 0, 0)),
}
"""thrusters -> what each motor gives to roll, pitch, yaw, throttle, forward, lateral in ArduSub's frames
VECTORED and VECTORED_6DOF (ArduPilot, AP_Motors6DOF.cpp): body x ahead, y right, z down, throttle up"""


class Motors:
    """The thrusters of one vehicle as ArduSub knows them."""

    def __init__(self, vehicle_cfg: VehicleConfig) -> None:
        """SettingError for a frame that ArduSub's two are not."""
        force_moment, _ = allocation_matrices(vehicle_cfg)
        ours = np.stack(
            [
                force_moment[3],
                -force_moment[4],
                -force_moment[5],
                force_moment[2],
                force_moment[0],
                -force_moment[1],
            ]
        ).T  # in ArduSub's axes and order
        frame = _FRAMES.get(len(ours))
        if frame is None:
            raise SettingError(
                f"the vehicle has {len(ours)} thrusters; ArduSub's frames here have 6 (VECTORED) or 8 "
                "(VECTORED_6DOF): --vehicle bluerov2_16v"
            )
        self.channel, self.sign = np.full(len(ours), -1), np.zeros(len(ours))
        for motor, factors in enumerate(np.array(frame, float)):
            thruster, sign = _same(ours, factors)
            self.channel[thruster], self.sign[thruster] = motor, sign
        if (self.channel < 0).any():
            raise SettingError(
                "the thrusters do not sit as in ArduSub's frames VECTORED or VECTORED_6DOF: "
                "--vehicle bluerov2_16v"
            )
        self._scale = vehicle_cfg.top_rpm / -_SPEED_OF_PULSE[0, 1]
        self.most_rpm = vehicle_cfg.top_rpm

    def rpm(self, pwm: Sequence[float]) -> np.ndarray:
        """(thrusters,) speed that is commanded. A channel that is off (0) stands still."""
        pulse = np.array(pwm, float)[self.channel]
        off = np.clip(pulse - NEUTRAL_US, -SPAN_US, SPAN_US)
        share = np.where(pulse == 0, 0.0, np.interp(off, _SPEED_OF_PULSE[:, 0], _SPEED_OF_PULSE[:, 1]))
        return np.clip(self.sign * self._scale * share, -self.most_rpm, self.most_rpm)


def _same(ours: np.ndarray, factors: np.ndarray) -> tuple[int, float]:
    """(thruster, sign) that gives what a motor's factors say, up to the sign; (0, 0) = none."""
    used = factors != 0
    is_upright = factors[3] != 0
    for thruster, given in enumerate(ours):
        if (abs(given[3]) > 0.7) != is_upright:
            continue
        for sign in (1.0, -1.0):
            if (np.sign(np.round(sign * given[used], 6)) == np.sign(factors[used])).all():
                return thruster, sign
    return 0, 0.0
