"""How often a policy arrived and collided, from the evaluations that are at hand: the counts behind every
rate of the model card."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uuvtai.config.learning import LearningConfig
from uuvtai.errors import UserError
from uuvtai.files import read_json
from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.loader import ConfigError
from uuvtai.outcomes import COLLIDED
from uuvtai.statistics import wilson_interval
from uuvtai.tables.wording import sensing

RESULT = Path("eval/result.json")
"""what ``uuv eval`` leaves in its run folder"""
_MAX_BYTES = 256 << 20


@dataclass(frozen=True)
class Evaluation:
    """One row of the card's table."""

    where: str
    """world, obstacles, sensing, seeds"""
    episodes: int
    successes: int
    collisions: int
    """contacts, TTC stops and leaving the tank"""
    repeated: bool = False
    """worlds or scenes had episodes of the same numbers, which go together; single ends were not kept"""

    def rates(self) -> tuple[str, str]:
        """Success and collision as k/n with their 95 % Wilson intervals; without where episodes are
        ``repeated``."""
        n, bare = self.episodes, self.repeated
        return _rate(self.successes, n, bare), _rate(self.collisions, n, bare)


def during_training(checkpoint: Checkpoint) -> Evaluation | None:
    """The evaluation by which training chose this checkpoint; None where there was none at this step."""
    metrics, config = checkpoint.manifest.metrics, checkpoint.config
    success, collision = (metrics.get(f"eval/{name}_rate") for name in ("success", "collision"))
    if not isinstance(success, float | int) or not isinstance(collision, float | int):
        return None
    where, n = _held_out_in_worlds(config) if config.twin.enabled else _held_out(config)
    where += f", seed {config.train.evaluate_seed}"
    repeated = config.twin.enabled and len(config.twin.worlds) * max(1, len(config.train.scenes)) > 1
    return Evaluation(where, n, round(success * n), round(collision * n), repeated)


def _held_out(config: LearningConfig) -> tuple[str, int]:
    """(conditions, number of episodes) of a training in its own world."""
    world = config.world
    return (
        f"the training's own world and sensing, S = {world.n_static}, D = {world.n_dynamic}, v = "
        f"{world.dynamic_speed_m_s:g} m/s"
    ), config.train.evaluate_episodes


def _held_out_in_worlds(config: LearningConfig) -> tuple[str, int]:
    """As ``_held_out``, of a policy over a set of bodies: as many of every world and scene."""
    worlds = config.twin.worlds
    groups = len(worlds) * max(1, len(config.train.scenes))
    each = -(-config.train.evaluate_episodes // groups)
    return f"the kinematic twin, {' and '.join(map(_word, worlds))}, {scenes_of(config)}", groups * each


def scenes_of(config: LearningConfig) -> str:
    """Numbers and speeds of the obstacles that were learnt among."""
    scenes = config.train.scenes or (config.world.own_scene,)
    return "; ".join(f"S = {s}, D = {d}, v = {v:g} m/s" for s, d, v in scenes)


def evaluations_of(checkpoint: Checkpoint, folders: Iterable[Path]) -> list[Evaluation]:
    """This checkpoint's rows in the results of ``uuv eval`` below the run folder and in ``folders``.

    Raises ConfigError for one of ``folders`` that does not hold any.
    """
    run = checkpoint.path.parent.parent
    found = [row for file in _own_results(checkpoint) for row in _rows(file, run, checkpoint.sha256)]
    for folder in folders:
        rows = _rows(folder / RESULT, folder, checkpoint.sha256)
        if not rows:
            raise ConfigError(
                f"--evaluation {folder}: does not evaluate this checkpoint; give the run folder that 'uuv "
                "eval RUN' printed"
            )
        found += rows
    return found


def _own_results(checkpoint: Checkpoint) -> list[Path]:
    run = checkpoint.path.parent.parent
    if checkpoint.path.parent.name != "checkpoints":
        return []
    return sorted(file for file in (run / RESULT, *run.glob(f"*/{RESULT}")) if file.is_file())


def _rows(file: Path, folder: Path, sha256: str) -> list[Evaluation]:
    """Rows of the methods that this checkpoint drove. Raises ConfigError for a file below ``folder`` that is
    no result."""
    try:
        result = read_json(file, _MAX_BYTES, folder)
        return [_row(result, m) for m in result["methods"] if m.get("checkpoint", {}).get("sha256") == sha256]
    except (UserError, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"{file}: is no result of uuv eval ({error!r}); give the run folder that 'uuv eval RUN' printed"
        ) from None


def _row(result: dict[str, Any], method: dict[str, Any]) -> Evaluation:
    speed = f", v = {float(result['v_m_s']):g} m/s" if result["D"] else ""
    seeds = ", ".join(str(int(seed)) for seed in result["seeds"])
    where = (
        f"{_word(result['world'])}, S = {int(result['S'])}, D = {int(result['D'])}{speed}, "
        f"{sensing({**result, 'sensors': _word(result['sensors'])})}, seed {seeds}"
    )
    k, n = int(method["outcomes"]["success"]), int(method["episodes"])
    collisions = sum(int(method["outcomes"][name]) for name in COLLIDED)
    if min(k, collisions) < 0 or k + collisions > n:
        raise ValueError(f"{k} successes and {collisions} collisions of {n} episodes")
    return Evaluation(where, n, k, collisions)


def _word(name: Any) -> str:
    """A preset's name or the last part of a path, without what would break a table."""
    return "".join(c for c in Path(str(name)).stem if c.isalnum() or c in "-_ ") or "unnamed"


def _rate(k: int, n: int, bare: bool) -> str:
    bounds = wilson_interval(k, n)
    if bounds is None:
        return "-"
    share = f"{k}/{n} = {100 * k / n:.1f} %"
    return share if bare else f"{share} [{100 * bounds[0]:.1f}, {100 * bounds[1]:.1f}]"
