"""The vehicle alone: actuation and dynamics in endless water, for experiments on the physics. No world, no
sensors."""

from __future__ import annotations

from dataclasses import is_dataclass
from typing import Any, TypeVar

import numpy as np

from uuvtai import state
from uuvtai.common.errors import SettingError
from uuvtai.compile.memory import HostFields, numpy_type
from uuvtai.compile.runtime import Runtime
from uuvtai.config import Config
from uuvtai.kernels.sensors import proprioception
from uuvtai.kernels.sensors.io import ExactProprioceptionIO
from uuvtai.kernels.vehicle import control, dynamics
from uuvtai.kernels.vehicle.io import ActuationIO, DynamicsIO
from uuvtai.kernels.vehicle.thruster_fault import response_size
from uuvtai.sim.setup import allocation_matrices
from uuvtai.sim.stages import bind

_T = TypeVar("_T")


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
        self._sizes = {
            "n_env": n_env,
            "n_thruster": len(config.vehicle.thrusters),
            "n_wrench": 6,
            "n_response": response_size(config.vehicle),
            "n_delay": 1 + round(config.disturbance.thruster_delay_s / config.episode.control_dt_s),
        }
        self.clock = self._allocated(state.ClockState)
        self.episode = self._allocated(state.EpisodeState)
        self.mission = self._allocated(state.MissionState)
        self.vehicle = self._allocated(state.VehicleState)
        self.params = self._allocated(state.VehicleParams)
        self.actuation = self._allocated(state.ActuationState)
        self.allocation = self._allocated(state.Allocation)
        self.current = self._allocated(state.CurrentState)
        self.ego = self._allocated(state.Proprioception)
        structs = [value for value in vars(self).values() if is_dataclass(value)]
        self.actuation_io = bind(ActuationIO, config, *structs)
        self.dynamics_io = bind(DynamicsIO, config, *structs)
        self.senses_io = bind(ExactProprioceptionIO, config, *structs)
        wrench_of_thrust, thrust_of_wrench = allocation_matrices(config.vehicle)
        self.write(self.allocation.wrench_of_thrust, wrench_of_thrust)
        self.write(self.allocation.thrust_of_wrench, thrust_of_wrench)
        self.steps = 0

    def _allocated(self, struct: type[_T]) -> _T:
        return state.allocate(struct, self._sizes, self.real)

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
        control.command_thrusters(self.actuation_io, np.ascontiguousarray(action, dtype=np.float32))
