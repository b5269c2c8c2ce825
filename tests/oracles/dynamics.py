"""Fossen's equation in float64 with full 6 x 6 matrices and RK4: written apart from the kernel, to check it.

(M_RB + M_A) dnu/dt + C_RB(nu) nu + C_A(nu_r) nu_r + D(nu_r) nu_r + g(eta) = tau; state = (position, rotation
matrix, nu).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np


def cross_matrix(a):
    """S(a) with S(a) b = a x b."""
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]], dtype=float)


def euler_rotation(roll, pitch, yaw):
    """R_wb of Z-Y-X angles [rad]."""
    cr, sr, cp, sp, cy, sy = (
        np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw),
    )  # fmt: skip
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return z @ y @ x


def quaternion_rotation(q):
    """R_wb of a quaternion (w, x, y, z)."""
    s = cross_matrix(q[1:])
    return np.eye(3) + 2 * q[0] * s + 2 * s @ s


def euler_angles(r):
    """Z-Y-X angles [rad] of R_wb."""
    return np.array(
        [np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(np.clip(r[2, 0], -1, 1)), np.arctan2(r[1, 0], r[0, 0])]
    )


@dataclass
class Body:
    """One vehicle's parameters (VehicleConfig's defaults = BlueROV2, 3-vehicle.md)."""

    mass: float = 11.26
    inertia: np.ndarray = field(default_factory=lambda: np.array([0.30375, 0.626, 0.5769]))
    buoyancy: float = 997.0 * 9.81 * 0.0113459
    gravity: float = 9.81
    height: float = 0.01
    added: np.ndarray = field(default_factory=lambda: np.array([5.5, 12.7, 14.57, 0.12, 0.12, 0.12]))
    linear: np.ndarray = field(default_factory=lambda: np.array([4.03, 6.22, 5.18, 0.07, 0.07, 0.07]))
    quadratic: np.ndarray = field(default_factory=lambda: np.array([18.18, 21.66, 36.99, 1.55, 1.55, 1.55]))

    @cached_property
    def rigid_mass_matrix(self):
        return np.diag(np.concatenate([np.full(3, self.mass), self.inertia]))

    @cached_property
    def added_mass_matrix(self):
        return np.diag(self.added)

    @cached_property
    def mass_matrix(self):
        return self.rigid_mass_matrix + self.added_mass_matrix

    def neutral(self):
        """The same obstacle with buoyancy equal to weight."""
        return replace(self, buoyancy=self.mass * self.gravity)


def coriolis_matrix(mass_matrix, nu):
    """Fossen (2011) eq. 3.46: C(nu) of a symmetric mass matrix; skew-symmetric."""
    top = cross_matrix(mass_matrix[:3, :3] @ nu[:3] + mass_matrix[:3, 3:] @ nu[3:])
    bottom = cross_matrix(mass_matrix[3:, :3] @ nu[:3] + mass_matrix[3:, 3:] @ nu[3:])
    found = np.zeros((6, 6))
    found[:3, 3:] = found[3:, :3] = -top
    found[3:, 3:] = -bottom
    return found


def nu_dot(body, rotation, nu, wrench, current_w):
    """d nu / dt by solving with the full mass matrix; ``wrench`` may be a function of (rotation, nu)."""
    nu_r = nu - np.concatenate([rotation.T @ current_w, np.zeros(3)])
    up = rotation[2]
    restoring = np.concatenate(
        [
            -(body.buoyancy - body.mass * body.gravity) * up,
            -cross_matrix([0, 0, body.height]) @ (body.buoyancy * up),
        ]
    )
    damping = (body.linear + body.quadratic * np.abs(nu_r)) * nu_r
    tau = wrench(rotation, nu) if callable(wrench) else wrench
    right = (
        tau
        - coriolis_matrix(body.rigid_mass_matrix, nu) @ nu
        - coriolis_matrix(body.added_mass_matrix, nu_r) @ nu_r
        - damping
        - restoring
    )
    return np.linalg.solve(body.mass_matrix, right)


def simulate(
    body, seconds, dt=1e-3, wrench=None, current=(0, 0, 0), rpy_deg=(0, 0, 0), nu=None, sample_s=None
):
    """RK4: position (n, 3), rpy_deg (n, 3), nu (n, 6) every ``sample_s`` (default: start and end)."""
    wrench = np.zeros(6) if wrench is None else wrench if callable(wrench) else np.asarray(wrench, float)
    current = np.asarray(current, float)
    x = (
        np.zeros(3),
        euler_rotation(*np.radians(rpy_deg)),
        np.zeros(6) if nu is None else np.array(nu, float),
    )
    n_step = round(seconds / dt)
    every = n_step if sample_s is None else round(sample_s / dt)
    samples = [x]

    def rate(state):
        _, r, v = state
        return r @ v[:3], r @ cross_matrix(v[3:]), nu_dot(body, r, v, wrench, current)

    def moved(state, k, h):
        return tuple(a + h * b for a, b in zip(state, k, strict=True))

    for step in range(1, n_step + 1):
        k1 = rate(x)
        k2 = rate(moved(x, k1, dt / 2))
        k3 = rate(moved(x, k2, dt / 2))
        k4 = rate(moved(x, k3, dt))
        x = tuple(
            a + dt / 6 * (p + 2 * q + 2 * r + s) for a, p, q, r, s in zip(x, k1, k2, k3, k4, strict=True)
        )
        u, _, vt = np.linalg.svd(x[1])
        x = (x[0], u @ vt, x[2])
        if step % every == 0:
            samples.append(x)
    return {
        "position": np.array([s[0] for s in samples]),
        "rpy_deg": np.degrees([euler_angles(s[1]) for s in samples]),
        "nu": np.array([s[2] for s in samples]),
    }


def energy(body, z, rotation, nu):
    """Kinetic energy of body and added water plus potential of weight and buoyancy [J]."""
    return (
        0.5 * nu @ body.mass_matrix @ nu
        + (body.mass * body.gravity - body.buoyancy) * z
        - body.buoyancy * body.height * rotation[2, 2]
    )
