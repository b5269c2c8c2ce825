"""``uuv train``: a run folder, iterations, checkpoints and evaluations in between."""

from __future__ import annotations

import contextlib
import itertools
import json
import shlex
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from uuvtai.common import signals
from uuvtai.common.errors import OwnCodeError
from uuvtai.common.files import FileError, open_to_append, parsed_json, read_json, read_lines, truncate
from uuvtai.common.statistics import wilson_interval
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import ConfigError, Overrides, load_resolved, to_yaml
from uuvtai.learning import checkpoint
from uuvtai.learning.agents import find_policy
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.environments import InSurrogate, Simulated
from uuvtai.learning.forecast import ForecastTrainer
from uuvtai.learning.parameter_search import ParameterSearchTrainer, training_simulator
from uuvtai.learning.policy_agent import load_agent
from uuvtai.learning.set_networks import actor_of
from uuvtai.learning.trainer import Trainer
from uuvtai.logs.run_folder import RunFolder, default_run_dir, refuse_place

if TYPE_CHECKING:
    from uuvtai.envs.vector_env import VectorEnv


Metrics = dict[str, float]

CONFIG, REWARD = "config.yaml", "reward.json"  # of a run folder
SCORE = "eval/success_rate"  # metric by which a checkpoint is the best


@dataclass(frozen=True)
class TrainRequest:
    """A new run with ``config``, or to go on with the run folder ``resume``."""

    config: LearningConfig | None = None
    preset: str = "run"
    """what a new run's folder is named after"""
    start: Path | None = None
    """run or checkpoint with whose policy a new run begins"""
    resume: Path | None = None
    overrides: Overrides | None = None
    """changes of the resumed run's config"""
    iterations: int | None = None
    """done in all; None = as it began, then ``train.iterations``, over which schedules run in any case"""
    device: str = "auto"
    run_dir: Path | None = None
    reward: RewardSource | None = None
    """terms of the user's beside the built-in ones"""


class RewardSource(Protocol):
    """Reward terms in a file of the user's (``plugins.loading.LoadedPlugin``)."""

    spec: Any
    """``plugins.api.PluginSpec``: as it was named"""
    sha256: str

    def reward(self, env: VectorEnv) -> None: ...


class TrainWatch(Protocol):
    """Shows how far a training is."""

    def start(self, folder: Path, config: LearningConfig, done: int, total: int) -> None: ...
    def note(self, text: str) -> None: ...
    def update(self, done: int, metrics: Metrics, success_ci95: tuple[float, float] | None) -> None: ...
    def stop(self) -> None: ...


AnyTrainer = Trainer | ParameterSearchTrainer | ForecastTrainer
Evaluate = Callable[[AnyTrainer, LearningConfig], Metrics]
"""``eval/*`` of the policy as it is (``evaluation.evaluate.evaluate_now``)"""


def train(request: TrainRequest, watch: TrainWatch, evaluate: Evaluate) -> tuple[dict[str, Any], Path]:
    """Train or go on training; what ``uuv train --json`` prints, and the run folder. Everything that can be
    refused is refused before anything is written. An interrupt (SIGINT, SIGTERM) lets the iteration end,
    saves and raises KeyboardInterrupt; a second one ends at once."""
    if request.iterations is not None and request.iterations < 1:
        raise ConfigError(f"--iterations {request.iterations}: at least 1, for example --iterations 100")
    # held before anything is read: what another process writes meanwhile must not count
    held = RunFolder.held(request.resume, "uuv train") if request.resume else None
    try:
        return _train(request, held, watch, evaluate)
    finally:
        if held:
            held.release()


def _train(
    request: TrainRequest, folder: RunFolder | None, watch: TrainWatch, evaluate: Evaluate
) -> tuple[dict[str, Any], Path]:
    """``folder``: of the run to go on with."""
    if folder is None:
        assert request.config is not None
        refuse_place(request.run_dir)
        found, (start, config) = None, _started(request.start, request.config, watch.note)
    else:
        start, config = None, load_resolved(folder.path / CONFIG, request.overrides)
        if not isinstance(config, LearningConfig):
            raise ConfigError(f"{folder.path}: is no training run; give the folder that 'uuv train' printed")
        found = checkpoint.newest(folder.path, watch.note, resumable=True)
        _check_reward(folder.path, request.reward)
    total = request.iterations or config.train.iterations
    kept = folder.record().get("iterations") if folder and found else None
    if not request.iterations and isinstance(kept, int) and found and found.step < kept:
        total = kept  # as the run began
    request = replace(request, iterations=total)
    if folder and found and found.step >= total:
        folder.settle(found.step >= config.train.iterations)
        done, more = f"{found.step} of {total} iterations", f"--iterations {2 * found.step}"
        raise ConfigError(f"{folder.path}: has done {done}; to go on give more: {more}")
    trainer = _trainer(config, request.device, request.reward)
    for checked in filter(None, (found, start)):
        checked.check_table(trainer.observation_table, config)
    if found:
        trainer.load_state(found.state(like=trainer.state()))
    if isinstance(trainer, Trainer):
        trainer.note = watch.note
        if start:
            trainer.start(start)
    if folder is None or found is None:
        folder = RunFolder(request.run_dir or default_run_dir(request.preset), config, [config.train.seed])
        if own := request.reward:
            folder.write_json(REWARD, {"schema": 1} | _kept(own))
    else:
        folder.go_on({"iteration": found.step, "checkpoint_sha256": found.sha256})
        if request.overrides:
            folder.write(CONFIG, to_yaml(config))
    folder.keep({"iterations": total})
    run = _Run(trainer, config, folder, watch, evaluate, request)
    with folder.recorded(), contextlib.closing(run), signals.StopEvent() as pressed:
        if not run.go(pressed):
            raise KeyboardInterrupt
    return run.document(), folder.path


def _started(
    place: Path | None, config: LearningConfig, note: Callable[[str], None]
) -> tuple[Checkpoint | None, LearningConfig]:
    """The checkpoint to begin with, and the config with its networks. ConfigError for one without policy."""
    if place is None:
        return None, config
    found = find_policy(str(place), note)
    if config.learner != "ppo" or found.config.learner != "ppo":
        raise ConfigError(f"--start {place}: policies alone can be begun with, by a preset that trains one")
    if config.encoder != found.config.encoder:
        other = "simulator" if config.surrogate.enabled else "surrogate"
        raise ConfigError(f"--start {place}: learned in the {other} and goes on there alone; take its preset")
    actor_of(found) if config.encoder == "set" else load_agent(found, 1)  # as wide as its config says
    theirs, sizes = found.config, ("obstacle_hidden", "head_hidden", "goal_gain")
    own = {name: getattr(theirs.policy, name) for name in ("hidden", "activation")}
    update = {
        "policy": config.policy.model_copy(update=own),
        "surrogate": config.surrogate.model_copy(update={n: getattr(theirs.surrogate, n) for n in sizes}),
        "observation": theirs.observation,
    }
    return found, config.model_copy(update=update)


def _kept(own: RewardSource) -> dict[str, Any]:
    """What a run folder keeps of a reward: all but ``typed`` must be the same where the run goes on."""
    spec = own.spec
    return {"typed": spec.typed, "name": spec.name, "argument": spec.argument, "sha256": own.sha256}


def _check_reward(folder: Path, own: RewardSource | None) -> None:
    """ConfigError where a run goes on with another reward than it began with."""
    there = (folder / REWARD).exists()
    found, now = read_json(folder / REWARD, folder=folder) if there else {}, _kept(own) if own else {}
    began = found if isinstance(found, dict) else {}
    if there == bool(own) and all(began.get(key) == now[key] for key in now if key != "typed"):
        return
    typed = f"--reward {began.get('typed', '')}; give it unchanged" if there else "no --reward; leave it out"
    more = f" --reward {own.spec.typed}" if own else ""
    start = f"begin a new run with its policy: uuv train PRESET --start {folder}{more}"
    raise ConfigError(f"{folder}: began with {typed}, or {start}")


def _trainer(config: LearningConfig, device: str, own: RewardSource | None) -> AnyTrainer:
    """What learns. Raises ConfigError for a GPU or a reward where there is no use for it."""
    if own and (config.surrogate.enabled or config.learner != "ppo"):
        told = f"such as ppo or paper: uuv train ppo --reward {own.spec.typed}"
        raise ConfigError(f"--reward {own.spec.typed}: needs a preset that trains in the simulator, {told}")
    for section in ("surrogate", "parameter_search", "forecast_training"):
        if device == "cuda" and getattr(config, section).enabled:
            raise ConfigError(f"{section}.enabled: it learns on the CPU; leave out --device cuda")
    if config.learner != "ppo":
        return ParameterSearchTrainer(config) if config.learner == "search" else ForecastTrainer(config)
    if config.surrogate.enabled:
        return Trainer(InSurrogate(config), config)
    env = _env(config, device)
    if own:
        own.reward(env)
    return Trainer(Simulated(env, config), config)


def _env(config: LearningConfig, device: str) -> VectorEnv:
    from uuvtai.envs.vector_env import VectorEnv

    sim = training_simulator(config, device)
    sim.set_scenes(config.train.scenes)
    return VectorEnv(sim, config.train.seed)


@dataclass
class _Run:
    """The iterations of a run, and what is written about them."""

    trainer: AnyTrainer
    config: LearningConfig
    folder: RunFolder
    watch: TrainWatch
    evaluate: Evaluate
    request: TrainRequest
    metrics: Metrics = field(default_factory=dict)
    """of the last one"""

    def __post_init__(self) -> None:
        self.saved = self.trainer.iteration
        self.total = self.request.iterations or self.config.train.iterations
        self.recorder = MetricsRecorder(self.folder.path, self.saved)
        self.watch.start(self.folder.path, self.config, self.saved, self.total)

    def go(self, pressed: threading.Event) -> bool:
        """Iterate to the end, or until an interrupt: then save and return False."""
        train, is_stopped = self.config.train, False
        while self.trainer.iteration < self.total and not is_stopped:
            self.metrics, done = self._iterate(), self.trainer.iteration
            # an interrupt that something has swallowed within the iteration was received all the same
            is_stopped = pressed.is_set() or signals.was_received()
            is_evaluated = not is_stopped and train.evaluate_every > 0 and done % train.evaluate_every == 0
            if is_evaluated:
                self.metrics |= self.evaluate(self.trainer, self.config)
            self.recorder.write(done, self.metrics)
            rate, episodes = self.metrics.get("rollout/success_rate"), self.trainer.recent.episodes
            found = None if rate is None else wilson_interval(round(rate * episodes), round(episodes))
            self.watch.update(done, self.metrics, found)
            if is_evaluated or done % train.checkpoint_every == 0:
                self._save()
        if self.saved != self.trainer.iteration:
            self._save()
        if is_stopped:
            self.watch.note(f"saved; go on with: uuv train {self._again('--resume')}")
        return not is_stopped

    def _iterate(self) -> Metrics:
        """One iteration. Where the user's reward fails, what was learned before is kept."""
        try:
            return self.trainer.iterate()
        except OwnCodeError:
            if self.trainer.iteration > self.saved:
                self._save()
                self.watch.note(f"saved; mend the reward, then: uuv train PRESET {self._again('--start')}")
            raise

    def _again(self, option: str) -> str:
        """The run folder behind an option, and what its config does not keep."""
        own = self.request.reward
        typed = [option, str(self.folder.path)] + (["--reward", own.spec.typed] if own else [])
        if self.total != self.config.train.iterations:
            typed += ["--iterations", str(self.total)]
        return shlex.join(typed)

    def document(self) -> dict[str, Any]:
        """What ``uuv train --json`` prints."""
        best = checkpoint.best(self.folder.path, self.watch.note)
        return {
            "schema": 1,
            "run": str(self.folder.path),
            "learner": self.config.learner,
            "iterations": self.trainer.iteration,
            "env_steps": self.trainer.env_steps,
            "checkpoint": str(best.path),
            "score": best.manifest.score,
            "metrics": checkpoint.finite(self.metrics),
        }

    def close(self) -> None:
        self.watch.stop()
        self.recorder.close()

    def _save(self) -> None:
        trainer, place = self.trainer, self.folder.path / "checkpoints"
        state, table, score = trainer.state(), trainer.observation_table, self.metrics.get(SCORE)
        checkpoint.save(place, trainer.iteration, state, self.config, table, self.metrics, score)
        if not isinstance(trainer, Trainer):
            for name, content in trainer.files().items():
                self.folder.write_bytes(name, content)
        self.saved = trainer.iteration


METRICS, EVENTS = "metrics.jsonl", "tensorboard"


class MetricsRecorder:
    """Writes what every iteration gave, as a line of ``metrics.jsonl`` and as TensorBoard events."""

    def __init__(self, run: Path, iteration: int = 0) -> None:
        """What came behind ``iteration``, the last one done, is cut off. Raises OSError, FileError."""
        from torch.utils.tensorboard import SummaryWriter  # takes a second to import

        if (run / METRICS).exists():
            kept = itertools.takewhile(lambda row: row[1]["iteration"] <= iteration, _whole_rows(run))
            truncate(run / METRICS, sum(len(line) for line, _ in kept), run)
        self._file = open_to_append(run / METRICS, run)
        if iteration:  # TensorBoard goes by the seconds in which files were opened, within one by their names
            time.sleep(1.0 - time.time() % 1.0)
        self._events = SummaryWriter(str(run / EVENTS), purge_step=iteration + 1 if iteration else None)

    def write(self, iteration: int, metrics: Mapping[str, float]) -> None:
        """Record an iteration, counted from 1. What is not finite becomes null, and no event."""
        row = checkpoint.finite(metrics)
        self._file.write(json.dumps({"iteration": iteration, **row}, allow_nan=False).encode() + b"\n")
        self._file.flush()
        for name, value in row.items():
            if value is not None:
                self._events.add_scalar(name, value, iteration)
        self._events.flush()

    def close(self) -> None:
        self._file.close()
        self._events.close()


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Every whole line of a run's ``metrics.jsonl``. Raises OSError, FileError."""
    return [row for _, row in _whole_rows(run)]


def _whole_rows(run: Path) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Lines and their objects, up to the first that was cut off."""
    for line in read_lines(run / METRICS, folder=run):
        try:
            row = parsed_json(line, METRICS)
        except FileError:
            return
        if line[-1:] != b"\n" or not isinstance(row, dict) or not isinstance(row.get("iteration"), int):
            return
        yield line, row
