"""What may be said to a vehicle, and nothing else: each a message of MAVLink by name and fields.

Every number is held within the limits here once more, whatever the caller asks for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from uuvtai.link.safety import SafetyLimits, Velocity, bounded

BODY_NED = 8
"""MAV_FRAME: axes turn with the yaw; z stays down"""
VELOCITY_AND_YAW_RATE = 0x5C7
"""type_mask: positions, accelerations and yaw are not given"""
ALT_HOLD, GUIDED, SURFACE = 2, 4, 9
"""modes of ArduSub"""
MODE_NAMES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 7: "CIRCLE", 9: "SURFACE",
    16: "POSHOLD", 19: "MANUAL", 20: "MOTOR_DETECT", 21: "SURFTRAK",
}  # fmt: skip
HARMLESS = ("HEARTBEAT", "MAV_CMD_SET_MESSAGE_INTERVAL")
"""kinds of orders that move nothing: they are sent in a dry run too"""
STICK = 600
"""of 1000: the farthest that a stick is ever pushed"""
FULL_STICK = (1.0, 1.0, 0.6, 2.0)
"""[m/s, m/s, m/s, rad/s] what a full stick is taken to give; the feedback corrects it"""
FEEDBACK = 1.5
"""of the missing velocity, added to the one asked for"""

DO_SET_MODE, ARM_DISARM, _SET_MESSAGE_INTERVAL = 176, 400, 511


@dataclass(frozen=True)
class Order:
    """A message on its way to the vehicle."""

    kind: str
    """its name; of a command the command's"""
    message: str
    fields: dict[str, Any]
    as_operator: bool = False
    """in the name of the ground station, from which alone ArduSub takes sticks"""


def set_velocity(velocity: Velocity, now_s: float, system: int, limits: SafetyLimits) -> Order:
    """Velocity in body axes and yaw rate, for GUIDED: SET_POSITION_TARGET_LOCAL_NED."""
    surge, sway, heave, turn = bounded(velocity, limits)
    place = dict.fromkeys(("x", "y", "z", "afx", "afy", "afz", "yaw"), 0.0)
    fields = {
        "time_boot_ms": int(1e3 * max(now_s, 0.0)) & 0xFFFFFFFF,
        "target_system": system,
        "target_component": 1,
        "coordinate_frame": BODY_NED,
        "type_mask": VELOCITY_AND_YAW_RATE,
        **place,
        "vx": surge, "vy": 0.0 - sway, "vz": 0.0 - heave, "yaw_rate": 0.0 - turn,
    }  # fmt: skip
    return Order("SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_LOCAL_NED", fields)


def push_sticks(velocity: Velocity, measured: Velocity | None, system: int, limits: SafetyLimits) -> Order:
    """The same for ALT_HOLD, where sticks are thrust ahead and sideways and rates up and round:
    MANUAL_CONTROL. ``measured``: velocity as it is, NaN or None = unknown, so that nothing is fed back. No
    stick goes beyond what a limit of speed is taken to need, whatever is measured."""
    asked = bounded(velocity, limits)
    most = (limits.speed_m_s, limits.speed_m_s, limits.heave_m_s, limits.yaw_rate_rad_s)
    shares = []
    for want, has, full, cap in zip(asked, measured or asked, FULL_STICK, most, strict=True):
        more = FEEDBACK * (want - has) if math.isfinite(has) else 0.0
        shares.append(max(-1.0, -cap / full, min(1.0, cap / full, (want + more) / full)))
    surge, sway, heave, turn = (round(STICK * share) for share in shares)
    fields = {"target": system, "x": surge, "y": -sway, "z": 500 + heave // 2, "r": -turn, "buttons": 0}
    return Order("MANUAL_CONTROL", "MANUAL_CONTROL", fields, as_operator=True)


def set_mode(mode: int, system: int) -> Order:
    """One of ArduSub's modes."""
    return _command("MAV_CMD_DO_SET_MODE", DO_SET_MODE, system, 1.0, float(mode))


def arm(system: int) -> Order:
    """Arm, never by force."""
    return _command("MAV_CMD_COMPONENT_ARM_DISARM", ARM_DISARM, system, 1.0)


def ask_for(message_id: int, rate_hz: float, system: int) -> Order:
    """Have the autopilot tell something so often."""
    return _command(
        "MAV_CMD_SET_MESSAGE_INTERVAL", _SET_MESSAGE_INTERVAL, system, float(message_id), 1e6 / rate_hz
    )


def heartbeat() -> Order:
    """An onboard controller is here."""
    fields = {"type": 18, "autopilot": 8, "base_mode": 0, "custom_mode": 0, "system_status": 4}
    return Order("HEARTBEAT", "HEARTBEAT", {**fields, "mavlink_version": 3})


def _command(kind: str, number: int, system: int, *given: float) -> Order:
    params = {f"param{i + 1}": given[i] if i < len(given) else 0.0 for i in range(7)}
    whom = {"target_system": system, "target_component": 1, "command": number, "confirmation": 0}
    return Order(kind, "COMMAND_LONG", {**whom, **params})
