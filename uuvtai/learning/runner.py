"""``uuv train``: a run folder, iterations one after the other, checkpoints and evaluations in between, and
how it all ends."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Union

from uuvtai.common import signals
from uuvtai.common.files import FileError, open_to_append, parsed_json, read_lines, truncate
from uuvtai.common.presets import TRAINING_TREE
from uuvtai.common.statistics import wilson_interval
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import ConfigError, Overrides, load_resolved, to_yaml
from uuvtai.logs.run_folder import RunFolder, default_run_dir, refuse_place

if TYPE_CHECKING:
    from uuvtai.envs.vector_env import VectorEnv
    from uuvtai.learning.checkpoint import Checkpoint
    from uuvtai.learning.forecast import ForecastTrainer
    from uuvtai.learning.parameter_search import ParameterSearchTrainer
    from uuvtai.learning.trainer import Trainer
    from uuvtai.sim.scene import SceneOptions


Metrics = dict[str, float]

CONFIG = "config.yaml"
"""of a run folder"""
SCORE = "eval/success_rate"
"""metric by which a checkpoint is the best"""


@dataclass(frozen=True)
class TrainRequest:
    """What ``uuv train`` was asked for: a new run with ``config``, or to go on with the run folder
    ``resume``."""

    config: LearningConfig | None = None
    preset: str = "run"
    """what a new run's folder is named after"""
    start: Path | None = None
    """run or checkpoint with whose policy a new run begins"""
    resume: Path | None = None
    overrides: Overrides | None = None
    """changes of the resumed run's config"""
    iterations: int | None = None
    """stop when so many are done in all; None = ``train.iterations``, over which the schedules run in any
    case"""
    device: str = "auto"
    run_dir: Path | None = None

    @classmethod
    def typed(cls, scene: SceneOptions, preset: str, seed: int | None, **rest: Any) -> TrainRequest:
        """What a command line asks of a new run, with the scene as it was typed. Raises ConfigError."""
        given = [] if seed is None else [("train.seed", seed)]
        return cls(config=scene.training(preset, given), preset=preset, **rest)


class TrainWatch(Protocol):
    """Shows how far a training is."""

    def start(self, folder: Path, config: LearningConfig, done: int, total: int) -> None: ...
    def note(self, text: str) -> None: ...
    def update(self, done: int, metrics: Metrics, success_ci95: tuple[float, float] | None) -> None: ...
    def stop(self) -> None: ...


AnyTrainer = Union["Trainer", "ParameterSearchTrainer", "ForecastTrainer"]
Evaluate = Callable[[AnyTrainer, LearningConfig], Metrics]
"""``eval/*`` of the policy as it is; training goes on as if nothing had been
(``evaluation.evaluate.evaluate_now``, which knows what learning does not)"""


def train(request: TrainRequest, watch: TrainWatch, evaluate: Evaluate) -> tuple[dict[str, Any], Path]:
    """Train or go on training; what ``uuv train --json`` prints, and the run folder. Every
    ``train.evaluate_every`` iterations ``evaluate`` is asked.

    Everything that can be refused is refused before anything is written. An interrupt (SIGINT, SIGTERM) lets
    the iteration end, saves and raises KeyboardInterrupt; a second one ends at once. Raises ConfigError,
    ValueError, MemoryError, RunFolderError, CheckpointError, TrainingError.
    """
    if request.iterations is not None and request.iterations < 1:
        raise ConfigError(f"--iterations {request.iterations}: at least 1, for example --iterations 100")
    if request.resume is None:
        refuse_place(request.run_dir)
        return _train(request, None, watch, evaluate)
    _refuse_no_run(request.resume)
    held = RunFolder.held(
        request.resume, "uuv train"
    )  # before anything is read: what another process writes meanwhile must not count
    try:
        return _train(request, held, watch, evaluate)
    finally:
        held.release()


def _train(
    request: TrainRequest, folder: RunFolder | None, watch: TrainWatch, evaluate: Evaluate
) -> tuple[dict[str, Any], Path]:
    """As ``train``; ``folder`` is the folder of the run to go on with."""
    found, config = _begin(request, watch)
    start, config = _started(request.start, config, watch.note)
    total = request.iterations or config.train.iterations
    if found and found.step >= total:
        if folder:
            folder.settle(found.step >= config.train.iterations)
        raise ConfigError(
            f"{request.resume}: has done {found.step} of {total} iterations; to go on give more: "
            f"--iterations {2 * found.step}"
        )
    watch.note(
        f"starting {config.train.num_envs} envs (sizes not used before compile their kernels first, about "
        "half a minute)"
    )
    trainer = _continued(TRAINERS[config.learner](config, request.device), config, found)
    trainer.note = watch.note
    if start is not None:
        start.check_table(trainer.observation_table, config)
        trainer.start(start)  # type: ignore[union-attr]
    place = _folder(request, config, found, folder)
    run = _Run(trainer, config, place, watch, evaluate, total)
    status, code = "failed", 1
    try:
        with signals.StopEvent() as pressed:
            is_complete = run.go(pressed)
        status, code = ("finished", 0) if is_complete else ("interrupted", signals.exit_code())
    except KeyboardInterrupt:
        status, code = "interrupted", signals.exit_code()
        raise
    finally:
        run.close()
        place.finish(status, code)
    if code:
        raise KeyboardInterrupt
    return run.document(), place.path


def _begin(request: TrainRequest, watch: TrainWatch) -> tuple[Checkpoint | None, LearningConfig]:
    """The checkpoint to go on from, None for a new run, and the config."""
    from uuvtai.learning import checkpoint

    if request.resume is None:
        assert request.config is not None
        return None, request.config
    config = load_resolved(request.resume / CONFIG, request.overrides)
    if not isinstance(config, LearningConfig):
        raise ConfigError(f"{request.resume}: is no training run; give the folder that 'uuv train' printed")
    return checkpoint.newest(request.resume, watch.note, resumable=True), config


def _started(
    place: Path | None, config: LearningConfig, note: Callable[[str], None]
) -> tuple[Checkpoint | None, LearningConfig]:
    """The checkpoint to begin with (``find_policy``), and the config with its networks. Raises ConfigError
    for one that holds no policy."""
    from uuvtai.learning.agents import find_policy

    if place is None:
        return None, config
    found = find_policy(str(place), note)
    if config.learner != "ppo" or found.config.learner != "ppo":
        raise ConfigError(f"--start {place}: policies alone can be begun with, by a preset that trains one")
    theirs, sizes = found.config, ("obstacle_hidden", "head_hidden", "goal_gain")
    own = {name: getattr(theirs.policy, name) for name in ("hidden", "activation")}
    update = {
        "policy": config.policy.model_copy(update=own | {"encoder": theirs.encoder}),
        "surrogate": config.surrogate.model_copy(update={n: getattr(theirs.surrogate, n) for n in sizes}),
        "observation": theirs.observation,
    }
    return found, config.model_copy(update=update)


def _refuse_no_run(place: Path) -> None:
    if not (place / CONFIG).is_file():
        raise ConfigError(
            f"{place}: is no run folder, it has no {CONFIG}; give the folder that 'uuv train' printed"
        )


def _ppo(config: LearningConfig, device: str) -> AnyTrainer:
    """A policy, in the simulator or in its surrogate."""
    from uuvtai.learning.environments import InSurrogate, Simulated, SimulatedSet
    from uuvtai.learning.trainer import Trainer

    if config.surrogate.enabled:
        _refuse_gpu("surrogate", device)
        return Trainer(InSurrogate(config), config)
    kind = SimulatedSet if config.encoder == "set" else Simulated
    return Trainer(kind(_env(config, device), config), config)


def _env(config: LearningConfig, device: str) -> VectorEnv:
    from uuvtai.envs.vector_env import VectorEnv
    from uuvtai.sim.behavior_tree import read_tree
    from uuvtai.sim.sim import Sim

    sim = Sim(config, config.train.num_envs, read_tree(TRAINING_TREE, config.behavior.max_node), device)
    sim.set_scenes(config.train.scenes)
    return VectorEnv(sim, config.train.seed, autoreset=config.encoder != "set")


def _search(config: LearningConfig, device: str) -> AnyTrainer:
    """Numbers of the tree."""
    from uuvtai.learning.parameter_search import ParameterSearchTrainer

    _refuse_gpu("parameter_search", device)
    return ParameterSearchTrainer(config)


def _forecast(config: LearningConfig, device: str) -> AnyTrainer:
    """What moving obstacles will do."""
    from uuvtai.learning.forecast import ForecastTrainer

    _refuse_gpu("forecast_training", device)
    return ForecastTrainer(config)


def _refuse_gpu(section: str, device: str) -> None:
    if device == "cuda":
        raise ConfigError(f"{section}.enabled: it learns on the CPU; leave out --device cuda")


TRAINERS: dict[str, Callable[[LearningConfig, str], AnyTrainer]] = {
    "ppo": _ppo,
    "search": _search,
    "forecast": _forecast,
}
"""by ``LearningConfig.learner``"""


def _continued(trainer: AnyTrainer, config: LearningConfig, checkpoint: Checkpoint | None) -> AnyTrainer:
    """A trainer that stands where the checkpoint does, or at the beginning where there is none."""
    if checkpoint:
        checkpoint.check_table(trainer.observation_table, config)
        trainer.load_state(checkpoint.state(like=trainer.state()))
    return trainer


def _folder(
    request: TrainRequest, config: LearningConfig, checkpoint: Checkpoint | None, folder: RunFolder | None
) -> RunFolder:
    if folder is None or checkpoint is None:
        return RunFolder(request.run_dir or default_run_dir(request.preset), config, [config.train.seed])
    folder.go_on({"iteration": checkpoint.step, "checkpoint_sha256": checkpoint.sha256})
    if request.overrides:
        folder.write(CONFIG, to_yaml(config))
    return folder


class _Run:
    """The iterations of a run, and what is written about them."""

    def __init__(
        self,
        trainer: AnyTrainer,
        config: LearningConfig,
        folder: RunFolder,
        watch: TrainWatch,
        evaluate: Evaluate,
        total: int,
    ) -> None:

        self._trainer, self._config, self._folder = trainer, config, folder
        self._watch, self._evaluate, self._total = watch, evaluate, total
        self._recorder = MetricsRecorder(folder.path, trainer.iteration)
        self._metrics: Metrics = {}
        self._saved = trainer.iteration if trainer.iteration else None
        watch.start(folder.path, config, trainer.iteration, total)

    def go(self, pressed: threading.Event) -> bool:
        """Iterate to the end, or until somebody presses Ctrl-C: then save and return False."""
        trainer, is_stopped = self._trainer, False
        while trainer.iteration < self._total and not is_stopped:
            self._metrics = trainer.iterate()
            # an interrupt that something has swallowed within the iteration was received all the same
            is_stopped = pressed.is_set() or signals.was_received()
            self._note_iteration(is_stopped)
        if self._saved != trainer.iteration:
            self._save()
        if is_stopped:
            self._watch.note(f"saved; go on with: uuv train --resume {self._folder.path}")
        return not is_stopped

    def document(self) -> dict[str, Any]:
        """What ``uuv train --json`` prints."""
        from uuvtai.learning import checkpoint

        best = checkpoint.best(self._folder.path, self._watch.note)
        return {
            "schema": 1,
            "run": str(self._folder.path),
            "learner": self._config.learner,
            "iterations": self._trainer.iteration,
            "env_steps": self._trainer.env_steps,
            "checkpoint": str(best.path),
            "score": best.manifest.score,
            "metrics": checkpoint.finite(self._metrics),
        }

    def close(self) -> None:
        """Give everything back."""
        self._watch.stop()
        self._recorder.close()

    def _note_iteration(self, is_stopped: bool) -> None:
        done, train = self._trainer.iteration, self._config.train
        is_evaluated = not is_stopped and train.evaluate_every > 0 and done % train.evaluate_every == 0
        if is_evaluated:
            self._metrics |= self._evaluate(self._trainer, self._config)
        self._recorder.write(done, self._metrics)
        self._watch.update(done, self._metrics, self._success_interval())
        if is_evaluated or done % train.checkpoint_every == 0:
            self._save()

    def _save(self) -> None:
        from uuvtai.learning import checkpoint

        trainer, table = self._trainer, self._trainer.observation_table
        score = self._metrics.get(SCORE)
        checkpoint.save(
            self._folder.path / "checkpoints",
            trainer.iteration,
            trainer.state(),
            self._config,
            table,
            self._metrics,
            score,
        )
        for name, content in getattr(trainer, "files", dict)().items():  # of some trainers
            self._folder.write_bytes(name, content)
        self._saved = trainer.iteration

    def _success_interval(self) -> tuple[float, float] | None:
        """95 % interval of ``rollout/success_rate`` over the episodes that it is the mean of."""
        rate, episodes = self._metrics.get("rollout/success_rate"), self._trainer.recent.episodes
        return None if rate is None else wilson_interval(round(rate * episodes), round(episodes))


# ------------------------------------------------------------------------------------------------------------
# The record of a run: ``metrics.jsonl``, one object an iteration, and the same as TensorBoard events under
# the usual names.


METRICS, EVENTS = "metrics.jsonl", "tensorboard"


class MetricsRecorder:
    """Writes what every iteration gave; each line is on its way to the disk before ``write`` returns.

    A resumed run goes on behind the iteration of its checkpoint: what came later is cut off, and TensorBoard
    is told to forget it.
    """

    def __init__(self, run: Path, iteration: int = 0) -> None:
        """``iteration``: how many are done already. Raises OSError, and FileError for what is no plain file
        of the run."""
        from torch.utils.tensorboard import SummaryWriter  # takes a second to import

        _cut(run, iteration)
        self._file = open_to_append(run / METRICS, run)
        _await_next_name(run / EVENTS)
        self._events = SummaryWriter(str(run / EVENTS), purge_step=iteration + 1 if iteration else None)

    def write(self, iteration: int, metrics: Mapping[str, float]) -> None:
        """Record an iteration, counted from 1. What is not finite becomes null, and no event."""
        row = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
        self._file.write(json.dumps({"iteration": iteration, **row}, allow_nan=False).encode() + b"\n")
        self._file.flush()
        for name, value in row.items():
            if value is not None:
                self._events.add_scalar(name, value, iteration)
        self._events.flush()

    def close(self) -> None:
        """Flush and close both."""
        self._file.close()
        self._events.close()


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Every whole line of a run's ``metrics.jsonl``; a last line that was cut off is left out. Raises
    OSError, FileError."""
    return list(_whole_rows(run))


def _whole_rows(run: Path) -> Iterator[dict[str, Any]]:
    for line in read_lines(run / METRICS, folder=run):
        if (row := _row(line)) is None:
            return
        yield row


def _cut(run: Path, iteration: int) -> None:
    """Shorten the file to the whole lines of iterations up to this one."""
    file, kept = run / METRICS, 0
    if not file.exists():
        return
    for line in read_lines(file, folder=run):
        row = _row(line)
        if row is None or row["iteration"] > iteration:
            break
        kept += len(line)
    truncate(file, kept, run)


def _await_next_name(folder: Path) -> None:
    """TensorBoard reads files in the order of their names, which begin with the second in which they were
    opened, and within one second as text: what goes on must not come before what it goes on from."""
    now = time.time()
    if any(folder.glob(f"events.out.tfevents.{int(now):010d}.*")):
        time.sleep(int(now) + 1 - now)


def _row(line: bytes) -> dict[str, Any] | None:
    """The object of a line; None where the line was cut off."""
    try:
        row = parsed_json(line, METRICS)
    except FileError:
        return None
    return (
        row
        if line[-1:] == b"\n" and isinstance(row, dict) and isinstance(row.get("iteration"), int)
        else None
    )
