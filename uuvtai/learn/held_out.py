"""Held-out episodes for a policy over a set of bodies, in the simulators that it learns in."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from uuvtai.learn.pilot import by_chunk
from uuvtai.outcomes import RUNNING

if TYPE_CHECKING:
    from uuvtai.learn.set_policy import SetActor
    from uuvtai.learn.simulated_world import SimulatedWorld


@torch.no_grad()
def play_held_out(
    world: SimulatedWorld, actor: SetActor, seed: int, each: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(outcome code, time [s], which of ``world.names``), one row per episode, of episodes 0 .. ``each`` - 1
    of ``seed`` for every pair of world and scene, driven by the mean. What the world was about goes on as if
    nothing had been."""
    held, found = world.capture(), []
    at_once = world.num_envs // len(world.names)
    place = torch.zeros(world.num_envs, dtype=torch.int64)
    for name in range(len(world.names)):
        place[world.origin == name] = torch.arange(at_once)
    for first in range(0, each, at_once):
        rows = first + place < each
        world.rest()
        world.begin(rows, first + place, seed)
        outcome, time_s = _played(world, actor, rows)
        found.append((outcome[rows], time_s[rows], world.origin[rows]))
    world.restore(held)
    outcome, time_s, origin = (torch.cat(parts) for parts in zip(*found, strict=True))
    return outcome, time_s, origin


def _played(world: SimulatedWorld, actor: SetActor, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(outcome code, time [s]), both (N,), when the episodes of these ``rows`` (N,) have ended."""
    running = rows
    outcome = torch.zeros(world.num_envs, dtype=torch.int32)
    while bool(running.any()):
        view = world.look()
        _, outcome = world.step(by_chunk(actor, view.bodies, view.own))
        running = rows & (outcome == RUNNING)
    return outcome.clone(), world.time_s
