"""The twin: as many episodes side by side as one likes, decided ten times a second."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

from uuvtai.binding import bind
from uuvtai.config.learning import LearningConfig
from uuvtai.runtime import start_taichi
from uuvtai.twin import kinematics, sensing_model
from uuvtai.twin.scenario_bank import ScenarioBank
from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS, N_RAY
from uuvtai.twin.twin_arrays import EGO_WIDTH, RAW_WIDTH, TRACK_WIDTH, TRUTH_WIDTH, TwinRules


class TwinView(NamedTuple):
    """What is known of N envs. The tensors are the twin's own: clone what must outlive the next step."""

    bodies: torch.Tensor
    """(N, lanes, BODY_WIDTH) bodies as tracked; the first column is 1 where there is one, else all are 0"""
    own: torch.Tensor
    """(N, EGO_COLUMNS) the vehicle, its goal and the free distances around it"""
    truth: torch.Tensor
    """(N, lanes, TRUTH_WIDTH) true places of the bodies, now and 1, 2, 3 s later: for a critic in training"""


class Twin:
    """N episodes of a bank's scenarios. An env whose episode has ended goes on after ``begin``."""

    def __init__(self, config: LearningConfig, bank: ScenarioBank, num_envs: int, seed: int) -> None:
        """``seed`` opens the noise of the tracks."""
        start_taichi("cpu")
        self.bank, self.num_envs, self.seed, self.count = bank, num_envs, seed, 0
        self.rules = bind(TwinRules, config)
        lanes = bank.path.shape[1]
        self.ego = torch.zeros(num_envs, EGO_WIDTH)
        self.scenario = torch.zeros(num_envs, dtype=torch.int32)
        self.track = torch.zeros(num_envs, lanes, TRACK_WIDTH)
        self.reward, self.outcome = torch.zeros(num_envs), torch.zeros(num_envs, dtype=torch.int32)
        self._raw = torch.zeros(num_envs, lanes, RAW_WIDTH)
        self._ray = torch.zeros(num_envs, N_RAY)
        self.view = TwinView(
            torch.zeros(num_envs, lanes, BODY_WIDTH),
            torch.zeros(num_envs, EGO_COLUMNS),
            torch.zeros(num_envs, lanes, TRUTH_WIDTH),
        )

    @property
    def num_scenarios(self) -> int:
        """How many there are to begin."""
        return len(self.bank.body)

    @property
    def time_s(self) -> torch.Tensor:
        """(N,) since the begin of each episode."""
        return self.ego[:, 8]

    def begin(self, rows: torch.Tensor, scenario: torch.Tensor) -> None:
        """Begin the scenarios of these numbers (N,) in the envs (N,) where ``rows`` is true; ``look`` comes
        next."""
        self.scenario = torch.where(rows, scenario.int(), self.scenario)
        kinematics.begin_twin(rows.int(), self.bank.mission, self.scenario, self.ego, self.track)

    def look(self) -> TwinView:
        """Sense once more, after ``step`` and ``begin``."""
        b = self.bank
        sensing_model.sense_twin(
            self.rules, self.seed, self.count, b.body, b.path, self.scenario, self.ego, self.track,
            self._raw, self._ray, self.view.truth, self.view.bodies, self.view.own,
        )  # fmt: skip
        self.count = (self.count + 1) % 2**30
        return self.view

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Carry out a decision (N, 3): (reward, outcome code), both (N,)."""
        b = self.bank
        kinematics.drive_twin(
            self.rules,
            action.contiguous(),
            b.body,
            b.path,
            self.scenario,
            self.ego,
            self.reward,
            self.outcome,
        )
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
