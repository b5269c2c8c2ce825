"""The surrogate: as many episodes side by side as one likes, decided ten times a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from uuvtai.common.enums import EGO_COLUMNS, N_RAY, OBSTACLE_WIDTH
from uuvtai.common.presets import TRAINING_TREE
from uuvtai.compile.runtime import start_taichi
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import ConfigError, load_config
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.setup import N_CORNER, Scene
from uuvtai.sim.sim import Sim
from uuvtai.sim.stages import bind
from uuvtai.surrogate import motion, safety, sensing
from uuvtai.surrogate.arrays import EGO_WIDTH, RAW_WIDTH, TRACK_WIDTH, TRUTH_WIDTH, At, Rules

BATCH = 256  # envs of the simulator that draws


@dataclass(frozen=True)
class ScenarioBank:
    """B scenarios, drawn by the simulator itself: static obstacles first, then the moving ones."""

    obstacle: torch.Tensor
    """(B, n_obstacle, 8) kind, centre (3), size (3), yaw; kind 0 = none"""
    path: torch.Tensor
    """(B, n_lane, 16) corners (0 = circle), radius, length, phase, speed, x and y of corners or centre"""
    route: torch.Tensor
    """(B, n_way, 3) waypoints x, y and the length left [m], filled up with the goal"""
    mission: torch.Tensor
    """(B, 7) start (3), goal (3), heading at the start"""
    origin: torch.Tensor
    """(B,) int32: which of ``names`` it was drawn for"""
    names: tuple[str, ...]
    """world_D_v by number"""


def draw_bank(config: LearningConfig, scenes: tuple[Scene, ...], seed: int, count: int) -> ScenarioBank:
    """Episodes 0 .. count - 1 of ``seed`` for every pair of a world of ``surrogate.worlds`` and a scene (S,
    D, v). Raises ConfigError for a world that is none, or has another tank than the run's."""
    parts, names = [], []
    n_static, n_dynamic = (max(scene[i] for scene in scenes) for i in range(2))
    for world in config.surrogate.worlds:
        own = load_config(world, overrides=[("world.n_static", n_static), ("world.n_dynamic", n_dynamic)])
        if own.world.tank != config.world.tank or own.world.tank.shape != "rectangle":
            told = "give worlds that share a rectangular one, for example surrogate.worlds=[pool,gauntlet]"
            raise ConfigError(f"surrogate.worlds: {world} has another tank, or a round one; {told}")
        if any(len(one.path) > N_CORNER for one in own.world.fixed):
            raise ConfigError(f"surrogate.worlds: {world} has a path of more than {N_CORNER} corners")
        sim = Sim(own, min(BATCH, count), read_tree(TRAINING_TREE))
        for scene in scenes:
            parts.append(drawn(sim, scene, seed, count))
            names.append(f"{Path(world).stem}_{scene[1]}_{scene[2]:g}")
        sim.close()
    static, moving, path, route, mission = zip(*parts, strict=True)
    obstacle = np.concatenate([_joined(static), _joined(moving)], axis=1)
    arrays = obstacle, _joined(path), _joined(route, "edge"), np.concatenate(mission)
    origin = np.arange(len(names), dtype=np.int32).repeat(count)
    return ScenarioBank(*map(torch.from_numpy, (*arrays, origin)), names=tuple(names))


def _joined(parts: Sequence[np.ndarray], more: Literal["constant", "edge"] = "constant") -> np.ndarray:
    """One below the other; what has fewer slots than others gets empty ones, or its last one ("edge")."""
    widest = max(part.shape[1] for part in parts)
    return np.concatenate([np.pad(p, ((0, 0), (0, widest - p.shape[1]), (0, 0)), more) for p in parts])


def drawn(sim: Sim, scene: Scene, seed: int, count: int) -> tuple[np.ndarray, ...]:
    """Static and moving obstacles, paths, routes and missions of one scene, without empty slots."""
    sim.set_scenes([scene])
    found = []
    for first in range(0, count, sim.num_envs):
        number = torch.arange(first, first + sim.num_envs, dtype=torch.int32)
        mask = (number < count).int()
        sim.draw_routes(mask, torch.full_like(mask, seed), number)
        found.append([rows[: count - first] for rows in scenario_rows(sim)])
    obstacle, path, route, mission = (np.concatenate(part) for part in zip(*found, strict=True))
    rest = obstacle.shape[1] - path.shape[1]
    used = np.any(obstacle[:, :, 0] > 0, axis=0)
    static, moving = obstacle[:, :rest][:, used[:rest]], obstacle[:, rest:][:, used[rest:]]
    longest = 1 + int(np.argmax(route[..., 2] <= 0.0, axis=1).max())
    return static, moving, path[:, used[rest:]], route[:, :longest], mission


def scenario_rows(sim: Sim) -> list[np.ndarray]:
    """Obstacles, paths, routes and missions that a simulator holds; without a route it is a straight line."""
    world, p, mission = sim.s.world, sim.s.path, sim.s.mission
    obstacle = _columns(sim, world.kind, world.pos_w, world.size, world.yaw)
    path = _columns(sim, p.n_way, p.radius_m, p.length_m, p.phase_m, p.speed_m_s, p.way_w, p.easing_m)
    path[..., 2] = np.where(path[..., 2] > 0, path[..., 2], 1.0)
    places = _columns(sim, mission.start_w, mission.goal_w, mission.start_yaw)
    return [obstacle, path, _routes(sim, places.astype(float)), places]


def _columns(sim: Sim, *fields: Any) -> np.ndarray:
    """Fields of numbers and of vectors side by side, float32."""
    found = [sim.rows(field) for field in fields]
    shape = min((rows.shape for rows in found), key=len)  # of those of numbers
    return np.concatenate([rows.reshape(*shape, -1) for rows in found], axis=-1, dtype=np.float32)


def _routes(sim: Sim, mission: np.ndarray) -> np.ndarray:
    start, goal = mission[:, :2], mission[:, 3:5]
    count, straight_m = sim.rows(sim.s.route.n_way)[:, None], np.hypot(*(goal - start).T)
    route = _columns(sim, sim.s.route.way_w, sim.s.route.way_left_m)
    route[:, 0] = np.where(count > 0, route[:, 0], np.column_stack([start, straight_m]))
    after = np.arange(route.shape[1]) >= np.maximum(count, 1)
    return np.where(after[..., None], np.pad(goal, ((0, 0), (0, 1)))[:, None].astype(np.float32), route)


class Surrogate:
    """N episodes of a bank's scenarios. An env whose episode has ended goes on after ``begin``."""

    def __init__(self, config: LearningConfig, bank: ScenarioBank, num_envs: int, seed: int) -> None:
        """``seed`` opens the noise of the tracks."""
        start_taichi("cpu")
        self.bank, self.num_envs, self.seed = bank, num_envs, seed
        self.rules, lanes = bind(Rules, config), bank.path.shape[1]
        self.ego, self.track = torch.zeros(num_envs, EGO_WIDTH), torch.zeros(num_envs, lanes, TRACK_WIDTH)
        self.scenario, self.outcome = (torch.zeros(num_envs, dtype=torch.int32) for _ in range(2))
        self.reward, self.count = torch.zeros(num_envs), torch.zeros(1, dtype=torch.int64)
        self._every = torch.ones(num_envs, dtype=torch.int32)
        self._raw, self._ray = torch.zeros(num_envs, lanes, RAW_WIDTH), torch.zeros(num_envs, N_RAY)
        self.view = {
            "obstacles": torch.zeros(num_envs, lanes, OBSTACLE_WIDTH),
            "own": torch.zeros(num_envs, EGO_COLUMNS),
            "truth": torch.zeros(num_envs, lanes, TRUTH_WIDTH),
        }
        """obstacles as tracked; the vehicle, its goal and the free distances around it; true places of the
        obstacles, now and 1, 2, 3 s later, for a critic. Clone what must outlive the next step."""
        self._carried = {"ego": self.ego, "scenario": self.scenario, "track": self.track, "count": self.count}
        self._carried |= {f"view.{name}": part for name, part in self.view.items()}

    @property
    def time_s(self) -> torch.Tensor:
        return self.ego[:, At.TIME]

    def begin(self, rows: torch.Tensor, scenario: torch.Tensor) -> None:
        """Begin the scenarios of these numbers (N,) in the envs where ``rows`` (N,) is true."""
        envs = rows.nonzero().flatten()
        number = scenario[envs].long()
        start, goal, yaw = self.bank.mission[number].split((3, 3, 1), dim=1)
        ego = torch.zeros(len(envs), EGO_WIDTH)
        ego[:, At.POS : At.POS + 3], ego[:, At.GOAL : At.GOAL + 3] = start, goal
        ego[:, At.YAW], ego[:, At.LEFT] = yaw[:, 0], self.bank.route[number, 0, 2]
        ego[:, At.FLIP : At.FLIP + 2] = torch.where(goal >= start, 1.0, -1.0)[:, :2]
        self.scenario[envs], self.ego[envs], self.track[envs] = number.int(), ego, 0.0
        self.track[envs, :, 5] = 9.0

    def look(self) -> dict[str, torch.Tensor]:
        """Sense once more, after ``step`` and ``begin``; the view."""
        b, view = self.bank, self.view
        sensing.sense_surrogate(
            self.rules, self.seed, int(self.count), b.obstacle, b.path, b.route, self.scenario, self.ego,
            self.track, self._raw, self._ray, view["truth"], view["obstacles"], view["own"],
        )  # fmt: skip
        self.count[0] = (self.count[0] + 1) % 2**30
        return view

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Carry out a decision (N, 3), filtered: (reward, outcome code), both (N,)."""
        b, view, action = self.bank, self.view, action.contiguous().clone()
        if horizon_s := self.rules.surrogate_cfg.safety_horizon_s:
            safety.filter_wishes(self.rules, horizon_s, self._every, view["obstacles"], view["own"], action)
        motion.drive_surrogate(
            self.rules, action, b.obstacle, b.path, b.route, self.scenario, self.ego,
            self.reward, self.outcome,
        )  # fmt: skip
        return self.reward, self.outcome

    def capture(self) -> dict[str, np.ndarray]:
        return {name: part.numpy().copy() for name, part in self._carried.items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        for name, part in self._carried.items():
            part.copy_(torch.from_numpy(arrays[name]))
