"""``uuv pilot --check``: what a dry run has heard of a vehicle at rest, judged before it is armed.

A row is ``ok``, a ``note`` (it may drive; somebody should know), or ``bad``: it may not. What does not show
at rest is judged by nobody: which way the DVL looks, how thrusters answer.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uuvtai.common.clocks import JUMP_S, stamp_of
from uuvtai.config import Config
from uuvtai.vehicle.handover import STICKS_S
from uuvtai.vehicle.mavlink import MavMessage, Order, ask_parameter
from uuvtai.vehicle.messages import (
    NAMES,
    DvlReading,
    ImuReading,
    PositionFix,
    PressureReading,
    SensorMessage,
    SonarPing,
)
from uuvtai.vehicle.safety import SafetyLimits
from uuvtai.vehicle.start_fix import StartFix, StartFound
from uuvtai.vehicle.telemetry import AUTOPILOT, KIND_OF, KINDS, Heard

OK, NOTE, BAD = "ok", "note", "bad"
CHECK_S = 30.0  # of a check whose time is not typed
_LEAST_HZ = {
    "autopilot": 0.5, "operator": 0.5, "imu": 10.0, "dvl": 2.0, "pressure": 2.0, "sonar": 2.0,
    "position": 5.0, "battery": 0.1,
}  # fmt: skip
"""slower is too slow to drive by, though it may be younger than the age that stops the pilot (EC)"""
MISSING = {
    "autopilot": "no HEARTBEAT of a submarine comes: --mavlink, --system; is the vehicle on",
    "operator": "no ground station's HEARTBEAT comes: start QGroundControl, or name its id by --operator",
    "imu": "no ATTITUDE comes: the router must pass the autopilot's messages on",
    "dvl": "no velocity comes: --dvl a50:HOST, or its extension in BlueOS; power, address, bottom in range",
    "pressure": "no SCALED_PRESSURE2 comes: is the depth sensor connected",
    "sonar": "no scan comes: --sonar ping360:HOST, or OBSTACLE_DISTANCE; power, address",
    "position": "no LOCAL_POSITION_NED comes: ArduSub needs a DVL and an origin, or take --set "
    "sensors.localization=estimated",
    "battery": "no voltage comes: nobody watches the battery",
}
"""what is said of a reading that never came, or no more"""
_GYRO_RAD_S, _FORCE_M_S2, _LEAN_RAD = 0.01, 0.5, math.radians(10.0)
"""errors of gyro and accelerometer that are bad (EC), and a lean that is noted"""
_DEPTH_M = (0.4, 1.0)  # between the pressure's depth and that of --start: noted, bad; weather is 0.3 m
_REST_M_S, _VALID = 0.1, (0.9, 0.5)  # a DVL at rest says less; its share of valid readings: noted, bad
_RINGS_M, _RINGS, _ECHOES = 0.5, 0.3, 0.05
"""so many echoes nearer than this are a ring-down; so few echoes at all are noted"""
_WALL_M, _TURN_DEG = 0.3, 8.0
"""a wall that is off by more is another tank's; a start that is so far off is noted, and corrected"""
_WARM_S, _HELD = 5.0, 0.02  # at first nothing counts; share of steps without decision that is bad
_MOST_ASKED, _KEPT = 5, 100_000  # requests for a parameter; arrivals of a kind that are remembered
_LOST = ("velocity not valid", "figure of merit", "VISION_POSITION_DELTA: without")
_OUT_OF_RANGE = "is the bottom out of its range, or something in its beams"
_STRANGERS = ("a second sender speaks as", "the vehicle is no submarine", "another program speaks as we do")
_FROZEN, _STILL_M = 50, 0.5  # the same reading so often is a stuck one; what rests tells places within this
_EMERGENCY, _CRITICAL, _ARMABLE = 5, 2, 1 << 28  # MAV_STATE, MAV_SEVERITY, MAV_SYS_STATUS_PREARM_CHECK


@dataclass(frozen=True)
class CheckRow:
    """One thing that was looked at. None: never came, or means nothing here."""

    what: str
    state: str  # OK, NOTE or BAD
    told: str = ""  # what was found; what is wrong, and what to do
    rate_hz: float | None = None
    gap_s: float | None = None  # 99 % of the gaps between two are shorter
    age_s: float | None = None  # of the last one
    sender: str = ""


# ---- ArduSub's parameters that decide what happens when something fails, and whether it takes our orders.


def _failsafe(value: float, told: str, worse: str = BAD) -> tuple[str, str]:
    """0 is off; 1 only warns, where more can be done."""
    return (worse, f"off: {told}") if value < 1 else (OK, "")


PARAMETERS = (
    "FS_GCS_ENABLE", "FS_LEAK_ENABLE", "FS_EKF_ACTION", "FS_PRESS_ENABLE", "FS_PILOT_INPUT", "FRAME_CONFIG",
    "SYSID_MYGCS", "VISO_TYPE", "EK3_SRC1_VELXY",
)  # fmt: skip
_FRAMES = {6: 1, 8: 2}  # thrusters -> FRAME_CONFIG: VECTORED, VECTORED_6DOF


def judged(name: str, value: float, config: Config, operator: int, has_sticks: bool) -> tuple[str, str]:
    """(state, what is wrong and what to do) of one of ``PARAMETERS``. ``has_sticks``: the operator's came."""
    guided = "GUIDED needs a position; without it the pilot drives by sticks in ALT_HOLD"
    if name in ("FS_GCS_ENABLE", "FS_LEAK_ENABLE"):
        is_gcs = name == "FS_GCS_ENABLE"
        mend = "set 3 (depth hold) or 4 (surface)" if is_gcs else "set 2 (surface)"
        if value == 1 or (is_gcs and value == 2):
            return NOTE, f"only {'warns' if value == 1 else 'disarms'}: {mend}"
        return _failsafe(value, mend)
    if name in ("FS_EKF_ACTION", "FS_PRESS_ENABLE"):
        return _failsafe(value, "set 1 (warn)", NOTE)
    if name == "FS_PILOT_INPUT" and value >= 2 and not has_sticks:
        return BAD, "disarms a vehicle in GUIDED that no stick is sent to: set 1 (warn)"
    frame = _FRAMES.get(len(config.vehicle.thrusters))
    if name == "FRAME_CONFIG" and value != (frame or value):
        return BAD, f"--vehicle has {len(config.vehicle.thrusters)} thrusters, frame {frame}: another one?"
    if name == "SYSID_MYGCS" and value != operator:
        return BAD, f"the ground station that it obeys is not {operator}: --operator {value:g}"
    wanted = {"VISO_TYPE": 1, "EK3_SRC1_VELXY": 6}.get(name, value)
    if value != wanted:
        joystick = ", and the operator's sticks hand it back: switch the joystick off" if has_sticks else ""
        return BAD if has_sticks else NOTE, f"not {wanted}: {guided}{joystick}"
    return OK, ""


# ---- What is gathered step by step.


class Preflight:
    """Is told what the loop hears, feeds and decides; ``rows`` judges it at the end."""

    def __init__(
        self, config: Config, limits: SafetyLimits, start_z_m: float, system: int, operator: int
    ) -> None:
        """``start_z_m``: height of the typed start. ``system``, ``operator``: MAVLink ids of the vehicle and
        of the ground station."""
        self._config, self._limits = config, limits
        self._start_z_m, self._system, self._operator = start_z_m, system, operator
        self._come: dict[str, deque[float]] = {name: deque(maxlen=_KEPT) for name in _LEAST_HZ}
        """by row: when something came [s]"""
        self._sources: dict[str, Counter[str]] = {name: Counter() for name in _LEAST_HZ}
        self.parameters: dict[str, float] = {}
        self._asked: Counter[str] = Counter()
        self._offsets: dict[tuple[str, int, int], float] = {}
        self._jumps: Counter[str] = Counter()
        self._force_s, self._depths_m = math.nan, dict[str, float]()
        """when an acceleration came last; newest depth by absolute pressure, by its message"""
        self._imu: ImuReading | None = None
        self._spent_s, self._turned, self._told = 0.0, np.zeros(3), np.zeros(3)
        """[s], [rad] by the rates, [rad] by the attitude"""
        self._force_off, self._upright = np.zeros(3), 0.0
        self._speeds: deque[float] = deque(maxlen=_KEPT)
        self._last, self._same = dict[str, bytes](), Counter[str]()  # reading; how often it came again
        self._span: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # smallest and largest place, or depth
        self._says: Counter[str] = Counter()  # what the autopilot complains of
        self._beams, self._echoes, self._near, self._looked = 0, 0, 0, set[float]()
        self._steps, self._undecided, self._held, self._broken = 0, 0, Counter[str](), Counter[str]()
        self._from_s = 0.0  # they count from then on, and not while it warms up
        self._now: Collection[str] = ()  # rules that are broken in the last step

    def asks(self) -> Iterator[Order]:
        """Once a second: requests for the parameters that were not told yet."""
        for name in PARAMETERS:
            if name not in self.parameters and self._asked[name] < _MOST_ASKED:
                self._asked[name] += 1
                yield ask_parameter(name, self._system)

    def saw(self, message: MavMessage, come_s: float, heard: Heard, was_used: bool) -> None:
        """A message that came; ``heard``: with it. ``was_used``: it was not left out."""
        name, fields = message.name, message.fields
        who = f"{message.system}/{message.component}"
        is_autopilot = (message.system, message.component) == (self._system, AUTOPILOT)
        if not was_used:
            return
        if name == "PARAM_VALUE" and is_autopilot and fields["param_id"] in PARAMETERS:
            if math.isfinite(value := float(fields["param_value"])):
                self.parameters[fields["param_id"]] = value
        if name == "HEARTBEAT":
            if is_autopilot and fields["system_status"] >= _EMERGENCY:
                self._says["its state is an emergency (MAV_STATE)"] += 1
            for row, last_s in (("autopilot", heard.vehicle_s), ("operator", heard.operator_s)):
                if last_s == come_s and (row == "autopilot") == is_autopilot:
                    self._note(row, who, come_s)
        elif name == "STATUSTEXT" and is_autopilot:
            text = str(fields["text"])
            self._says.update([text] if fields["severity"] <= _CRITICAL or text.startswith("PreArm") else [])
        elif name in KINDS["battery"] and heard.battery_s > -math.inf:
            self._note("battery", f"{name} {who}", come_s)
            asked = int(fields.get("onboard_control_sensors_enabled", 0)) & _ARMABLE
            if is_autopilot and asked & ~int(fields.get("onboard_control_sensors_health", 0)):
                self._says["its checks before arming fail: see QGroundControl"] += 1
        elif name in KINDS["imu"]:
            self._force_s = come_s
        elif name in KINDS["pressure"] and fields["press_abs"] > 0:
            vehicle = self._config.vehicle
            weight = vehicle.water_density_kg_m3 * vehicle.gravity_m_s2
            self._depths_m[name] = 100.0 * (float(fields["press_abs"]) - 1013.25) / weight
        self._look_at_clock((name, message.system, message.component), fields, come_s)

    def _look_at_clock(self, key: tuple[str, int, int], fields: Mapping[str, Any], come_s: float) -> None:
        sent_s, wrap_s = stamp_of(fields)
        if not sent_s or key[0] not in KIND_OF:
            return
        offset = come_s - sent_s
        moved = offset - self._offsets.get(key, offset)
        moved = math.remainder(moved, wrap_s) if math.isfinite(wrap_s) else moved
        self._jumps[key[0]] += abs(moved) > JUMP_S
        self._offsets[key] = offset

    def _note(self, row: str, source: str, come_s: float) -> None:
        self._come[row].append(come_s)
        self._sources[row][source] += 1

    def read(self, reading: SensorMessage, source: str, come_s: float) -> None:
        """A reading that the pilot was fed, and of whom."""
        if (row := NAMES[type(reading)]) in self._come:
            self._note(row, source, come_s)
        if isinstance(reading, ImuReading | DvlReading):
            told = np.concatenate([v for name, v in vars(reading).items() if name != "time_s"]).tobytes()
            self._same[row], self._last[row] = (told == self._last.get(row)) * (self._same[row] + 1), told
        if isinstance(reading, PositionFix | PressureReading):
            place = np.atleast_1d(reading.pos_w if isinstance(reading, PositionFix) else reading.depth_m)
            low, high = self._span.get(row, (place, place))
            self._span[row] = np.minimum(low, place), np.maximum(high, place)
        if isinstance(reading, ImuReading):
            self._feel(reading)
        elif isinstance(reading, DvlReading) and not source.startswith("LOCAL_POSITION_NED"):
            self._speeds.append(float(np.linalg.norm(reading.vel_b)))
        elif isinstance(reading, SonarPing):
            hit, ranges = np.asarray(reading.hit) > 0, np.asarray(reading.range_m)
            self._beams, self._echoes = self._beams + len(hit), self._echoes + int(hit.sum())
            self._near += int((hit & (ranges < _RINGS_M)).sum())
            self._looked.update(reading.first_beam + beam for beam in range(len(hit)))

    def begun(self, now_s: float) -> None:
        """The walls have told the start: the stack runs freely from now on, and the heading that they have
        corrected is no motion."""
        self._imu, self._from_s = None, now_s + 1.0
        self._span.clear()
        self._steps, self._undecided, self._held, self._broken = 0, 0, Counter(), Counter()

    def _feel(self, imu: ImuReading) -> None:
        """A gyro's error is what its rates turn and the attitude does not, so the vehicle may be turned."""
        roll, pitch, _ = (float(angle) for angle in imu.rpy)
        upright = math.cos(roll) * math.cos(pitch)
        down_b = np.array([-math.sin(pitch), math.cos(pitch) * math.sin(roll), upright])
        self._force_off += np.asarray(imu.specific_force_b) - self._config.vehicle.gravity_m_s2 * down_b
        self._upright += upright
        if (last := self._imu) is not None and 0.0 < imu.time_s - last.time_s < 1.0:
            spent_s = imu.time_s - last.time_s
            self._spent_s += spent_s
            self._turned += 0.5 * spent_s * (np.asarray(imu.rate_b) + np.asarray(last.rate_b))
            moved = np.asarray(imu.rpy) - np.asarray(last.rpy)
            self._told += np.remainder(moved + math.pi, math.tau) - math.pi
        self._imu = imu

    def stepped(self, now_s: float, most_s: float, held: Collection[str], broken: Collection[str]) -> None:
        """A step of a check of ``most_s``: why the stack held, and the rules that are broken."""
        self._now = broken
        if now_s < max(self._from_s, min(_WARM_S, 0.5 * most_s)):
            return
        self._steps += 1
        self._held.update(reason.partition(":")[0] for reason in held)
        self._undecided += bool(held)
        self._broken.update([*broken])

    # ---- The judgement.

    def document(
        self,
        now_s: float,
        heard: Heard,
        needed: Collection[str],
        instruments: Mapping[str, Mapping[str, Any]],
        start: tuple[StartFix | None, StartFound],
        clock_jumps: int,
    ) -> dict[str, Any]:
        """``ready`` and ``rows`` (``CheckRow``). ``needed``: readings that the pilot needs. ``start``: who
        seeks it, and what was found."""
        lost: Counter[str] = Counter()
        for refused in (heard.refused, *(one["refused"] for one in instruments.values())):
            lost.update({why: count for why, count in refused.items() if why.startswith(_LOST)})
        foms = [one["fom_m_s"] for one in instruments.values() if one.get("fom_m_s") is not None]
        shown = {*needed, "autopilot", "operator", "battery"}
        rows = [
            *(self._heard_row(name, now_s, heard, lost, foms) for name in _LEAST_HZ if name in shown),
            *self._imu_rows(),
            *self._start_rows(*start),
            *self._parameter_rows(heard),
            *self._strange_rows(heard, clock_jumps),
            *self._run_rows(heard, now_s),
        ]
        ready = self._steps > 0 and all(row.state != BAD for row in rows)
        return {"ready": ready, "rows": [asdict(row) for row in rows]}

    def _heard_row(
        self, name: str, now_s: float, heard: Heard, lost: Counter[str], foms: list[float]
    ) -> CheckRow:
        come = self._come[name]
        if not come:
            why = MISSING[name]
            if name == "dvl" and lost:
                why = f"{_OUT_OF_RANGE}: {lost.most_common(1)[0][0]}, {lost.total()} times"
            return CheckRow(name, NOTE if name == "battery" else BAD, why)
        gaps = np.diff([*come, now_s])
        rate_hz, gap_s = len(come) / max(now_s, 1e-9), float(np.quantile(gaps, 0.99))
        limits = self._limits
        most_s = {"autopilot": limits.vehicle_s, "operator": limits.operator_s, "battery": limits.battery_s}
        oldest_s = (most_s | dict(limits.sensor_s))[name]
        state, told = {
            "dvl": lambda: self._dvl(lost, foms), "sonar": self._sonar,
            "pressure": self._depth, "battery": lambda: self._battery(heard),
        }.get(name, lambda: (OK, ""))()  # fmt: skip
        if gap_s > oldest_s or now_s - come[-1] > oldest_s:
            state, told = BAD, f"it stops for longer than {oldest_s:g} s, which holds the vehicle; {told}"
        elif rate_hz < _LEAST_HZ[name]:
            state, told = BAD, f"slower than {_LEAST_HZ[name]:g} Hz: raise its rate (BlueOS, SR0_..); {told}"
        elif self._same[name] >= _FROZEN:
            state, told = BAD, f"the same reading came {self._same[name]} times: it is stuck; {told}"
        elif name in self._span and (moved_m := float(np.ptp(self._span[name], axis=0).max())) > _STILL_M:
            state, told = BAD, f"moves by {moved_m:.2f} m at rest; {told}"
        elif gaps.max() > oldest_s and state == OK:
            state, told = NOTE, f"once it stopped for {gaps.max():.1f} s; {told}"
        several = [one for one in self._sources[name] if not one.startswith("LOCAL_POSITION_NED")]
        if len({one.rpartition(" ")[2] for one in several}) > 1:
            kind = "attitude" if name == "imu" else name
            told = f"several tell it: {', '.join(several)}; --sender {kind}=SYSTEM/COMPONENT takes one"
            state = NOTE if name == "battery" else BAD
        sender = self._sources[name].most_common(1)[0][0]
        return CheckRow(name, state, told.rstrip("; "), rate_hz, gap_s, now_s - come[-1], sender)

    def _dvl(self, lost: Counter[str], foms: list[float]) -> tuple[str, str]:
        fom = "".join(f", figure of merit {value:.3f} m/s" for value in foms)
        if not self._speeds:
            told = "no DVL is heard: this is the autopilot's own estimate"
            return (BAD, f"{told}; {_OUT_OF_RANGE}") if lost else (NOTE, told)
        share, speed = len(self._speeds) / (len(self._speeds) + lost.total()), float(np.mean(self._speeds))
        told = f"valid {100 * share:.0f} %, {speed:.2f} m/s{fom}; its yaw does not show at rest"
        if share < _VALID[1]:
            return BAD, f"{told}; {_OUT_OF_RANGE}: {lost.most_common(1)[0][0]}"
        return (NOTE if share < _VALID[0] or speed > _REST_M_S else OK), told

    def _sonar(self) -> tuple[str, str]:
        sonar, beams = self._config.sensors.sonar, max(self._beams, 1)
        echoes, near = self._echoes / beams, self._near / beams
        told = f"{100 * echoes:.0f} % of {self._beams} beams return"
        if near > _RINGS:
            return BAD, (
                f"{told}, {100 * near:.0f} % nearer than {_RINGS_M:g} m: ring-down, raise "
                "sensors.sonar.min_range_m; or something is that near"
            )
        unseen = sonar.n_ray - len(self._looked & {*range(sonar.n_ray)})
        if sonar.mechanical and unseen > 0:
            return NOTE, f"{told}; {unseen} bearings were never looked at: --seconds"
        return (OK if echoes >= _ECHOES else NOTE), told

    def _depth(self) -> tuple[str, str]:
        depth_m = self._depths_m.get("SCALED_PRESSURE2", next(iter(self._depths_m.values()), math.nan))
        off_m, floor_m = abs(depth_m + self._start_z_m), -self._config.world.tank.z_m[0]
        told = f"{depth_m:.2f} m deep if the air has 1013 hPa, --start says {-self._start_z_m:.2f}"
        is_alone = "SCALED_PRESSURE2" not in self._depths_m
        hull = "; by SCALED_PRESSURE alone, which may be the hull's own: is the depth sensor connected?"
        more = hull if is_alone else ""
        if not off_m <= _DEPTH_M[not is_alone]:
            return BAD, f"{told} in a tank of {floor_m:g} m: measure again, or another sensor speaks{more}"
        return (NOTE if off_m > _DEPTH_M[0] or is_alone else OK), told + more

    def _battery(self, heard: Heard) -> tuple[str, str]:
        volts, share, limits = heard.battery_v, heard.battery_share, self._limits
        told = ", ".join([*([f"{volts:.1f} V"] if volts else []), *([f"{share:.0%}"] if share else [])])
        is_low = volts is not None and volts < limits.battery_v
        is_low = is_low or (share is not None and share < limits.battery_share)
        return (BAD, f"{told}: it would surface; charge it, or --battery") if is_low else (OK, told)

    def _imu_rows(self) -> Iterator[CheckRow]:
        if self._spent_s < 1.0:
            return
        count = len(self._come["imu"])
        bias = float(np.abs(self._turned - self._told).max() / self._spent_s)
        off, lean = self._force_off / count, math.acos(max(-1.0, min(1.0, self._upright / count)))
        told = f"rates and attitude part by {bias:.4f} rad/s"
        wrong = f"{told}: keep it still and calibrate the gyro in QGroundControl"
        yield CheckRow("gyro", BAD if bias > _GYRO_RAD_S else OK, wrong if bias > _GYRO_RAD_S else told)
        size = float(np.linalg.norm(off))
        if math.isnan(self._force_s):
            yield CheckRow("accelerometer", NOTE, "no RAW_IMU comes: taken for that of a vehicle at rest")
        elif size > _FORCE_M_S2:
            wrong = f"{size:.1f} m/s^2 off gravity: is it upside down (AHRS_ORIENTATION)? Calibrate it"
            yield CheckRow("accelerometer", BAD, wrong)
        else:
            yield CheckRow("accelerometer", OK, f"{size:.2f} m/s^2 off gravity")
        state = BAD if lean > self._limits.tilt_rad else NOTE if lean > _LEAN_RAD else OK
        more = "" if state == OK else ": trim it, or AHRS_ORIENTATION is wrong"
        yield CheckRow("upright", state, f"leans {math.degrees(lean):.0f} degrees{more}")

    def _start_rows(self, fix: StartFix | None, start: StartFound) -> Iterator[CheckRow]:
        if fix is None:
            return
        if start.scans and not start.refusal:
            off_m, off = math.hypot(*start.shift), math.degrees(start.turn_rad)
            told = f"found by the walls, {off_m:.2f} m and {off:.1f} degrees from what was typed"
            told = f"{told}; they fit to {start.residual_m:.2f} m"
            if is_far := off_m > _WALL_M or abs(off) > _TURN_DEG:
                told = f"{told}: measure --start and --heading again; else the tank is another (--world)"
            yield CheckRow("start", NOTE if is_far else OK, told)
        else:
            told = start.refusal or f"{fix.waits_for}; turn it once around meanwhile, or --seconds 60"
            yield CheckRow("start", BAD, told)
        for name, off_m, count in fix.walls():
            if math.isnan(off_m):
                yield CheckRow(f"wall {name}", OK, f"{count} beams, too few or too scattered to tell")
            elif abs(off_m) > _WALL_M:
                far = f"{abs(off_m):.2f} m {'farther' if off_m > 0 else 'nearer'} than configured"
                told = f"{far}, {count} beams: --world (world.tank), --start or --heading"
                yield CheckRow(f"wall {name}", BAD, told)
            else:
                yield CheckRow(f"wall {name}", OK, f"{off_m:+.2f} m, {count} beams")

    def _parameter_rows(self, heard: Heard) -> Iterator[CheckRow]:
        silent = [name for name in PARAMETERS if name not in self.parameters]
        for name, value in self.parameters.items():
            state, told = judged(name, value, self._config, self._operator, heard.sticks_s > -math.inf)
            yield CheckRow(name, state, f"{value:g}{f', {told}' if told else ''}")
        if silent:
            yield CheckRow("parameters", NOTE, f"not answered, look in QGroundControl: {', '.join(silent)}")

    def _strange_rows(self, heard: Heard, clock_jumps: int) -> Iterator[CheckRow]:
        for why, count in heard.refused.most_common(6):
            state = BAD if why.startswith(_STRANGERS) else NOTE
            yield CheckRow("left out", state, f"{count} times: {why}")
        jumped = {name: count for name, count in self._jumps.items() if count}
        if jumped or clock_jumps:
            names = ", ".join(f"{name} {count} times" for name, count in jumped.items())
            told = f"{names or f'{clock_jumps} times'}: does it restart, is its time set, is the link stuck?"
            yield CheckRow("clock jumps", BAD, told)

    def _run_rows(self, heard: Heard, now_s: float) -> Iterator[CheckRow]:
        for text, count in self._says.most_common(4):
            yield CheckRow("autopilot says", BAD, f"{count} times: {text}")
        if now_s - heard.sticks_moved_s <= STICKS_S:
            yield CheckRow("sticks", BAD, "they are off their middle, which hands it back: let go of them")
        if heard.is_armed:
            yield CheckRow("armed", BAD, "the vehicle is armed: disarm it, a check is of one at rest")
        steps, held = max(self._steps, 1), self._undecided
        why = ", ".join(f"{name} {count}" for name, count in self._held.most_common(4))
        told = f"{held} of {self._steps} steps without a decision{f' ({why})' if why else ''}"
        yield CheckRow(
            "free run", BAD if held > _HELD * steps or not self._steps else NOTE if held else OK, told
        )
        wrong = [
            f"{name} ({100 * count / steps:.0f} %)"
            for name, count in self._broken.items()
            if name in self._now or (count > _HELD * steps and name != "start unchecked")
        ]
        told = f"would hold it: {', '.join(wrong)}" if wrong else "none is broken"
        yield CheckRow("safety rules", BAD if wrong else OK, told)
