"""policy_spec.json: what every column of the inputs is, what an output means, how often to decide, and what
the files hold."""

from __future__ import annotations

import math
from typing import Any

from uuvtai.common.enums import LEAST_SPEED_M_S, N_OBSTACLE, N_RAY, TURN_GAIN
from uuvtai.common.version import __version__
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.export.modules import OPSET, TOLERANCE, ExportedModule, OneAction
from uuvtai.learning.export.run_policy import GOLDEN, SCHEMA, WEIGHTS
from uuvtai.learning.world_model import N_FEATURES

ONNX = "policy.onnx"

_OBSERVATION = (
    "float32, raw SI units, in this order; the scaling is inside the policy. A value that is not finite "
    "counts as the mean of training. Frames: body is the vehicle's (x ahead, y left, z up); level is the "
    "same without roll and pitch; route follows the planned path; world has z up and 0 at the surface."
)
_ACTION = (
    "parts of the limits within [-1, 1]; velocities in the body frame, wanted of the inner velocity loop"
)
_HOLD = (
    "The networks decide at the first control step of a mission and then at every hold_steps-th one. In "
    "between the action is held. It is carried out cut off to [-1, 1]. last_obs and last_action are those of "
    "the last decision."
)
_WISH = (
    "ahead, left, up in the mirrored world: the first two in parts of fastest_m_s, shortened to length 1 "
    "where they are longer, the third in parts of the heave limit; held until the next decision"
)


def specification(
    checkpoint: Checkpoint, module: ExportedModule, name: str, has_onnx: bool
) -> dict[str, Any]:
    """The document without ``files``, which ``export`` adds."""
    graph = {"file": ONNX, "opset": OPSET, "inputs": module.inputs, "outputs": module.outputs}
    is_set = not isinstance(module, OneAction)
    about = _set_parts(checkpoint.config) if is_set else _action_parts(checkpoint, module)
    return {
        "schema": SCHEMA,
        "kind": module.kind,
        "name": name,
        "uuvtai": __version__,
        "checkpoint": {
            "sha256": checkpoint.sha256,
            "step": checkpoint.step,
            "created": checkpoint.manifest.created,
        },
        **about,
        "graph": graph if has_onnx else None,
        "golden": {"file": GOLDEN, "tolerance": TOLERANCE},
        "weights": WEIGHTS,
    }


def _action_parts(checkpoint: Checkpoint, module: OneAction) -> dict[str, Any]:
    policy, world = module.policy, module.world_model
    scales = list(
        zip(policy.observation_norm.mean.tolist(), policy.observation_norm.std().tolist(), strict=True)
    )
    features = zip(("residual", "uncertainty"), scales[-N_FEATURES:], strict=True)
    return {
        "observation": {
            "width": policy.n_in - N_FEATURES,
            "meaning": _OBSERVATION,
            "columns": _columns(checkpoint, scales),
        },
        "features": [
            {"name": name, "unit": "1", "mean": mean, "std": std, "used": world is not None}
            for name, (mean, std) in features
        ],
        "action": checkpoint.manifest.action,
        "action_meaning": _ACTION,
        "rate": _rate(checkpoint.config) | {"meaning": _HOLD},
        "network": {"hidden": list(policy.config.hidden), "activation": policy.config.activation},
    }


def _columns(checkpoint: Checkpoint, scales: list[tuple[float, float]]) -> list[dict[str, Any]]:
    """Every single column with its place, name, unit, frame and what it is scaled by."""
    found = []
    for row in checkpoint.manifest.observation_table:
        first, stop = row["first"], row["stop"]
        for at in range(first, stop):
            name = row["name"] if stop - first == 1 else f"{row['name']}[{at - first}]"
            about = {"index": at, "name": name, "unit": row["unit"], "frame": row["frame"]}
            found.append(about | {"mean": scales[at][0], "std": scales[at][1]})
    return found


def _rate(config: LearningConfig) -> dict[str, Any]:
    dt_s, hold = config.episode.control_dt_s, config.policy.hold_steps
    hertz = 1.0 / dt_s
    return {"control_dt_s": dt_s, "control_hz": hertz, "hold_steps": hold, "decision_hz": hertz / hold}


def _set_parts(config: LearningConfig) -> dict[str, Any]:
    return {
        "observation": {
            "meaning": MEANING,
            "obstacles": {"most": N_OBSTACLE, "columns": OBSTACLE_COLUMNS},
            "own": {"columns": OWN_COLUMNS},
        },
        "action": {"columns": ["ahead", "left", "up"], "meaning": _WISH},
        "rate": _rate(config),
        "hull_rule": hull_rule_of(config),
        "network": {"goal_gain": config.surrogate.goal_gain},
    }


def hull_rule_of(config: LearningConfig) -> dict[str, Any]:
    """Numbers of the rule that lays a wish on the hull, as the card's README tells it."""
    vehicle = config.vehicle
    limits = {"surge": vehicle.max_surge_m_s, "sway": vehicle.max_sway_m_s, "heave": vehicle.max_heave_m_s}
    return {
        "fastest_m_s": math.hypot(vehicle.max_surge_m_s, vehicle.max_sway_m_s),
        "limits_m_s": limits,
        "max_yaw_rate_rad_s": vehicle.max_yaw_rate_rad_s,
        "turn_gain_1_s": TURN_GAIN,
        "least_speed_m_s": LEAST_SPEED_M_S,
        "z_m": list(config.world.tank.z_m),
        "gap_m": config.surrogate.vertical_gap_m,
    }


# ------------------------------------------------------------------------------------------------------------
# What every column of a policy over a set of obstacles is, in words (``surrogate/observation.py`` writes
# them).


MEANING = (
    "float32. Mirrored world: x is turned round where the goal lies at smaller x than the start, y "
    "where it lies at smaller y (flip is -1 there, else 1), so that the goal lies ahead and to the left "
    "at the start; flips do not change during a mission. Each column is the quantity in its unit, "
    "computed as its meaning says. clip(v, a, b) cuts off to [a, b]. An obstacle is a tracked moving "
    "obstacle; "
    "one row each, at most the nearest ones; a row of zeros is no obstacle. Numbers that are not finite are "
    "refused."
)


def _column(name: str, unit: str, meaning: str) -> dict[str, str]:
    return {"name": name, "unit": unit, "meaning": meaning}


def _pair(name: str, unit: str, meaning: str) -> list[dict[str, str]]:
    return [_column(f"{name}.{axis}", unit, meaning) for axis in "xy"]


OBSTACLE_COLUMNS = [
    _column("there", "1", "1 = an obstacle"),
    *_pair("way", "4 m", "from the vehicle to the obstacle, in metres, / 4"),
    *_pair("relative_velocity", "m/s", "the obstacle's less the vehicle's"),
    *_pair("velocity", "m/s", "of the obstacle"),
    _column("width", "m", "twice its radius"),
    _column(
        "water_above", "m", "from the vehicle's depth up to the obstacle's top, where known: clip(v, 0, 1.6)"
    ),
    _column(
        "water_below",
        "m",
        "from the obstacle's bottom up to the vehicle's depth, where known: clip(v, 0, 1.6)",
    ),
    _column("unseen", "2 s", "seconds since it was seen, at most 4, / 2"),
    _column(
        "turn", "2 rad/s", "rate of its course, mirrored by flip.x flip.y, clip(v, -3, 3) / 2; 0 = a corner"
    ),
    *_pair("way_in_1s", "4 m", "from the vehicle now to where the obstacle is forecast in 1 s, / 4"),
    *_pair("way_in_2s", "4 m", "the same in 2 s"),
    _column("gap", "4 m", "distance less the obstacle's radius, at most 8 m, / 4"),
    _column("nearness", "1/m", "1 / (0.3 + max(distance - radius - 0.22, 0))"),
    _column("closest_in", "s", "time of the closest approach on straight lines, clip(v, 0, 3)"),
    _column("closest_gap", "m", "distance then, less radius and 0.22, clip(v, -1, 3)"),
    *_pair("route_direction", "1", "unit vector to the look-ahead point of the route"),
]
"""Columns of an obstacle."""
OWN_COLUMNS = [
    _column("goal.x", "10 m", "from the vehicle to the goal, / 10"),
    _column("goal.y", "4 m", "the same, / 4"),
    _column("goal.z", "m", "height of the goal above the vehicle"),
    *_pair("route_direction", "1", "unit vector to the look-ahead point, or to the goal"),
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
    *_pair("goal_direction", "1", "unit vector to the goal"),
    _column("route_distance", "m", "horizontal, to the look-ahead point, at most 2 m"),
    _column("route_left", "10 m", "length of the route to the goal, / 10"),
    _column("route_aside", "m", "place left of the route, times flip.x flip.y, clip(v, -2, 2)"),
    *[
        _column(f"ray[{i}]", "1/m", "1 / (0.3 + clip(free - 0.22, 0, 4)) - 0.5, free metres to the nearest "
                f"wall or occupied cell (at most 4.3) at {360 * i / N_RAY:g} degrees from x towards y")
        for i in range(N_RAY)
    ],
]  # fmt: skip
"""Columns of the vehicle's own."""
