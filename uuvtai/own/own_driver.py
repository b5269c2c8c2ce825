"""A controller or a policy of the user's at the wheel, as ``measure.episodes.playing`` wants it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from uuvtai.learn.pilot import CHUNK, PilotDecision
from uuvtai.own import answers
from uuvtai.own.call_meter import CallMeter
from uuvtai.own.piece_errors import failed
from uuvtai.own.piece_spec import PieceSpec
from uuvtai.own.piece_view import Fixed, PieceView, Readings
from uuvtai.own.protocol import ACTION, COMMAND, View
from uuvtai.sim import Sim


class Marks(NamedTuple):
    """How a piece wants to be called (``protocol.piece``)."""

    rows: str = "batch"
    arrays: str = "numpy"
    hold_steps: int = 1


class OwnCode(NamedTuple):
    """The user's functions, and where they come from."""

    spec: PieceSpec
    act: Callable[..., Any]
    reset: Callable[..., Any] | None
    place: str
    """FILE:LINE of ``act``"""
    marks: Marks
    meter: CallMeter

    def called(self, function: Callable[..., Any], given: Any, decisions: int) -> Any:
        """What a function of hers answers. PieceError names the line where it fails."""
        try:
            with self.meter.call(decisions):
                return function(given)
        except (Exception, SystemExit) as error:
            raise failed(error, self.spec.path, self.spec.option) from error

    def forget(self, mask: torch.Tensor) -> None:
        """Tell her that new episodes begin in the rows where ``mask`` (n_env,) is not 0."""
        if self.reset is not None:
            rows = mask.nonzero().flatten().cpu().numpy()
            try:
                self.reset(rows)
            except (Exception, SystemExit) as error:
                raise failed(error, self.spec.path, f"in reset of {self.spec.option}") from error


Ask = Callable[[list[int], torch.Tensor], torch.Tensor]
"""(rows, their observations (n, n_obs)) -> actions (n, 4) in parts of the limits"""


class OwnDriver:
    """Asks for every row once per decision, the running rows alone. A ``playing.Driver``."""

    world_model = None

    def __init__(self, sim: Sim, code: OwnCode, ask: Ask) -> None:
        self._sim, self.code, self._ask = sim, code, ask
        self._age = np.zeros(sim.num_envs, np.int64)
        self._due = np.ones(sim.num_envs, bool)
        self._action = torch.zeros(sim.num_envs, 4, device=sim.device)
        self.decision = self._decision()

    def reset(self, rows: torch.Tensor) -> None:
        """New episodes have begun in the rows (n_env,) where this is not 0."""
        begun = rows.cpu().numpy() != 0
        self._age[begun], self._due[begun] = 0, True
        self.code.forget(rows)

    @torch.no_grad()
    def decide(self, obs: torch.Tensor) -> PilotDecision:
        """What to do now; rows that have decided already are not asked again."""
        running = self._sim.rows(self._sim.s.clock.active) == 1
        rows = np.flatnonzero(self._due & running)
        if len(rows):
            chosen = torch.from_numpy(rows).to(obs.device)
            self._action[chosen] = self._ask(rows.tolist(), obs[chosen]).clamp(-1.0, 1.0)
            self._due[rows] = False
            self.decision = self._decision()
        return self.decision

    def advance(self) -> None:
        """What was decided last has been done."""
        self._age += 1
        self._due |= self._age % self.code.marks.hold_steps == 0

    def _decision(self) -> PilotDecision:
        nothing = torch.zeros(0)
        return PilotDecision(self._action.clone(), *(nothing,) * (len(PilotDecision._fields) - 1))


def asking_controller(sim: Sim, code: OwnCode, columns: Mapping[str, slice], limits: np.ndarray) -> Ask:
    """Of ``act(view)``, which answers with a velocity command."""
    fixed, top = Fixed(sim, columns, limits, code.marks.arrays), torch.as_tensor(limits, device=sim.device)

    def ask(rows: list[int], obs: torch.Tensor) -> torch.Tensor:
        readings = Readings(sim, rows, obs)
        view: View = PieceView(readings, fixed)
        if code.marks.rows == "batch":
            found = code.called(code.act, view, len(rows))
        else:
            each = (code.called(code.act, PieceView(readings, fixed, i), 1) for i in range(len(rows)))
            found = torch.cat([answers.command(one, code.place, COMMAND) for one in each])
        return answers.commands(found, len(rows), code.place, COMMAND, sim.device) / top

    return ask


def asking_policy(code: OwnCode, device: torch.device) -> Ask:
    """Of ``act(obs)``, which answers with actions. Always ``CHUNK`` rows at once, the last chunk filled up:
    what a row does shall not depend on how many others are asked."""

    def ask(rows: list[int], obs: torch.Tensor) -> torch.Tensor:
        parts = []
        for first in range(0, len(rows), CHUNK):
            part = obs[first : first + CHUNK]
            whole = torch.cat([part, part[:1].expand(CHUNK - len(part), -1)])
            given = whole if code.marks.arrays == "torch" else whole.cpu().numpy()
            found = code.called(code.act, given, len(part))
            parts.append(answers.commands(found, CHUNK, code.place, ACTION, device)[: len(part)])
        return torch.cat(parts)

    return ask
