"""Required detection distance: how far off a body that comes head-on must be known, to step aside in time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from uuvtai.config import Config

_BISECTIONS = 60


@dataclass(frozen=True)
class Detection:
    """Distance from the hull's middle to the body's surface, and what it is made of.

    required = closing x aside_s + margin + nose:
    closing = cruise speed + v, for a body that comes straight at the vehicle with the condition's speed v;
    aside_s = time T to move aside by ``aside_m`` = largest radius of a moving body + hull radius + collision
    clearance, at the sway limit w reached with the pilot's lag tau: aside_m = w (T - tau (1 - exp(-T /
    tau))); margin = the clearance at which the referee still lets a head-on approach go: collision clearance,
    or TTC x closing if that is more; nose = hull radius + half length. It is on the safe side: what is passed
    on one side closes more slowly, and diagonals of the body, diving and climbing are faster ways out. The
    time to become sure of a track (three scans) is not in it.
    """

    required_m: float
    closing_m_s: float
    aside_m: float
    aside_s: float
    margin_m: float


def required_detection(config: Config) -> Detection | None:
    """Required detection distance of a condition; None where nothing moves."""
    world, vehicle, rules = config.world, config.vehicle, config.episode
    movers = [
        (body.radius_m or math.hypot(*(body.half_extents_m or (0.0, 0.0))), body.speed_m_s)
        for body in world.fixed
        if body.path
    ]
    if world.n_dynamic:
        movers.append((world.dynamic.radius_m[1], None))
    speeds = [world.dynamic_speed_m_s if speed is None else speed for _, speed in movers]
    if not any(speeds):
        return None
    closing = config.teacher.cruise_m_s + max(speeds)
    aside = max(radius for radius, _ in movers) + vehicle.hull_radius_m + rules.collision_clearance_m
    needed = time_aside_s(aside, vehicle.max_sway_m_s, config.teacher.lag_s)
    margin = max(rules.collision_clearance_m, rules.ttc_s * closing)
    nose = vehicle.hull_radius_m + vehicle.hull_half_length_m
    return Detection(closing * needed + margin + nose, closing, aside, needed, margin)


def time_aside_s(way_m: float, speed_m_s: float, lag_s: float) -> float:
    """T with way = speed (T - lag (1 - exp(-T / lag))): from rest to a speed that is approached with a
    first-order lag."""
    low, high = 0.0, way_m / speed_m_s + lag_s
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if speed_m_s * (middle - lag_s * (1.0 - math.exp(-middle / lag_s))) < way_m:
            low = middle
        else:
            high = middle
    return high
