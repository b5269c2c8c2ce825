"""The vehicle, its thrusters and inner loop, and the water that carries it."""

from __future__ import annotations

from dataclasses import dataclass

import taichi as ti

from uuvtai.common.enums import Truth
from uuvtai.state.arrays import array


@dataclass(frozen=True, eq=False)
class VehicleState(Truth):
    """Truth: rigid body and rotors. Origin = centre of mass."""

    pos_w: ti.Field = array("n_env", vec=3)
    """[m]"""
    quat_wb: ti.Field = array("n_env", vec=4)
    """unit quaternion (w, x, y, z), body to world"""
    vel_b: ti.Field = array("n_env", vec=3)
    """[m/s] over ground"""
    rate_b: ti.Field = array("n_env", vec=3)
    """[rad/s]"""
    acc_b: ti.Field = array("n_env", vec=3)
    """[m/s^2] inertial acceleration in body axes over the last substep (what an IMU feels, without
    gravity)"""
    rpm: ti.Field = array("n_env", "n_thruster")
    """[rpm] rotor speed after the lag"""


@dataclass(frozen=True, eq=False)
class VehicleParams(Truth):
    """Truth: physical parameters of each vehicle (equal unless randomised). Diagonals in the order of
    Fossen's nu."""

    mass_kg: ti.Field = array("n_env")
    """[kg]"""
    inertia: ti.Field = array("n_env", vec=3)
    """[kg m^2] diagonal"""
    added_mass: ti.Field = array("n_env", vec=6)
    """[kg, kg m^2] diagonal"""
    linear_damping: ti.Field = array("n_env", vec=6)
    """[N s/m, N m s] diagonal"""
    quadratic_damping: ti.Field = array("n_env", vec=6)
    """[N s^2/m^2, N m s^2] diagonal"""
    buoyancy_n: ti.Field = array("n_env")
    """[N] rho g V"""
    buoyancy_height_m: ti.Field = array("n_env")
    """[m] centre of buoyancy above the centre of mass"""
    thruster_gain: ti.Field = array("n_env", "n_thruster")
    """1 = healthy, 0 = dead"""
    delay_steps: ti.Field = array("n_env", dtype=ti.i32)
    """control steps between an rpm command and its effect"""


@dataclass(frozen=True, eq=False)
class ActuationState(Truth):
    """Inner loop and rotors' commands."""

    command: ti.Field = array("n_env", vec=4)
    """[m/s, m/s, m/s, rad/s] commanded surge, sway, heave, yaw rate"""
    integral: ti.Field = array("n_env", vec=4)
    """[N, N, N, N m] integral part of the wrench"""
    rpm_command: ti.Field = array("n_env", "n_thruster")
    """[rpm] what the rotors are told now (after the delay)"""
    rpm_queue: ti.Field = array("n_env", "n_delay", "n_thruster")
    """[rpm] commands under way, a ring indexed by episode step"""
    response: ti.Field = array("n_env", "n_response")
    """what the watch remembers (``lost_thruster``): [N] vertical thrust felt, and asked of each vertical
    thruster, smoothed; then sums over time of these and their products, older ones counting less"""
    thrust_n: ti.Field = array("n_env", "n_thruster")
    """[N] thrust of each rotor in the last substep"""
    hold_moment_b: ti.Field = array("n_env", vec=3)
    """[N m] moment of the ideal attitude hold"""
    external_wrench_b: ti.Field = array("n_env", vec=6)
    """[N, N m] applied from outside (experiments); zero in navigation"""
    n_not_finite: ti.Field = array(dtype=ti.i32, scratch=True)
    """numbers that are not finite in the actions that were asked for last"""


@dataclass(frozen=True, eq=False)
class Allocation:
    """Thruster geometry, the same for all envs."""

    wrench_of_thrust: ti.Field = array("n_wrench", "n_thruster")
    """body wrench (6) of unit thrust of each thruster"""
    thrust_of_wrench: ti.Field = array("n_thruster", "n_wrench")
    """least-squares inverse over the controllable axes"""


@dataclass(frozen=True, eq=False)
class CurrentState(Truth):
    """Truth: water velocity."""

    mean_w: ti.Field = array("n_env", vec=3)
    """[m/s] constant part"""
    vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] constant plus Gauss-Markov part"""


@dataclass(frozen=True, eq=False)
class VehicleStructs:
    """Structs of this room, by the noun of their stage."""

    vehicle: VehicleState
    params: VehicleParams
    actuation: ActuationState
    allocation: Allocation
    current: CurrentState
