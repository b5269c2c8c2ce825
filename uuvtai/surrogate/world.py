"""The surrogate: as many episodes side by side as one likes, decided ten times a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from uuvtai.common.enums import EGO_COLUMNS, N_RAY, OBSTACLE_WIDTH
from uuvtai.common.presets import TRAINING_TREE
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import TankConfig
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import ConfigError, load_config
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.setup import Scene
from uuvtai.sim.sim import Sim
from uuvtai.sim.stages import bind
from uuvtai.surrogate import motion, sensing
from uuvtai.surrogate.arrays import EGO_WIDTH, RAW_WIDTH, TRACK_WIDTH, TRUTH_WIDTH, SurrogateRules

# ------------------------------------------------------------------------------------------------------------
# Scenarios drawn by the simulator itself, as plain arrays that the surrogate's kernels read.


BATCH = 256
"""envs of the simulator that draws"""


@dataclass(frozen=True)
class ScenarioBank:
    """B scenarios: static obstacles first, then the moving ones."""

    obstacle: torch.Tensor
    """(B, n_obstacle, 8) kind, centre (3), size (3), yaw; kind 0 = none"""
    path: torch.Tensor
    """(B, n_lane, 16) corners (0 = circle), radius, length, phase, speed, corners' x and y; of a circle the
    first is its centre"""
    route: torch.Tensor
    """(B, n_way, 3) waypoints x, y and the length left [m], at its end the goal again and again"""
    mission: torch.Tensor
    """(B, 8) start (3), goal (3), heading at the start"""
    origin: torch.Tensor
    """(B,) int32: which of ``names`` it was drawn for"""
    names: tuple[str, ...]
    """world_D_v by number"""


def draw_bank(config: LearningConfig, scenes: tuple[Scene, ...], seed: int, count: int) -> ScenarioBank:
    """Episodes 0 .. count - 1 of ``seed`` for every pair of a world of ``surrogate.worlds`` and a scene (S,
    D, v), drawn by ``Sim.draw_routes``. Raises ConfigError for a world that is none, or has another tank
    than the run's."""
    parts, names = [], []
    for world in config.surrogate.worlds:
        most = [("world.n_static", max(s[0] for s in scenes)), ("world.n_dynamic", max(s[1] for s in scenes))]
        drawn_config = load_config(world, overrides=[*most])
        _refuse_other_tank(world, drawn_config.world.tank, config.world.tank)
        tree = read_tree(TRAINING_TREE, drawn_config.behavior.max_node)
        sim = Sim(drawn_config, min(BATCH, count), tree)
        for scene in scenes:
            rows = drawn(sim, scene, seed, count)
            parts.append((*rows, torch.full((count,), len(names), dtype=torch.int32)))
            names.append(f"{Path(world).stem}_{scene[1]}_{scene[2]:g}")
        sim.close()
    widest = [max(part[i].shape[1] for part in parts) for i in range(2)]
    rest = max(part[0].shape[1] - part[1].shape[1] for part in parts)
    obstacle = torch.cat([_padded(part[0], rest + widest[1], part[1].shape[1], rest) for part in parts])
    path = torch.cat([torch.nn.functional.pad(p[1], (0, 0, 0, widest[1] - p[1].shape[1])) for p in parts])
    longest = max(part[2].shape[1] for part in parts)
    route = torch.cat(
        [torch.cat([p[2], p[2][:, -1:].expand(-1, longest - p[2].shape[1], -1)], dim=1) for p in parts]
    )
    mission, origin = (torch.cat([part[i] for part in parts]) for i in (3, 4))
    return ScenarioBank(obstacle, path, route, mission, origin, tuple(names))


def _refuse_other_tank(world: str, own: TankConfig, wanted: TankConfig) -> None:
    if own != wanted or own.shape != "rectangle":
        raise ConfigError(
            f"surrogate.worlds: {world} has another tank than the run's world, or a round one; the surrogate "
            f"has one "
            "rectangular tank: give worlds that share it, for example surrogate.worlds=[pool,gauntlet]"
        )


def _padded(obstacle: torch.Tensor, width: int, lanes: int, rest: int) -> torch.Tensor:
    """With empty slots behind the static and behind the moving obstacles."""
    out = torch.zeros(len(obstacle), width, 8)
    own = obstacle.shape[1] - lanes
    out[:, :own], out[:, rest : rest + lanes] = obstacle[:, :own], obstacle[:, own:]
    return out


def drawn(sim: Sim, scene: Scene, seed: int, count: int) -> list[torch.Tensor]:
    """Obstacles, paths, routes and missions as in a bank, of one scene's episodes; slots that are empty
    everywhere are left out."""
    sim.set_scenes([scene])
    found = []
    for first in range(0, count, sim.num_envs):
        number = torch.arange(first, first + sim.num_envs, dtype=torch.int32)
        mask = (number < count).int()
        sim.draw_routes(mask, torch.full_like(mask, seed), number)
        found.append([rows[: int(mask.sum())] for rows in scenario_rows(sim)])
    obstacle, path, route, mission = (np.concatenate(part) for part in zip(*found, strict=True))
    rest = obstacle.shape[1] - path.shape[1]
    longest = 1 + int(np.argmax(route[..., 2] <= 0.0, axis=1).max())
    used = np.any(obstacle[:, :, 0] > 0, axis=0)
    moving = used[rest:]
    kept = obstacle[:, used], path[:, moving], route[:, :longest], mission
    return [torch.from_numpy(part.copy()) for part in kept]


def scenario_rows(sim: Sim) -> list[np.ndarray]:
    """Obstacles, paths, routes and missions of what every row of a simulator holds, float32; a row without a
    route goes straight to its goal."""
    s = sim.s
    kind, pos, size, yaw = (sim.rows(f) for f in (s.world.kind, s.world.pos_w, s.world.size, s.world.yaw))
    way = sim.rows(s.path.way_w)
    numbers = (s.path.n_way, s.path.radius_m, s.path.length_m, s.path.phase_m, s.path.speed_m_s)
    path = np.stack([sim.rows(field) for field in numbers], axis=-1)
    path = np.concatenate([path, way.reshape(*way.shape[:2], -1)], axis=-1)
    path = np.concatenate([path, sim.rows(s.path.easing_m)[..., None]], axis=-1)
    path[..., 2] = np.where(path[..., 2] > 0, path[..., 2], 1.0)
    m = s.mission
    mission = np.concatenate(
        [sim.rows(m.start_w), sim.rows(m.goal_w), sim.rows(m.start_yaw)[:, None]], axis=1
    )
    mission = np.concatenate([mission, np.zeros((len(mission), 1))], axis=1)
    obstacle = np.concatenate([kind[..., None], pos, size, yaw[..., None]], axis=-1)
    parts = obstacle, path, _routes(sim, mission), mission
    return [np.ascontiguousarray(a, np.float32) for a in parts]


def _routes(sim: Sim, mission: np.ndarray) -> np.ndarray:
    """(n, n_way, 3) as in a bank."""
    planned, start, goal = sim.s.route, mission[:, :2], mission[:, 3:5]
    count, straight_m = sim.rows(planned.n_way), np.hypot(*(goal - start).T)
    route = np.concatenate([sim.rows(planned.way_w), sim.rows(planned.way_left_m)[..., None]], axis=-1)
    straight = np.concatenate([start, straight_m[:, None]], axis=1)
    route[:, 0] = np.where(count[:, None] > 0, route[:, 0], straight)
    after = np.arange(route.shape[1]) >= np.maximum(count, 1)[:, None]
    end = np.concatenate([goal, np.zeros((len(goal), 1))], axis=1)
    return np.where(after[..., None], end[:, None], route)


# ------------------------------------------------------------------------------------------------------------


class SurrogateView(NamedTuple):
    """What is known of N envs. The tensors are the surrogate's own: clone what must outlive the next step."""

    obstacles: torch.Tensor
    """(N, lanes, OBSTACLE_WIDTH) obstacles as tracked; the first column is 1 where there is one, else all are
    0"""
    own: torch.Tensor
    """(N, EGO_COLUMNS) the vehicle, its goal and the free distances around it"""
    truth: torch.Tensor
    """(N, lanes, TRUTH_WIDTH) true places of the obstacles, now and 1, 2, 3 s later: for a critic in
    training"""


class Surrogate:
    """N episodes of a bank's scenarios. An env whose episode has ended goes on after ``begin``."""

    def __init__(self, config: LearningConfig, bank: ScenarioBank, num_envs: int, seed: int) -> None:
        """``seed`` opens the noise of the tracks."""
        start_taichi("cpu")
        self.bank, self.num_envs, self.seed, self.count = bank, num_envs, seed, 0
        self.rules = bind(SurrogateRules, config)
        lanes = bank.path.shape[1]
        self.ego = torch.zeros(num_envs, EGO_WIDTH)
        self.scenario = torch.zeros(num_envs, dtype=torch.int32)
        self.track = torch.zeros(num_envs, lanes, TRACK_WIDTH)
        self.reward, self.outcome = torch.zeros(num_envs), torch.zeros(num_envs, dtype=torch.int32)
        self._raw = torch.zeros(num_envs, lanes, RAW_WIDTH)
        self._ray = torch.zeros(num_envs, N_RAY)
        self.view = SurrogateView(
            torch.zeros(num_envs, lanes, OBSTACLE_WIDTH),
            torch.zeros(num_envs, EGO_COLUMNS),
            torch.zeros(num_envs, lanes, TRUTH_WIDTH),
        )

    @property
    def num_scenarios(self) -> int:
        """How many there are to begin."""
        return len(self.bank.obstacle)

    @property
    def time_s(self) -> torch.Tensor:
        """(N,) since the begin of each episode."""
        return self.ego[:, 8]

    def begin(self, rows: torch.Tensor, scenario: torch.Tensor) -> None:
        """Begin the scenarios of these numbers (N,) in the envs (N,) where ``rows`` is true; ``look`` comes
        next."""
        self.scenario = torch.where(rows, scenario.int(), self.scenario)
        b = self.bank
        motion.begin_surrogate(rows.int(), b.mission, b.route, self.scenario, self.ego, self.track)

    def look(self) -> SurrogateView:
        """Sense once more, after ``step`` and ``begin``."""
        b = self.bank
        sensing.sense_surrogate(
            self.rules, self.seed, self.count, b.obstacle, b.path, b.route, self.scenario, self.ego,
            self.track, self._raw, self._ray, self.view.truth, self.view.obstacles, self.view.own,
        )  # fmt: skip
        self.count = (self.count + 1) % 2**30
        return self.view

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Carry out a decision (N, 3): (reward, outcome code), both (N,)."""
        b = self.bank
        motion.drive_surrogate(
            self.rules, action.contiguous(), b.obstacle, b.path, b.route, self.scenario, self.ego,
            self.reward, self.outcome,
        )  # fmt: skip
        return self.reward, self.outcome

    def capture(self) -> dict[str, np.ndarray]:
        """All that the next steps depend on."""
        found = {name: getattr(self, name).numpy().copy() for name in ("ego", "scenario", "track")}
        found |= {f"view.{name}": part.numpy().copy() for name, part in self.view._asdict().items()}
        return found | {"count": np.array([self.count])}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on from what ``capture`` gave."""
        for name in ("ego", "scenario", "track"):
            getattr(self, name).copy_(torch.from_numpy(arrays[name]))
        for name, part in self.view._asdict().items():
            part.copy_(torch.from_numpy(arrays[f"view.{name}"]))
        self.count = int(arrays["count"][0])
