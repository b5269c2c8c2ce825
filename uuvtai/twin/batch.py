"""Many twins side by side: ``reset`` and ``step`` as a simulator has them, ten decisions a second."""

from __future__ import annotations

from typing import NamedTuple

import torch

from uuvtai.config import Config
from uuvtai.outcomes import RUNNING, SUCCESS, TIMEOUT
from uuvtai.runtime import start_taichi
from uuvtai.twin import motion, sensed
from uuvtai.twin.scenario_bank import ScenarioBank, TwinScene
from uuvtai.twin.tensors import (
    BODY_COLUMNS,
    DECISION_S,
    EGO_COLUMNS,
    MOVERS,
    N_EGO,
    N_MOVER,
    N_STATIC,
    N_TRACK,
    RAYS,
    SEEN_COLUMNS,
    STATICS,
    TRUE_COLUMNS,
)

PROGRESS, TIME, NEAR, NEAR_M = 0.05, 0.001, 0.01, 0.5
"""reward: per metre towards the goal, per decision, per decision at a body, from this clearance on"""


class TwinView(NamedTuple):
    """What N rows see; copies."""

    body: torch.Tensor
    """(N, MOVERS, BODY_COLUMNS)"""
    row: torch.Tensor
    """(N, EGO_COLUMNS)"""
    true: torch.Tensor
    """(N, MOVERS, TRUE_COLUMNS) for the critic alone"""


class TwinBatch:
    """``num_envs`` twins. ``state`` and ``load_state`` hold all that goes on changing."""

    def __init__(
        self,
        config: Config,
        banks: dict[str, ScenarioBank],
        scenes: list[TwinScene],
        num_envs: int,
        seed: int,
    ) -> None:
        """``config``: tank, vehicle and the referee's rules, the same for all scenes."""
        start_taichi("cpu")
        self.config, self.scenes, self._banks, self.num_envs = config, scenes, banks, num_envs
        self.generator = torch.Generator().manual_seed(seed)
        n = num_envs
        self.static, self.mover = torch.zeros(n, STATICS, N_STATIC), torch.zeros(n, MOVERS, N_MOVER)
        self.ego, self.track = torch.zeros(n, N_EGO), torch.zeros(n, MOVERS, N_TRACK)
        self.scene = torch.zeros(n, dtype=torch.int64)
        self.nearest, self.outcome = torch.zeros(n), torch.zeros(n, dtype=torch.int32)
        self._seen, self._ray = torch.zeros(n, MOVERS, SEEN_COLUMNS), torch.zeros(n, RAYS)
        self._view = TwinView(
            torch.zeros(n, MOVERS, BODY_COLUMNS),
            torch.zeros(n, EGO_COLUMNS),
            torch.zeros(n, MOVERS, TRUE_COLUMNS),
        )
        self._weight = torch.tensor([scene.weight for scene in scenes], dtype=torch.float32)

    def state(self) -> dict[str, torch.Tensor]:
        """All that a run goes on from."""
        names = ("static", "mover", "ego", "track", "scene")
        return {name: getattr(self, name).clone() for name in names} | {"random": self.generator.get_state()}

    def load_state(self, state: dict[str, torch.Tensor]) -> None:
        """Stand where ``state`` was taken."""
        for name in ("static", "mover", "ego", "track", "scene"):
            getattr(self, name).copy_(state[name])
        self.generator.set_state(state["random"])

    def reset(self, rows: torch.Tensor) -> None:
        """Begin episodes in the rows (indices): a scene by its weight, one of its world's scenarios."""
        if len(rows) == 0:
            return
        scene = torch.multinomial(self._weight, len(rows), replacement=True, generator=self.generator)
        pick = torch.rand(len(rows), generator=self.generator)
        for number in scene.unique().tolist():
            chosen = scene == number
            bank = self._banks[self.scenes[number].world]
            self.begin(
                rows[chosen], number, (pick[chosen] * len(bank.start)).long().clamp(max=len(bank.start) - 1)
            )

    def begin(self, rows: torch.Tensor, number: int, index: torch.Tensor) -> None:
        """Begin scenarios ``index`` of scene ``number`` in these rows."""
        scene = self.scenes[number]
        bank = self._banks[scene.world]
        static, mover = bank.static[index].clone(), bank.mover[index].clone()
        static[:, scene.n_static :, 0] = 0.0
        mover[:, scene.n_dynamic :, 0] = 0.0
        mover[:, :, 8] = scene.speed_m_s
        self.static[rows], self.mover[rows], self.scene[rows] = static, mover, number
        start, goal = bank.start[index], bank.goal[index]
        ego = torch.zeros(len(rows), N_EGO)
        ego[:, 0:3], ego[:, 6], ego[:, 9:12] = start, bank.yaw[index], goal
        ego[:, 12:14] = flips(start, goal)
        self.ego[rows] = ego
        track = torch.zeros(len(rows), MOVERS, N_TRACK)
        track[..., 5] = 9.0
        self.track[rows] = track

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Carry out a decision (N, 3), parts of the limits in the mirrored frame; (reward, outcome) (N,)."""
        before = (self.ego[:, 9:12] - self.ego[:, :3]).norm(dim=-1)
        c = self.config
        motion.drive(
            self.static, self.mover, self.ego, action.contiguous(), self.nearest, self.outcome, c.vehicle,
            c.world.tank, c.episode,
        )  # fmt: skip
        noise = torch.randn(self.num_envs, MOVERS, 2, generator=self.generator)
        sensed.sense(self.static, self.mover, self.ego, self.track, noise, DECISION_S)
        after = (self.ego[:, 9:12] - self.ego[:, :3]).norm(dim=-1)
        reward = PROGRESS * (before - after) - TIME - NEAR * (1.0 - self.nearest / NEAR_M).clamp(0.0, 1.0)
        ended = (self.outcome != RUNNING) & (self.outcome != TIMEOUT)
        won = self.outcome == SUCCESS
        return reward + won.float() - (ended & ~won).float(), self.outcome.clone()

    def look(self) -> TwinView:
        """What every row sees now."""
        view, tank = self._view, self.config.world.tank
        sensed.gather_tracks(
            self.static,
            self.mover,
            self.ego,
            self.track,
            self._seen,
            self._ray,
            view.true,
            tank.x_m[1],
            tank.y_m[1],
        )
        sensed.write_rows(self.ego, self._seen, self._ray, view.body, view.row)
        return TwinView(view.body.clone(), view.row.clone(), view.true.clone())


def flips(start: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """(n, 2) of 1 and -1: mirrors that bring the goal towards +x, +y."""
    return torch.where((goal - start)[:, :2] >= 0.0, 1.0, -1.0)
