"""What may go wrong, and what is done then: pure functions, a view of the vehicle in, a decision out.

``RULES`` is the list that docs/safety.md prints. A rule names what is wrong, or nothing; each of its actions
counts from a time on for which it has been wrong without a break. The gravest of all actions that count is
taken. Angles in rad, lengths in m, speeds in m/s, times in s; world z up, body x ahead, y left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum

Velocity = tuple[float, float, float, float]  # surge, sway, heave [m/s] and yaw rate [rad/s], body axes
STOP: Velocity = (0.0, 0.0, 0.0, 0.0)
STALL_S = 0.25  # a step that is later than this is a stall
LATE_S, LATE_WINDOW_S = 0.5, 3.0  # so much lateness in so long is too much
UNANSWERED_S = 4.0  # it was asked to move for so long, and did not


class SafeAction(IntEnum):
    """What is done, each graver than the one before."""

    DRIVE = 0  # what the pilot wants, within the limits
    HOLD = 1  # ask for zero speed; ends when its reason does
    SURFACE = 2  # have the autopilot surface; for good
    HAND_BACK = 3  # leave the vehicle to the autopilot's ALT_HOLD and the operator, and say no more; for good


@dataclass(frozen=True)
class SafetyLimits:
    """What the vehicle must keep to."""

    box_m: tuple[float, float, float, float]  # least x, least y, most x, most y
    depth_m: tuple[float, float]  # least and most depth, positive down
    speed_m_s: float = 0.5  # horizontal
    heave_m_s: float = 0.3
    yaw_rate_rad_s: float = 0.8
    operator_s: float = 2.0  # age of the operator's heartbeat
    vehicle_s: float = 3.0  # age of the autopilot's heartbeat
    sensor_s: Mapping[str, float] = field(
        default_factory=lambda: {"imu": 0.5, "dvl": 2.0, "pressure": 2.0, "sonar": 1.0, "position": 0.5}
    )
    """age of the newest message of each sensor that the pilot needs"""
    battery_v: float = 13.2  # of the pack; a BlueROV2's has four cells
    battery_share: float = 0.2
    battery_s: float = 10.0  # age of the battery's telemetry, once it has come
    tilt_rad: float = math.radians(45.0)


@dataclass(frozen=True)
class VehicleView:
    """What is known at one moment. An age is infinite where nothing has come yet."""

    now_s: float
    wanted: Velocity  # by the pilot
    held: tuple[str, ...]  # why the pilot itself stops
    vehicle_age_s: float
    operator_age_s: float
    sensor_age_s: Mapping[str, float]
    """of the sensors that the pilot needs; of the sonar's newest scan that was placed in the map"""
    pos_w: tuple[float, float, float]
    rpy: tuple[float, float, float]  # NaN: not known now
    speed_m_s: float | None  # measured, over ground; None: not known now
    battery_v: float | None  # None: nobody tells
    battery_share: float | None
    stalled_s: float  # by how much this computer was late with this step
    lost_command: str
    """why the vehicle no longer does what we say (somebody took over, it disarmed, a mode was refused); '' =
    it does, or was never asked"""
    late_s: float = 0.0  # lateness of all stalls in the last LATE_WINDOW_S
    battery_age_s: float = 0.0  # of its telemetry; infinite: none has come yet
    unanswered_s: float = 0.0  # for how long it was asked to move and did not
    moved: str = ""  # how the given position jumped; '' = it did not
    misfit: str = ""  # how the scans disagree with the known walls; '' = they do not
    unchecked: str = ""  # what is missing to check the start by the walls; '' = nothing


@dataclass(frozen=True)
class SafetyMemory:
    """What must be remembered from one decision to the next."""

    since_s: Mapping[str, float] = field(default_factory=dict)  # rule -> since when it has been broken
    latched: SafeAction = SafeAction.DRIVE  # the gravest action that is for good
    latched_why: tuple[str, ...] = ()


@dataclass(frozen=True)
class SafeDecision:
    action: SafeAction
    velocity: Velocity  # to ask for; zero unless the action is DRIVE
    reasons: tuple[str, ...]  # of the action; none = DRIVE


@dataclass(frozen=True)
class SafetyRule:
    """One thing that may go wrong."""

    name: str
    broken: Callable[[VehicleView, SafetyLimits], str]  # what is wrong in words, '' = nothing
    actions: tuple[tuple[float, SafeAction], ...]  # (broken for so many seconds, action)
    meaning: str  # when it is broken, for the page

    @property
    def case(self) -> str:
        """What its cases in tests/vehicle/test_safety.py are called."""
        return self.name.replace(" ", "_")


# -------------------------------------------------------------------------------------------------- the rules


def _pilot_stops(view: VehicleView, limits: SafetyLimits) -> str:
    wrong = [] if all(map(math.isfinite, view.wanted)) else ["its command is not finite"]
    return "; ".join([*view.held, *wrong])


def _stalled(view: VehicleView, limits: SafetyLimits) -> str:
    return f"this step came {view.stalled_s:.2f} s late" if not view.stalled_s <= STALL_S else ""


def _slow(view: VehicleView, limits: SafetyLimits) -> str:
    return f"{view.late_s:.2f} s late in {LATE_WINDOW_S:g} s" if not view.late_s <= LATE_S else ""


def _battery_silent(view: VehicleView, limits: SafetyLimits) -> str:
    if math.isinf(view.battery_age_s):  # nobody watches it: the waiting line says so
        return ""
    return _old("battery", view.battery_age_s, limits.battery_s)


def _unanswered(view: VehicleView, limits: SafetyLimits) -> str:
    if view.unanswered_s <= UNANSWERED_S:
        return ""
    return f"asked to move for {view.unanswered_s:.0f} s, and the measured speed stays near zero"


def _battery_low(view: VehicleView, limits: SafetyLimits) -> str:
    if view.battery_v is not None and view.battery_v < limits.battery_v:
        return f"battery at {view.battery_v:.1f} V"
    if view.battery_share is not None and view.battery_share < limits.battery_share:
        return f"battery at {100 * view.battery_share:.0f} %"
    return ""


def _tilted(view: VehicleView, limits: SafetyLimits) -> str:
    upright = math.cos(view.rpy[0]) * math.cos(view.rpy[1]) if all(map(math.isfinite, view.rpy)) else math.nan
    if upright >= math.cos(limits.tilt_rad):
        return ""
    if not math.isfinite(upright):
        return "no attitude"
    return f"tilted by {math.degrees(math.acos(upright)):.0f} degrees"


def _outside(view: VehicleView, limits: SafetyLimits) -> str:
    out = outside_m(view.pos_w, limits)
    return f"{out:.2f} m outside the fence" if not out <= 0.0 else ""


def _too_fast(view: VehicleView, limits: SafetyLimits) -> str:
    if view.speed_m_s is None:  # navigation is lost then
        return ""
    most = 1.5 * math.hypot(limits.speed_m_s, limits.heave_m_s) + 0.1
    return f"moving at {view.speed_m_s:.2f} m/s" if not view.speed_m_s <= most else ""


_A = SafeAction
RULES = (
    SafetyRule("command lost", lambda view, _: view.lost_command, ((0.0, _A.HAND_BACK),),
               "somebody else changed the mode or disarmed, or the vehicle refused GUIDED and ALT_HOLD"),
    SafetyRule("autopilot silent",
               lambda view, limits: _old("autopilot", view.vehicle_age_s, limits.vehicle_s),
               ((0.0, _A.HAND_BACK),), "no heartbeat of the autopilot"),
    SafetyRule("operator silent",
               lambda view, limits: _old("operator", view.operator_age_s, limits.operator_s),
               ((0.0, _A.HOLD), (30.0, _A.SURFACE)), "no heartbeat of the operator's ground station"),
    SafetyRule("navigation lost",
               lambda view, limits: _lost_sensors(view, limits, ("imu", "dvl", "pressure", "position")),
               ((0.0, _A.HOLD), (5.0, _A.HAND_BACK)),
               "attitude, velocity, depth or a needed position is missing or old"),
    SafetyRule("position jumped", lambda view, _: view.moved, ((0.0, _A.HAND_BACK),),
               "the given position changed by more than the vehicle can move"),
    SafetyRule("start unchecked", lambda view, _: view.unchecked, ((0.0, _A.HOLD),),
               "the walls have not confirmed the start yet; after 60 s it is refused"),
    SafetyRule("walls misfit", lambda view, _: view.misfit, ((0.0, _A.HOLD), (5.0, _A.HAND_BACK)),
               "the scans do not fit the known walls where the vehicle takes itself to be"),
    SafetyRule("sonar lost", lambda view, limits: _lost_sensors(view, limits, ("sonar",)),
               ((0.0, _A.HOLD), (30.0, _A.SURFACE)),
               "no scan could be placed in the map, or the last one is old"),
    SafetyRule("pilot stops", _pilot_stops, ((0.0, _A.HOLD), (30.0, _A.SURFACE)),
               "the stack itself says that it cannot go on, or its command is not finite"),
    SafetyRule("computer late", _stalled, ((0.0, _A.HOLD),), f"a step comes more than {STALL_S:g} s late"),
    SafetyRule("computer slow", _slow, ((0.0, _A.HOLD), (5.0, _A.HAND_BACK)),
               f"such steps lose more than {LATE_S:g} s in {LATE_WINDOW_S:g} s"),
    SafetyRule("battery low", _battery_low, ((5.0, _A.SURFACE),), "voltage or charge below the limit"),
    SafetyRule("battery silent", _battery_silent, ((0.0, _A.HOLD), (30.0, _A.HAND_BACK)),
               "the battery's telemetry has ended"),
    SafetyRule("tilted", _tilted, ((0.0, _A.HOLD), (3.0, _A.HAND_BACK)), "the hull leans beyond the limit"),
    SafetyRule("outside the fence", _outside, ((0.0, _A.HOLD), (5.0, _A.HAND_BACK)),
               "outside the box or the depths"),
    SafetyRule("too fast", _too_fast, ((1.0, _A.HOLD), (6.0, _A.HAND_BACK)),
               "measured speed half as much again above the limit"),
    SafetyRule("no answer", _unanswered, ((0.0, _A.HOLD), (5.0, _A.HAND_BACK)),
               f"it was asked to move for {UNANSWERED_S:g} s and the measured speed stays near zero"),
)  # fmt: skip


def decide(
    view: VehicleView, memory: SafetyMemory, limits: SafetyLimits
) -> tuple[SafeDecision, SafetyMemory]:
    """What to do now, and what to remember for the next time."""
    words = {rule.name: said for rule in RULES if (said := rule.broken(view, limits))}
    since = {name: memory.since_s.get(name, view.now_s) for name in words}
    action, reasons = memory.latched, list(memory.latched_why)
    for rule in RULES:
        if rule.name not in words:
            continue
        grave = max(
            (step for after, step in rule.actions if view.now_s - since[rule.name] >= after),
            default=SafeAction.DRIVE,
        )
        reason = f"{rule.name}: {words[rule.name]}"
        if grave > action:
            action, reasons = grave, [reason]
        elif grave == action > SafeAction.DRIVE and action != memory.latched:
            reasons.append(reason)
    for_good = action >= SafeAction.SURFACE
    kept = SafetyMemory(
        since, action if for_good else memory.latched, tuple(reasons) if for_good else memory.latched_why
    )
    velocity = allowed(view.wanted, view, limits) if action == SafeAction.DRIVE else STOP
    return SafeDecision(action, velocity, tuple(reasons)), kept


# ------------------------------------------------------------------------------------------------- the limits

FENCE_RATE_HZ, FENCE_ROOM_M = (0.5, 1.5), (0.05, 0.02)
"""towards the fence (box, depths) no faster than this times the distance to a line so far within it, which a
vehicle that follows late, or errors of its place, may overrun; depth is held better, and pools are shallow"""


def allowed(wanted: Velocity, view: VehicleView, limits: SafetyLimits) -> Velocity:
    """``wanted`` within the speed limits, and towards a side of the fence no faster than the room left there
    allows; beyond, only inward. Not finite: zero."""
    surge, sway, heave, turn = bounded(wanted, limits)
    yaw = view.rpy[2]
    if not all(map(math.isfinite, (*view.pos_w, yaw))):
        return STOP
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y, z = view.pos_w
    low_x, low_y, high_x, high_y = limits.box_m
    east = _within(cos * surge - sin * sway, x - low_x, high_x - x, 0)
    north = _within(sin * surge + cos * sway, y - low_y, high_y - y, 0)
    heave = _within(heave, z + limits.depth_m[1], -limits.depth_m[0] - z, 1)
    return cos * east + sin * north, -sin * east + cos * north, heave, turn


def bounded(wanted: Velocity, limits: SafetyLimits) -> Velocity:
    """``wanted`` within the speed limits, its horizontal direction kept. Not finite: zero."""
    if not all(map(math.isfinite, wanted)):
        return STOP
    surge, sway, heave, turn = (max(-1e6, min(1e6, float(value))) for value in wanted)
    speed = math.hypot(surge, sway)
    share = min(1.0, limits.speed_m_s / speed) if speed > 0 else 1.0
    return (
        share * surge,
        share * sway,
        max(-limits.heave_m_s, min(limits.heave_m_s, heave)),
        max(-limits.yaw_rate_rad_s, min(limits.yaw_rate_rad_s, turn)),
    )


def outside_m(pos_w: tuple[float, float, float], limits: SafetyLimits) -> float:
    """How far a place is outside the fence; inside it is negative. Not a number: infinite."""
    x, y, z = pos_w
    low_x, low_y, high_x, high_y = limits.box_m
    sides = (low_x - x, x - high_x, low_y - y, y - high_y, limits.depth_m[0] + z, -z - limits.depth_m[1])
    return max(sides) if all(map(math.isfinite, sides)) else math.inf


def _within(speed: float, room_below: float, room_above: float, way: int) -> float:
    """``way``: 0 = level, 1 = up and down."""
    rooms = (max(room - FENCE_ROOM_M[way], 0.0) for room in (room_below, room_above))
    least, most = (FENCE_RATE_HZ[way] * room for room in rooms)
    return max(-least, min(most, speed))


def _old(who: str, age_s: float, limit_s: float) -> str:
    if age_s <= limit_s:
        return ""
    return f"{who}: nothing yet" if math.isinf(age_s) else f"{who}: {age_s:.1f} s ago"


def _lost_sensors(view: VehicleView, limits: SafetyLimits, names: tuple[str, ...]) -> str:
    told = (
        _old(name, view.sensor_age_s[name], limits.sensor_s[name])
        for name in names
        if name in view.sensor_age_s
    )
    return ", ".join(filter(None, told))
