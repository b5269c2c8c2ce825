"""What every column of a policy over a set of bodies is, in words, for policy_spec.json
(``twin/set_columns.py`` writes them)."""

from __future__ import annotations

from uuvtai.forecast_codes import AHEAD_STEPS, FAR, LENGTH_M, N_BEND, N_PAST, PAST_S
from uuvtai.twin.set_codes import N_RAY

MEANING = (
    "float32. Mirrored world: x is turned round where the goal lies at smaller x than the start, y "
    "where it lies at smaller y (flip is -1 there, else 1), so that the goal lies ahead and to the left "
    "at the start; flips do not change during a mission. Each column is the quantity in its unit, "
    "computed as its meaning says. clip(v, a, b) cuts off to [a, b]. A body is a tracked moving body; "
    "one row each, at most the nearest ones; a row of zeros is no body. Numbers that are not finite are "
    "refused."
)
MOTION_MEANING = (
    "float32, in the track's frame: its place now, x along its course, y to the left. Lengths are "
    f"divided by {LENGTH_M:g} m and cut off to +-{FAR:g}. In this order: speed [m/s], turn rate [rad/s] "
    "within +-4, its standard deviation, 1 where it is known, standard deviations of place [m] and "
    "velocity [m/s] at most 2, time unseen [s] at most 3, log(1 + scans) / 5, radius [m], 1 where it "
    "was tracked from the beginning of this straight way, 1 where it turned into it, way gone straight; "
    "walls ahead, behind, left, right; way to the next remembered turn of this water, course behind it "
    "(2; 0 = none), turns back and other turns seen in this water / 8 at most 2; the analytic forecast "
    f"after {', '.join(map(str, AHEAD_STEPS))} tenths of a second (2 each); the last {N_BEND} turns of "
    f"this track (2, and 1 where known); its last {N_PAST} places, {PAST_S:g} s apart (2 each), and "
    "seconds since the newest."
)


def _column(name: str, unit: str, meaning: str) -> dict[str, str]:
    return {"name": name, "unit": unit, "meaning": meaning}


def _pair(name: str, unit: str, meaning: str) -> list[dict[str, str]]:
    return [_column(f"{name}.{axis}", unit, meaning) for axis in "xy"]


BODY_COLUMNS = [
    _column("there", "1", "1 = a body"),
    *_pair("way", "4 m", "from the vehicle to the body, in metres, / 4"),
    *_pair("relative_velocity", "m/s", "the body's less the vehicle's"),
    *_pair("velocity", "m/s", "of the body"),
    _column("width", "m", "twice its radius"),
    _column(
        "water_above", "m", "from the vehicle's depth up to the body's top, where known: clip(v, 0, 1.6)"
    ),
    _column(
        "water_below", "m", "from the body's bottom up to the vehicle's depth, where known: clip(v, 0, 1.6)"
    ),
    _column("unseen", "2 s", "seconds since it was seen, at most 4, / 2"),
    _column(
        "turn", "2 rad/s", "rate of its course, mirrored by flip.x flip.y, clip(v, -3, 3) / 2; 0 = a corner"
    ),
    *_pair("way_in_1s", "4 m", "from the vehicle now to where the body is forecast in 1 s, / 4"),
    *_pair("way_in_2s", "4 m", "the same in 2 s"),
    _column("gap", "4 m", "distance less the body's radius, at most 8 m, / 4"),
    _column("nearness", "1/m", "1 / (0.3 + max(distance - radius - 0.22, 0))"),
    _column("closest_in", "s", "time of the closest approach on straight lines, clip(v, 0, 3)"),
    _column("closest_gap", "m", "distance then, less radius and 0.22, clip(v, -1, 3)"),
    *_pair("goal_direction", "1", "unit vector from the vehicle to the goal"),
]
"""Columns of a body."""
OWN_COLUMNS = [
    _column("goal.x", "10 m", "from the vehicle to the goal, / 10"),
    _column("goal.y", "4 m", "the same, / 4"),
    _column("goal.z", "m", "height of the goal above the vehicle"),
    *_pair("goal_direction", "1", "unit vector to the goal"),
    _column("goal_distance", "4 m", "horizontal, at most 4 m, / 4"),
    *_pair("speed", "m/s", "of the vehicle"),
    _column("heave", "0.5 m/s", "upward velocity in the body frame, x 2"),
    _column("height", "m", "z + 0.8, z = 0 at the surface"),
    *[
        _column(f"last_wish.{axis}", "1", "carried out last: x and y shortened to length 1, z within +-1; 0 "
                "at the start")
        for axis in "xyz"
    ],
    _column("cos_4_yaw", "1", "cosine of four times the heading"),
    _column("sin_4_yaw", "1", "its sine, times flip.x flip.y"),
    _column("across", "3 m", "flip.y (y - 3) / 3, y in the tank"),
    _column("along", "10 m", "flip.x (x - 10) / 10, x in the tank"),
    *[
        _column(f"ray[{i}]", "1/m", "1 / (0.3 + clip(free - 0.22, 0, 4)) - 0.5, free metres to the nearest "
                f"wall or occupied cell (at most 4.3) at {360 * i / N_RAY:g} degrees from x towards y")
        for i in range(N_RAY)
    ],
]  # fmt: skip
"""Columns of the vehicle's own."""
