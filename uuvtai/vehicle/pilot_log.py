"""What was heard, decided and said, as MCAP: a message on /mavlink/said for every order, sent or not."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.common.files import refusing
from uuvtai.logs.container import McapFile
from uuvtai.logs.encode import LogError
from uuvtai.logs.schemas import BOOLEAN, FOUR, INT, NUMBER, STRING, THREE, array_of, record
from uuvtai.vehicle.mavlink import MavMessage, Order
from uuvtai.vehicle.messages import NAMES, DepthShot, SensorMessage
from uuvtai.vehicle.onboard import PilotCommand
from uuvtai.vehicle.safety import SafeDecision
from uuvtai.vehicle.telemetry import Heard

_FIELDS = {"type": "object"}
_SCHEMAS = {
    "/mavlink/seen": record(
        "uuv.MavlinkSeen", "A message of MAVLink that came.",
        name=STRING, system=INT, component=INT, fields=_FIELDS,
    ),
    "/instruments/read": record(
        "uuv.InstrumentReading", "What an instrument itself told; time_s is when it was measured.",
        kind=STRING, fields=_FIELDS,
    ),
    "/mavlink/said": record(
        "uuv.MavlinkSaid", "A message of MAVLink that was sent, or (sent = false) would have been.",
        name=STRING, kind=STRING, sent=BOOLEAN, fields=_FIELDS,
    ),
    "/pilot/command": record(
        "uuv.PilotCommand", "What the stack wanted: surge, sway, heave [m/s], yaw rate [rad/s].",
        velocity=FOUR, position=THREE, leaf=STRING, held=array_of(STRING),
    ),
    "/pilot/safety": record(
        "uuv.SafetyDecision", "What was done with it; asked: the velocity after all limits.",
        action=STRING, asked=FOUR, reasons=array_of(STRING), mode=INT, armed=BOOLEAN, speed=NUMBER,
    ),
}  # fmt: skip
ABOUT = "uuv.pilot"  # metadata
SEEN = "/mavlink/seen", "/instruments/read"  # topics of what was heard
MOST_SEEN = 10  # messages heard in one step that are written; more are counted, lest the disk fill


class LinkLog:
    """One run's log. Once it cannot be written it is given up, and driving goes on: see ``trouble``."""

    def __init__(self, path: Path, about: dict[str, str]) -> None:
        """Raises LogError."""
        self.path, self.trouble = path, ""
        self._left, self._unwritten, self._closed = 0, 0, False
        with refusing(LogError, f"{path}: cannot write there", "try --log FILE"):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = McapFile(path)
            self._file.add_metadata(ABOUT, about)
            self._channels = {
                topic: self._file.add_channel(
                    topic, self._file.add_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
                )
                for topic, schema in _SCHEMAS.items()
            }

    def begin_step(self) -> None:
        self._left = MOST_SEEN

    def saw(self, time_s: float, heard: MavMessage) -> None:
        if self._left <= 0:
            self._unwritten += 1
            return
        self._left -= 1
        whose = {"name": heard.name, "system": heard.system, "component": heard.component}
        self._write("/mavlink/seen", time_s, {**whose, "fields": heard.fields})

    def read(self, time_s: float, reading: SensorMessage) -> None:
        """An instrument told something; images are left out."""
        if not isinstance(reading, DepthShot):
            fields = {name: np.asarray(value).tolist() for name, value in vars(reading).items()}
            self._write("/instruments/read", time_s, {"kind": NAMES[type(reading)], "fields": fields})

    def said(self, time_s: float, order: Order, was_sent: bool) -> None:
        """An order was given, or would have been."""
        whose = {"name": order.message, "kind": order.kind, "sent": was_sent}
        self._write("/mavlink/said", time_s, {**whose, "fields": order.fields})

    def decided(
        self,
        time_s: float,
        command: PilotCommand | None,
        decision: SafeDecision,
        heard: Heard,
        speed: float | None,
    ) -> None:
        """What this step came to; without a command while the vehicle is given back."""
        if command is not None:
            wanted = {"velocity": _finite(command.velocity), "position": _finite(command.pos_w)}
            self._write(
                "/pilot/command", time_s, {**wanted, "leaf": command.leaf, "held": list(command.held)}
            )
        done = {
            "action": decision.action.name,
            "asked": list(decision.velocity),
            "reasons": list(decision.reasons),
        }
        state = {"mode": heard.mode, "armed": heard.is_armed, "speed": _finite([speed or 0.0])[0]}
        self._write("/pilot/safety", time_s, done | state)

    def _write(self, topic: str, time_s: float, content: dict[str, Any]) -> None:
        if self.trouble:
            return
        try:
            data = as_json(content)
            self._file.add_message(self._channels[topic], max(0, round(1e9 * time_s)), data)
            self._file.settle()
        except OSError as error:
            self._give_up(error)

    def close(self) -> None:
        if not (self.trouble or self._closed):
            self._closed = True
            try:
                self._file.finish()
            except OSError as error:
                self._give_up(error)
            if self._unwritten and not self.trouble:
                self.trouble = f"{self.path}: lacks {self._unwritten} messages: {MOST_SEEN} a step are kept"

    def _give_up(self, error: OSError) -> None:
        self.trouble = f"{self.path}: the log ends early ({error.strerror or error})"


_JSON = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


def as_json(content: dict[str, Any]) -> bytes:
    """A message as JSON; a number that is not finite is null."""
    try:
        return _JSON.encode(content).encode()
    except (TypeError, ValueError):  # rarely, and a look at every number costs as much as all the rest
        return _JSON.encode(_plain_value(content)).encode()


def _plain_value(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain_value(part) for name, part in value.items()}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_plain_value(item) for item in value]
    return value if value is None or isinstance(value, int | str) else str(value)


def _finite(values: Any) -> list[float]:
    return [float(value) if math.isfinite(value) else 0.0 for value in values]
