"""One vehicle under way without a world: what it is told, and how a simulator's row 0 serves it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from uuvtai import stack
from uuvtai.kernels.task import episode
from uuvtai.sim import Sim


@dataclass(frozen=True)
class Mission:
    """What a vehicle is told before it begins."""

    start: tuple[float, float, float]
    """[m] world, where it begins"""
    goal: tuple[float, float, float]
    """[m] world"""
    seed: int = 0
    """with ``episode``: of the fallback planner's random numbers"""
    episode: int = 0


def begin_mission(sim: Sim, mission: Mission) -> None:
    """Begin in row 0 alone: ``sim.sensors`` delivers what is sensed there, ``step_mission`` goes on. The
    other rows sleep."""
    mask, seed, number = torch.zeros(3, sim.num_envs, dtype=torch.int32, device=sim.device)
    mask[0], seed[0], number[0] = 1, mission.seed, mission.episode
    sim.sleep()
    episode.begin_episodes(sim.io.episode, mask, seed, number)
    for field, place in (
        (sim.s.mission.start_w, mission.start),
        (sim.s.mission.goal_w, mission.goal),
        (sim.s.vehicle.pos_w, mission.start),
    ):
        places = sim.rows(field)
        places[0] = place
        sim.put(field, places)
    stack.forget(sim.io, sim.config)
    sim.perceive()
    episode.wake(sim.io.episode)


def step_mission(sim: Sim) -> None:
    """One control step more: perception to the tree's choice, nothing is moved."""
    episode.advance_clock(sim.io.episode)
    sim.perceive()
