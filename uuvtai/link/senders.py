"""From whom each kind of message counts: what an autopilot says of itself from the autopilot alone, a DVL and
a sonar from whom they are known to come."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from uuvtai.link.link_errors import LinkError

AUTOPILOT = 1
"""MAV_COMP_ID_AUTOPILOT1"""
KINDS = {
    "attitude": ("ATTITUDE",),
    "imu": ("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU", "HIGHRES_IMU"),
    "pressure": ("SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3"),
    "position": ("LOCAL_POSITION_NED",),
    "battery": ("SYS_STATUS", "BATTERY_STATUS"),
    "dvl": ("VISION_POSITION_DELTA",),
    "sonar": ("OBSTACLE_DISTANCE", "DISTANCE_SENSOR"),
}
KIND_OF = {name: kind for kind, names in KINDS.items() for name in names}
BLUEOS = (255, 0)
"""as whom extensions of BlueOS speak, its DVL's among them (mavlink2rest)"""
_OF_OTHERS = ("dvl", "sonar")
_WRITTEN = re.compile(r"([a-z]+)=(\d{1,3})/(\d{1,3}|\*)")

Sender = tuple[int, int | None]
"""system and component; None = any component"""


@dataclass(frozen=True)
class Senders:
    """Of one vehicle."""

    system: int = 1
    given: Mapping[str, tuple[Sender, ...]] = field(default_factory=dict)
    """kind -> those that count in place of the usual ones"""

    @classmethod
    def typed(cls, texts: Sequence[str], system: int) -> Senders:
        """Of ``KIND=SYSTEM/COMPONENT``, each once or more. Raises LinkError."""
        given: dict[str, tuple[Sender, ...]] = {}
        for text in texts:
            found = _WRITTEN.fullmatch(text)
            numbers = [int(part) for part in found.groups()[1:] if part != "*"] if found else []
            if found is None or found[1] not in KINDS or max(numbers) > 255:
                raise LinkError(
                    f"--sender {text!r}: write KIND=SYSTEM/COMPONENT, for example --sender dvl=255/0; KIND "
                    f"is one of {', '.join(KINDS)}, numbers go to 255, COMPONENT may be *"
                )
            sender = numbers[0], None if found[3] == "*" else numbers[1]
            given[found[1]] = (*given.get(found[1], ()), sender)
        return cls(system, given)

    def counts(self, name: str, system: int, component: int) -> bool:
        """Whether a message of this name counts from there; one of no kind as what the autopilot says."""
        kind = KIND_OF.get(name, "")
        usual = ((self.system, None), BLUEOS) if kind in _OF_OTHERS else ((self.system, AUTOPILOT),)
        return any(system == known and one in (None, component) for known, one in self.given.get(kind, usual))
