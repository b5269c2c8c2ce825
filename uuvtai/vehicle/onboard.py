"""The stack on a vehicle: sensor messages in, commands out (docs/on_a_vehicle.md)."""

from __future__ import annotations

import torch

from uuvtai.config import Config
from uuvtai.kernels.task import episode
from uuvtai.logs.encode import numbered
from uuvtai.sim import stack
from uuvtai.sim.behavior_tree import FlatTree
from uuvtai.sim.sim import Sim
from uuvtai.sim.stack import SensorSource
from uuvtai.vehicle.messages import (
    KINDS,
    DepthShot,
    DvlReading,
    ImuReading,
    Mission,
    PilotNumbers,
    PositionFix,
    PressureReading,
    SensorMessage,
    SonarPing,
    Tally,
    ThrusterLoss,
)
from uuvtai.vehicle.onboard_core import FedPilot, PilotCommand, StaleLimits

# ---- The stages behind the sensors as a simulator's row 0 runs them.


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
        for name, place in mission.places().items():
            self.views[name][0] = place

    def step(self, sensors: SensorSource) -> None:
        """One control step more: perception to the tree's choice, nothing is moved."""
        self.sim.sensors = sensors
        episode.advance_clock(self.sim.io.episode)
        self.sim.perceive()


# ---- The stack without the simulator: sensor messages in, commands with their reasons out.
#
#     pilot = OnboardPilot.built(config, read_tree("bt"), Mission(start, goal))
#     while True:                      # every control_dt_s (20 ms)
#         for message in arrived:
#             pilot.feed(message)
#         command = pilot.tick()
#
# It runs the stages of ``Sim`` themselves, on arrays of which ``FedSensors`` fills the readings. Where it can
# only stop, the action is zero and ``held`` says why (``StaleLimits``).


class OnboardPilot(FedPilot):
    """One vehicle's stack in a simulator's row 0. On the CPU."""

    def __init__(self, sim: Sim, mission: Mission) -> None:
        """``sim``: its row 0 becomes the pilot's, its ``sensors`` are replaced. ValueError on a GPU."""
        self.config = sim.config
        if sim.device.type != "cpu":
            raise ValueError("the pilot runs on the CPU")
        super().__init__(numbers_of(sim.config, sim.tree), SimStack(sim), mission)

    @classmethod
    def built(cls, config: Config, tree: FlatTree, mission: Mission) -> OnboardPilot:
        """A pilot with a simulator of its own; its kernels are compiled, or found compiled, at the first
        steps (``uuv doctor --compile --num-envs 1``)."""
        return cls(Sim(config, 1, tree), mission)


def numbers_of(config: Config, tree: FlatTree) -> PilotNumbers:
    sensors, vehicle = config.sensors, config.vehicle
    sonar, camera = sensors.sonar, sensors.depth
    return PilotNumbers(
        dt_s=config.episode.control_dt_s,
        top=(vehicle.max_surge_m_s, vehicle.max_sway_m_s, vehicle.max_heave_m_s, vehicle.max_yaw_rate_rad_s),
        nodes=numbered(tree.names),
        gravity_m_s2=vehicle.gravity_m_s2,
        estimated=sensors.localization == "estimated",
        dvl_steps=sensors.dvl.period_steps,
        beams=sonar.n_ray,
        circle=sonar.circle_beams,
        mechanical=sonar.mechanical,
        doppler=sonar.doppler,
        sonar_latency_steps=sonar.latency_steps,
        sonar_m=sonar.max_range_m,
        image=(camera.rows, camera.cols),
        camera_m=camera.max_range_m,
    )


__all__ = [
    "KINDS", "DepthShot", "DvlReading", "ImuReading", "Mission", "OnboardPilot", "PilotCommand",
    "PositionFix", "PressureReading", "SensorMessage", "SonarPing", "StaleLimits", "Tally", "ThrusterLoss",
]  # fmt: skip
