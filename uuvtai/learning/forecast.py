"""Learn what moving obstacles will do: every iteration runs episodes of one world in the simulator, driven by
the tree, and fits a mixture density network to what the obstacles behind the tracks then did."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as fn
from torch import Tensor, nn

from uuvtai.common import enums
from uuvtai.common.errors import SettingError
from uuvtai.common.obstacle_motion import describe_scenario, path_positions
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.networks import HALF_LOG_2PI, AdamLearner, linear
from uuvtai.learning.parameter_search import EpisodeTrainer
from uuvtai.learning.ppo import ADAM_EPS
from uuvtai.sim.forecast_weights import WEIGHTS, packed_weights

if TYPE_CHECKING:
    from uuvtai.sim.setup import Scene
    from uuvtai.sim.sim import Sim


# ------------------------------------------------------------------------------------------------------------
# A mixture of ``N_MODE`` Gaussians over the places at ``ANCHORS`` times, along and across the track's course
# (Bishop 1994). Each future is a whole way: its places share one weight.


TIMES_S = torch.arange(1, enums.ANCHORS + 1) * enums.ANCHOR_S  # [s] ahead, of the places that it tells
_LEAST_M, _MOST = 0.03, 4.0  # [m] smallest deviation; largest, as a part of the way that an obstacle can go


class Mixture(NamedTuple):
    """What may come of n tracks, in their frames."""

    log_weight: Tensor
    """(n, N_MODE) logarithm of the probability of each future"""
    place: Tensor
    """(n, N_MODE, ANCHORS, 2) [m] along and across the course"""
    sigma: Tensor
    """(n, N_MODE, ANCHORS, 2) [m] standard deviations"""


class MixtureNet(nn.Module):
    """Columns of a track to its futures."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        gain = math.sqrt(2.0)
        self.into = linear(enums.N_COLUMN, enums.N_HIDDEN, gain, generator)
        self.middle = linear(enums.N_HIDDEN, enums.N_HIDDEN, gain, generator)
        self.said = linear(enums.N_HIDDEN, enums.N_TOLD, 0.1, generator)
        self.spread = linear(enums.N_HIDDEN, enums.N_SPREAD, 0.1, generator)
        with torch.no_grad():  # the futures begin apart: straight on, slower, back, left and right
            ways = torch.tensor([[1.0, 0.0], [0.3, 0.0], [-0.3, 0.0], [-0.8, 0.0], [0.5, 0.5], [0.5, -0.5]])
            places = ways[: enums.N_MODE].repeat_interleave(enums.ANCHORS, 0)
            self.said.bias[enums.N_MODE :] = places.flatten()
            self.spread.bias.fill_(math.log(0.3))

    def forward(self, columns: Tensor) -> Mixture:
        """``columns`` (n, N_COLUMN), of which the first is the speed that it can go [m/s]."""
        hidden = torch.relu(self.middle(torch.relu(self.into(columns))))
        said = self.said(hidden)
        reach = (columns[:, :1] * TIMES_S)[:, None, :, None]
        place = said[:, enums.N_MODE :].view(-1, enums.N_MODE, enums.ANCHORS, 2) * reach
        part = self.spread(hidden).view(-1, enums.N_MODE, enums.ANCHORS, 2).clamp(-6.0, math.log(_MOST)).exp()
        return Mixture(torch.log_softmax(said[:, : enums.N_MODE], -1), place, _LEAST_M + part * reach)

    def weights(self) -> dict[str, np.ndarray]:
        """Arrays of a forecast's file (``mixture_weights``)."""
        found, layers = {}, {"in": self.into, "mid": self.middle, "out": self.said, "spread": self.spread}
        for name, layer in layers.items():
            padding = 0, enums.N_SAID - enums.N_TOLD if name == "out" else 0  # that of the spreads: there
            for kind, values in (("weight", layer.weight.T), ("bias", layer.bias)):
                found[f"{kind}_{name}"] = fn.pad(values.detach(), padding).contiguous().numpy().copy()
        return found


def negative_log_likelihood(mixture: Mixture, truth: Tensor) -> Tensor:
    """(n,) [nat] of the true places (n, ANCHORS, 2) [m] in the tracks' frames."""
    off = (truth[:, None] - mixture.place) / mixture.sigma
    log_density = -(0.5 * off * off + mixture.sigma.log() + HALF_LOG_2PI).sum((-1, -2))
    return -torch.logsumexp(mixture.log_weight + log_density, -1)


def mirrored(columns: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """The same tracks seen in a mirror along their course: left is right."""
    flip = torch.ones(enums.N_COLUMN)
    flip[list(enums.SIDE_COLUMNS)] = -1.0
    order = torch.arange(enums.N_COLUMN)
    for one, other in enums.FAR_COLUMNS:
        order[one], order[other] = other, one
    return (columns * flip)[:, order], truth * torch.tensor([1.0, -1.0])


def scores_of(mixture: Mixture, truth: Tensor) -> dict[str, float]:
    """How good forecasts of n tracks are: likelihood [nat]; median and 90 % quantile [m] of last distances of
    the likeliest future and of the nearest; how probable the likeliest is said to be, how often nearest."""
    away, likeliest = (mixture.place - truth[:, None]).norm(dim=-1), mixture.log_weight.argmax(-1)
    last = {"likeliest": away[..., -1].gather(1, likeliest[:, None])[:, 0], "nearest": away[..., -1].amin(-1)}
    found = {f"{name}_median_m": part.median() for name, part in last.items()}
    found |= {f"{name}_p90_m": part.quantile(0.9) for name, part in last.items()}
    found |= {
        "nll": negative_log_likelihood(mixture, truth).mean(),
        "likeliest_said": mixture.log_weight.amax(-1).exp().mean(),
        "likeliest_right": (away.mean(-1).argmin(-1) == likeliest).float().mean(),
    }
    return {name: float(value) for name, value in found.items()}


# ------------------------------------------------------------------------------------------------------------
# Tracks as the tracker delivers them in the simulator, with what their obstacles then did: to learn a
# forecast from, and to judge one. The truth serves learning alone; what drives sees columns of tracks.


EVERY_STEPS = 25  # a track is looked at so often, in control steps
_OBSTACLE_M = 0.5  # a track belongs to a moving obstacle this close to where it is forecast now,
_SPEED_S = 0.3  # the nearest of them, a m/s of difference in velocity counting as so many metres
_STEP_S = 0.02


TrackMoments = tuple[Tensor, Tensor]
"""of n moments of tracks that an obstacle is behind: columns (n, N_COLUMN) that a network is told; where the
obstacle then was (n, ANCHORS, 2) [m], in the track's frame"""


def watch(sim: Sim, scenes: tuple[Scene, ...], seed: int, first: int, steps: int) -> tuple[TrackMoments, int]:
    """Moments of episodes ``first`` .. of ``seed``, one in every env, driven by the simulator's tree for at
    most ``steps``; and the env steps that it took."""
    sim.set_scenes(scenes)
    rows = torch.arange(sim.num_envs, dtype=torch.int32)
    sim.sleep()
    sim.reset(torch.ones_like(rows), torch.full_like(rows, seed), first + rows)
    field = functools.cache(lambda name: sim.rows(attrgetter(name)(sim.s)))
    scenarios = [describe_scenario(lambda name, env=env: field(name)[env]) for env in range(sim.num_envs)]
    paths = [
        [path for body in scenario["obstacles"] if (path := body["path"]) and path["speed_m_s"] > 0]
        for scenario in scenarios
    ]
    found, running, done = [], np.ones(sim.num_envs, bool), 0
    for step in range(1, steps + 1):
        done += int(running.sum())
        sim.step()
        running &= sim.rows(sim.s.termination.outcome) == enums.RUNNING
        if not running.any():
            break
        sim.deactivate_ended()
        if step % EVERY_STEPS == 0:
            found.append(_moments(sim, np.flatnonzero(running).tolist(), paths, step * _STEP_S))
    columns, truth = zip(*found, strict=True)
    return (torch.cat(columns), torch.cat(truth)), done


def _moments(sim: Sim, envs: list[int], paths: list[list[dict[str, Any]]], now_s: float) -> TrackMoments:
    """Of the tracks of these envs that have a forecast and an obstacle, which move along ``paths``."""
    there = sim.rows(sim.s.forecast.radius_m, envs)[..., 0] >= 0
    frame = sim.rows(sim.s.mixture.frame, envs)
    """(env, track, 5) [m, m, -, -, m/s] place, unit course, speed"""
    times = now_s + np.array([-0.05, 0.0, 0.05, *TIMES_S.tolist()])
    obstacles = np.full((len(envs), max(1, *map(len, paths)), len(times), 2), np.nan)
    for row, env in enumerate(envs):
        for lane, path in enumerate(paths[env]):
            obstacles[row, lane] = path_positions(path, times)
    velocity = (obstacles[:, :, 2] - obstacles[:, :, 0]) / 0.1
    own_velocity = sim.rows(sim.s.tracks.state, envs)[..., 2:4]
    away = np.linalg.norm(obstacles[:, None, :, 1] - frame[:, :, None, :2], axis=-1)
    cost = away + _SPEED_S * np.linalg.norm(velocity[:, None] - own_velocity[:, :, None], axis=-1)
    cost = np.where(away < _OBSTACLE_M, cost, np.inf)
    body = np.argmin(np.nan_to_num(cost, nan=np.inf, posinf=np.inf), -1)
    row, track = np.nonzero(there & np.isfinite(np.min(cost, -1)))
    chosen = frame[row, track]
    x, y = np.moveaxis(obstacles[row, body[row, track], 3:] - chosen[:, None, :2], -1, 0)
    c, s = chosen[:, 2, None], chosen[:, 3, None]
    truth = np.stack([c * x + s * y, c * y - s * x], -1, dtype=np.float32, casting="same_kind")
    return torch.from_numpy(sim.rows(sim.s.mixture.column, envs)[row, track]), torch.from_numpy(truth)


MEMORY, MINIBATCH = 2**21, 512  # moments of tracks that are kept to learn from, and of one step
_LEAST_RATE = 0.02  # part of the learning rate that is left at the end


class ForecastTrainer(EpisodeTrainer):
    """The network and the moments that it learns from."""

    counters = ("iteration", "env_steps", "kept", "seen")

    def __init__(self, config: LearningConfig, sims: Mapping[str, Sim] | None = None) -> None:
        """Raises SettingError where the stack already forecasts by a network."""
        from uuvtai.envs.vector_env import ObservationColumn

        if config.forecast.learned:
            raise SettingError("forecast.learned: it is learned beside the analytic forecast; leave it empty")
        forecast = config.forecast.model_copy(update={"keep_columns": True})
        super().__init__(config.model_copy(update={"forecast": forecast}), sims)
        columns = slice(0, enums.COLUMNS)
        self.observation_table = (ObservationColumn("motion", columns, "mixed", "track", "how tracks move"),)
        torch.set_flush_denormal(True)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        self.net = MixtureNet(self.generator)
        rate = config.forecast_training.learning_rate
        self.learner = AdamLearner(self.net.parameters(), lr=rate, eps=ADAM_EPS)
        self._columns = torch.zeros(MEMORY, enums.N_COLUMN, dtype=torch.float16)
        self._truth = torch.zeros(MEMORY, len(TIMES_S), 2)
        self.kept = self.seen = 0
        self._scenes: tuple[Scene, ...] = tuple(config.train.scenes) or (config.world.own_scene,)

    def iterate(self) -> dict[str, float]:
        """Run episodes of one world, learn from all that is kept; metrics."""
        began, config = time.perf_counter(), self.config
        worlds, first = config.forecast_training.worlds, self.iteration * config.train.num_envs
        found, steps = self._watched(worlds[self.iteration % len(worlds)], config.train.seed, first)
        self._keep(*found)
        between = time.perf_counter()
        losses = [self._fit() for _ in range(config.forecast_training.minibatches)]
        return {
            "train/nll": sum(losses) / len(losses),
            "train/learning_rate": self.learner.optimiser.param_groups[0]["lr"],
            "train/moments": float(self.kept),
        } | self._done(steps, began, between)

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """``eval/*`` on episodes that it never learned from, world by world."""
        train, metrics = self.config.train, {}
        for world in self.config.forecast_training.worlds:
            (columns, truth), _ = self._watched(world, train.evaluate_seed, 0)
            scores = scores_of(self.net(columns), truth)
            metrics |= {f"eval/{name}_{world}": value for name, value in scores.items()}
        return metrics

    def files(self) -> dict[str, bytes]:
        """The file that ``forecast.learned`` takes."""
        return {WEIGHTS: packed_weights(self.net.weights())}

    def _watched(self, world: str, seed: int, first: int) -> tuple[TrackMoments, int]:
        sim = self.simulator(world, self._scenes)
        return watch(sim, self._scenes, seed, first, self.config.forecast_training.episode_steps)

    def _keep(self, columns: Tensor, truth: Tensor) -> None:
        """Remember moments, the newest in the place of the oldest."""
        size = len(self._columns)
        at = torch.arange(self.seen, self.seen + len(columns)) % size
        self._columns[at], self._truth[at] = columns.half(), truth
        self.seen += len(columns)
        self.kept = min(self.seen, size)

    def _fit(self) -> float:
        """One step of the network towards what came; the loss in nats."""
        config, share = self.config.forecast_training, self.iteration / self.config.train.iterations
        self.learner.optimiser.param_groups[0]["lr"] = config.learning_rate * max(_LEAST_RATE, 1.0 - share)
        at = torch.randint(self.kept, (MINIBATCH,), generator=self.generator)
        columns, truth = self._columns[at].float(), self._truth[at]
        if torch.rand(1, generator=self.generator) < 0.5:
            columns, truth = mirrored(columns, truth)
        loss = negative_log_likelihood(self.net(columns), truth).mean()
        self.learner.step(loss, 5.0)
        return float(loss.detach())

    def state(self) -> dict[str, Any]:
        """What forecasts is the part ``forecast``."""
        return super().state() | {
            "forecast": {name: tensor.clone() for name, tensor in self.net.state_dict().items()},
            "optimiser": self.learner.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "env": {"columns": self._columns, "truth": self._truth},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        super().load_state(state)
        self.net.load_state_dict(state["forecast"])
        self.learner.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self._columns.copy_(state["env"]["columns"])
        self._truth.copy_(state["env"]["truth"])
