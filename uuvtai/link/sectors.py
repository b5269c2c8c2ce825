"""Distances by sectors, as MAVLink tells them, into the beams of the pilot's sonar_cfg."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from uuvtai.config.sensors import SonarConfig
from uuvtai.pilot import SonarPing

UNKNOWN_CM = 65535
"""of a sector that was not looked into (UINT16_MAX)"""
SECTORS = 72
"""at most, in OBSTACLE_DISTANCE"""


def bearings_deg(sonar_cfg: SonarConfig) -> np.ndarray:
    """(n_ray,) of the beams, clockwise from ahead as MAVLink counts."""
    return -np.degrees(sonar_cfg.first_beam_rad + sonar_cfg.beam_step_rad * np.arange(sonar_cfg.n_ray))


def ping_of(
    sonar_cfg: SonarConfig,
    time_s: float,
    distances_cm: np.ndarray,
    increment_deg: float,
    offset_deg: float,
    min_cm: int,
    max_cm: int,
) -> SonarPing | str:
    """A scan in which each beam has the range of the sector that it lies in, or why there is none.

    The pilot takes a beam without a return for free water as far as the sonar sees, so a sector that nobody
    looked into, or a sensor that sees less far than the config says, would be a lie. By MAVLink 0 is a touch,
    ``max_cm`` + 1 free water; what else lies outside ``min_cm`` to ``max_cm`` tells nothing.
    """
    if not (np.isfinite(increment_deg) and 0.1 <= abs(increment_deg) <= 90.0 and np.isfinite(offset_deg)):
        return f"sectors of {increment_deg:g} degrees from {offset_deg:g} on make no sense"
    if max_cm < 100.0 * sonar_cfg.max_range_m - 1.0:
        return (
            f"the sensor sees {max_cm / 100:g} m far, the config says {sonar_cfg.max_range_m:g}: "
            f"--set sensors.sonar.max_range_m={max_cm / 100:g}"
        )
    turn = (bearings_deg(sonar_cfg) - offset_deg) / increment_deg
    index = np.rint(np.mod(turn + 0.5, 360.0 / abs(increment_deg)) - 0.5).astype(int)
    heard = (index >= 0) & (index < len(distances_cm))
    distance = np.where(heard, distances_cm[np.clip(index, 0, len(distances_cm) - 1)], UNKNOWN_CM)
    if (distance == UNKNOWN_CM).any():
        return "beams lie in sectors that nobody looked into"
    if (((distance != 0) & (distance < min_cm)) | (distance > max_cm + 1)).any():
        return "distances outside of what the sensor says that it measures"
    return SonarPing(time_s, distance / 100.0, (distance <= max_cm).astype(float), np.zeros(0))


def sectors_of(
    sonar_cfg: SonarConfig, range_m: np.ndarray, hit: np.ndarray
) -> tuple[list[int], float, float]:
    """(distances [cm], increment, offset [deg]) of a scan: the nearest return in each sector. The sectors
    share the sonar's aperture; one without a return reads a centimetre beyond the range."""
    increment = (360.0 if sonar_cfg.is_ring else sonar_cfg.horizontal_aperture_deg) / SECTORS
    offset = 0.0 if sonar_cfg.is_ring else -0.5 * sonar_cfg.horizontal_aperture_deg + 0.5 * increment
    turn = (bearings_deg(sonar_cfg) - offset) / increment
    index = np.rint(np.mod(turn + 0.5, 360.0 / increment) - 0.5).astype(int)
    free = round(100.0 * sonar_cfg.max_range_m) + 1
    read = np.where(hit > 0, np.clip(np.rint(100.0 * range_m), 1, free - 1), free).astype(int)
    found = np.full(SECTORS, free)
    np.minimum.at(found, np.clip(index, 0, SECTORS - 1), read)
    empty = np.setdiff1d(np.arange(SECTORS), index)
    found[empty] = found[(empty + 1) % SECTORS]
    return found.tolist(), increment, offset


class Rangers:
    """Eight rangefinders around the hull make a ring of eight sectors, told when the one ahead speaks."""

    _TOGETHER_S = 1.0
    _INVALID = 1
    """signal_quality: no return that counts"""

    def __init__(self) -> None:
        self._rows: dict[int, tuple[float, int, int]] = {}

    def ring(self, fields: Mapping[str, Any], time_s: float) -> tuple[np.ndarray, int] | None:
        """(8,) [cm] clockwise from ahead, and how far all of them see; None = not yet. ``fields``: of a
        DISTANCE_SENSOR."""
        turn = int(fields["orientation"])
        if not 0 <= turn < 8:
            return None
        read, reach = int(fields["current_distance"]), int(fields["max_distance"])
        is_blind = int(fields.get("signal_quality", 0)) == self._INVALID or read == UNKNOWN_CM
        if is_blind or read < int(fields.get("min_distance", 0)):
            read = UNKNOWN_CM
        elif read >= reach:
            read = reach + 1
        self._rows[turn] = time_s, read, reach
        if turn != 0:
            return None
        recent = {at: row for at, row in self._rows.items() if abs(time_s - row[0]) <= self._TOGETHER_S}
        distances = np.array([recent[at][1] if at in recent else UNKNOWN_CM for at in range(8)])
        least = min(row[2] for row in recent.values())
        return np.where((distances > least) & (distances < UNKNOWN_CM), least + 1, distances), least
