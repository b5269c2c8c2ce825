"""The vehicle, its thrusters and inner loop, and what disturbs it."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from uuvtai.config.base import (
    Count,
    Fraction,
    NonNegative,
    NonNegative6,
    Positive,
    Real,
    Section,
    Spread,
    Vector3,
)

_S = 0.7071067811865476


class Thruster(Section):
    """One thruster: where it sits and which way positive thrust pushes."""

    position_m: Vector3
    direction: Vector3


_BLUEROV2_THRUSTERS = (
    Thruster(position_m=(0.1355, -0.1, -0.0725), direction=(_S, _S, 0.0)),
    Thruster(position_m=(0.1355, 0.1, -0.0725), direction=(_S, -_S, 0.0)),
    Thruster(position_m=(-0.1475, -0.1, -0.0725), direction=(-_S, _S, 0.0)),
    Thruster(position_m=(-0.1475, 0.1, -0.0725), direction=(-_S, -_S, 0.0)),
    Thruster(position_m=(0.0025, -0.1105, -0.005), direction=(0.0, 0.0, 1.0)),
    Thruster(position_m=(0.0025, 0.1105, -0.005), direction=(0.0, 0.0, 1.0)),
)


_T200_FULL_RPM = (
    (10.0, 2662.0),
    (12.0, 2976.0),
    (14.0, 3233.0),
    (16.0, 3465.0),
    (18.0, 3643.0),
    (20.0, 3783.0),
)
"""[V, rpm] speed at full throttle, of the two ways the slower (docs/data/t200.csv)"""


def _full_rpm(battery_v: float) -> float:
    """[rpm] of the motor at a voltage within the table."""
    for (low_v, low), (high_v, high) in pairwise(_T200_FULL_RPM):
        if battery_v <= high_v:
            return low + (high - low) * (battery_v - low_v) / (high_v - low_v)
    raise ValueError(f"battery_v {battery_v}: the table ends at {_T200_FULL_RPM[-1][0]:g} V")


class VehicleConfig(Section):
    """Rigid body, hydrodynamics and thrusters (MarineGym BlueROV asset; Wu 2018 coefficients). Origin =
    centre of mass."""

    mass_kg: Positive = 11.26
    inertia_kg_m2: tuple[Positive, Positive, Positive] = (0.30375, 0.626, 0.5769)
    water_density_kg_m3: Positive = 997.0
    gravity_m_s2: Positive = 9.81
    volume_m3: Positive = 0.0113459
    buoyancy_height_m: Real = 0.01
    added_mass: NonNegative6 = (5.5, 12.7, 14.57, 0.12, 0.12, 0.12)
    added_mass_follows: Literal["ground", "water"] = "ground"
    """whose acceleration the added mass resists: "ground" is M_A dnu/dt, the design's equation; "water" is
    M_A dnu_r/dt (Fossen 2011), which makes motion in a uniform current equal to motion in still water plus
    drift. They differ only where it turns in a current"""
    linear_damping: NonNegative6 = (4.03, 6.22, 5.18, 0.07, 0.07, 0.07)
    quadratic_damping: NonNegative6 = (18.18, 21.66, 36.99, 1.55, 1.55, 1.55)
    thrusters: Annotated[tuple[Thruster, ...], Field(min_length=1)] = _BLUEROV2_THRUSTERS
    rotor_tau_s: Positive = 0.01
    battery_v: Annotated[float, Field(ge=_T200_FULL_RPM[0][0], le=_T200_FULL_RPM[-1][0])] | None = None
    """[V] of the pack under load: the rotors turn as fast as a T200 does with it, by the maker's table,
    straight lines between its voltages; none = as ``rotor_max_rpm`` says"""
    rotor_max_rpm: Positive = 3900.0
    thrust_forward: Vector3 = (4.7368e-7, -1.9275e-4, 8.4452e-2)
    """[kgf] quadratic in rpm for n > 0"""
    thrust_reverse: Vector3 = (-3.8442e-7, -1.6186e-4, -3.9139e-2)
    """[kgf] quadratic in rpm for n < 0"""
    dead_band_rpm: tuple[NonNegative, NonNegative] = (203.5, 210.5)
    """no thrust below this speed, forward and reverse: where the quadratic fit turns round. MarineGym's
    throttle dead band of 7.5 % is (620, 696): possible here too, slow motion then becomes a limit cycle of
    about 1 cm/s"""
    thrust_scale: Positive = 1.0
    """the paper's K_F / 4.4e-7"""
    attitude_hold: Literal["ideal", "thrusters", "none"] = "ideal"
    tether_m: NonNegative = 0.0
    """[m] of a tether of neutral weight in the water, from the vehicle up to a point at rest; 0 = none, as in
    the paper"""
    tether_diameter_m: Positive = 0.0076
    """Fathom ROV Tether (Blue Robotics)"""
    tether_at_b_m: Vector3 = (-0.2, 0.0, 0.1)
    """where it leaves the vehicle, from the centre of mass, body axes (EC)"""
    hull_radius_m: Positive = 0.17
    hull_half_length_m: NonNegative = 0.10
    max_surge_m_s: Positive = 0.6
    max_sway_m_s: Positive = 0.6
    max_heave_m_s: Positive = 0.4
    max_yaw_rate_rad_s: Positive = 1.0

    @property
    def top_rpm(self) -> float:
        """Speed of a rotor at full throttle [rpm]."""
        return self.rotor_max_rpm if self.battery_v is None else _full_rpm(self.battery_v)

    @model_validator(mode="after")
    def _thrust_grows(self) -> VehicleConfig:
        for name, curve, dead, sign in (
            ("thrust_forward", self.thrust_forward, self.dead_band_rpm[0], 1.0),
            ("thrust_reverse", self.thrust_reverse, self.dead_band_rpm[1], -1.0),
        ):
            edge = sign * max(dead, -sign * curve[1] / (2 * curve[0])) if sign * curve[0] > 0 else 0.0
            if sign * curve[0] <= 0 or sign * (curve[0] * edge * edge + curve[1] * edge + curve[2]) < 0:
                raise ValueError(
                    f"{name} must push its own way and harder with speed outside the dead band, got {curve}"
                )
            if abs(edge) >= self.top_rpm:
                raise ValueError(
                    f"rotor_max_rpm must exceed the dead band of {name} ({abs(edge):.0f} rpm), got "
                    f"{self.top_rpm}"
                )
        return self


class ActuationConfig(Section):
    """Inner loop: commanded body velocity and yaw rate to wrench, allocation, rotors (gains EC)."""

    velocity_gain: tuple[NonNegative, NonNegative, NonNegative] = (60.0, 60.0, 60.0)
    """[N s/m]"""
    velocity_integral: tuple[NonNegative, NonNegative, NonNegative] = (40.0, 40.0, 40.0)
    """[N/m]"""
    yaw_rate_gain: NonNegative = 4.0
    """[N m s]"""
    yaw_rate_integral: NonNegative = 4.0
    """[N m]"""
    max_integral_n: NonNegative = 40.0
    """what a current, lost gain or wrong parameters may take"""
    max_integral_n_m: NonNegative = 4.0
    max_force_n: tuple[Positive, Positive, Positive] = (90.0, 90.0, 80.0)
    """covers the drag at full speed of every published BlueROV2 parameter set (59, 78 and 44 N)"""
    max_moment_n_m: Positive = 8.0
    watch_s: NonNegative = 2.0
    """memory of the watch over the vertical thrusters, which notices a dead one and of two gives it up;
    0 = no watch"""
    hold_gain_n_m: NonNegative = 60.0
    """[N m/rad] roll and pitch, ideal hold"""
    hold_damping: NonNegative = 8.0
    """[N m s] ideal hold"""
    hold_limit_n_m: NonNegative = 5.0
    """bound of the stabilising moment"""
    thruster_hold_gain_n_m: NonNegative = 20.0
    """[N m/rad] roll and pitch, hold by thrusters: lower, since it acts one control step and a rotor lag
    late"""
    thruster_hold_damping: NonNegative = 5.0
    """[N m s] hold by thrusters"""


class DisturbanceConfig(Section):
    """What the paper leaves out; all off by default. Each is a sweep axis."""

    current_m_s: Vector3 = (0.0, 0.0, 0.0)
    current_sigma_m_s: NonNegative = 0.0
    """standard deviation of the Gauss-Markov part, per horizontal axis"""
    current_tau_s: Positive = 20.0
    thruster_delay_s: NonNegative = 0.0
    thruster_gain_loss: Fraction = 0.0
    """each thruster's gain is drawn from [1 - loss, 1]"""
    dead_thruster: Count | None = None
    """index of a thruster that gives nothing"""
    mass_spread: Spread = 0.0
    """each parameter is scaled by a factor drawn from [1 - spread, 1 + spread] per episode; inertia and
    buoyancy follow the mass"""
    damping_spread: Spread = 0.0
    added_mass_spread: Spread = 0.0


AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
_LIMIT = 2.0
"""of (damping / inertia) times the substep: beyond it the midpoint rule's error grows in every substep"""


def instability(
    vehicle: VehicleConfig, actuation: ActuationConfig, disturbance: DisturbanceConfig, substep_s: float
) -> str:
    """Why the motion of a vehicle cannot be integrated in substeps of so many seconds, '' where it can: the
    stiffest axis at the speed to which the strongest push of its loop takes it, or at rest. A spread of the
    parameters counts with its worst draw."""
    net_n = vehicle.gravity_m_s2 * abs(vehicle.water_density_kg_m3 * vehicle.volume_m3 - vehicle.mass_kg)
    is_held = vehicle.attitude_hold == "ideal"
    hold = (actuation.hold_damping if is_held else 0.0, actuation.hold_gain_n_m if is_held else 0.0)
    surge_n, sway_n, heave_n = actuation.max_force_n
    push = (surge_n, sway_n, heave_n + net_n, *[actuation.hold_limit_n_m] * 2, actuation.max_moment_n_m)
    body = (*[vehicle.mass_kg] * 3, *vehicle.inertia_kg_m2)
    stiffest, found = _LIMIT / substep_s, ""
    for i, axis in enumerate(AXES):
        inertia = body[i] * (1 - disturbance.mass_spread)
        inertia += vehicle.added_mass[i] * (1 - disturbance.added_mass_spread)
        linear, quadratic = (
            damping[i] * (1 + disturbance.damping_spread)
            for damping in (vehicle.linear_damping, vehicle.quadratic_damping)
        )
        moving = math.sqrt(linear * linear + 4 * quadratic * push[i])  # slope of drag at that speed
        damping, spring = hold if axis in ("roll", "pitch") else (0.0, 0.0)
        rate = max((moving + damping) / inertia, math.sqrt(spring / inertia))
        if rate > stiffest:
            stiffest, found = rate, f"{axis} (inertia and added mass {inertia:.3g})"
    if not found:
        return ""
    return (
        f"{found} would diverge: damping / inertia is {stiffest:.0f} per second, and substeps of "
        f"{1000 * substep_s:g} ms allow {_LIMIT / substep_s:.0f}; give it inertia, damping and gains "
        f"(actuation) that belong together, or {math.ceil(stiffest * substep_s / _LIMIT)} times as many "
        "episode.substeps"
    )
