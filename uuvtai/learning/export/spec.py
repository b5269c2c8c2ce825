"""policy_spec.json: what every column of the inputs is, what an output means, how often to decide, and what
the files hold."""

from __future__ import annotations

import math
from typing import Any

from uuvtai.common.enums import LEAST_SPEED_M_S, N_OBSTACLE, N_RAY, TURN_GAIN
from uuvtai.common.version import __version__
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.export.modules import OPSET, ExportedModule, OneAction
from uuvtai.learning.export.run_policy import GOLDEN, SCHEMA, TOLERANCE, WEIGHTS
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
    config = checkpoint.config
    dt_s, hold = config.episode.control_dt_s, config.policy.hold_steps
    rate = {"control_dt_s": dt_s, "control_hz": 1 / dt_s, "hold_steps": hold, "decision_hz": 1 / dt_s / hold}
    if isinstance(module, OneAction):
        about = _action_parts(checkpoint, module) | {"rate": rate | {"meaning": _HOLD}}
    else:
        about = _wish_parts(config) | {"rate": rate}
    graph = {"file": ONNX, "opset": OPSET, "inputs": module.inputs, "outputs": module.outputs}
    made = checkpoint.manifest.created
    return {
        "schema": SCHEMA,
        "kind": module.kind,
        "name": name,
        "uuvtai": __version__,
        "checkpoint": {"sha256": checkpoint.sha256, "step": checkpoint.step, "created": made},
        **about,
        "graph": graph if has_onnx else None,
        "golden": {"file": GOLDEN, "tolerance": TOLERANCE},
        "weights": WEIGHTS,
    }


def _action_parts(checkpoint: Checkpoint, module: OneAction) -> dict[str, Any]:
    """Every single column with its place, name, unit, frame and what it is scaled by."""
    policy = module.policy
    norm = policy.observation_norm
    pairs = zip(norm.mean.tolist(), norm.std().tolist(), strict=True)
    scales = [{"mean": mean, "std": std} for mean, std in pairs]
    columns = []
    for row in checkpoint.manifest.observation_table:
        first, stop = row["first"], row["stop"]
        for at in range(first, stop):
            name = row["name"] if stop - first == 1 else f"{row['name']}[{at - first}]"
            about = {"index": at, "name": name, "unit": row["unit"], "frame": row["frame"]}
            columns.append(about | scales[at])
    used = {"unit": "1", "used": module.world_model is not None}
    features = zip(("residual", "uncertainty"), scales[-N_FEATURES:], strict=True)
    return {
        "observation": {"width": policy.n_in - N_FEATURES, "meaning": _OBSERVATION, "columns": columns},
        "features": [{"name": name, **used, **scale} for name, scale in features],
        "action": checkpoint.manifest.action,
        "action_meaning": _ACTION,
        "network": {"hidden": list(policy.config.hidden), "activation": policy.config.activation},
    }


def _wish_parts(config: LearningConfig) -> dict[str, Any]:
    return {
        "observation": {
            "meaning": MEANING,
            "obstacles": {"most": N_OBSTACLE, "columns": OBSTACLE_COLUMNS},
            "own": {"columns": OWN_COLUMNS},
        },
        "action": {"columns": ["ahead", "left", "up"], "meaning": _WISH},
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
    "obstacle; one row each, at most the nearest ones; a row of zeros is no obstacle. Numbers that are not "
    "finite are refused."
)


def _columns(table: str) -> list[dict[str, str]]:
    """Rows of "names | unit | meaning"."""
    rows = [line.split(" | ") for line in table.strip().splitlines()]
    return [
        {"name": name, "unit": unit, "meaning": meaning}
        for names, unit, meaning in rows
        for name in names.split()
    ]


OBSTACLE_COLUMNS = _columns("""
there | 1 | 1 = an obstacle
way.x way.y | 4 m | from the vehicle to the obstacle, in metres, / 4
relative_velocity.x relative_velocity.y | m/s | the obstacle's less the vehicle's
velocity.x velocity.y | m/s | of the obstacle
width | m | twice its radius
water_above | m | from the vehicle's depth up to the obstacle's top, where known: clip(v, 0, 1.6)
water_below | m | from the obstacle's bottom up to the vehicle's depth, where known: clip(v, 0, 1.6)
unseen | 2 s | seconds since it was seen, at most 4, / 2
turn | 2 rad/s | rate of its course, mirrored by flip.x flip.y, clip(v, -3, 3) / 2; 0 = a corner
way_in_1s.x way_in_1s.y | 4 m | from the vehicle now to where the obstacle is forecast in 1 s, / 4
way_in_2s.x way_in_2s.y | 4 m | the same in 2 s
gap | 4 m | distance less the obstacle's radius, at most 8 m, / 4
nearness | 1/m | 1 / (0.3 + max(distance - radius - 0.22, 0))
closest_in | s | time of the closest approach on straight lines, clip(v, 0, 3)
closest_gap | m | distance then, less radius and 0.22, clip(v, -1, 3)
route_direction.x route_direction.y | 1 | unit vector to the look-ahead point of the route
""")
"""Columns of an obstacle."""
OWN_COLUMNS = _columns("""
goal.x | 10 m | from the vehicle to the goal, / 10
goal.y | 4 m | the same, / 4
goal.z | m | height of the goal above the vehicle
route_direction.x route_direction.y | 1 | unit vector to the look-ahead point, or to the goal
goal_distance | 4 m | horizontal, at most 4 m, / 4
speed.x speed.y | m/s | of the vehicle
heave | 0.5 m/s | upward velocity in the body frame, x 2
height | m | z + 0.8, z = 0 at the surface
last_wish.x last_wish.y last_wish.z | 1 | carried out last: x and y shortened to length 1, \
z within +-1; 0 at the start
cos_4_yaw | 1 | cosine of four times the heading
sin_4_yaw | 1 | its sine, times flip.x flip.y
across | 3 m | flip.y (y - 3) / 3, y in the tank
along | 10 m | flip.x (x - 10) / 10, x in the tank
goal_direction.x goal_direction.y | 1 | unit vector to the goal
route_distance | m | horizontal, to the look-ahead point, at most 2 m
route_left | 10 m | length of the route to the goal, / 10
route_aside | m | place left of the route, times flip.x flip.y, clip(v, -2, 2)
""") + [
    {
        "name": f"ray[{i}]",
        "unit": "1/m",
        "meaning": "1 / (0.3 + clip(free - 0.22, 0, 4)) - 0.5, free metres to the nearest wall or occupied "
        f"cell (at most 4.3) at {360 * i / N_RAY:g} degrees from x towards y",
    }
    for i in range(N_RAY)
]
"""Columns of the vehicle's own."""
