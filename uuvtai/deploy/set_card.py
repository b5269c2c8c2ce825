"""README.md of an exported policy over a set of bodies or of a learned forecast: how a stranger drives by it,
what it learnt from, how it did, and what it is not for."""

from __future__ import annotations

from typing import Any

from uuvtai.deploy.card import results_text, training_text
from uuvtai.deploy.evaluations import Evaluation
from uuvtai.learn.checkpoint import Checkpoint

_CARD = """# {name}

{what}
Trained with uuvtai {version}.

## What it was trained on
{training}

## How it did
{results}

## How to run it
`python run_set_policy.py` (NumPy alone) replays the golden pairs and prints the latency.
{how}
`policy_spec.json` says what every column is.{graph}

{rule}## What it is not for
- It has been judged in this simulator alone. Nothing here says how it does on a real vehicle, in other water,
  or with other sensors.
{limits}
"""
_SET = (
    "A policy that drives an underwater vehicle by a wish for a velocity, from tracked bodies and free "
    "distances."
)
_FORECAST = "A forecast of tracked moving bodies: a mixture of Gaussians over the places in the next seconds."
_HOW_SET = """In a program: `from run_set_policy import load`, `policy = load(folder)`, then {rate:g} times a
second `said = policy.act(bodies, own)`, and at every control step ({control_hz:g} Hz)
`policy.command(said.wish, flip, yaw_rad, z_m)`. It remembers nothing; the last wish that was carried out is
among the columns."""
_HOW_FORECAST = """In a program: `from run_set_policy import load`, `forecast = load(folder)`, then
`forecast.futures(columns, speed)` for each track: `log_weight` of each future, `place` [m] along and
across the track's course after {times} s, and `sigma` [m]."""
_GRAPH = " `policy.onnx` is the same for any number of rows."
_RULE = """## The hull rule
A wish (x, y, up) becomes a command at every control step, by the heading and the height of that moment;
numbers are `hull_rule` of `policy_spec.json`, and `command` in `run_set_policy.py` is this rule.

1. Velocity wanted in the world: (flip.x x, flip.y y) times {fastest_m_s:.3f} m/s, shortened to that
   length where (x, y) is longer than 1; upward `up`, within +-1, times {heave:g} m/s. A flip is -1
   where the goal lies at a smaller coordinate than the start, else 1.
2. In the body frame (turned by the heading) the two become parts of {surge:g} m/s surge and {sway:g}
   m/s sway. Where one is beyond 1 both are divided by the larger one.
3. Heave: the upward velocity is at most what leads to {gap_m:g} m below the surface in one second, and
   at least what leads to {gap_m:g} m above the floor in one second; then in parts of {heave:g} m/s,
   within +-1. Height 0 is the surface, the floor lies at {floor:g} m.
4. Yaw rate: the nearest diagonal of the hull (45, 135, 225 or 315 degrees) turns to the motion, for
   there surge and sway add up: the angle times {turn_gain_1_s:g} 1/s, in parts of
   {max_yaw_rate_rad_s:g} rad/s, within +-1. Slower than {least_speed_m_s:g} m/s the heading stays.

"""
_LIMITS = """- It does not guarantee clearance. Keep a separate safety stop.
- Columns have to come from the same stack (tracks, map, pose) with the same meaning.
- It expects the vehicle's inner velocity loop with these limits; it never commands thrusters."""
_LIMITS_FORECAST = """- Its probabilities are those of bodies as they move in this simulator.
- Columns have to come from the same tracker with the same meaning."""


def set_card(spec: dict[str, Any], checkpoint: Checkpoint, evaluations: list[Evaluation]) -> str:
    """The card as Markdown."""
    kind = spec["kind"]
    parts = _forecast_parts(spec, checkpoint) if kind == "forecast" else _set_parts(spec)
    results = {"results": results_text(checkpoint, evaluations)} | parts
    return _CARD.format(
        name=spec["name"],
        version=checkpoint.manifest.version,
        training=training_text(checkpoint),
        graph=_GRAPH if spec["graph"] else "",
        **results,
    )


def _set_parts(spec: dict[str, Any]) -> dict[str, str]:
    rate = spec["rate"]
    return {
        "what": _SET,
        "how": _HOW_SET.format(rate=rate["decision_hz"], control_hz=rate["control_hz"]),
        "rule": _rule(spec["hull_rule"]),
        "limits": _LIMITS,
    }


def _rule(rule: dict[str, Any]) -> str:
    return _RULE.format(**rule, **rule["limits_m_s"], floor=rule["z_m"][0])


def _forecast_parts(spec: dict[str, Any], checkpoint: Checkpoint) -> dict[str, str]:
    rows = [
        f"- {name.removeprefix('eval/')}: {value:.3g}"
        for name, value in sorted(checkpoint.manifest.metrics.items())
        if name.startswith("eval/") and isinstance(value, float)
    ]
    times = ", ".join(f"{time:g}" for time in spec["network"]["times_s"])
    return {
        "what": _FORECAST,
        "how": _HOW_FORECAST.format(times=times),
        "rule": "",
        "limits": _LIMITS_FORECAST,
        "results": "\n".join(["On held-out episodes of the training's worlds:", *rows])
        if rows
        else "No evaluation was at hand.",
    }
