"""``uuv pilot --calibrate``: which way the DVL looks, and the compass heading of the tank, from places where
the vehicle rests while somebody drives it by hand from one to the next.

At each place the walls that the sonar sees tell where it is (``start_fix``); between them the DVL tells how
it has moved. The turn and the scale that lay the second on the first are those of the DVL (least squares:
Umeyama 1991, in the plane). An error of the sonar's own zero goes into the heading of the tank and into the
DVL's yaw alike.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.common.files import whole_file
from uuvtai.config import Config
from uuvtai.config.loader import preset_names
from uuvtai.vehicle.messages import DvlReading, ImuReading, SensorMessage
from uuvtai.vehicle.start_fix import FLOOR_M, FLOOR_RAD, StartFix, StartFound, Track, expected

LONGEST_S = 1200.0  # of a calibration
_LEGS, _MOST_LEGS, _FIXES = 6, 11, 3  # legs between places at least and at most, and fixes at each place
_LEG_M, _TOLD_M, _DRIFT_M = 1.5, 1.7, 0.5
"""between two places so far by the DVL at least, and so far as the operator is told; less is drift"""
YAW_RAD, SCALE = math.radians(0.5), 0.05
"""standard deviation of the yaw at most; by how much more or less the DVL may tell than the walls"""
_REST_M_S, _STILL_S = 0.1, 1.5  # at rest, though it may turn: slower, for so long
WAYS = (
    "ahead", "ahead to port", "to port", "back to port", "back", "back to starboard", "to starboard",
    "ahead to starboard",
)  # fmt: skip
"""where to drive next, from the hull, counter-clockwise in steps of 45 degrees"""
_ALL_WAYS_RAD = np.arange(len(WAYS)) * math.tau / len(WAYS)
_SIDE_M, _LEAST_M = 2.0, 1.0  # of a square; from a wall, and from where the sonar no longer sees it
_SQUARE_M = _SIDE_M * np.array([(1, 0), (1, 1), (0, 1), (0, 0)])
"""where to, one place after the other, from the first one: inwards, or to a wall that would leave the view"""


def _without_numbers(text: str) -> str:
    return re.sub(r"[-+.,\d]+", "", text)


@dataclass(frozen=True, eq=False)
class Place:
    """A fix: where the walls say that the vehicle is, where attitude and DVL say, and of which rest it is."""

    number: int
    by_walls: np.ndarray  # (2,) [m] world
    by_dvl: np.ndarray  # (2,) [m] from where the calibration began, axes as typed
    turn_rad: float  # to be added to the yaw as typed
    stretch: int = 0  # by the DVL its way is known to places of the same stretch alone


@dataclass(frozen=True)
class Calibrated:
    """What was found."""

    dvl_yaw_rad: float  # to be added to what is configured
    dvl_yaw_sd_rad: float
    dvl_scale: float  # walls' distances over the DVL's
    turn_rad: float  # to be added to the yaw as typed
    turn_sd_rad: float
    start: tuple[float, float]  # [m] where the vehicle rests now
    residual_m: float  # root mean square by which walls and DVL disagree about a leg
    places: int


class Calibration:
    """Is fed what the pilot is fed, unarmed. ``says`` tells the operator what to do next; ``found`` is there
    when it is done, ``refusal`` where it cannot be."""

    def __init__(self, config: Config, typed: tuple[float, float, float]) -> None:
        """``typed``: start (x, y, z) [m] world; the attitudes fed have the heading as typed."""
        self.says, self.refusal = "let the vehicle rest, away from obstacles: the walls tell where it is", ""
        self.found: Calibrated | None = None
        self.places: list[Place] = []
        self._config, self._z_m = config, typed[2]
        self._track, self._at = Track(), np.array(typed[:2])
        """way by attitude and DVL; where the last fix was [m]"""
        self._from, self._turn = np.zeros(2), 0.0  # the way until then; by how much its yaw was wrong
        self._fix: StartFix | None = None
        self._still_s, self._number, self._stretch = math.inf, 1, 0
        """at rest since; number of this rest, and of the stretch of the way"""

    def feed(self, message: SensorMessage) -> None:
        """A message of the pilot's, in any order."""
        if self.found or self.refusal:
            return
        if isinstance(message, ImuReading):
            if not self._track.go(message) and self.places:
                self._interrupt()
            self._rest(message.time_s)
        elif isinstance(message, DvlReading):
            self._track.hear(message)
        if self._fix is not None:
            self._fix.feed(message)
            waits = self._fix.waits_for
            if ": turn" in waits and _without_numbers(waits) not in _without_numbers(self.says):
                self.says = f"place {self._number}: {waits}"  # once, though each scan has other numbers
            if (result := self._fix.result) is not None:
                self._fix = None
                self._take(result)

    def _interrupt(self) -> None:
        """Where it has been meanwhile nobody knows."""
        self._stretch, self._fix = self._stretch + 1, None
        self._number += bool(self._of(self._number))
        self.says = "attitude or velocity was missing for seconds: this way does not count, let it rest"

    def _rest(self, now_s: float) -> None:
        """Look for the walls while it rests, far from where it rested before; it may turn meanwhile."""
        is_old = now_s - self._track.vel_s > _STILL_S
        if is_old or not math.hypot(*self._track.vel_b) <= _REST_M_S:
            self._still_s, self._fix = math.inf, None
            return
        self._still_s = min(self._still_s, now_s)
        if self._fix is not None or now_s - self._still_s < _STILL_S:
            return
        here = self._of(self._number)
        if len(here) >= _FIXES:
            if (way_m := math.dist(self._track.at, here[-1].by_dvl)) < _LEG_M:
                if way_m > _DRIFT_M:
                    self.says = f"that was {way_m:.1f} m of {_LEG_M:g} at least: drive on, then let it rest"
                return
            self._number += 1
        x, y = self._now()
        self._fix = StartFix(self._config, (float(x), float(y), self._z_m))

    def _now(self) -> np.ndarray:
        """(2,) [m] Where it is, by the last fix and the way since."""
        return self._at + _turned(self._track.at - self._from, self._turn)

    def _of(self, number: int) -> list[Place]:
        return [place for place in self.places if place.number == number]

    def _take(self, result: StartFound) -> None:
        if result.refusal:
            self.says = result.refusal
            if self.places:
                why, way = result.refusal.partition(": ")[2].partition(";")[0], self._way_to(self._middle())
                self.says = f"place {self._number}: {why}: drive {way} by hand, then let it rest"
            return
        self._at, self._from, self._turn = np.array(result.place), self._track.at, result.turn_rad
        self.places.append(Place(self._number, self._at, self._from, self._turn, self._stretch))
        if (count := len(self._of(self._number))) < _FIXES:
            self.says = f"place {self._number}: fix {count} of {_FIXES}, let it rest"
            return
        self.says = f"place {self._number} is known: drive {self._next_way()} by hand, then let it rest"
        if len(_legs(self.places)[0]) >= _LEGS:
            self._conclude()

    def _middle(self) -> np.ndarray:
        tank = self._config.world.tank
        return np.array([sum(tank.x_m), sum(tank.y_m)]) / 2

    def _next_way(self) -> str:
        """To the next corner of the square that is a leg away."""
        tank, first = self._config.world.tank, self.places[0].by_walls
        off = self._middle() - first
        wall_m = np.array([np.ptp(tank.x_m), np.ptp(tank.y_m)]) / 2 - np.abs(off)
        sees_m = self._config.sensors.sonar.max_range_m - _LEAST_M
        is_inwards = (wall_m + _SIDE_M <= sees_m) | (wall_m < _SIDE_M + _LEAST_M)
        signs = np.where(is_inwards == (off >= 0), 1.0, -1.0)
        corners = np.roll(first + signs * _SQUARE_M, 1 - self._number, axis=0) - self._at
        return self._way_to(self._at + corners[int(np.argmax(np.hypot(*corners.T) > _TOLD_M))])

    def _way_to(self, target: np.ndarray) -> str:
        """What to drive, as seen from the hull, to end near ``target`` (2,) [m] and away from the walls."""
        yaw, found = self._track.rpy[2] + self._turn, {}
        for metres, way in itertools.product((2, 3), range(len(WAYS))):
            angle = yaw + way * math.tau / len(WAYS)
            end = self._now() + metres * np.array([math.cos(angle), math.sin(angle)])
            around = expected(self._config.world.tank, np.tile(end, (len(WAYS), 1)), _ALL_WAYS_RAD)[0]
            found[f"{metres} m {WAYS[way]}"] = math.dist(end, target) + 100 * max(_LEAST_M - min(around), 0)
        return min(found, key=lambda told: found[told])

    def _conclude(self) -> None:
        found = solved(self.places)
        yaw, off = math.degrees(found.dvl_yaw_sd_rad), found.dvl_scale - 1.0
        if found.dvl_yaw_sd_rad > YAW_RAD and len(_legs(self.places)[0]) < _MOST_LEGS:
            self.says = f"{self.says} (the DVL's yaw is known to {yaw:.1f} degrees, wanted are 0.5)"
        elif found.dvl_yaw_sd_rad > YAW_RAD:
            self.refusal = (
                f"walls and DVL disagree by {found.residual_m:.2f} m: is the tank another (--world)?"
            )
        elif abs(off) > SCALE:
            more = f"{100 * abs(off):.0f} % {'less' if off > 0 else 'more'}"
            self.refusal = (
                f"the DVL tells {more} than the walls: its speed of sound, or the sizes of the tank"
            )
        else:
            self.found, self.says = found, f"place {self._number} is known: nothing more to drive"

    def document(self, heading_rad: float | None) -> dict[str, Any]:
        """What was found (null: it was not) in SI units, as sections of a sensors file, and why not.
        ``heading_rad``: compass heading of the x axis as it was taken; None: no attitude was heard."""
        rig = self._rig(self.found, heading_rad) if self.found and heading_rad is not None else None
        return {
            "ready": rig is not None,
            "found": asdict(self.found) if self.found else None,
            "rig": rig,
            "refusal": "" if self.found else self.refusal or self.says,
            "places": len({place.number for place in self.places}),
        }

    def _rig(self, found: Calibrated, heading_rad: float) -> dict[str, Any]:
        yaw_deg = self._config.sensors.dvl.yaw_deg + math.degrees(found.dvl_yaw_rad)
        heading_deg = math.degrees(heading_rad + found.turn_rad)
        return {
            "sensors": {"dvl": {"yaw_deg": round(math.remainder(yaw_deg, 360.0), 2)}},
            "world": {"tank": {"heading_deg": round(heading_deg % 360.0, 1) % 360.0}},
        }


def solved(places: list[Place]) -> Calibrated:
    """The turn and the scale that lay the ways by the DVL on those by the walls, from three rests on: leg by
    leg, for what a DVL misses on one is missing for good."""
    legs, way = _legs(places)
    turns = np.array([math.remainder(place.turn_rad, math.tau) for place in places])
    turn = float(np.mean(turns))
    turned = _turned(way, turn)
    along = float((turned * legs).sum())
    across = float((turned[:, 0] * legs[:, 1] - turned[:, 1] * legs[:, 0]).sum())
    size = float((turned**2).sum())
    yaw, scale = math.atan2(across, along), math.hypot(along, across) / size
    off = legs - scale * _turned(turned, yaw)
    deviation = math.sqrt(float((off**2).sum()) / max(2 * len(legs) - 2, 1))
    return Calibrated(
        yaw,
        max(deviation, FLOOR_M) / math.sqrt(size),
        scale,
        turn,
        max(float(np.std(turns)), FLOOR_RAD),
        (float(places[-1].by_walls[0]), float(places[-1].by_walls[1])),
        math.sqrt(float((off**2).sum()) / (2 * len(legs))),
        len({place.number for place in places}),
    )


def _legs(places: list[Place]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) each: ways from place to place by the walls, and by the DVL, which has measured them whole."""
    rows = [[*row] for _, row in itertools.groupby(places, key=lambda place: place.number)]
    whole = [one[0].stretch == other[0].stretch for one, other in itertools.pairwise(rows)]
    walls, way = (
        np.diff([np.mean([getattr(place, name) for place in row], axis=0) for row in rows], axis=0)[whole]
        for name in ("by_walls", "by_dvl")
    )
    return walls, way


def _turned(vectors: np.ndarray, angle: float) -> np.ndarray:
    """(..., 2) counter-clockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return vectors @ np.array([[c, s], [-s, c]])


def write_rig(target: Path, sensors: str, calibration: Mapping[str, Any]) -> None:
    """A file for ``--sensors``: those (a name or a file) with what was found. OSError."""
    import yaml

    found = calibration["found"]
    yaw_deg, spread_deg = (math.degrees(found[name]) for name in ("dvl_yaw_sd_rad", "turn_sd_rad"))
    about = (
        f"# By uuv pilot --calibrate, from {calibration['places']} places. Standard deviations: "
        f"the DVL's yaw {yaw_deg:.2f} degrees, heading {spread_deg:.2f} degrees.\n"
    )
    base = sensors if sensors in preset_names("sensors") else str(Path(sensors).resolve())
    body = yaml.safe_dump({"extends": base} | calibration["rig"], sort_keys=False)
    with whole_file(target) as (file, _):
        file.write((about + body).encode())
