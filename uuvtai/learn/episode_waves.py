"""Episodes of one scene in a trainer's simulator, so many at once as there are rows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import torch

from uuvtai.outcomes import RUNNING

if TYPE_CHECKING:
    from uuvtai.learn.pilot import PilotDecision
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim


class WavePilot(Protocol):
    """Who drives."""

    @property
    def simulator(self) -> Sim: ...

    running: torch.Tensor
    """(num_envs,) rows whose episode has not ended"""
    number: torch.Tensor
    """(num_envs,) episode of every row"""

    def reset(self, rows: torch.Tensor) -> None: ...
    def decide(self, obs: torch.Tensor, /) -> PilotDecision: ...
    def advance(self) -> None: ...


def play_episodes(
    pilot: WavePilot, scene: Scene, seed: int, first: int, count: int, times: int = 1
) -> tuple[torch.Tensor, torch.Tensor]:
    """(outcome code, control steps), both (count,), of episodes from ``first`` on of a seed, each played
    ``times`` times in a row."""
    sim = pilot.simulator
    outcome, steps = (torch.zeros(count, dtype=torch.int64) for _ in range(2))
    sim.set_scenes([scene])
    for begin in range(0, count, sim.num_envs):
        rows = torch.arange(sim.num_envs)
        mask = (rows < count - begin).int()
        pilot.running, pilot.number = mask == 1, begin + rows
        sim.sleep()
        sim.reset(mask, torch.full_like(mask, seed), (first + (begin + rows) // times).int())
        pilot.reset(mask)
        action = pilot.decide(sim.action).action
        while bool(pilot.running.any()):
            steps[pilot.number[pilot.running]] += 1
            sim.step(action)
            pilot.advance()
            now = torch.from_numpy(sim.rows(sim.s.referee.outcome).astype("int64"))
            ended = pilot.running & (now != RUNNING)
            if bool(ended.any()):
                outcome[pilot.number[ended]] = now[ended]
                pilot.running &= ~ended
                sim.sleep_ended()
            action = pilot.decide(sim.action).action
    return outcome, steps
