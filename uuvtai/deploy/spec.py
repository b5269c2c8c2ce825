"""policy_spec.json: what every column of the observation is, what an action means, how often to decide, and
what the files hold."""

from __future__ import annotations

from typing import Any

from uuvtai.deploy.golden import TOLERANCE
from uuvtai.deploy.graph import INPUTS, OPSET, OUTPUTS, OneDecision
from uuvtai.deploy.run_policy import GOLDEN, SCHEMA, WEIGHTS
from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.pilot import Pilot
from uuvtai.learn.world_model import N_FEATURES
from uuvtai.version import __version__

ONNX = "policy.onnx"

_OBSERVATION = (
    "float32, raw SI units, in this order; the scaling is inside the policy. A value that is not finite "
    "counts as the mean of training. Frames: body is the vehicle's (x ahead, y left, z up); level is the "
    "same without roll and pitch; route follows the planned path; world has z up and 0 at the surface."
)
_HOLD = (
    "The networks decide at the first control step of a mission and then at every hold_steps-th one. In "
    "between the decision is held: the action itself, or, for a residual policy, its difference from the "
    "tree's action, which is added to the newest tree action in the observation. The result is cut off to "
    "[-1, 1]. last_obs and last_action are those of the last decision."
)


def origin_of(checkpoint: Checkpoint) -> dict[str, Any]:
    """What the folder came from: part of the document."""
    return {
        "uuvtai": __version__,
        "checkpoint": {
            "sha256": checkpoint.sha256,
            "step": checkpoint.step,
            "created": checkpoint.manifest.created,
        },
    }


def specification(checkpoint: Checkpoint, pilot: Pilot, name: str, has_onnx: bool) -> dict[str, Any]:
    """The document without ``files``, which ``export`` adds."""
    config, policy = checkpoint.config, pilot.policy
    return {
        "schema": SCHEMA,
        "name": name,
        **origin_of(checkpoint),
        "observation": {
            "width": policy.n_in - N_FEATURES,
            "meaning": _OBSERVATION,
            "columns": _columns(checkpoint, pilot),
        },
        "features": _features(pilot),
        "action": checkpoint.manifest.action,
        "action_meaning": "parts of the limits within [-1, 1]; velocities in the body frame, wanted of the "
        "inner velocity loop",
        "rate": _rate(config.episode.control_dt_s, policy.config.hold_steps),
        "network": _network(pilot),
        "graph": _graph(pilot) if has_onnx else None,
        "golden": {"file": GOLDEN, "tolerance": TOLERANCE},
        "weights": WEIGHTS,
    }


def _columns(checkpoint: Checkpoint, pilot: Pilot) -> list[dict[str, Any]]:
    """Every single column with its place, name, unit, frame and what it is scaled by."""
    norm = pilot.policy.observation_norm
    mean, std = norm.mean.tolist(), norm.std().tolist()
    found = []
    for row in checkpoint.manifest.observation_table:
        width = row["stop"] - row["first"]
        for i in range(width):
            at = row["first"] + i
            name = row["name"] if width == 1 else f"{row['name']}[{i}]"
            found.append(
                {
                    "index": at,
                    "name": name,
                    "unit": row["unit"],
                    "frame": row["frame"],
                    "mean": mean[at],
                    "std": std[at],
                }
            )
    return found


def _features(pilot: Pilot) -> list[dict[str, Any]]:
    """The two inputs that the policy makes itself."""
    norm = pilot.policy.observation_norm
    names = ("residual", "uncertainty")
    rows = zip(names, norm.mean[-N_FEATURES:].tolist(), norm.std()[-N_FEATURES:].tolist(), strict=True)
    return [
        {"name": name, "unit": "1", "mean": mean, "std": std, "used": pilot.world_model is not None}
        for name, mean, std in rows
    ]


def _rate(control_dt_s: float, hold_steps: int) -> dict[str, Any]:
    hertz = 1.0 / control_dt_s
    return {
        "control_dt_s": control_dt_s,
        "control_hz": hertz,
        "hold_steps": hold_steps,
        "decision_hz": hertz / hold_steps,
        "meaning": _HOLD,
    }


def _network(pilot: Pilot) -> dict[str, Any]:
    """What ``run_policy.py`` has to know beside the arrays."""
    config, teacher = pilot.policy.config, pilot.policy.teacher_slice
    return {
        "hidden": list(config.hidden),
        "activation": config.activation,
        "residual_limit": config.residual_limit,
        "teacher_columns": [teacher.start, teacher.stop] if config.residual and teacher else None,
        "predict_change": pilot.world_model is None or pilot.world_model.config.predict_change,
        "clip_observation": config.clip_observation,
    }


def _graph(pilot: Pilot) -> dict[str, Any]:
    names = OneDecision(pilot).outputs
    return {
        "file": ONNX,
        "opset": OPSET,
        "inputs": INPUTS,
        "outputs": {name: OUTPUTS[name] for name in names},
    }
