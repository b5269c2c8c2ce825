"""The vehicle alone: actuation and dynamics in endless water, for experiments on the physics. No world, no
sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_type_hints

import numpy as np
import taichi as ti
import torch

from uuvtai import state
from uuvtai.common.errors import SettingError
from uuvtai.compile.codegen import adopt
from uuvtai.compile.memory import HostFields, Memory, address_of, numpy_type
from uuvtai.compile.runtime import Runtime
from uuvtai.config import Config
from uuvtai.kernels.sensors import proprioception
from uuvtai.kernels.sensors.io import ExactProprioceptionIO
from uuvtai.kernels.vehicle import control, dynamics
from uuvtai.kernels.vehicle.io import ActuationIO, DynamicsIO
from uuvtai.kernels.vehicle.thruster_fault import response_size
from uuvtai.sim.setup import allocation_matrices
from uuvtai.sim.stages import bind


@dataclass(frozen=True)
class Structs:
    """All that a vehicle alone needs."""

    clock: state.ClockState
    episode: state.EpisodeState
    mission: state.MissionState
    vehicle: state.VehicleState
    params: state.VehicleParams
    actuation: state.ActuationState
    allocation: state.Allocation
    current: state.CurrentState
    ego: state.Proprioception


class Plant:
    """``n_env`` vehicles of one config, moved step by step. Taichi must be running as ``runtime``."""

    def __init__(self, config: Config, runtime: Runtime, n_env: int = 1) -> None:
        dead, count = config.disturbance.dead_thruster, len(config.vehicle.thrusters)
        if dead is not None and dead >= count:
            raise SettingError(
                f"disturbance.dead_thruster is {dead}, but the vehicle has thrusters 0 to {count - 1}"
            )
        self.config, self.n_env, self.real = config, n_env, runtime.real
        self._host = HostFields() if runtime.device == "cpu" else None
        sizes = {
            "n_env": n_env,
            "n_thruster": len(config.vehicle.thrusters),
            "n_wrench": 6,
            "n_response": response_size(config.vehicle),
            "n_delay": 1 + round(config.disturbance.thruster_delay_s / config.episode.control_dt_s),
        }
        ti.sync()  # what others have declared is placed by itself
        kinds = get_type_hints(Structs)
        s = Structs(**{name: state.allocate(kind, sizes, self.real) for name, kind in kinds.items()})
        self.clock, self.episode, self.mission = s.clock, s.episode, s.mission
        self.vehicle, self.params, self.ego, self.current = s.vehicle, s.params, s.ego, s.current
        self.actuation, self.allocation = s.actuation, s.allocation
        self.actuation_io = bind(ActuationIO, config, s)
        self.dynamics_io = bind(DynamicsIO, config, s)
        self.senses_io = bind(ExactProprioceptionIO, config, s)
        if config.runtime.native and runtime.device == "cpu" and runtime.precision == "f32":
            device = torch.device("cpu")
            memory = Memory(s, s.clock.running, address_of(s.clock.running, device), device)
            adopt((self.actuation_io, self.dynamics_io, self.senses_io), memory, alone=n_env == 1)
        wrench_of_thrust, thrust_of_wrench = allocation_matrices(config.vehicle)
        self.write(self.allocation.wrench_of_thrust, wrench_of_thrust)
        self.write(self.allocation.thrust_of_wrench, thrust_of_wrench)
        self._asked = torch.zeros(n_env, 4, device=runtime.device)
        self.steps = 0

    def write(self, field: Any, value: Any) -> None:
        """Fill a field from anything that broadcasts to (field shape, vector length)."""
        view = self._host.view(field) if self._host else None
        if view is not None:  # in memory: Taichi would compile a kernel for every field
            view[...] = value
            return
        shape = (*field.shape, field.n) if hasattr(field, "n") else field.shape
        whole = np.broadcast_to(np.asarray(value, numpy_type(field)), shape)
        field.from_numpy(np.ascontiguousarray(whole))

    def read(self, field: Any) -> np.ndarray:
        """A copy of a field, vectors with a last axis."""
        view = self._host.view(field) if self._host else None
        return field.to_numpy() if view is None else view.copy()

    def reset(self, keys: np.ndarray | None = None) -> None:
        """All vehicles at rest at the origin; ``keys`` (n_env) are the episodes' random keys (default: 0, 1,
        2, ..)."""
        self.write(self.clock.running, 1)
        self.write(self.clock.active, 1)
        self._set_time(0)
        self.write(self.episode.key, np.arange(self.n_env) if keys is None else keys)
        dynamics.reset_vehicle(self.dynamics_io)
        control.reset_actuation(self.actuation_io)

    def step(
        self, action: np.ndarray | None = None, substeps: int | None = None, dt_s: float | None = None
    ) -> None:
        """One control step, driven by the inner loop on exact measurements where ``action`` (n_env, 4) is
        given."""
        rules = self.config.episode
        if action is not None:
            proprioception.sense_exactly(self.senses_io)
            self.command(action)
        dt_s = rules.control_dt_s if dt_s is None else dt_s
        dynamics.move_vehicle(self.dynamics_io, dt_s, rules.substeps if substeps is None else substeps)
        self._set_time(self.steps + 1)

    def _set_time(self, steps: int) -> None:
        self.steps = steps
        self.write(self.clock.step, steps)

    def command(self, action: np.ndarray) -> None:
        """The inner loop alone, on whatever ``ego`` holds."""
        self._asked.copy_(torch.as_tensor(action))
        control.command_thrusters(self.actuation_io, self._asked)
