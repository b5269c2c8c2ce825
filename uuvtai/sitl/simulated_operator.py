"""The operator of a simulated vehicle: a heartbeat of a ground station, and where on earth the water is.

Without a ground station the pilot's dead-man stops it, and ArduSub has no origin for what a DVL tells. It
does not operate an ArduSub that drove in another water, for that is not where it takes itself to be.
"""

from __future__ import annotations

from uuvtai.link.orders import Order

BEAT_S, PLACE_S, PLACED_S = 1.0, 0.25, 60.0
"""a heartbeat so often; the place so often, until so long after the beginning. ArduSub takes it once, as soon
as its filter is there: the heading that it aligns without a place lacks the magnetic declination"""
PLACE = (-353600000, 1491600000, 0)
"""latitude, longitude [1e-7 degrees], altitude [mm] of the surface"""


class SimulatedOperator:
    """One vehicle's. ``report`` is called after every step of the water."""

    def __init__(self, system: int) -> None:
        self._system = system
        self._beat_s = self._place_s = float("-inf")

    def report(self, time_s: float) -> list[Order]:
        """What it says at this time of the water's; a time that falls has begun anew."""
        if time_s < self._beat_s:
            self._beat_s = self._place_s = float("-inf")
        found = []
        if time_s - self._beat_s >= BEAT_S:
            self._beat_s = time_s
            fields = {"type": 6, "autopilot": 8, "base_mode": 0, "custom_mode": 0, "system_status": 4}
            found.append(Order("HEARTBEAT", "HEARTBEAT", {**fields, "mavlink_version": 3}, as_operator=True))
        if time_s - self._place_s >= PLACE_S and time_s <= PLACED_S:
            self._place_s = time_s
            names = ("latitude", "longitude", "altitude")
            where = {"target_system": self._system, **dict(zip(names, PLACE, strict=True))}
            found.append(Order("SET_GPS_GLOBAL_ORIGIN", "SET_GPS_GLOBAL_ORIGIN", where, as_operator=True))
        return found
