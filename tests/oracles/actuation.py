"""Inner loop in float64 NumPy, one vehicle, one control step: written apart from the kernel, to check it."""

from __future__ import annotations

import numpy as np

BAND_M_S, BAND_RAD_S = 0.3, 0.5


def thrust_of_rpm(rpm, cfg):
    """Thrust [N]: one quadratic per direction, nothing inside the dead band."""
    rpm = np.asarray(rpm, float)
    forward, reverse = np.polyval(cfg.thrust_forward, rpm), np.polyval(cfg.thrust_reverse, rpm)
    kgf = np.where(rpm >= cfg.dead_band_rpm[0], forward, np.where(rpm <= -cfg.dead_band_rpm[1], reverse, 0.0))
    return 9.81 * cfg.thrust_scale * kgf


def control(
    cfg, gains, dt, command, integral, vel, rate, rpy, wrench_of_thrust, thrust_of_wrench, vel_valid=1
):
    """(thrusts (n,) after the limits, new integral (4,)) of the velocity loop; ``vel_valid`` 2 = heave."""
    known = {0: [0, 0, 0, 1], 1: [1, 1, 1, 1], 2: [0, 0, 1, 1]}[vel_valid]
    vel = np.where(known[:3], vel, command[:3])
    mass = np.array([cfg.mass_kg] * 3) + np.array(cfg.added_mass[:3])
    inertia = np.array(cfg.inertia_kg_m2) + np.array(cfg.added_mass[3:])
    up = np.array([-np.sin(rpy[1]), np.sin(rpy[0]) * np.cos(rpy[1]), np.cos(rpy[0]) * np.cos(rpy[1])])
    net = cfg.gravity_m_s2 * (cfg.water_density_kg_m3 * cfg.volume_m3 - cfg.mass_kg)
    drag = np.array(
        [
            (cfg.linear_damping[i] + cfg.quadratic_damping[i] * abs(c)) * c
            for i, c in zip((0, 1, 2, 5), command, strict=True)
        ]
    )
    force = np.cross(rate, mass * vel) + drag[:3] - net * up
    moment = np.cross(rate, inertia * rate) + np.cross(vel, mass * vel) + np.array([0, 0, drag[3]])
    error = command - np.array([*vel, rate[2]])
    kp = np.array([*gains.velocity_gain, gains.yaw_rate_gain])
    ki = np.array([*gains.velocity_integral, gains.yaw_rate_integral])
    limit = np.array([*gains.max_force_n, gains.max_moment_n_m])
    asked = np.array([*force, moment[2]]) + kp * error + integral
    given = np.clip(asked, -limit, limit)
    hold = np.zeros(2)
    if cfg.attitude_hold == "thrusters":
        k, d = gains.thruster_hold_gain_n_m, gains.thruster_hold_damping
        hold = np.array([moment[0] - k * up[1] - d * rate[0], moment[1] + k * up[0] - d * rate[1]])
        hold *= min(1.0, gains.hold_limit_n_m / max(np.linalg.norm(hold), 1e-6))
    thrust = thrust_of_wrench @ np.array([given[0], given[1], given[2], hold[0], hold[1], given[3]])
    top, bottom = thrust_of_rpm(cfg.rotor_max_rpm, cfg), thrust_of_rpm(-cfg.rotor_max_rpm, cfg)
    share = min(1.0, *(top / t if t > 0 else bottom / t for t in thrust if t != 0))
    band = np.array([BAND_M_S] * 3 + [BAND_RAD_S])
    bound = np.array([gains.max_integral_n] * 3 + [gains.max_integral_n_m])
    saturated = (share < 1) | (given != asked)
    part = np.where(
        error * integral < 0, 1.0, np.where(saturated, 0.0, np.maximum(0, 1 - np.abs(error) / band))
    )
    new = np.clip(integral + ki * part * error * dt, -bound, bound)
    return share * thrust, np.where(known, new, integral)
