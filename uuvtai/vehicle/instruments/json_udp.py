"""Anything else: one JSON object a datagram.

``{"kind": "dvl", "age_s": 0.05, "vel_b": [0.3, 0.0, 0.0]}``: ``kind`` and the fields are those of
``vehicle/messages.py``, SI units, body axes x ahead, y left, z up; ``age_s`` [s] is how long ago it was
measured (0 where it is left out).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from uuvtai.common.files import FileError, parsed_json
from uuvtai.vehicle.instruments.channel import Instrument
from uuvtai.vehicle.messages import KINDS, SensorMessage

PORT = 14700
LONGEST = 65507
_OLDEST_S = 5.0


class JsonUdp(Instrument):
    """Readings of somebody else's driver."""

    def poll(self, now_s: float) -> list[SensorMessage]:
        """As in ``Instrument``."""
        found = []
        for data in self.channel.read(now_s):
            message = self._message(data, now_s)
            if message is not None:
                self.heard += 1
                found.append(message)
        return found

    def _message(self, data: bytes, now_s: float) -> SensorMessage | None:
        try:
            said: Any = parsed_json(data, "a datagram")
            kind = KINDS.get(said.pop("kind"))
            age_s = float(said.pop("age_s", 0.0))
            if kind is None or not 0.0 <= age_s <= _OLDEST_S:
                return self.refuse("no 'kind' of ours, or an 'age_s' that cannot be")
            wanted = {field.name for field in dataclasses.fields(kind)} - {"time_s"}
            required = wanted - {"first_beam"}
            if not required <= said.keys() <= wanted:
                return self.refuse(f"{kind.__name__}: wants {', '.join(sorted(required))}")
            arrays = {name: np.array(value, np.float64) for name, value in said.items()}
            given = {name: array if array.ndim else _plain(name, array) for name, array in arrays.items()}
        except (FileError, ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
            return self.refuse("no JSON object of numbers")
        return kind(now_s - age_s, **given)


def _plain(name: str, value: np.ndarray) -> float | int:
    """A number, of ``first_beam`` a whole one. ValueError, OverflowError."""
    number = float(value)
    return int(number) if name == "first_beam" else number
