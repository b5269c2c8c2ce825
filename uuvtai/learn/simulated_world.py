"""The full simulator in the place of the kinematic twin: decided ten times a second, rewarded as the twin
rewards, with the truth for a critic; what the actor is shown is what ``SetPilot`` shows it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.errors import SettingError
from uuvtai.learn.set_policy import MOST_WISH
from uuvtai.learn.set_wheel import SetWheel
from uuvtai.learn.world_sims import simulator_of
from uuvtai.outcomes import RUNNING

if TYPE_CHECKING:
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim
    from uuvtai.twin.twin_world import TwinView

SIMULATOR_SEED = 4243
"""of the episodes to learn from; those of evaluations come from ``train.evaluate_seed``"""
NUM_EPISODES = 2**20
"""numbers that are drawn from"""
FAR_AWAY_M = 9.0
"""[m] the twin's distance where nothing is near"""


class SimulatedWorld:
    """N episodes of ``twin.worlds``, used as ``Twin`` is. Every world has a simulator and an equal share of
    the rows, every scene an equal share of these; row i plays episodes of ``SIMULATOR_SEED`` in its own world
    and scene."""

    num_scenarios = NUM_EPISODES

    def __init__(
        self, config: LearningConfig, scenes: tuple[Scene, ...], sims: Mapping[str, Sim] | None = None
    ) -> None:
        """``sims``: simulators of worlds that are there already, each with its share of the rows. Raises
        SettingError for numbers that do not fit, ConfigError for a world that is none."""
        from uuvtai.binding import bind
        from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, N_BODY
        from uuvtai.twin.twin_arrays import TRUTH_WIDTH, TwinRules
        from uuvtai.twin.twin_world import TwinView

        worlds, rows = config.twin.worlds, config.train.num_envs
        _refuse_uneven(config, len(worlds) * len(scenes))
        share = config.model_copy(
            update={"train": config.train.model_copy(update={"num_envs": rows // len(worlds)})}
        )
        self.num_envs, self.scenes = rows, scenes
        self._parts = [
            _WorldRows((sims or {}).get(world) or simulator_of(share, world, scenes), share, scenes)
            for world in worlds
        ]
        self._rules = bind(TwinRules, config)
        self._reward, self._outcome = torch.zeros(rows), torch.zeros(rows, dtype=torch.int32)
        self.view = TwinView(
            torch.zeros(rows, N_BODY, BODY_WIDTH),
            torch.zeros(rows, EGO_COLUMNS),
            torch.zeros(rows, N_BODY, TRUTH_WIDTH),
        )
        self.names = tuple(f"{Path(w).stem}_{scene[1]}_{scene[2]:g}" for w in worlds for scene in scenes)
        place = torch.arange(rows // len(worlds)) % len(scenes)
        self.origin = torch.cat([place + number * len(scenes) for number in range(len(worlds))])
        """(N,) which of ``names``, world_D_v, each row plays"""

    @property
    def time_s(self) -> torch.Tensor:
        """(N,) since the begin of each episode."""
        return torch.cat([part.time_s() for part in self._parts])

    def begin(self, rows: torch.Tensor, scenario: torch.Tensor, seed: int = SIMULATOR_SEED) -> None:
        """Begin the episodes of these numbers (N,) in the envs (N,) where ``rows`` is true; ``look`` comes
        next."""
        for part, here, number in zip(self._parts, self._split(rows), self._split(scenario), strict=True):
            if bool(here.any()):
                part.begin(here.int(), torch.full_like(number, seed).int(), number.int())

    def look(self) -> TwinView:
        """What is known now, after ``step`` and ``begin``; the same as often as it is asked."""
        shares = zip(*(self._split(tensor) for tensor in self.view), strict=True)
        for part, (bodies, own, truth) in zip(self._parts, shares, strict=True):
            part.look(bodies, own, truth)
        return self.view

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Carry out a decision (N, 3), held until the next one or the end: (reward, outcome code), both (N,).
        Envs that have ended rest until they begin again."""
        from uuvtai.twin.simulator_truth import reward_decisions

        driven = [part.drive(wish) for part, wish in zip(self._parts, self._split(action), strict=True)]
        nearer, nearest, outcome = (torch.cat(parts) for parts in zip(*driven, strict=True))
        self._outcome.copy_(outcome)
        reward_decisions(self._rules, nearer, nearest, self._outcome, self._reward)
        return self._reward, self._outcome

    def rest(self) -> None:
        """Put every env to sleep, until it begins again."""
        for part in self._parts:
            part.sim.sleep()

    def capture(self) -> dict[str, np.ndarray]:
        """All that the next steps depend on."""
        from uuvtai.capture import capture

        found: dict[str, np.ndarray] = {}
        for number, part in enumerate(self._parts):
            found |= {f"{number}.{name}": array for name, array in capture(part.sim.memory()).items()}
            found[f"{number}:last"] = part.wheel.last.numpy().copy()
        return found

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on from what ``capture`` gave."""
        from uuvtai.capture import restore

        for number, part in enumerate(self._parts):
            own = f"{number}."
            state = {n.removeprefix(own): array for n, array in arrays.items() if n.startswith(own)}
            restore(part.sim.memory(), state)
            part.wheel.last = torch.from_numpy(arrays[f"{number}:last"].copy())
            part.read_paths()
        self.look()

    def _split(self, tensor: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Each world's rows."""
        return tensor.split(self.num_envs // len(self._parts))


class _WorldRows:
    """The rows of one world."""

    def __init__(self, sim: Sim, config: LearningConfig, scenes: tuple[Scene, ...]) -> None:
        from uuvtai.binding import bind
        from uuvtai.twin.twin_arrays import EGO_WIDTH, TRUTH_WIDTH, TrueBodiesIO

        sim.set_scenes(scenes)
        sim.sleep()
        self.sim, self._hold = sim, config.policy.hold_steps
        self._dt_s = config.episode.control_dt_s
        self.wheel = SetWheel(sim, config.twin.vertical_gap_m)
        self._io = bind(TrueBodiesIO, sim.s, sim.config)
        self._every = torch.ones(sim.num_envs, dtype=torch.bool)
        self.read_paths()
        self._ego = torch.zeros(sim.num_envs, EGO_WIDTH)
        self._known = torch.zeros(*self._path.shape[:2], TRUTH_WIDTH)

    def read_paths(self) -> None:
        """Ways of the moving bodies, as they were drawn."""
        from uuvtai.twin.scenario_bank import scenario_rows

        self._path = torch.from_numpy(scenario_rows(self.sim)[1].copy())

    def begin(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Episodes (rows,) in the rows where ``mask`` is 1."""
        self.sim.reset(mask, seed, number)
        self.wheel.last = self.wheel.last * (mask == 0)[:, None]
        self.read_paths()

    def look(self, bodies: torch.Tensor, own: torch.Tensor, truth: torch.Tensor) -> None:
        """Write what the rows know, and the truth beside it."""
        from uuvtai.twin.simulator_truth import see_truth

        self.wheel.look(self._every)
        bodies.copy_(self.wheel.bodies)
        own.copy_(self.wheel.own)
        see_truth(self._io, self._path, self.wheel.raw, self._ego, self._known, truth)

    def drive(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """([m] nearer to the goal, [m] nearest to anything, outcome code), all (rows,), of a decision."""
        sim, referee = self.sim, self.sim.s.referee
        self.wheel.wish.copy_(action.clamp(-MOST_WISH, MOST_WISH))
        before, nearest = self._to_goal(), np.full(sim.num_envs, FAR_AWAY_M, np.float32)
        for _ in range(self._hold):
            sim.step(self.wheel.command())
            nearest = np.minimum(nearest, sim.rows(referee.clearance_m))
            if bool((sim.rows(referee.outcome) != RUNNING).any()):
                sim.sleep_ended()
        self.wheel.note_last(self._every)
        nearer = torch.from_numpy(before - self._to_goal())
        return nearer, torch.from_numpy(nearest), torch.from_numpy(sim.rows(referee.outcome).copy())

    def time_s(self) -> torch.Tensor:
        """(rows,)."""
        return torch.from_numpy(self.sim.rows(self.sim.s.clock.step) * np.float32(self._dt_s))

    def _to_goal(self) -> np.ndarray:
        """(rows,) [m] true distance."""
        way = self.sim.rows(self.sim.s.mission.goal_w) - self.sim.rows(self.sim.s.vehicle.pos_w)
        return np.linalg.norm(way, axis=1)


def _refuse_uneven(config: LearningConfig, groups: int) -> None:
    """Raise SettingError for rows that worlds and scenes cannot share, and for held-out episodes that are
    none."""
    if config.train.num_envs % groups:
        raise SettingError(
            f"train.num_envs={config.train.num_envs}: twin.worlds and train.scenes make {groups} pairs, each "
            f"with as many envs; give a multiple of {groups}"
        )
    if config.train.evaluate_seed == SIMULATOR_SEED:
        raise SettingError(
            f"train.evaluate_seed={SIMULATOR_SEED}: is what the policy learns from in the simulator; give "
            "another one"
        )
