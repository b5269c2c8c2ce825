"""What ``uuv pilot`` was told, checked before anything is opened or compiled."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from uuvtai.config import Config
from uuvtai.link.endpoint import LinkPlace, place_of
from uuvtai.link.link_errors import LinkError
from uuvtai.link.safety import SafetyLimits, outside_m
from uuvtai.link.senders import Senders
from uuvtai.pilot import Mission

EDGE_M = 0.2
"""the fence's depths keep so far from surface and floor of the tank where none are typed"""
MOST_SPEED_M_S = 2.0


@dataclass(frozen=True)
class FlightPlan:
    """What ``uuv pilot`` was told."""

    place: LinkPlace
    mission: Mission
    limits: SafetyLimits
    log: Path
    arms: bool = False
    """whether orders are sent; else a dry run"""
    heading_rad: float | None = None
    """compass heading of the world's x axis; None = where the vehicle looks at first"""
    seconds: float = math.inf
    rate: float = 1.0
    """seconds of the vehicle's clock in one of ours: a simulated one may be slower or faster; 0 = it is
    followed"""
    system: int = 1
    operator: int = 255
    senders: Senders | None = None
    """from whom what counts; None = the usual ones of ``system``"""

    @classmethod
    def typed(
        cls,
        config: Config,
        mavlink: str,
        start: Sequence[float] | None,
        goal: Sequence[float] | None,
        box: Sequence[float] | None,
        depth: Sequence[float] | None,
        max_speed: float,
        battery: float,
        *,
        arms: bool,
        heading_deg: float | None,
        seconds: float | None,
        rate: float,
        log: Path | None,
        system: int,
        operator: int,
        senders: Sequence[str] = (),
    ) -> FlightPlan:
        """Of what was typed. Raises LinkError."""
        tank, vehicle = config.world.tank, config.vehicle
        if config.sensors.sonar.doppler:
            raise LinkError(
                "the pilot would wait for a sonar with Doppler, which OBSTACLE_DISTANCE does not have: "
                "--sensors multibeam, or --set sensors.sonar.doppler=false"
            )
        if system == operator:
            raise LinkError(f"--system {system}: the operator has this id too; give another --operator")
        if not 0 < max_speed <= MOST_SPEED_M_S:
            raise LinkError(f"--max-speed {max_speed:g}: give metres per second up to {MOST_SPEED_M_S:g}")
        if not 0 <= battery < 100:
            raise LinkError(f"--battery {battery:g}: give volts, 0 = never mind")
        if heading_deg is not None and not abs(heading_deg) <= 360:
            raise LinkError(f"--heading {heading_deg:g}: give degrees of a compass, for example --heading 90")
        if seconds is not None and not 0 < seconds < math.inf:
            raise LinkError(f"--seconds {seconds:g}: give a number above 0, or leave it out")
        limits = SafetyLimits(
            box_m=_four(box or (tank.x_m[0], tank.y_m[0], tank.x_m[1], tank.y_m[1])),
            depth_m=(depth[0], depth[1]) if depth else (EDGE_M - tank.z_m[1], -tank.z_m[0] - EDGE_M),
            speed_m_s=max_speed,
            heave_m_s=min(max_speed, vehicle.max_heave_m_s),
            yaw_rate_rad_s=vehicle.max_yaw_rate_rad_s,
            battery_v=battery,
        )
        mission = Mission(_three(start or ()), _three(goal or ()))
        _refuse_places(mission, limits)
        return cls(
            place_of(mavlink),
            mission,
            limits,
            log or Path("runs") / f"pilot_{time.strftime('%Y%m%d-%H%M%S')}.mcap",
            arms,
            None if heading_deg is None else math.radians(heading_deg),
            math.inf if seconds is None else seconds,
            rate,
            system,
            operator,
            Senders.typed(senders, system),
        )


def _refuse_places(mission: Mission, limits: SafetyLimits) -> None:
    low_x, low_y, high_x, high_y = limits.box_m
    if not (low_x < high_x and low_y < high_y):
        raise LinkError("--box: give least x, least y, most x, most y, for example --box 0,0,20,6")
    if not 0 <= limits.depth_m[0] < limits.depth_m[1]:
        raise LinkError("--depth: give the least depth, then the most, for example --depth 0.3,1.4")
    for option, place in (("--start", mission.start), ("--goal", mission.goal)):
        if (out := outside_m(place, limits)) > 0:
            where = ",".join(f"{value:g}" for value in place)
            raise LinkError(
                f"{option} {where}: is {out:.2f} m outside the fence; z is up and 0 at the surface, so a "
                "depth of 0.8 m is -0.8; or widen --box and --depth"
            )


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _four(values: Sequence[float]) -> tuple[float, float, float, float]:
    low_x, low_y, high_x, high_y = values
    return low_x, low_y, high_x, high_y
