"""Learn what moving bodies will do: what ``learn/run.py`` drives where ``forecaster.enabled``.

Every iteration plays episodes of one world in the simulator, driven by the tree, and fits a mixture density
network to what the bodies behind the tracks then did, by likelihood.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.errors import SettingError
from uuvtai.forecast_codes import COLUMNS, N_COLUMN
from uuvtai.learn.forecast_scores import scores_of
from uuvtai.learn.mixture_net import TIMES_S, MixtureNet, mirrored, negative_log_likelihood
from uuvtai.learn.optimiser import PlainAdam
from uuvtai.learn.ppo import ADAM_EPS
from uuvtai.learn.rollout_sums import Recent
from uuvtai.learn.track_futures import TrackMoments, watch
from uuvtai.learn.world_sims import simulator_of
from uuvtai.mixture_weights import packed_weights
from uuvtai.outcomes import OUTCOMES

if TYPE_CHECKING:
    from uuvtai.env import ObservationColumn
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim

_LEAST_RATE = 0.02
"""part of the learning rate that is left at the end"""


class ForecastTrainer:
    """Everything that learning to forecast carries from one iteration to the next. Episodes begin and end
    within an iteration: the simulators carry nothing."""

    def __init__(self, config: LearningConfig, sims: Mapping[str, Sim] | None = None) -> None:
        """``sims``: simulators of worlds that are there already. Raises SettingError where the stack already
        forecasts by a network."""
        if config.forecast.learned:
            raise SettingError(
                "forecast.learned: a forecast is learnt beside the one by arcs and habits; leave it empty"
            )
        self.config = config
        self.observation_table = (column_row(),)
        torch.set_flush_denormal(True)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        self.net = MixtureNet(self.generator)
        self.optimiser = PlainAdam(self.net.parameters(), lr=config.forecaster.learning_rate, eps=ADAM_EPS)
        size = config.forecaster.memory
        self._columns = torch.zeros(size, N_COLUMN, dtype=torch.float16)
        self._truth = torch.zeros(size, len(TIMES_S), 2)
        self.recent = Recent(OUTCOMES, ())
        self.iteration = self.env_steps = self.kept = self.seen = 0
        self._scenes: tuple[Scene, ...] = tuple(config.train.scenes) or (config.world.own_scene,)
        self._sims: dict[str, Sim] = dict(sims or {})

    def iterate(self) -> dict[str, float]:
        """Play episodes of one world, learn from all that is kept; metrics by their names in
        metrics.jsonl."""
        began, config = time.perf_counter(), self.config
        worlds = config.forecaster.worlds
        found, steps = self._watched(
            worlds[self.iteration % len(worlds)], config.train.seed, self.iteration * config.train.num_envs
        )
        self._keep(found)
        between = time.perf_counter()
        losses = [self._fit() for _ in range(config.forecaster.minibatches)]
        learn_s = time.perf_counter() - between
        self.iteration += 1
        self.env_steps += steps
        return {
            "train/nll": sum(losses) / len(losses),
            "train/learning_rate": self.optimiser.param_groups[0]["lr"],
            "train/moments": float(self.kept),
            "time/simulate_s": between - began,
            "time/infer_s": 0.0,
            "time/learn_s": learn_s,
            "time/env_steps_per_s": steps / (between - began + learn_s),
            "time/env_steps": float(self.env_steps),
        }

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """``eval/*`` of the forecast as it is, on episodes that it never learnt from, world by world."""
        train, metrics = self.config.train, {}
        for world in self.config.forecaster.worlds:
            found, _ = self._watched(world, train.evaluate_seed, 0)
            scores = scores_of(self.net(found.columns, found.frame[:, 4]), found.truth)
            metrics |= {f"eval/{name}_{world}": value for name, value in scores.items()}
        return metrics

    def exported(self) -> bytes:
        """The file that ``forecast.learned`` takes."""
        return packed_weights(self.net.weights())

    def _watched(self, world: str, seed: int, first: int) -> tuple[TrackMoments, int]:
        if world not in self._sims:
            self._sims[world] = _simulator_of(self.config, world, self._scenes)
        return watch(self._sims[world], self._scenes, seed, first, self.config.forecaster.episode_steps)

    def _keep(self, seen: TrackMoments) -> None:
        """Remember moments, the newest in the place of the oldest."""
        size = len(self._columns)
        at = torch.arange(self.seen, self.seen + len(seen.columns)) % size
        self._columns[at], self._truth[at] = seen.columns.half(), seen.truth
        self.seen += len(seen.columns)
        self.kept = min(self.seen, size)

    def _fit(self) -> float:
        """One step of the network towards what came; the loss in nats."""
        config, share = self.config.forecaster, self.iteration / self.config.train.iterations
        self.optimiser.param_groups[0]["lr"] = config.learning_rate * max(_LEAST_RATE, 1.0 - share)
        at = torch.randint(self.kept, (config.minibatch,), generator=self.generator)
        columns, truth = self._columns[at].float(), self._truth[at]
        speed = columns[:, 0]
        if torch.rand(1, generator=self.generator) < 0.5:
            columns, truth = mirrored(columns, truth)
        loss = negative_log_likelihood(self.net(columns, speed), truth).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 5.0)
        self.optimiser.step()
        return float(loss.detach())

    # ------------------------------------------------------------------------------------------------- resume

    def state(self) -> dict[str, Any]:
        """All that the next iterations depend on. What forecasts is the part ``forecast``."""
        return {
            "forecast": {name: tensor.clone() for name, tensor in self.net.state_dict().items()},
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "counters": {name: getattr(self, name) for name in ("iteration", "env_steps", "kept", "seen")},
            "env": {"columns": self._columns, "truth": self._truth},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self.net.load_state_dict(state["forecast"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        for name, value in state["counters"].items():
            setattr(self, name, int(value))
        self._columns.copy_(state["env"]["columns"])
        self._truth.copy_(state["env"]["truth"])


def _simulator_of(config: LearningConfig, world: str, scenes: tuple[Scene, ...]) -> Sim:
    """A simulator that keeps columns, with room for every scene, on the run's sensors and stack. Raises
    ConfigError."""
    forecast = config.forecast.model_copy(update={"keep_columns": True})
    return simulator_of(config.model_copy(update={"forecast": forecast}), world, scenes)


def column_row() -> ObservationColumn:
    """The observation of a forecast, for a checkpoint's manifest."""
    from uuvtai.env import ObservationColumn

    return ObservationColumn(
        "motion", slice(0, COLUMNS), "mixed", "track", "how a track moves, moved and turned"
    )
