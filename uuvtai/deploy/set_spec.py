"""policy_spec.json of policies over a set of bodies and of learned forecasts: every column, the hull rule,
and what the networks are."""

from __future__ import annotations

import math
from typing import Any

from uuvtai.config.learning import LearningConfig
from uuvtai.deploy.golden import TOLERANCE
from uuvtai.deploy.graph import OPSET, ExportedModule
from uuvtai.deploy.run_policy import GOLDEN, SCHEMA, WEIGHTS
from uuvtai.deploy.set_columns_text import BODY_COLUMNS, MEANING, MOTION_MEANING, OWN_COLUMNS
from uuvtai.deploy.set_graph import SET_OUTPUTS, OneWish
from uuvtai.deploy.spec import ONNX, origin_of
from uuvtai.forecast_codes import COLUMNS, N_MODE
from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.mixture_net import TIMES_S
from uuvtai.twin.set_codes import LEAST_SPEED_M_S, N_BODY, TURN_GAIN

_WISH = (
    "ahead, left, up in the mirrored world: the first two in parts of fastest_m_s, shortened to length 1 "
    "where they are longer, the third in parts of the heave limit; held until the next decision"
)


def set_specification(
    checkpoint: Checkpoint, decision: ExportedModule, kind: str, name: str, has_onnx: bool
) -> dict[str, Any]:
    """The document without ``files``, which ``export`` adds."""
    about = _set_parts(checkpoint.config) if isinstance(decision, OneWish) else _forecast_parts()
    graph = {
        "file": ONNX,
        "opset": OPSET,
        "inputs": decision.inputs,
        "outputs": {output: SET_OUTPUTS[output] for output in decision.outputs},
    }
    return {
        "schema": SCHEMA,
        "kind": kind,
        "name": name,
        **origin_of(checkpoint),
        **about,
        "graph": graph if has_onnx else None,
        "golden": {"file": GOLDEN, "tolerance": TOLERANCE},
        "weights": WEIGHTS,
    }


def _set_parts(config: LearningConfig) -> dict[str, Any]:
    columns = {"bodies": {"most": N_BODY, "columns": BODY_COLUMNS}, "own": {"columns": OWN_COLUMNS}}
    dt_s, hold = config.episode.control_dt_s, config.policy.hold_steps
    return {
        "observation": {"meaning": MEANING, **columns},
        "action": {"columns": ["ahead", "left", "up"], "meaning": _WISH},
        "rate": {
            "control_dt_s": dt_s,
            "control_hz": 1.0 / dt_s,
            "hold_steps": hold,
            "decision_hz": 1.0 / dt_s / hold,
        },
        "hull_rule": hull_rule_of(config),
        "network": {"goal_gain": config.twin.goal_gain},
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
        "gap_m": config.twin.vertical_gap_m,
    }


def _forecast_parts() -> dict[str, Any]:
    return {
        "observation": {"columns": {"width": COLUMNS}, "meaning": MOTION_MEANING},
        "network": {"modes": N_MODE, "times_s": [float(time) for time in TIMES_S]},
    }
