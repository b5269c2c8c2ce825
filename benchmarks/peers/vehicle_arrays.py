"""Inner loop and Fossen's equations on whole arrays, for NumPy or torch: what a user of either would write
for many vehicles.

The same equations as the kernels (midpoint rule, exact rotor lag, ideal attitude hold), on arrays (component,
n_env) in single precision.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.kernels.vehicle.control import axis_loops
from uuvtai.kernels.vehicle.dynamics import KGF, edge_rpm, thrust_at, thrust_limits
from uuvtai.sim.setup import allocation_matrices

_STATE = ("pos", "vel", "rate", "quat", "rpm", "rpm_command", "integral")


class Vehicles:
    """``n_env`` vehicles at rest; ``xp`` is ``numpy`` or ``torch``. Only the paths of the default vehicle
    (ideal hold, no delay)."""

    def __init__(self, config: Config, n_env: int, xp: Any, device: str = "cpu") -> None:
        self.xp, self.config, self.device = xp, config, device
        v = config.vehicle
        wrench_of_thrust, thrust_of_wrench = allocation_matrices(v)
        self.wrench_of_thrust, self.thrust_of_wrench = (
            self._array(wrench_of_thrust),
            self._array(thrust_of_wrench),
        )
        full = np.ones(n_env, np.float32)
        self.added, self.linear, self.quadratic = (
            self._array(np.outer(p, full)) for p in (v.added_mass, v.linear_damping, v.quadratic_damping)
        )
        self.mass, self.inertia = self._array(v.mass_kg * full), self._array(np.outer(v.inertia_kg_m2, full))
        self.buoyancy = self._array(v.water_density_kg_m3 * v.gravity_m_s2 * v.volume_m3 * full)
        self.per_mass = 1.0 / (self.mass + self.added[:3])
        self.per_inertia = 1.0 / (self.inertia + self.added[3:])
        self.pos, self.vel, self.rate, self.current = (self._array(np.zeros((3, n_env))) for _ in range(4))
        self.quat = self._array(np.outer([1, 0, 0, 0], full))
        self.rpm, self.rpm_command = (self._array(np.zeros((len(v.thrusters), n_env))) for _ in range(2))
        self.integral = self._array(np.zeros((4, n_env)))

    def _array(self, values: Any) -> Any:
        made = np.ascontiguousarray(values, dtype=np.float32)
        return made if self.xp is np else self.xp.from_numpy(made).to(self.device)

    def _column(self, values: Any) -> Any:
        if self.xp is np:
            return self._array(np.reshape(values, (-1, 1)))
        rows = [[float(value)] for value in values]  # a constant that torch.compile understands
        return self.xp.tensor(rows, dtype=self.xp.float32, device=self.device)

    # ---------------------------------------------------------------------------------------------- compiled

    def compiled(self) -> Callable[[Any], None]:
        """A control step (``control`` and ``move``) as one function that ``torch.compile`` has fused."""

        def step(state: tuple, action: Any) -> tuple:
            for name, values in zip(_STATE, state, strict=True):
                setattr(self, name, values)
            self.control(action)
            self.move()
            return tuple(getattr(self, name) for name in _STATE)

        fused = self.xp.compile(step, fullgraph=True)

        def again(action: Any) -> None:
            after = fused(tuple(getattr(self, name) for name in _STATE), action)
            for name, values in zip(_STATE, after, strict=True):
                setattr(self, name, values)

        return again

    # --------------------------------------------------------------------------------------------- inner loop

    def control(self, action: Any) -> None:
        """Rotor commands for ``action`` (4, n_env) in [-1, 1], from the true motion."""
        xp, c, v = self.xp, self.config.actuation, self.config.vehicle
        loops = axis_loops(c)
        gain, integral_gain, band, bound, limit = (
            self._column(values) for values in zip(*loops, strict=True)
        )
        command = xp.clip(action, -1, 1) * self._column(
            [v.max_surge_m_s, v.max_sway_m_s, v.max_heave_m_s, v.max_yaw_rate_rad_s]
        )
        vel, rate = self.vel, self.rate
        momentum = self._column(v.mass_kg + np.array(v.added_mass[:3])) * vel
        spin = self._column(np.array(v.inertia_kg_m2) + np.array(v.added_mass[3:])) * rate
        drag_of = [(v.linear_damping[i], v.quadratic_damping[i]) for i in (0, 1, 2, 5)]
        linear, quadratic = (self._column(values) for values in zip(*drag_of, strict=True))
        net = v.gravity_m_s2 * (v.water_density_kg_m3 * v.volume_m3 - v.mass_kg)
        drag = (linear + quadratic * abs(command)) * command
        force = self._cross(rate, momentum) + drag[:3] - net * self._up(self.quat)
        yaw = (self._cross(rate, spin) + self._cross(vel, momentum))[2] + drag[3]
        error = command - xp.stack([vel[0], vel[1], vel[2], rate[2]])
        asked = xp.stack([force[0], force[1], force[2], yaw]) + self.integral + gain * error
        given = xp.minimum(xp.maximum(asked, -limit), limit)
        none = given[0] * 0.0
        thrust = self.thrust_of_wrench @ xp.stack([given[0], given[1], given[2], none, none, given[3]])
        forward, reverse = thrust_limits(v)
        room = xp.where(thrust > 0, forward, reverse) / xp.where(thrust == 0, reverse, thrust)
        share = (room.min(0) if xp is np else room.amin(0)).clip(None, 1.0)
        self.rpm_command = self._rpm_of(share * thrust)
        saturated = (share < 1) | (given != asked)
        part = xp.where(saturated, 0.0, (1.0 - abs(error) / band).clip(0.0))
        part = xp.where(error * self.integral < 0, 1.0, part)
        after = self.integral + integral_gain * self.config.episode.control_dt_s * part * error
        self.integral = xp.minimum(xp.maximum(after, -bound), bound)

    def _rpm_of(self, thrust: Any) -> Any:
        """Rotor speed of a thrust, both branches of the curve."""
        xp, v = self.xp, self.config.vehicle
        rpm = thrust * 0.0
        for curve, dead, sign in (
            (v.thrust_forward, v.dead_band_rpm[0], 1.0),
            (v.thrust_reverse, v.dead_band_rpm[1], -1.0),
        ):
            edge = edge_rpm(curve, dead, sign)
            least = sign * thrust_at(curve, edge, v.thrust_scale)
            root = (curve[1] ** 2 - 4 * curve[0] * (curve[2] - thrust / (KGF * v.thrust_scale))).clip(
                0.0
            ) ** 0.5
            branch = xp.where(
                sign * thrust >= least,
                (root - curve[1]) / (2 * curve[0]),
                xp.where(sign * thrust >= 0.5 * least, edge, 0.0),
            )
            rpm = xp.where((thrust > 0) if sign > 0 else (thrust <= 0), branch, rpm)
        return xp.clip(rpm, -v.top_rpm, v.top_rpm)

    # ----------------------------------------------------------------------------------------------- dynamics

    def move(self) -> None:
        """One control step in the config's substeps."""
        e = self.config.episode
        for _ in range(e.substeps):
            self._substep(e.control_dt_s / e.substeps)

    def _substep(self, dt: float) -> None:
        v = self.config.vehicle
        kept = float(np.exp(-0.5 * dt / v.rotor_tau_s))
        middle = self.rpm_command + kept * (self.rpm - self.rpm_command)
        self.rpm = self.rpm_command + kept * (middle - self.rpm_command)
        wrench = self.wrench_of_thrust @ self._thrust_of(middle)
        dv, dw = self._acceleration(self.quat, self.vel, self.rate, wrench)
        q_mid = self._unit(self.quat + 0.25 * dt * self._spun(self.quat, self.rate))
        v_mid, w_mid = self.vel + 0.5 * dt * dv, self.rate + 0.5 * dt * dw
        dv, dw = self._acceleration(q_mid, v_mid, w_mid, wrench)
        self.pos = self.pos + dt * self._turned(q_mid, v_mid)
        self.quat = self._unit(self.quat + 0.5 * dt * self._spun(q_mid, w_mid))
        self.vel, self.rate = self.vel + dt * dv, self.rate + dt * dw

    def _thrust_of(self, rpm: Any) -> Any:
        xp, v = self.xp, self.config.vehicle
        (f2, f1, f0), (r2, r1, r0) = v.thrust_forward, v.thrust_reverse
        ahead, back = (
            edge_rpm(v.thrust_forward, v.dead_band_rpm[0], 1.0),
            edge_rpm(v.thrust_reverse, v.dead_band_rpm[1], -1.0),
        )
        backward = xp.where(rpm <= back, (r2 * rpm + r1) * rpm + r0, 0.0)
        return KGF * v.thrust_scale * xp.where(rpm >= ahead, (f2 * rpm + f1) * rpm + f0, backward)

    def _acceleration(self, q: Any, v: Any, w: Any, wrench: Any) -> tuple[Any, Any]:
        c = self.config
        up = self._up(q)
        v_r = v - self._turned(q * self._column([1, -1, -1, -1]), self.current)
        momentum = self.added[:3] * v_r
        tau_v = wrench[:3] + (self.buoyancy - self.mass * c.vehicle.gravity_m_s2) * up
        tau_v = (
            tau_v
            - self.mass * self._cross(w, v)
            - self._cross(w, momentum)
            - (self.linear[:3] + self.quadratic[:3] * abs(v_r)) * v_r
        )
        tau_w = wrench[3:] - self._cross(w, (self.inertia + self.added[3:]) * w) - self._cross(v_r, momentum)
        tau_w = tau_w - (self.linear[3:] + self.quadratic[3:] * abs(w)) * w
        lever = c.vehicle.buoyancy_height_m * self.buoyancy
        roll, pitch = self._hold(up, w)
        righting = self.xp.stack([roll - lever * up[1], pitch + lever * up[0], 0.0 * roll])
        return self.per_mass * tau_v, self.per_inertia * (tau_w + righting)

    def _hold(self, up: Any, w: Any) -> tuple[Any, Any]:
        c = self.config.actuation
        roll, pitch = (
            -c.hold_gain_n_m * up[1] - c.hold_damping * w[0],
            c.hold_gain_n_m * up[0] - c.hold_damping * w[1],
        )
        share = (c.hold_limit_n_m / ((roll * roll + pitch * pitch) ** 0.5).clip(1e-6)).clip(None, 1.0)
        return share * roll, share * pitch

    # ----------------------------------------------------------------------------------------------- geometry

    def _cross(self, a: Any, b: Any) -> Any:
        return self.xp.stack(
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        )

    def _up(self, q: Any) -> Any:
        w, x, y, z = q
        return self.xp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])

    def _turned(self, q: Any, v: Any) -> Any:
        """Vectors from body to world axes."""
        t = 2 * self._cross(q[1:], v)
        return v + q[0] * t + self._cross(q[1:], t)

    def _spun(self, q: Any, w: Any) -> Any:
        """q times the pure quaternion (0, w)."""
        return self.xp.stack(
            [
                -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
                q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
                q[0] * w[1] - q[1] * w[2] + q[3] * w[0],
                q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
            ]
        )

    @staticmethod
    def _unit(q: Any) -> Any:
        return q / (q * q).sum(0) ** 0.5
