"""Thruster: rotor lag, thrust curve and its inverse. Floor file: actuation asks for thrusts, dynamics
produces them.

The curve is the T200 fit of MarineGym's BlueROV asset: one quadratic in rotor speed per direction, nothing
inside a dead band.
"""

import taichi as ti

from uuvtai.config import VehicleConfig
from uuvtai.kernels.core.signature import Const

KGF = 9.81
"""[N] in one kilogram-force, in which the curve is given"""


def edge_rpm(curve, dead_rpm, sign):
    """Smallest speed [rpm, signed] that pushes: the dead band's edge, or the vertex below which the fit turns
    round."""
    return sign * max(dead_rpm, -sign * curve[1] / (2.0 * curve[0]))


def thrust_at(curve, rpm, scale):
    """Thrust [N] on one branch of the curve; plain Python."""
    return scale * KGF * (curve[0] * rpm * rpm + curve[1] * rpm + curve[2])


def thrust_limits(cfg):
    """(forward, reverse) thrust [N] at full speed; reverse is negative."""
    return (
        thrust_at(cfg.thrust_forward, cfg.top_rpm, cfg.thrust_scale),
        thrust_at(cfg.thrust_reverse, -cfg.top_rpm, cfg.thrust_scale),
    )


@ti.func
def lag_kept(dt_s, tau_s):
    """Share of the distance to a constant command that a first-order lag still has to go after dt (exact)."""
    return ti.exp(-dt_s / tau_s)


@ti.func
def thrust_of_rpm(rpm, vehicle_cfg: Const[VehicleConfig]):
    """Thrust [N] at a rotor speed [rpm]."""
    forward, reverse = ti.static(vehicle_cfg.thrust_forward, vehicle_cfg.thrust_reverse)
    thrust = 0.0 * rpm
    if rpm >= ti.static(edge_rpm(vehicle_cfg.thrust_forward, vehicle_cfg.dead_band_rpm[0], 1.0)):
        thrust = ti.static(KGF * vehicle_cfg.thrust_scale) * (
            (forward[0] * rpm + forward[1]) * rpm + forward[2]
        )
    elif rpm <= ti.static(edge_rpm(vehicle_cfg.thrust_reverse, vehicle_cfg.dead_band_rpm[1], -1.0)):
        thrust = ti.static(KGF * vehicle_cfg.thrust_scale) * (
            (reverse[0] * rpm + reverse[1]) * rpm + reverse[2]
        )
    return thrust


@ti.func
def rpm_of_thrust(thrust, vehicle_cfg: Const[VehicleConfig]):
    """Rotor speed [rpm] that gives a thrust [N]; a thrust below the smallest one is rounded to it or to
    nothing, whichever is nearer."""
    rpm = 0.0 * thrust
    if thrust > 0:
        rpm = _branch_rpm(
            thrust, vehicle_cfg.thrust_forward, vehicle_cfg.dead_band_rpm[0], 1.0, vehicle_cfg.thrust_scale
        )
    else:
        rpm = _branch_rpm(
            thrust, vehicle_cfg.thrust_reverse, vehicle_cfg.dead_band_rpm[1], -1.0, vehicle_cfg.thrust_scale
        )
    return ti.math.clamp(rpm, -vehicle_cfg.top_rpm, vehicle_cfg.top_rpm)


@ti.func
def _branch_rpm(thrust, curve: Const[tuple], dead_rpm: Const[float], sign: Const[float], scale: Const[float]):
    edge = ti.static(edge_rpm(curve, dead_rpm, sign))
    least = ti.static(thrust_at(curve, edge, scale))
    rpm = 0.0 * thrust
    if sign * thrust >= ti.static(sign * least):
        # a n^2 + b n + c = T has the roots (-b +- sqrt(b^2 - 4 a (c - T))) / 2 a: the upper sign is that on
        # the outer side of the vertex, for either sign of a
        offset = curve[2] - thrust / ti.static(KGF * scale)
        root = ti.sqrt(ti.max(curve[1] * curve[1] - 4.0 * curve[0] * offset, 0.0))
        rpm = (root - curve[1]) / ti.static(2.0 * curve[0])
    elif sign * thrust >= ti.static(0.5 * sign * least):
        rpm = edge
    return rpm
