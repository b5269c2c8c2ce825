"""The stack without the simulator: sensor messages in, commands with their reasons out.

    pilot = OnboardPilot.built(config, read_tree("bt"), Mission(start, goal))
    while True:                      # every control_dt_s (20 ms)
        for message in arrived:
            pilot.feed(message)
        command = pilot.tick()

It runs the stages of ``Sim`` themselves, from the pose filter to the behaviour tree's tick: the same kernels
on the same arrays, of which ``FedSensors`` fills the readings. Where nothing better can be done than to stop,
the action is zero and ``held`` says why (``StaleLimits``).
"""

from __future__ import annotations

from uuvtai.config import Config
from uuvtai.logs.moment import numbered
from uuvtai.pilot.fed_pilot import FedPilot, StaleLimits
from uuvtai.pilot.mission import Mission
from uuvtai.pilot.pilot_numbers import PilotNumbers
from uuvtai.pilot.sim_stack import SimStack
from uuvtai.sim import Sim
from uuvtai.tree import FlatTree


class OnboardPilot(FedPilot):
    """One vehicle's stack in a simulator's row 0. On the CPU."""

    def __init__(self, sim: Sim, mission: Mission, limits: StaleLimits | None = None) -> None:
        """``sim``: its row 0 becomes the pilot's, its ``sensors`` are replaced. ValueError on a GPU, and for
        a config whose map takes the truth in (``mapping.stamp``)."""
        self.config = sim.config
        if sim.device.type != "cpu" or self.config.mapping.stamp > 0:
            raise ValueError("the pilot runs on the CPU, with a map that it makes itself (mapping.stamp 0)")
        super().__init__(numbers_of(sim.config, sim.tree), SimStack(sim), mission, limits)

    @classmethod
    def built(
        cls, config: Config, tree: FlatTree, mission: Mission, limits: StaleLimits | None = None
    ) -> OnboardPilot:
        """A pilot with a simulator of its own; its kernels are compiled, or found compiled, at the first
        steps (``uuv warm --num-envs 1``)."""
        return cls(Sim(config, 1, tree), mission, limits)


def numbers_of(config: Config, tree: FlatTree) -> PilotNumbers:
    """Of a config and a tree."""
    sensors, vehicle = config.sensors, config.vehicle
    sonar, camera = sensors.sonar, sensors.depth
    return PilotNumbers(
        dt_s=config.episode.control_dt_s,
        top=(
            vehicle.max_surge_m_s,
            vehicle.max_sway_m_s,
            vehicle.max_heave_m_s,
            vehicle.max_yaw_rate_rad_s,
        ),
        nodes=numbered(tree.names),
        gravity_m_s2=vehicle.gravity_m_s2,
        estimated=sensors.localization == "estimated",
        dvl_steps=sensors.dvl.period_steps,
        beams=sonar.n_ray,
        beam_limit=2 * sonar.n_ray if sonar.is_ring else sonar.n_ray,
        mechanical=sonar.mechanical,
        doppler=sonar.doppler,
        sonar_latency_steps=sonar.latency_steps,
        sonar_m=sonar.max_range_m,
        image=(camera.rows, camera.cols),
        camera_m=camera.max_range_m,
    )
