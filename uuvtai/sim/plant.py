"""The vehicle alone: actuation and dynamics in endless water, for experiments on the physics. No world, no
sensors."""

from __future__ import annotations

from dataclasses import make_dataclass
from typing import Any, get_type_hints

import numpy as np
import taichi as ti
import torch

from uuvtai import state
from uuvtai.common.errors import SettingError
from uuvtai.compile.codegen import adopt
from uuvtai.compile.memory import Memory, address_of, numpy_type
from uuvtai.compile.runtime import Runtime
from uuvtai.config import Config
from uuvtai.kernels.sensors import proprioception
from uuvtai.kernels.sensors.io import ExactProprioceptionIO
from uuvtai.kernels.vehicle import control, dynamics
from uuvtai.kernels.vehicle.io import ActuationIO, DynamicsIO
from uuvtai.kernels.vehicle.thruster_fault import response_size
from uuvtai.sim.setup import allocation_matrices
from uuvtai.sim.stages import SimState, bind

NOUNS = ["clock", "episode", "mission", "vehicle", "params", "actuation", "allocation", "current", "ego"]


class Plant:
    """``n_env`` vehicles of one config, moved step by step. Taichi must be running as ``runtime``."""

    def __init__(self, config: Config, runtime: Runtime, n_env: int = 1) -> None:
        dead, count = config.disturbance.dead_thruster, len(config.vehicle.thrusters)
        if dead is not None and dead >= count:
            raise SettingError(
                f"disturbance.dead_thruster is {dead}, but the vehicle has thrusters 0 to {count - 1}"
            )
        self.config, self.n_env, self.real = config, n_env, runtime.real
        sizes = {
            "n_env": n_env,
            "n_thruster": len(config.vehicle.thrusters),
            "n_wrench": 6,
            "n_response": response_size(config.vehicle),
            "n_delay": 1 + round(config.disturbance.thruster_delay_s / config.episode.control_dt_s),
        }
        ti.sync()  # what others have declared is placed by itself
        kinds, device = get_type_hints(SimState), torch.device(runtime.device)
        made = {noun: state.allocate(kinds[noun], sizes, self.real) for noun in NOUNS}
        structs, anchor = make_dataclass("Structs", made)(**made), made["clock"].running
        vars(self).update(made)
        self.actuation_io = bind(ActuationIO, config, structs)
        self.dynamics_io = bind(DynamicsIO, config, structs)
        self.senses_io = bind(ExactProprioceptionIO, config, structs)
        self._memory = Memory(structs, anchor, address_of(anchor, device), device)
        if config.runtime.native and (runtime.device, runtime.precision) == ("cpu", "f32"):
            adopt((self.actuation_io, self.dynamics_io, self.senses_io), self._memory, alone=n_env == 1)
        wrench_of_thrust, thrust_of_wrench = allocation_matrices(config.vehicle)
        self.write(self.allocation.wrench_of_thrust, wrench_of_thrust)
        self.write(self.allocation.thrust_of_wrench, thrust_of_wrench)
        self.steps, self._asked = 0, torch.zeros(n_env, 4, device=device)

    def __getattr__(self, noun: str) -> Any:
        """No struct of that noun, for all that there are are attributes."""
        raise AttributeError(noun)

    def write(self, field: Any, value: Any) -> None:
        """Fill a field from anything that broadcasts to (field shape, vector length)."""
        if self._memory.device.type == "cpu":
            self._memory.live(field)[...] = value
            return
        shape = (*field.shape, field.n) if hasattr(field, "n") else field.shape
        whole = np.broadcast_to(np.asarray(value, numpy_type(field)), shape)
        field.from_numpy(np.ascontiguousarray(whole))

    def read(self, field: Any) -> np.ndarray:
        """A copy of a field, vectors with a last axis."""
        return self._memory.live(field).copy() if self._memory.device.type == "cpu" else field.to_numpy()

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
