"""Learn the behavior tree's numbers: every iteration runs episodes of one scene in the simulator, each with
numbers of its own, and moves the best so far: those for slow obstacles or those for fast ones."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from uuvtai.common.enums import OUTCOMES, RUNNING, SUCCESS
from uuvtai.common.presets import TRAINING_TREE
from uuvtai.config.behavior import FAST, SLOW, TUNED, configured_factors, log_bounds
from uuvtai.config.learning import LearningConfig, SearchScene
from uuvtai.config.loader import ConfigError, load_config
from uuvtai.learning.agents import TunedAgent, tuned_sections
from uuvtai.learning.rollout import Recent, RolloutSums

if TYPE_CHECKING:
    from uuvtai.learning.policy_agent import HeldAgent
    from uuvtai.sim.setup import Scene
    from uuvtai.sim.sim import Sim


class NumberSearch:
    """A search among many numbers at once: trials drawn around the best ones so far, and steps along the
    response surface of all trials, a quadratic without mixed terms (Box & Wilson 1951)."""

    def __init__(self, centre: Tensor, bounds: Tensor, spread: float, size: int, seed: int) -> None:
        """``centre`` (n,) to begin at, within ``bounds`` (2, n); ``spread`` of the way between these is how
        far trials lie from the best ones; ``size`` is the most trials there will be."""
        self.centre = centre.clone()
        self.low, self.high = bounds
        self.spread = spread * (self.high - self.low)
        self.size, self.trials = size, 0
        self._generator = torch.Generator().manual_seed(seed)
        self.memory = {"place": torch.zeros(size, len(centre)), "score": torch.zeros(size)}
        self.memory["group"] = torch.zeros(size, dtype=torch.int64)

    def drawn(self, count: int) -> Tensor:
        """(count, n) numbers to try: within ``spread``, the second of a pair as far the other way."""
        draw = torch.rand(count // 2, len(self.centre), generator=self._generator)
        way = (2.0 * draw - 1.0) * self.spread
        tried = self.centre + torch.stack([way, -way], 1).reshape(count, len(self.centre))
        return tried.clamp(self.low, self.high)

    def take(self, place: Tensor, score: Tensor, group: int) -> None:
        """Remember trials at ``place`` (count, n) with scores (count,), all of one ``group``."""
        rows = slice(self.trials, self.trials + len(place))
        self.memory["place"][rows], self.memory["score"][rows] = place, score
        self.memory["group"][rows] = group
        self.trials += len(place)

    def move(self) -> None:
        """One step along the surface of all trials."""
        place, score, group = (part[: self.trials].numpy() for part in self.memory.values())
        own = self.spread, self.centre, self.low, self.high
        spread, centre, low, high = (part.double().numpy() for part in own)
        slope, bend = fitted(place.astype(float), score.astype(float), group, spread)
        self.centre = torch.from_numpy(best_near(centre, slope, bend, spread, low, high)).float()

    def state(self) -> dict[str, Any]:
        """But for ``memory``."""
        return {"centre": self.centre, "generator": self._generator.get_state(), "trials": self.trials}

    def load_state(self, state: Mapping[str, Any], memory: Mapping[str, Tensor]) -> None:
        self.centre = state["centre"].clone()
        self._generator.set_state(state["generator"])
        self.trials = int(state["trials"])
        for name, own in self.memory.items():
            own.copy_(memory[name])


Array = np.ndarray
PAIR_CORRELATION = 0.4  # of the scores of two trials of one episode: as measured in the fast gauntlet
SLOPE_SD, BEND_MEAN, BEND_SD = 0.02, -0.01, 0.01
"""what is expected of the terms per ``spread`` and per its square"""


def fitted(place: Array, score: Array, group: Array, spread: Array) -> tuple[Array, Array]:
    """(slopes, bends), both (n,) per unit of ``spread`` (n,), of the scores (m,) of trials at ``place`` (m,
    n): score = level of its group + slopes x + bends x^2. Trials 0 and 1, 2 and 3, .. are of one episode."""
    x = place / spread
    level = np.eye(int(group.max()) + 1)[group]
    columns = np.concatenate([level, x, x * x], axis=1)
    centred = score - (level @ (level.T @ score / np.maximum(level.sum(0), 1)))
    noise = max(float(np.mean(centred**2)), 1e-9)
    columns, score = _uncorrelated(columns), _uncorrelated(score)
    n, n_level = x.shape[1], level.shape[1]
    prior = np.repeat([1e-6, noise / SLOPE_SD**2, noise / BEND_SD**2], [n_level, n, n])
    mean = np.repeat([0.0, BEND_MEAN], [n_level + n, n])
    found = np.linalg.solve(columns.T @ columns + np.diag(prior), columns.T @ score + prior * mean)
    return found[n_level : n_level + n], found[n_level + n :]


def _uncorrelated(rows: Array) -> Array:
    """Sums and differences of the pairs, with errors of the same size that are not correlated."""
    first, second = rows[0::2], rows[1::2]
    total = (first + second) / np.sqrt(2.0 * (1.0 + PAIR_CORRELATION))
    return np.concatenate([total, (first - second) / np.sqrt(2.0 * (1.0 - PAIR_CORRELATION))])


def best_near(centre: Array, slope: Array, bend: Array, spread: Array, low: Array, high: Array) -> Array:
    """(n,) highest place of the surface within half a ``spread`` of ``centre`` and within the bounds."""
    first, last = np.maximum(centre - 0.5 * spread, low), np.minimum(centre + 0.5 * spread, high)
    top = np.where(bend < 0, -0.5 * slope / np.where(bend < 0, bend, -1.0) * spread, first)
    tries = np.stack([first, last, np.clip(top, first, last)])
    x = tries / spread
    return np.take_along_axis(tries, np.argmax(slope * x + bend * x * x, axis=0)[None], axis=0)[0]


def simulator_of(config: LearningConfig, world: str, scenes: tuple[Scene, ...]) -> Sim:
    """A simulator of a world with room for every scene, on the run's sensors and stack; what the world says
    is known of its traffic counts. ConfigError."""
    most = [("world.n_static", max(s[0] for s in scenes)), ("world.n_dynamic", max(s[1] for s in scenes))]
    there = load_config(world, overrides=[*most])
    update: dict[str, Any] = {"world": there.world}
    for name in ("traffic", "tracking"):
        said = getattr(there, name).model_dump(exclude_defaults=True)
        update[name] = getattr(config, name).model_copy(update=said)
    return training_simulator(config.model_copy(update=update))


def training_simulator(config: LearningConfig, device: str = "cpu") -> Sim:
    """As many envs as the run has, driven by the tree that teaches."""
    from uuvtai.sim.behavior_tree import read_tree
    from uuvtai.sim.sim import Sim

    return Sim(config, config.train.num_envs, read_tree(TRAINING_TREE), device)


def run_search_episodes(
    sim: Sim, agent: HeldAgent, scene: Scene, seed: int, first: int, count: int, times: int = 1
) -> tuple[Tensor, Tensor]:
    """(outcome code, control steps), both (count,), of a scene's episodes from ``first`` on of a seed, each
    ``times`` times in a row, driven by an agent of this simulator."""
    outcome, steps = (torch.zeros(count, dtype=torch.int64) for _ in range(2))
    sim.set_scenes([scene])
    rows = torch.arange(sim.num_envs)
    for begin in range(0, count, sim.num_envs):
        running = rows < count - begin
        mask = running.int()
        sim.sleep()
        sim.reset(mask, torch.full_like(mask, seed), (first + (begin + rows) // times).int())
        agent.reset(mask)
        action = agent.decide(sim.action).action
        while bool(running.any()):
            steps[begin + rows[running]] += 1
            sim.step(action)
            agent.advance()
            now = torch.from_numpy(sim.rows(sim.s.termination.outcome).astype("int64"))
            ended = running & (now != RUNNING)
            if bool(ended.any()):
                outcome[begin + rows[ended]] = now[ended]
                running = running & ~ended
                sim.deactivate_ended()
            action = agent.decide(sim.action).action
    return outcome, steps


class EpisodeTrainer:
    """A trainer whose episodes begin and end within an iteration: its simulators carry nothing on."""

    counters: tuple[str, ...] = ("iteration", "env_steps")

    def __init__(self, config: LearningConfig, sims: Mapping[str, Sim] | None) -> None:
        """``sims``: of worlds that are there already."""
        self.config, self._sims = config, dict(sims or {})
        self.recent = Recent(OUTCOMES, ())
        self.iteration = self.env_steps = 0

    def simulator(self, world: str, scenes: tuple[Scene, ...]) -> Sim:
        """That of a world, with room for every scene. Raises ConfigError."""
        if world not in self._sims:
            self._sims[world] = simulator_of(self.config, world, scenes)
        return self._sims[world]

    def _done(self, steps: int, began: float, between: float) -> dict[str, float]:
        """Count an iteration, which simulated from ``began`` to ``between`` [s], then learned."""
        self.iteration += 1
        self.env_steps += steps
        now = time.perf_counter()
        return {
            "time/simulate_s": between - began,
            "time/infer_s": 0.0,
            "time/learn_s": now - between,
            "time/env_steps_per_s": steps / (now - began),
            "time/env_steps": float(self.env_steps),
        }

    def state(self) -> dict[str, Any]:
        """All that the next iterations depend on."""
        return {"counters": {name: getattr(self, name) for name in self.counters}}

    def load_state(self, state: Mapping[str, Any]) -> None:
        for name, value in state["counters"].items():
            setattr(self, name, int(value))


class ParameterSearchTrainer(EpisodeTrainer):
    """Two searches: for slow obstacles and for fast ones."""

    def __init__(self, config: LearningConfig, sims: Mapping[str, Sim] | None = None) -> None:
        """Raises ConfigError for scenes that are neither slow nor fast."""
        from uuvtai.envs.vector_env import ObservationColumn

        if config.train.num_envs % 2:
            raise ConfigError("train.num_envs: trials come in pairs; give an even number")
        super().__init__(config, sims)
        self.observation_table = (ObservationColumn("tree", slice(0, 4), "1", "body", "what the tree asks"),)
        self._scenes = config.parameter_search.scenes
        self._part = [self._part_of(scene) for scene in self._scenes]
        self.searches = tuple(self._search(part) for part in (SLOW, FAST))

    def _part_of(self, scene: SearchScene) -> int:
        fast = self.config.fast
        if fast.from_m_s < scene[3] < fast.full_m_s:
            raise ConfigError(
                f"parameter_search.scenes: obstacles at {scene[3]:g} m/s, in {scene[0]}, are neither slow "
                f"(fast.from_m_s, {fast.from_m_s:g} m/s or less) nor fast (fast.full_m_s, "
                f"{fast.full_m_s:g} m/s or more); choose another speed"
            )
        return SLOW if scene[3] <= fast.from_m_s else FAST

    def _search(self, part: int) -> NumberSearch:
        config, n = self.config, len(self._part)
        rounds = sum(self._part[i % n] == part for i in range(config.train.iterations))
        centre = torch.from_numpy(configured_factors(config.slow, config.fast)[:, part])
        spread, size = config.parameter_search.spread, rounds * config.train.num_envs
        return NumberSearch(centre, torch.tensor(log_bounds()), spread, size, config.train.seed)

    def files(self) -> dict[str, bytes]:
        """The stack that drives by the numbers as they are now."""
        lines = [f"tree: {TRAINING_TREE}"]
        for section, factors in tuned_sections(self.centre).items():
            lines += [f"{section}:", *(f"  {name}: {value}" for name, value in factors.items())]
        return {"stack.yaml": ("\n".join(lines) + "\n").encode()}

    @property
    def centre(self) -> Tensor:
        """(n_tuned, 2) natural logarithms of the best factors so far."""
        return torch.stack([search.centre for search in self.searches], 1)

    def iterate(self) -> dict[str, float]:
        """Run episodes, move towards the better ones; metrics."""
        began = time.perf_counter()
        nth = self.iteration % len(self._scenes)
        scene, part = self._scenes[nth], self._part[nth]
        search = self.searches[part]
        count = self.config.train.num_envs
        place = self.centre.repeat(count, 1, 1)
        place[:, :, part] = search.drawn(count)
        outcome, steps = self._played(scene, place, self.config.train.seed, search.trials // 2, count, 2)
        between = time.perf_counter()
        search.take(place[:, :, part], self._scored(outcome, steps, part), nth)
        if search.trials >= self.config.parameter_search.warm_up * search.size:
            search.move()
        env_steps, sums = int(steps.sum()), RolloutSums(len(OUTCOMES), 0, torch.device("cpu"))
        sums.outcomes += torch.bincount(outcome, minlength=len(OUTCOMES)).double()
        sums.episode_steps += env_steps
        sums.samples += env_steps
        times = self._done(env_steps, began, between)
        return self.recent.add(sums) | self.factors() | times

    def factors(self) -> dict[str, float]:
        """The best so far, as metrics."""
        return {
            f"{section}/{number.name}": factor
            for section, search in zip(("slow", "fast"), self.searches, strict=True)
            for number, factor in zip(TUNED, search.centre.exp().tolist(), strict=True)
        }

    def _played(
        self, scene: SearchScene, place: Tensor, seed: int, first: int, count: int, times: int = 1
    ) -> tuple[Tensor, Tensor]:
        """As ``run_search_episodes``, by numbers (n_tuned, 2), or (num_envs, n_tuned, 2)."""
        world, s, d, v = scene
        sim = self.simulator(world, tuple(other[1:] for other in self._scenes if other[0] == world))
        agent = TunedAgent(self.centre, sim)
        agent.log_factor[: sim.num_envs] = place.numpy()
        return run_search_episodes(sim, agent, (s, d, v), seed, first, count, times)

    def _scored(self, outcome: Tensor, steps: Tensor, part: int) -> Tensor:
        """1 for an arrival at once, less for a late one, 0 for none."""
        parameter_search = self.config.parameter_search
        cost = parameter_search.slow_time_cost if part == SLOW else parameter_search.time_cost
        late = steps * self.config.episode.control_dt_s * cost
        return (outcome == SUCCESS).float() * (1.0 - late)

    def evaluate(self) -> dict[str, float]:
        """``eval/*`` of the best so far, on episodes that no trial met, as many of each scene."""
        train, scenes = self.config.train, list(dict.fromkeys(self._scenes))
        each, won, metrics = -(-train.evaluate_episodes // len(scenes)), [], {}
        for scene in scenes:
            outcome, steps = self._played(scene, self.centre, train.evaluate_seed, 0, each)
            arrived = outcome == SUCCESS
            won.append(arrived.float())
            name = f"{Path(scene[0]).stem}_{scene[2]}_{scene[3]:g}"
            metrics[f"eval/success_{name}"] = float(won[-1].mean())
            if bool(arrived.any()):
                mean_s = float(steps[arrived].float().mean()) * self.config.episode.control_dt_s
                metrics[f"eval/time_to_success_{name}_s"] = mean_s
        return metrics | {"eval/success_rate": float(torch.cat(won).mean())}

    def state(self) -> dict[str, Any]:
        """What drives is the part ``tree``."""
        return super().state() | {
            "tree": {"log_factor": self.centre},
            "recent": list(self.recent.rows),
            "searches": [search.state() for search in self.searches],
            "env": [search.memory for search in self.searches],
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        super().load_state(state)
        self.recent.rows = [list(row) for row in state["recent"]]
        for search, own, memory in zip(self.searches, state["searches"], state["env"], strict=True):
            search.load_state(own, memory)
