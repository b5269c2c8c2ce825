"""Learn the behaviour tree's numbers: what ``learn/run.py`` drives where ``tuner.enabled``.

Every iteration plays episodes of one world and scene in the simulator, each with numbers of its own, drawn
around the best ones so far, and moves these along the response surface of all episodes
(``response_surface``).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.learn.distributed import Processes
from uuvtai.learn.episode_waves import play_episodes
from uuvtai.learn.response_surface import best_near, fitted
from uuvtai.learn.rollout_sums import Recent, RolloutSums
from uuvtai.learn.tuned_pilot import TunedPilot, tree_row
from uuvtai.learn.world_sims import simulator_of
from uuvtai.outcomes import OUTCOMES, SUCCESS
from uuvtai.tuned_numbers import TUNED, log_bounds

if TYPE_CHECKING:
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim


class TunerTrainer:
    """Everything that the search carries from one iteration to the next. Episodes begin and end within an
    iteration: the simulators carry nothing."""

    def __init__(self, config: LearningConfig, sims: Mapping[str, Sim] | None = None) -> None:
        """``sims``: simulators of worlds that are there already."""
        self.config, self.processes = config, Processes()
        self.observation_table = (tree_row(),)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        self.centre = torch.zeros(len(TUNED))
        """natural logarithms of the best factors so far, which the next trials are drawn around"""
        size = config.train.iterations * config.train.num_envs
        self._place, self._score = torch.zeros(size, len(TUNED)), torch.zeros(size)
        self._group = torch.zeros(size, dtype=torch.int64)
        self.recent = Recent(OUTCOMES, ())
        self.iteration = self.env_steps = self.trials = 0
        self._low, self._high = (torch.tensor(side) for side in log_bounds())
        self._spread = config.tuner.spread * (self._high - self._low)
        world = config.world
        own = (world.n_static, world.n_dynamic, world.dynamic_speed_m_s)
        self._all_scenes: tuple[Scene, ...] = tuple(config.train.scenes) or (own,)
        self._sims = dict(sims or {})

    def iterate(self) -> dict[str, float]:
        """Play episodes, move towards the better ones; metrics by their names in metrics.jsonl."""
        began = time.perf_counter()
        scenes = self._scenes()
        group = self.iteration % len(scenes)
        place = self._drawn(self.config.train.num_envs)
        outcome, steps = self._played(*scenes[group], place, self.config.train.seed, self.trials // 2, 2)
        between = time.perf_counter()
        self._take(place, outcome, steps, group)
        if self.iteration + 1 >= self.config.tuner.warm_up * self.config.train.iterations:
            self._move()
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
            f"tuner/{number.name}": factor
            for number, factor in zip(TUNED, self.centre.exp().tolist(), strict=True)
        }

    def _scenes(self) -> list[tuple[str, Scene]]:
        """Every world of ``tuner.worlds`` with every scene, in the order in which they are played."""
        return [(name, scene) for scene in self._all_scenes for name in self.config.tuner.worlds]

    def _drawn(self, count: int) -> torch.Tensor:
        """(count, n_tuned) numbers to try, by pairs for one episode each: anywhere within ``spread``, the
        second of a pair as far the other way (mirrored sampling)."""
        draw = torch.rand(count // 2, len(TUNED), generator=self.generator)
        way = (2.0 * draw - 1.0) * self._spread
        tried = self.centre + torch.stack([way, -way], 1).reshape(count, len(TUNED))
        return tried.clamp(self._low, self._high)

    def _played(
        self, world: str, scene: Scene, place: torch.Tensor, seed: int, first: int, times: int = 1
    ) -> tuple[torch.Tensor, torch.Tensor]:
        if world not in self._sims:
            self._sims[world] = simulator_of(self.config, world, self._all_scenes)
        return play_episodes(_TrialPilot(place, self._sims[world]), scene, seed, first, len(place), times)

    def _take(self, place: torch.Tensor, outcome: torch.Tensor, steps: torch.Tensor, group: int) -> None:
        """Remember trials."""
        rows = slice(self.trials, self.trials + len(place))
        self._place[rows], self._group[rows] = place, group
        self._score[rows] = self._scored(outcome, steps)
        self.trials += len(place)

    def _scored(self, outcome: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
        """1 for an arrival at once, less for a late one, 0 for none."""
        late = steps * self.config.episode.control_dt_s * self.config.tuner.time_cost
        return (outcome == SUCCESS).float() * (1.0 - late)

    def _move(self) -> None:
        """One step along the surface of all trials."""
        n = slice(self.trials)
        place, spread = self._place[n].double().numpy(), self._spread.double().numpy()
        slope, bend = fitted(place, self._score[n].double().numpy(), self._group[n].numpy(), spread)
        centre, low, high = (part.double().numpy() for part in (self.centre, self._low, self._high))
        found = best_near(centre, slope, bend, spread, low, high)
        self.centre = torch.from_numpy(found.astype(np.float32))

    def _counted(self, outcome: torch.Tensor, steps: int) -> dict[str, float]:
        sums = RolloutSums.zeros(len(OUTCOMES), 0, torch.device("cpu"))
        sums.outcomes += torch.bincount(outcome, minlength=len(OUTCOMES)).double()
        sums.episode_steps += steps
        sums.samples += steps
        return self.recent.add(sums)

    # --------------------------------------------------------------------------------------------- evaluation

    def evaluate(self) -> dict[str, float]:
        """``eval/*`` of what was found so far, on episodes that no trial met, the same number of each world
        and scene."""
        train, scenes = self.config.train, list(dict.fromkeys(self._scenes()))
        each, won, metrics = -(-train.evaluate_episodes // len(scenes)), [], {}
        for world, scene in scenes:
            outcome, _ = self._played(world, scene, self.centre.repeat(each, 1), train.evaluate_seed, 0)
            won.append((outcome == SUCCESS).float())
            metrics[f"eval/success_{Path(world).stem}_{scene[1]}_{scene[2]:g}"] = float(won[-1].mean())
        return metrics | {"eval/success_rate": float(torch.cat(won).mean())}

    # ------------------------------------------------------------------------------------------------- resume

    def state(self) -> dict[str, Any]:
        """All that the next iterations depend on. What drives is the part ``tree``."""
        return {
            "tree": {"log_factor": self.centre.clone()},
            "generator": self.generator.get_state(),
            "recent": list(self.recent.rows),
            "counters": {name: getattr(self, name) for name in ("iteration", "env_steps", "trials")},
            "env": {"place": self._place, "score": self._score, "group": self._group},
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self.centre = state["tree"]["log_factor"].clone()
        self.generator.set_state(state["generator"])
        self.recent.rows = [list(row) for row in state["recent"]]
        for name, value in state["counters"].items():
            setattr(self, name, int(value))
        for own, name in ((self._place, "place"), (self._score, "score"), (self._group, "group")):
            own.copy_(state["env"][name])


class _TrialPilot(TunedPilot):
    """Drives every episode with numbers of its own."""

    def __init__(self, place: torch.Tensor, sim: Sim) -> None:
        """``place`` (count, n_tuned) of the episodes, in their order."""
        super().__init__(torch.zeros(len(TUNED)), sim)
        self._place = place.numpy()
        self.running = torch.ones(sim.num_envs, dtype=torch.bool)
        self.number = torch.zeros(sim.num_envs, dtype=torch.int64)

    def reset(self, rows: torch.Tensor) -> None:
        """As ``TunedPilot.reset``."""
        of_row = np.minimum(self.number.numpy(), len(self._place) - 1)
        self.log_factor[: len(of_row)] = self._place[of_row]
        super().reset(rows)
