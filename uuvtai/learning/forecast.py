"""Learn what moving obstacles will do: what ``learning/runner.py`` drives where
``forecast_training.enabled``.

Every iteration runs episodes of one world in the simulator, driven by the tree, and fits a mixture density
network to what the obstacles behind the tracks then did, by likelihood.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from uuvtai.common.enums import COLUMNS, N_COLUMN, OUTCOMES, RUNNING
from uuvtai.common.errors import SettingError
from uuvtai.common.obstacle_motion import path_document, path_positions
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.networks import (
    TIMES_S,
    Mixture,
    MixtureNet,
    PlainAdam,
    mirrored,
    negative_log_likelihood,
)
from uuvtai.learning.parameter_search import simulator_of
from uuvtai.learning.ppo import ADAM_EPS
from uuvtai.learning.rollout import Recent
from uuvtai.sim.forecast_weights import WEIGHTS, packed_weights

if TYPE_CHECKING:
    from uuvtai.envs.vector_env import ObservationColumn
    from uuvtai.sim.setup import Scene
    from uuvtai.sim.sim import Sim


# ------------------------------------------------------------------------------------------------------------
# How good a forecast of several futures is: likelihood and distances.


def scores_of(mixture: Mixture, truth: torch.Tensor) -> dict[str, float]:
    """Means over n tracks of ``truth`` (n, ANCHORS, 2) [m]: nats of the likelihood; median and 90 % quantile
    [m] of the distance at the last time, of the likeliest future and of the nearest; how probable the
    likeliest future is said to be, and how often it is the nearest."""
    last = (mixture.place[:, :, -1] - truth[:, None, -1]).norm(dim=-1)
    likeliest = mixture.log_weight.argmax(-1)
    nearest = (
        (mixture.place - truth[:, None]).norm(dim=-1).mean(-1).argmin(-1)
    )  # by the mean of the whole way
    one = last.gather(1, likeliest[:, None])[:, 0]
    return {
        "nll": float(negative_log_likelihood(mixture, truth).mean()),
        "likeliest_median_m": float(one.median()),
        "likeliest_p90_m": float(one.quantile(0.9)),
        "nearest_median_m": float(last.amin(-1).median()),
        "nearest_p90_m": float(last.amin(-1).quantile(0.9)),
        "likeliest_said": float(mixture.log_weight.amax(-1).exp().mean()),
        "likeliest_right": float((nearest == likeliest).float().mean()),
    }


# ------------------------------------------------------------------------------------------------------------
# Tracks as the tracker delivers them in the simulator, with what their obstacles then did: to learn a
# forecast from, and to judge one. The truth serves learning alone; what drives sees columns of tracks.


EVERY_STEPS = 25
"""a track is looked at so often, in control steps"""
_OBSTACLE_M = 0.5
"""a track belongs to a moving obstacle this close to where it is forecast now,"""
_SPEED_S = 0.3
"""the nearest of them, a m/s of difference in velocity counting as so many metres"""
_STEP_S = 0.02


class TrackMoments(NamedTuple):
    """n moments of tracks that an obstacle is behind."""

    columns: torch.Tensor
    """(n, N_COLUMN) what a network is told"""
    frame: torch.Tensor
    """(n, 5) [m, m, -, -, m/s] place, unit course, speed of the track"""
    truth: torch.Tensor
    """(n, ANCHORS, 2) [m] where the body then was, in the track's frame"""


def path_places(path: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """(n, n_lane, t, 2) [m] of the obstacles of n scenarios, ``path`` (n, n_lane, 16) as in a bank of the
    surrogate's, at times (n, t) [s]; NaN where there is no obstacle."""
    names = ("n_way", "radius_m", "length_m", "phase_m", "speed_m_s")
    out = np.full((*path.shape[:2], time_s.shape[1], 2), np.nan)
    for i, lane in zip(*np.nonzero(path[..., 4] > 0), strict=True):
        row = path[i, lane].astype(float)
        told = dict(zip(names, row, strict=False)) | {"way_w": row[5:15].reshape(5, 2), "easing_m": row[15]}
        out[i, lane] = path_positions(path_document(told), time_s[i])
    return out


def watch(sim: Sim, scenes: tuple[Scene, ...], seed: int, first: int, steps: int) -> tuple[TrackMoments, int]:
    """Moments of episodes ``first`` .. of ``seed``, one in every env, the scenes dealt out in turn, driven by
    the simulator's tree for at most ``steps``; and the env steps that it took."""
    from uuvtai.surrogate.world import scenario_rows

    sim.set_scenes(scenes)
    rows = torch.arange(sim.num_envs, dtype=torch.int32)
    sim.sleep()
    sim.reset(torch.ones_like(rows), torch.full_like(rows, seed), first + rows)
    path = scenario_rows(sim)[1]
    found, running, done = [], np.ones(sim.num_envs, bool), 0
    for step in range(1, steps + 1):
        done += int(running.sum())
        sim.step()
        running &= sim.rows(sim.s.termination.outcome) == RUNNING
        if not running.any():
            break
        sim.deactivate_ended()
        if step % EVERY_STEPS == 0:
            found.append(_moments(sim, np.flatnonzero(running), path, step * _STEP_S))
    return joined(found), done


def joined(parts: list[TrackMoments]) -> TrackMoments:
    """All of them, one after the other."""
    return TrackMoments(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def _moments(sim: Sim, rows: np.ndarray, path: np.ndarray, now_s: float) -> TrackMoments:
    """Of the tracks of these rows that have a forecast and a obstacle."""
    s, envs = sim.s, [int(row) for row in rows]
    there = sim.rows(s.forecast.radius_m, envs)[..., 0] >= 0
    frame = sim.rows(s.mixture.frame, envs)
    times = np.broadcast_to(
        now_s + np.array([-0.05, 0.0, 0.05, *TIMES_S.tolist()]), (len(rows), 3 + len(TIMES_S))
    )
    obstacles = path_places(path[rows], times)
    velocity = (obstacles[:, :, 2] - obstacles[:, :, 0]) / 0.1
    own_velocity = frame[..., 2:4] * frame[..., 4:]
    away = np.linalg.norm(obstacles[:, None, :, 1] - frame[:, :, None, :2], axis=-1)
    cost = away + _SPEED_S * np.linalg.norm(velocity[:, None] - own_velocity[:, :, None], axis=-1)
    cost = np.where(away < _OBSTACLE_M, cost, np.inf)
    body = np.argmin(np.nan_to_num(cost, nan=np.inf, posinf=np.inf), -1)
    env, track = np.nonzero(there & np.isfinite(np.min(cost, -1)))
    chosen = frame[env, track]
    column = sim.rows(s.mixture.column, envs)[env, track]
    parts = (column, chosen, _in_frame(obstacles[env, body[env, track], 3:], chosen))
    return TrackMoments(*(torch.from_numpy(np.ascontiguousarray(part, np.float32)) for part in parts))


def _in_frame(place: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Places (n, ..., 2) in the world, in the frames (n, 5) of their tracks."""
    shape = (len(frame), *(1,) * (place.ndim - 2))
    x, y = place[..., 0] - frame[:, 0].reshape(shape), place[..., 1] - frame[:, 1].reshape(shape)
    c, s = frame[:, 2].reshape(shape), frame[:, 3].reshape(shape)
    return np.stack([c * x + s * y, c * y - s * x], -1)


# ------------------------------------------------------------------------------------------------------------


MEMORY, MINIBATCH = 2**21, 512
"""moments of tracks that are kept to learn from, and of one step"""
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
                "forecast.learned: a forecast is learnt beside the one by arcs and turn history; leave it "
                "empty"
            )
        self.config = config
        self.observation_table = (column_row(),)
        torch.set_flush_denormal(True)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        self.net = MixtureNet(self.generator)
        self.optimiser = PlainAdam(
            self.net.parameters(), lr=config.forecast_training.learning_rate, eps=ADAM_EPS
        )
        self._columns = torch.zeros(MEMORY, N_COLUMN, dtype=torch.float16)
        self._truth = torch.zeros(MEMORY, len(TIMES_S), 2)
        self.recent = Recent(OUTCOMES, ())
        self.iteration = self.env_steps = self.kept = self.seen = 0
        self._scenes: tuple[Scene, ...] = tuple(config.train.scenes) or (config.world.own_scene,)
        self._sims: dict[str, Sim] = dict(sims or {})

    def iterate(self) -> dict[str, float]:
        """Run episodes of one world, learn from all that is kept; metrics by their names in metrics.jsonl."""
        began, config = time.perf_counter(), self.config
        worlds = config.forecast_training.worlds
        found, steps = self._watched(
            worlds[self.iteration % len(worlds)], config.train.seed, self.iteration * config.train.num_envs
        )
        self._keep(found)
        between = time.perf_counter()
        losses = [self._fit() for _ in range(config.forecast_training.minibatches)]
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
        for world in self.config.forecast_training.worlds:
            found, _ = self._watched(world, train.evaluate_seed, 0)
            scores = scores_of(self.net(found.columns, found.frame[:, 4]), found.truth)
            metrics |= {f"eval/{name}_{world}": value for name, value in scores.items()}
        return metrics

    def files(self) -> dict[str, bytes]:
        """The file that ``forecast.learned`` takes."""
        return {WEIGHTS: packed_weights(self.net.weights())}

    def _watched(self, world: str, seed: int, first: int) -> tuple[TrackMoments, int]:
        if world not in self._sims:
            self._sims[world] = _simulator_of(self.config, world, self._scenes)
        return watch(
            self._sims[world], self._scenes, seed, first, self.config.forecast_training.episode_steps
        )

    def _keep(self, seen: TrackMoments) -> None:
        """Remember moments, the newest in the place of the oldest."""
        size = len(self._columns)
        at = torch.arange(self.seen, self.seen + len(seen.columns)) % size
        self._columns[at], self._truth[at] = seen.columns.half(), seen.truth
        self.seen += len(seen.columns)
        self.kept = min(self.seen, size)

    def _fit(self) -> float:
        """One step of the network towards what came; the loss in nats."""
        config, share = self.config.forecast_training, self.iteration / self.config.train.iterations
        self.optimiser.param_groups[0]["lr"] = config.learning_rate * max(_LEAST_RATE, 1.0 - share)
        at = torch.randint(self.kept, (MINIBATCH,), generator=self.generator)
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
    from uuvtai.envs.vector_env import ObservationColumn

    return ObservationColumn(
        "motion", slice(0, COLUMNS), "mixed", "track", "how a track moves, moved and turned"
    )
