"""The model card, README.md of an exported policy: what it was trained on, how it did, what it is for and
what it is not for."""

from __future__ import annotations

from typing import Any

from uuvtai.config.learning import LearningConfig
from uuvtai.deploy.evaluations import Evaluation, during_training, scenes_of
from uuvtai.learn.checkpoint import Checkpoint

_TEXT = """# {name}

A policy that drives an underwater vehicle of the BlueROV2 class from sensor features, trained in the
simulator of uuvtai {version}.

## What it was trained on
{training}

## How it did
{results}

## How to run it
`python run_policy.py` (NumPy alone) replays the golden pairs and prints the latency. In a program:
`load(folder)`, `reset()` when a mission begins, `act(observation)` at every control step ({control_hz:g} Hz).
A decision is made every {hold_steps} control step(s);
{residual} `policy_spec.json` lists every column of the observation
with unit, frame and scaling, the limits of the actions, the rate and the sha256 of every file.{graph}

## What it is for
Research in simulation, and trials on a vehicle in a tank with an operator who can stop it. The observation
has to come from the same stack (sonar, map, route, tracking{tree}) with the same meaning; a column that
means something else makes the policy worthless.

## What it is not for
- It has been judged in this simulator alone. Nothing here says how it does on a real vehicle, in other water,
  or with other sensors.
- It does not guarantee clearance and does not say when it is in danger. Keep a separate safety stop.
- It expects the vehicle's inner velocity loop with the limits of `policy_spec.json`; it never commands
  thrusters.
"""

_COUNTED = """
Rates are counts with 95 % Wilson intervals. Collision counts contacts, time-to-collision stops and leaving
the tank."""
_RESIDUAL = (
    "it adds to the behaviour tree's action, which is part of the observation, so the tree has to "
    "run beside it."
)
_PLAIN = "in between the action is kept."
_GRAPH = """

`policy.onnx` is one decision without memory: remember the last decision yourself, as `graph`
in the specification says."""


def model_card(spec: dict[str, Any], checkpoint: Checkpoint, evaluations: list[Evaluation]) -> str:
    """The card as Markdown."""
    is_residual = spec["network"]["teacher_columns"] is not None
    return _TEXT.format(
        name=spec["name"],
        version=checkpoint.manifest.version,
        training=training_text(checkpoint),
        results=results_text(checkpoint, evaluations),
        control_hz=spec["rate"]["control_hz"],
        hold_steps=spec["rate"]["hold_steps"],
        residual=_RESIDUAL if is_residual else _PLAIN,
        tree=", behaviour tree" if checkpoint.config.features.teacher else "",
        graph=_GRAPH if spec["graph"] else "",
    )


def training_text(checkpoint: Checkpoint) -> str:
    """How long, on what, and which checkpoint, as a list."""
    config, metrics = checkpoint.config, checkpoint.manifest.metrics
    steps = metrics.get("time/env_steps")
    trained = f"{checkpoint.step} iterations" + (
        f", {steps / 1e6:.2f} million env-steps" if isinstance(steps, float) else ""
    )
    lines = [
        f"{trained}, seed {config.train.seed}, {config.train.num_envs} vehicles at once.",
        f"Checkpoint {checkpoint.sha256} of {checkpoint.manifest.created}.",
        _tank(config),
        _obstacles(config),
    ]
    return "\n".join(f"- {line}" for line in lines)


def _tank(config: LearningConfig) -> str:
    tank, sonar = config.world.tank, config.sensors.sonar
    extent = " x ".join(f"{high - low:g}" for low, high in (tank.x_m, tank.y_m, tank.z_m))
    return (
        f"Tank of {extent} m, sonar with {sonar.n_ray} beams to {sonar.max_range_m:g} m, all numbers in "
        "the checkpoint's config."
    )


def _obstacles(config: LearningConfig) -> str:
    return f"Resting obstacles S, moving ones D, their speed v: {scenes_of(config)}."


def results_text(checkpoint: Checkpoint, evaluations: list[Evaluation]) -> str:
    """Counts of all evaluations as a table, and what they count."""
    own = during_training(checkpoint)
    rows = [(row, "") for row in evaluations] + (
        [(own, " (chose the checkpoint: too good by selection)")] if own else []
    )
    if not rows:
        return (
            "No evaluation was at hand. Evaluate it with `uuv eval RUN` and export again with "
            "`--evaluation FOLDER`."
        )
    lines = ["| where | success | collision |", "|---|---|---|"]
    lines += ["| " + " | ".join((row.where + remark, *row.rates())) + " |" for row, remark in rows]
    return "\n".join([*lines, _COUNTED])
