"""The model card, README.md of an exported policy."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from uuvtai.common.enums import COLLIDED
from uuvtai.common.errors import UserError
from uuvtai.common.files import read_json
from uuvtai.common.statistics import wilson_interval
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import ConfigError
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.report.tables import rate, sensing, text_table

RESULT = Path("eval/result.json")  # what ``uuv eval`` leaves in its run folder
_MAX_BYTES = 256 << 20
_GIVE = "give the run folder that 'uuv eval RUN' printed"


def _row(where: str, n: int, successes: int, collisions: int, together: bool = False) -> list[str]:
    """A row of the card's table; without intervals where groups of episodes share their numbers."""
    counts = successes, collisions
    return [where, *(str(rate(k, n, None if together else wilson_interval(k, n))) for k in counts)]


def _row_of_training(checkpoint: Checkpoint) -> list[list[str]]:
    """The evaluation by which training chose this checkpoint, if there was one."""
    metrics, config = checkpoint.manifest.metrics, checkpoint.config
    success, collision = (metrics.get(f"eval/{name}_rate") for name in ("success", "collision"))
    if not isinstance(success, float | int) or not isinstance(collision, float | int):
        return []
    n, groups = config.train.evaluate_episodes, 1
    if config.surrogate.enabled:  # as many of every world and scene
        groups = len(config.surrogate.worlds) * max(1, len(config.train.scenes))
        n = groups * -(-n // groups)
        worlds = " and ".join(", ".join(map(_word, config.surrogate.worlds)).rsplit(", ", 1))
        where = f"the kinematic surrogate, {worlds}, {_scenes(config)}"
    else:
        where = f"the training's own world and sensing, {_scene(*config.world.own_scene)}"
    where += f", seed {config.train.evaluate_seed} (chose the checkpoint: too good by selection)"
    return [_row(where, n, round(success * n), round(collision * n), groups > 1)]


def _scenes(config: LearningConfig) -> str:
    return "; ".join(_scene(*each) for each in config.train.scenes or (config.world.own_scene,))


def _scene(n_static: int, n_moving: int, speed_m_s: float) -> str:
    return f"S = {n_static}, D = {n_moving}, v = {speed_m_s:g} m/s"


def evaluations_of(checkpoint: Checkpoint, folders: Iterable[Path]) -> list[list[str]]:
    """Rows of this checkpoint, of results in the run folder and in ``folders``, else ConfigError."""
    run, found = checkpoint.path.parent.parent, []
    if checkpoint.path.parent.name == "checkpoints":
        for file in sorted((run / RESULT, *run.glob(f"*/{RESULT}"))):
            found += _rows_of_result(file, run, checkpoint.sha256) if file.is_file() else []
    for folder in folders:
        rows = _rows_of_result(folder / RESULT, folder, checkpoint.sha256)
        if not rows:
            raise ConfigError(f"--evaluation {folder}: does not evaluate this checkpoint; {_GIVE}")
        found += rows
    return found


def _rows_of_result(file: Path, folder: Path, sha256: str) -> list[list[str]]:
    """Rows of the agents that this checkpoint drove. Raises ConfigError for a file that is no result."""
    rows = []
    try:
        result = read_json(file, _MAX_BYTES, folder)
        for agent in result["agents"]:
            if agent.get("checkpoint", {}).get("sha256") != sha256:
                continue
            speed = f", v = {float(result['v_m_s']):g} m/s" if result["D"] else ""
            seeds = ", ".join(str(int(seed)) for seed in result["seeds"])
            where = (
                f"{_word(result['world'])}, S = {int(result['S'])}, D = {int(result['D'])}{speed}, "
                f"{sensing({**result, 'sensors': _word(result['sensors'])})}, seed {seeds}"
            )
            k, n = int(agent["outcomes"]["success"]), int(agent["episodes"])
            collisions = sum(int(agent["outcomes"][name]) for name in COLLIDED)
            if min(k, collisions) < 0 or k + collisions > n:
                raise ValueError(f"{k} successes and {collisions} collisions of {n} episodes")
            rows.append(_row(where, n, k, collisions))
    except (UserError, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file}: is no result of uuv eval ({error!r}); {_GIVE}") from None
    return rows


def _word(name: Any) -> str:
    """A preset's name or the last part of a path, without what would break a table."""
    return "".join(c for c in Path(str(name)).stem if c.isalnum() or c in "-_ ") or "unnamed"


_CARD = """# {name}

{what}
Trained with uuvtai {checkpoint.manifest.version}.

## What it was trained on
- {checkpoint.step} iterations{steps}, seed {config.train.seed}, {config.train.num_envs} vehicles at once.
- Checkpoint {checkpoint.sha256} of {checkpoint.manifest.created}.
- Tank of {extent} m, sonar with {sonar.n_ray} beams to {sonar.max_range_m:g} m, all numbers in the \
checkpoint's config.
- Static obstacles S, moving ones D, their speed v: {scenes}.

## How it did
{results}

## How to run it
`python run_policy.py` (NumPy alone) replays the golden pairs and prints the latency. In a program:
`from run_policy import load`, then `policy = load(folder)`.
{how}
`policy_spec.json` says what every column is, and the sha256 of every file.
`policy.onnx`, if it is there, is one decision for any number of rows; `graph` in the specification names its
inputs.

## What it is for
Research in simulation, and trials on a vehicle in a tank with an operator who can stop it. Columns have to
come from the same stack ({stack}) with the same meaning.

## What it is not for
- It was judged in this simulator alone: not on a real vehicle, in other water, or with other sensors.
- It does not guarantee clearance and does not say when it is in danger. Keep a separate safety stop.
- It expects the vehicle's inner velocity loop with these limits; it never commands thrusters.
"""
_WHAT = {
    "mlp": "A policy that drives an underwater vehicle of the BlueROV2 class from sensor features.",
    "set": "A policy that drives an underwater vehicle by a wish for a velocity, from tracked obstacles.",
}
_HOW = {
    "mlp": """`policy.reset()` when a mission begins, `policy.act(observation)` at every control step
({control_hz:g} Hz). A decision is made every {hold_steps} control step(s); in between the action is kept.""",
    "set": """`said = policy.act(obstacles, own)` {decision_hz:g} times a second, and at every control step
({control_hz:g} Hz) `policy.command(said.wish, flip, yaw_rad, z_m)`, the hull rule. `said.wish` has passed the
safety filter; the graph's `mean_wish` has not (`policy.kept_safe`). The code of both is in `run_policy.py`,
their numbers are `safety` and `hull_rule` of `policy_spec.json`.""",
}
_STACK = {"mlp": "sonar, map, route, tracking{tree}", "set": "tracks, map, route, pose"}
_NONE = "No evaluation was at hand. Evaluate it with `uuv eval RUN`, export again with `--evaluation FOLDER`."
_COUNTED = """

Rates are counts with 95 % Wilson intervals. Collision counts contacts, time-to-collision stops and leaving
the tank."""


def model_card(spec: dict[str, Any], checkpoint: Checkpoint, evaluations: list[list[str]]) -> str:
    """The card as Markdown, with the rows of ``evaluations_of``."""
    kind = spec["kind"]
    config, metrics = checkpoint.config, checkpoint.manifest.metrics
    rows = evaluations + _row_of_training(checkpoint)
    unit = "decisions" if "time/decisions" in metrics else "env-steps"
    steps, tank = metrics.get(f"time/{unit.replace('-', '_')}"), config.world.tank
    return _CARD.format(
        name=spec["name"],
        what=_WHAT[kind],
        checkpoint=checkpoint,
        config=config,
        steps=f", {steps / 1e6:.2f} million {unit}" if isinstance(steps, float) else "",
        extent=" x ".join(f"{high - low:g}" for low, high in (tank.x_m, tank.y_m, tank.z_m)),
        sonar=config.sensors.sonar,
        scenes=_scenes(config),
        results=text_table(("where", "success", "collision"), rows) + _COUNTED if rows else _NONE,
        how=_HOW[kind].format(**spec["rate"]),
        stack=_STACK[kind].format(tree=", behavior tree" if config.observation.behavior else ""),
    )
