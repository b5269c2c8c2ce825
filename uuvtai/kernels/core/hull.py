"""Distances of the hull, a capsule along body x, to bodies and side walls: clearance, where, and in which
direction.

The capsule follows the full attitude (roll does not matter). Distance to a convex body is a convex function
along the capsule's axis, so bisection on the sign of its slope finds the nearest point: an end of the axis in
most cases, else to 2^-16 of the axis's length.
"""

import taichi as ti

from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.kernels.core.geometry import BOX, CYLINDER, SPHERE, turned_z
from uuvtai.kernels.core.signature import Const

_BISECTIONS = 16
"""0.2 m of axis / 2^16 = 3 micrometres"""

_TINY = 1e-9


@ti.func
def nearest_point(kind, q, size):
    """Point of a body's core nearest to q; body frame. The core of a sphere is its centre, other bodies are
    their own core."""
    out = ti.Vector([0.0, 0.0, 0.0])
    if kind == BOX:
        out = ti.math.clamp(q, -size, size)
    elif kind == CYLINDER:
        rho = ti.sqrt(q[0] * q[0] + q[1] * q[1])
        scale = ti.min(1.0, size[0] / ti.max(rho, _TINY))
        out = ti.Vector([q[0] * scale, q[1] * scale, ti.math.clamp(q[2], -size[2], size[2])])
    return out


@ti.func
def distance_slope(kind, q, axis, size):
    """Half the slope of the squared distance at q along the axis: rises monotonically along it."""
    return (q - nearest_point(kind, q, size)).dot(axis)


@ti.func
def nearest_along(kind, center, axis, half_length, size):
    """Where on the axis the body is nearest [m from the middle]; body frame."""
    # f(s) = |c + s axis - nearest point|^2 is convex, as the distance to a convex set is; its slope is 2 (q
    # - nearest point)'axis. Rising at the lower end or falling at the upper one, that end is nearest; else
    # the slope changes its sign in between.
    low = -half_length
    high = half_length
    if distance_slope(kind, center + low * axis, axis, size) >= 0.0:
        high = low
    elif distance_slope(kind, center + high * axis, axis, size) <= 0.0:
        low = high
    else:
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            if distance_slope(kind, center + middle * axis, axis, size) > 0.0:
                high = middle
            else:
                low = middle
    return 0.5 * (low + high)


@ti.func
def body_frame(v, kind, yaw):
    """Vector turned from the world into a body's frame (only boxes have a heading)."""
    out = v
    if kind == BOX:
        flat = turned_z(v, -yaw)
        out = ti.Vector([flat[0], flat[1], v[2]])
    return out


@ti.func
def hull_to_body(pos_w, axis_w, kind, body_pos_w, size, yaw, vehicle_cfg: Const[VehicleConfig]):
    """(clearance [m], unit vector from hull to body, place on the axis [m from the middle]).

    ``axis_w`` is the hull's unit x axis. With the body's axis inside the other body the clearance stays at
    minus the hull's radius. The clearance shrinks at ``-(v_body - v_hull_point) . normal``.
    """
    center = body_frame(pos_w - body_pos_w, kind, yaw)
    axis = body_frame(axis_w, kind, yaw)
    along = nearest_along(kind, center, axis, vehicle_cfg.hull_half_length_m, size)
    q = center + along * axis
    away = q - nearest_point(kind, q, size)
    distance = away.norm()
    toward = -away
    if distance < _TINY:
        toward = -q
    toward_w = body_frame(toward, kind, -yaw)
    normal_w = toward_w / ti.max(toward_w.norm(), _TINY)
    rounding = vehicle_cfg.hull_radius_m + 0.0
    if kind == SPHERE:
        rounding += size[0]
    return distance - rounding, normal_w, along


@ti.func
def hull_to_side_wall(pos_w, axis_w, vehicle_cfg: Const[VehicleConfig], tank_cfg: Const[TankConfig]):
    """Clearance to the nearest side wall [m], negative beyond it; the walls are flat or curve inwards, so an
    end of the axis is nearest."""
    half = vehicle_cfg.hull_half_length_m * axis_w
    gap = 0.0
    if ti.static(tank_cfg.shape == "circle"):
        x = pos_w[0] - 0.5 * (tank_cfg.x_m[0] + tank_cfg.x_m[1])
        y = pos_w[1] - 0.5 * (tank_cfg.y_m[0] + tank_cfg.y_m[1])
        ahead = (x + half[0]) ** 2 + (y + half[1]) ** 2
        behind = (x - half[0]) ** 2 + (y - half[1]) ** 2
        gap = tank_cfg.radius_m - ti.sqrt(ti.max(ahead, behind))
    else:
        gap_x = ti.min(pos_w[0] - tank_cfg.x_m[0], tank_cfg.x_m[1] - pos_w[0]) - ti.abs(half[0])
        gap_y = ti.min(pos_w[1] - tank_cfg.y_m[0], tank_cfg.y_m[1] - pos_w[1]) - ti.abs(half[1])
        gap = ti.min(gap_x, gap_y)
    return gap - vehicle_cfg.hull_radius_m


@ti.func
def hull_to_floor_or_surface(pos_w, axis_w, vehicle_cfg: Const[VehicleConfig], tank_cfg: Const[TankConfig]):
    """Clearance to the nearer of floor and surface [m]."""
    gap = ti.min(pos_w[2] - tank_cfg.z_m[0], tank_cfg.z_m[1] - pos_w[2])
    return gap - ti.abs(axis_w[2]) * vehicle_cfg.hull_half_length_m - vehicle_cfg.hull_radius_m


@ti.func
def is_in_tank(pos_w, tank_cfg: Const[TankConfig]):
    """1 where a point lies within walls, floor and surface; a position that is not finite lies outside."""
    flat = 0
    if ti.static(tank_cfg.shape == "circle"):
        x = pos_w[0] - 0.5 * (tank_cfg.x_m[0] + tank_cfg.x_m[1])
        y = pos_w[1] - 0.5 * (tank_cfg.y_m[0] + tank_cfg.y_m[1])
        flat = ti.cast(x * x + y * y <= tank_cfg.radius_m**2, ti.i32)
    else:
        in_x = pos_w[0] >= tank_cfg.x_m[0] and pos_w[0] <= tank_cfg.x_m[1]
        in_y = pos_w[1] >= tank_cfg.y_m[0] and pos_w[1] <= tank_cfg.y_m[1]
        flat = ti.cast(in_x and in_y, ti.i32)
    return flat * ti.cast(pos_w[2] >= tank_cfg.z_m[0] and pos_w[2] <= tank_cfg.z_m[1], ti.i32)
