"""Learn the behaviour tree's numbers: what ``learn/run.py`` drives where ``tuner.enabled``.

Every iteration plays episodes of one scene in the simulator, each with numbers of its own, and moves the best
numbers so far: those for slow bodies or those for fast ones (``number_search``).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from uuvtai.config.learning import LearningConfig, TunerScene
from uuvtai.learn.episode_waves import play_episodes
from uuvtai.learn.number_search import NumberSearch
from uuvtai.learn.rollout_sums import Recent, RolloutSums
from uuvtai.learn.tuned_pilot import TunedPilot, tree_row
from uuvtai.learn.world_sims import simulator_of
from uuvtai.loader import ConfigError
from uuvtai.outcomes import OUTCOMES, SUCCESS
from uuvtai.tuned_numbers import FAST, SLOW, TUNED, configured_factors, log_bounds

if TYPE_CHECKING:
    from uuvtai.sim import Sim


class TunerTrainer:
    """Everything that the search carries from one iteration to the next. Episodes begin and end within an
    iteration: the simulators carry nothing."""

    def __init__(self, config: LearningConfig, sims: Mapping[str, Sim] | None = None) -> None:
        """``sims``: simulators of worlds that are there already. Raises ConfigError."""
        self.config = config
        self.observation_table = (tree_row(),)
        self._scenes = config.tuner.scenes
        self._part = [self._part_of(scene) for scene in self._scenes]
        self.searches = tuple(self._search(part) for part in (SLOW, FAST))
        self.recent = Recent(OUTCOMES, ())
        self.iteration = self.env_steps = 0
        self._sims = dict(sims or {})

    def _part_of(self, scene: TunerScene) -> int:
        """``SLOW`` or ``FAST``."""
        fast = self.config.fast
        if fast.from_m_s < scene[3] < fast.full_m_s:
            raise ConfigError(
                f"tuner.scenes: bodies at {scene[3]:g} m/s, in {scene[0]}, are neither slow (fast.from_m_s, "
                f"{fast.from_m_s:g} m/s or less) nor fast (fast.full_m_s, {fast.full_m_s:g} m/s or more); "
                "choose another speed"
            )
        return SLOW if scene[3] <= fast.from_m_s else FAST

    def _search(self, part: int) -> NumberSearch:
        config, n = self.config, len(self._part)
        rounds = sum(self._part[i % n] == part for i in range(config.train.iterations))
        return NumberSearch(
            torch.from_numpy(configured_factors(config)[:, part]),
            torch.tensor(log_bounds()),
            config.tuner.spread,
            rounds * config.train.num_envs,
            config.train.seed,
        )

    @property
    def centre(self) -> torch.Tensor:
        """(n_tuned, 2) natural logarithms of the best factors so far."""
        return torch.stack([search.centre for search in self.searches], 1)

    def iterate(self) -> dict[str, float]:
        """Play episodes, move towards the better ones; metrics by their names in metrics.jsonl."""
        began = time.perf_counter()
        nth = self.iteration % len(self._scenes)
        scene, part = self._scenes[nth], self._part[nth]
        search = self.searches[part]
        place = self.centre.repeat(self.config.train.num_envs, 1, 1)
        place[:, :, part] = search.drawn(len(place))
        outcome, steps = self._played(scene, place, self.config.train.seed, search.trials // 2, 2)
        between = time.perf_counter()
        search.take(place[:, :, part], self._scored(outcome, steps, part), nth)
        if search.trials >= self.config.tuner.warm_up * search.size:
            search.move()
        learn_s = time.perf_counter() - between
        self.iteration += 1
        env_steps = int(steps.sum())
        self.env_steps += env_steps
        return (
            self._counted(outcome, env_steps)
            | self.factors()
            | {
                "time/simulate_s": between - began,
                "time/infer_s": 0.0,
                "time/learn_s": learn_s,
                "time/env_steps_per_s": env_steps / (between - began + learn_s),
                "time/env_steps": float(self.env_steps),
            }
        )

    def factors(self) -> dict[str, float]:
        """The factors that trials are drawn around, by their names in metrics.jsonl."""
        return {
            f"{section}/{number.name}": factor
            for section, search in zip(("slow", "fast"), self.searches, strict=True)
            for number, factor in zip(TUNED, search.centre.exp().tolist(), strict=True)
        }

    def _played(
        self, scene: TunerScene, place: torch.Tensor, seed: int, first: int, times: int = 1
    ) -> tuple[torch.Tensor, torch.Tensor]:
        world, s, d, v = scene
        if world not in self._sims:
            here = tuple(other[1:] for other in self._scenes if other[0] == world)
            self._sims[world] = simulator_of(self.config, world, here)
        pilot = _TrialPilot(place, self._sims[world])
        return play_episodes(pilot, (s, d, v), seed, first, len(place), times)

    def _scored(self, outcome: torch.Tensor, steps: torch.Tensor, part: int) -> torch.Tensor:
        """1 for an arrival at once, less for a late one, 0 for none."""
        tuner = self.config.tuner
        cost = tuner.slow_time_cost if part == SLOW else tuner.time_cost
        late = steps * self.config.episode.control_dt_s * cost
        return (outcome == SUCCESS).float() * (1.0 - late)

    def _counted(self, outcome: torch.Tensor, steps: int) -> dict[str, float]:
        sums = RolloutSums.zeros(len(OUTCOMES), 0, torch.device("cpu"))
        sums.outcomes += torch.bincount(outcome, minlength=len(OUTCOMES)).double()
        sums.episode_steps += steps
        sums.samples += steps
        return self.recent.add(sums)

    # --------------------------------------------------------------------------------------------- evaluation

    def evaluate(self) -> dict[str, float]:
        """``eval/*`` of what was found so far, on episodes that no trial met, as many of each scene."""
        train, scenes = self.config.train, list(dict.fromkeys(self._scenes))
        each, won, metrics = -(-train.evaluate_episodes // len(scenes)), [], {}
        for scene in scenes:
            outcome, steps = self._played(scene, self.centre.repeat(each, 1, 1), train.evaluate_seed, 0)
            arrived = outcome == SUCCESS
            won.append(arrived.float())
            name = f"{Path(scene[0]).stem}_{scene[2]}_{scene[3]:g}"
            metrics[f"eval/success_{name}"] = float(won[-1].mean())
            if bool(arrived.any()):
                mean_s = float(steps[arrived].float().mean()) * self.config.episode.control_dt_s
                metrics[f"eval/time_to_success_{name}_s"] = mean_s
        return metrics | {"eval/success_rate": float(torch.cat(won).mean())}

    # ------------------------------------------------------------------------------------------------- resume

    def state(self) -> dict[str, Any]:
        """All that the next iterations depend on. What drives is the part ``tree``."""
        return {
            "tree": {"log_factor": self.centre},
            "recent": list(self.recent.rows),
            "counters": {name: getattr(self, name) for name in ("iteration", "env_steps")},
            "searches": [search.state() for search in self.searches],
            "env": [search.memory() for search in self.searches],
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self.recent.rows = [list(row) for row in state["recent"]]
        for name, value in state["counters"].items():
            setattr(self, name, int(value))
        for search, own, memory in zip(self.searches, state["searches"], state["env"], strict=True):
            search.load_state(own, memory)


class _TrialPilot(TunedPilot):
    """Drives every episode with numbers of its own."""

    def __init__(self, place: torch.Tensor, sim: Sim) -> None:
        """``place`` (count, n_tuned, 2) of the episodes, in their order."""
        super().__init__(torch.zeros(len(TUNED), 2), sim)
        self._place = place.numpy()
        self.running = torch.ones(sim.num_envs, dtype=torch.bool)
        self.number = torch.zeros(sim.num_envs, dtype=torch.int64)

    def reset(self, rows: torch.Tensor) -> None:
        """As ``TunedPilot.reset``."""
        of_row = np.minimum(self.number.numpy(), len(self._place) - 1)
        self.log_factor[: len(of_row)] = self._place[of_row]
        super().reset(rows)
