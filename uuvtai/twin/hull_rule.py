"""The fixed rule that lays a velocity in the world on the hull: where it is wanted to go, not how."""

import taichi as ti

from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.kernels.core.geometry import PI, wrapped_angle
from uuvtai.kernels.core.signature import Const
from uuvtai.twin.set_codes import LEAST_SPEED_M_S, TURN_GAIN


@ti.func
def hull_command(wish, yaw, z_m, gap_m, vehicle_cfg: Const[VehicleConfig], tank_cfg: Const[TankConfig]):
    """(surge, sway, heave, yaw rate) in parts of the vehicle's limits for a wished velocity [m/s] in the
    world.

    A diagonal of the hull is turned along the motion, for there surge and sway add up; heave is held back so
    that the centre stays ``gap_m`` from floor and surface.
    """
    c, s = ti.cos(yaw), ti.sin(yaw)
    surge = (c * wish[0] + s * wish[1]) / vehicle_cfg.max_surge_m_s
    sway = (c * wish[1] - s * wish[0]) / vehicle_cfg.max_sway_m_s
    over = ti.max(1.0, ti.max(ti.abs(surge), ti.abs(sway)))
    rise = ti.min(
        ti.max(wish[2], ti.min(tank_cfg.z_m[0] + gap_m - z_m, 0.0)),
        ti.max(tank_cfg.z_m[1] - gap_m - z_m, 0.0),
    )
    turn = 0.0
    if wish[0] * wish[0] + wish[1] * wish[1] > LEAST_SPEED_M_S**2:
        off = wrapped_angle(ti.atan2(wish[1], wish[0]) - yaw)
        turn = off - 0.5 * PI * (ti.floor(off / (0.5 * PI)) + 0.5)
    return ti.Vector(
        [
            surge / over,
            sway / over,
            ti.math.clamp(rise / vehicle_cfg.max_heave_m_s, -1.0, 1.0),
            ti.math.clamp(TURN_GAIN * turn / vehicle_cfg.max_yaw_rate_rad_s, -1.0, 1.0),
        ]
    )


@ti.func
def wished_velocity(x, y, z, flip_x, flip_y, vehicle_cfg: Const[VehicleConfig]):
    """Velocity [m/s] in the world of a policy's action (parts of the speed along the hull's diagonal, and of
    heave) in the frame in which the goal lies ahead and to the left."""
    fastest = ti.sqrt(vehicle_cfg.max_surge_m_s**2 + vehicle_cfg.max_sway_m_s**2)
    long = ti.max(1.0, ti.sqrt(x * x + y * y))
    return ti.Vector(
        [
            flip_x * x / long * fastest,
            flip_y * y / long * fastest,
            ti.math.clamp(z, -1.0, 1.0) * vehicle_cfg.max_heave_m_s,
        ]
    )
