"""The stages behind the sensors as a simulator's row 0 runs them."""

from __future__ import annotations

import torch

from uuvtai import stack
from uuvtai.kernels.task import episode
from uuvtai.pilot.mission import Mission
from uuvtai.sensing import SensorSource
from uuvtai.sim import Sim


class SimStack:
    """A ``StackRunner``."""

    def __init__(self, sim: Sim) -> None:
        self.sim = sim
        memory = sim.memory()
        self.views = memory.views(memory.read(), scratch=True)
        self._asked = list(torch.zeros(3, sim.num_envs, dtype=torch.int32, device=sim.device))

    def begin(self, mission: Mission, sensors: SensorSource) -> None:
        """Begin in row 0 alone: ``sensors`` delivers what is sensed there. The other rows sleep."""
        sim = self.sim
        for asked, of_row in zip(self._asked, (1, mission.seed, mission.episode), strict=True):
            asked[0] = of_row
        sim.sleep()
        episode.begin_episodes(sim.io.episode, *self._asked)
        self.place(mission)
        stack.forget(sim.io, sim.config)
        sim.sensors = sensors
        sim.perceive()
        episode.wake(sim.io.episode)

    def place(self, mission: Mission) -> None:
        """Tell the stack start and goal."""
        for name, place in mission.places().items():
            self.views[name][0] = place

    def step(self, sensors: SensorSource) -> None:
        """One control step more: perception to the tree's choice, nothing is moved."""
        self.sim.sensors = sensors
        episode.advance_clock(self.sim.io.episode)
        self.sim.perceive()
