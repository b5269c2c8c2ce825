"""Frames, rotations and distances shared by the stages.

World is z-up, body is FLU, quaternions are (w, x, y, z) and rotate body into world.
"""

import taichi as ti

from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.kernels.core.stage import Const

# kinds of an obstacle in the per-env list
NONE = 0
SPHERE = 1
CYLINDER = 2
"""Vertical cylinder: size = (radius, radius, half height)."""
BOX = 3
"""Box turned about z: size = half extents before the turn."""

PI = 3.141592653589793
TWO_PI = 6.283185307179586
FAR_M = 1.0e6
"""A distance that stands for "nothing there"."""


@ti.func
def wrapped_angle(angle):
    """Angle in [-pi, pi)."""
    return angle - TWO_PI * ti.floor((angle + PI) / TWO_PI)


@ti.func
def rotation_wb(q):
    """Rotation matrix R_wb of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ti.Matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@ti.func
def quaternion_wb(roll, pitch, yaw):
    """Quaternion (w, x, y, z) of yaw-pitch-roll angles (Z-Y-X)."""
    cr, sr = ti.cos(0.5 * roll), ti.sin(0.5 * roll)
    cp, sp = ti.cos(0.5 * pitch), ti.sin(0.5 * pitch)
    cy, sy = ti.cos(0.5 * yaw), ti.sin(0.5 * yaw)
    return ti.Vector(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


@ti.func
def roll_pitch_yaw(q):
    """Z-Y-X Euler angles (roll, pitch, yaw) [rad] of a unit quaternion; pitch is clamped at +-pi/2."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    roll = ti.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = ti.asin(ti.math.clamp(2 * (w * y - z * x), -1.0, 1.0))
    yaw = ti.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return ti.Vector([roll, pitch, yaw])


@ti.func
def turned_z(v, yaw):
    """Two-vector turned by yaw about z."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    return ti.Vector([c * v[0] - s * v[1], s * v[0] + c * v[1]])


@ti.func
def turned_z3(v, yaw):
    """Three-vector turned by yaw about z."""
    level = turned_z(ti.Vector([v[0], v[1]]), yaw)
    return ti.Vector([level[0], level[1], v[2]])


# ------------------------------------------------------------------------------------------------------------
# Distances of the hull, a capsule along body x, to obstacles and side walls: clearance, where, and in which
# direction.
#
# The capsule follows the full attitude (roll does not matter). Distance to a convex body is a convex function
# along the capsule's axis, so bisection on the sign of its slope finds the nearest point: an end of the axis
# in most cases, else to 2^-16 of the axis's length.


_BISECTIONS = 16  # 0.2 m of axis / 2^16 = 3 micrometres

_TINY = 1e-9


@ti.func
def nearest_point(kind, q, size):
    """Point of an obstacle's core nearest to q; body frame. The core of a sphere is its centre, other
    obstacles are their own core."""
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
    """Vector turned from the world into an obstacle's frame (only boxes have a heading)."""
    out = v
    if kind == BOX:
        flat = turned_z(v, -yaw)
        out = ti.Vector([flat[0], flat[1], v[2]])
    return out


@ti.func
def hull_to_obstacle(pos_w, axis_w, kind, obstacle_pos_w, size, yaw, vehicle_cfg: Const[VehicleConfig]):
    """(clearance [m], unit vector from hull to body, place on the axis [m from the middle]).

    ``axis_w`` is the hull's unit x axis. With the body's axis inside the other obstacle the clearance stays
    at minus the hull's radius. The clearance shrinks at ``-(v_obstacle - v_hull_point) . normal``.
    """
    center = body_frame(pos_w - obstacle_pos_w, kind, yaw)
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


# ------------------------------------------------------------------------------------------------------------
# Plan view of obstacles: rectangles with rounded corners, and how far apart they are. Floor of the scenario's
# drawing.
#
# A footprint is seven numbers (centre x, y; direction x, y; half extents along and across, in units of the
# direction's length; rounding radius [m]): a disc has no extents, a box no rounding, a straight stroke of a
# moving disc has length and rounding. What is decided here must be decided alike on every device, so
# distances are compared as squares and directions come from a fixed polynomial: no square root, sine or
# cosine, which differ in the last bit between devices.


_TINY_LENGTH = 1e-12


@ti.func
def steady_direction(angle):
    """(cos, sin) of an angle [rad] by Taylor polynomials on +-pi/4, the same bits on every device; error
    below 4e-7."""
    quarters = ti.floor(angle * (2.0 / PI) + 0.5)
    x = angle - quarters * (0.5 * PI)
    x2 = x * x
    sine = x * (1.0 - x2 * (1.0 / 6.0 - x2 * (1.0 / 120.0 - x2 * (1.0 / 5040.0))))
    cosine = 1.0 - x2 * (0.5 - x2 * (1.0 / 24.0 - x2 * (1.0 / 720.0 - x2 * (1.0 / 40320.0))))
    quadrant = ti.cast(quarters, ti.i32) & 3
    out = ti.Vector([cosine, sine])
    if quadrant == 1:
        out = ti.Vector([-sine, cosine])
    elif quadrant == 2:
        out = ti.Vector([-cosine, -sine])
    elif quadrant == 3:
        out = ti.Vector([sine, -cosine])
    return out


@ti.func
def disc(center, radius):
    """Footprint of a disc."""
    return ti.Vector([center[0], center[1], 1.0, 0.0, 0.0, 0.0, radius])


@ti.func
def stroke(a, b, radius):
    """Footprint of a disc that goes straight from a to b."""
    return ti.Vector([0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), b[0] - a[0], b[1] - a[1], 0.5, 0.0, radius])


@ti.func
def footprint_of(kind, pos_w, size, yaw):
    """Footprint of a body (geometry.SPHERE, CYLINDER or BOX)."""
    out = disc(pos_w, size[0])
    if kind == BOX:
        ahead = steady_direction(yaw)
        out = ti.Vector([pos_w[0], pos_w[1], ahead[0], ahead[1], size[0], size[1], 0.0])
    return out


@ti.func
def corner_of(shape, i):
    """Corner 0 to 3 of the unrounded rectangle."""
    along = shape[4] * (1.0 - 2.0 * ti.cast(i & 1, ti.f32))
    across = shape[5] * (1.0 - ti.cast(i & 2, ti.f32))
    return ti.Vector(
        [shape[0] + along * shape[2] - across * shape[3], shape[1] + along * shape[3] + across * shape[2]]
    )


@ti.func
def foot_on(point, start, along, least):
    """Nearest point of a segment, as a share of it from ``least`` on, and its squared distance [m^2]."""
    share = ti.math.clamp((point - start).dot(along) / ti.max(along.norm_sqr(), 1e-12), 0.0, 1.0)
    share = ti.max(share, least)
    return share, (point - start - along * share).norm_sqr()


@ti.func
def nearest_squared(shape, point):
    """Squared distance [m^2] from a point to the unrounded rectangle, 0 inside."""
    ahead = ti.Vector([shape[2], shape[3]])
    side = ti.Vector([-shape[3], shape[2]])
    offset = ti.Vector([point[0] - shape[0], point[1] - shape[1]])
    inverse = 1.0 / ti.max(ahead.dot(ahead), _TINY_LENGTH)
    along = ti.math.clamp(offset.dot(ahead) * inverse, -shape[4], shape[4])
    across = ti.math.clamp(offset.dot(side) * inverse, -shape[5], shape[5])
    rest_x = offset[0] - along * ahead[0] - across * side[0]
    rest_y = offset[1] - along * ahead[1] - across * side[1]
    return rest_x * rest_x + rest_y * rest_y


@ti.func
def farthest_squared(shape, point):
    """Squared distance [m^2] from a point to the farthest corner of the unrounded rectangle."""
    out = 0.0
    for i in range(4):
        corner = corner_of(shape, i)
        offset = ti.Vector([corner[0] - point[0], corner[1] - point[1]])
        out = ti.max(out, offset.dot(offset))
    return out


@ti.func
def half_width(shape, axis):
    """Half of the unrounded rectangle's extent along an axis, in units of the axis's length."""
    ahead = ti.Vector([shape[2], shape[3]])
    side = ti.Vector([-shape[3], shape[2]])
    return shape[4] * ti.abs(ahead.dot(axis)) + shape[5] * ti.abs(side.dot(axis))


@ti.func
def between_squared(a, b):
    """Squared distance [m^2] between two unrounded rectangles, 0 where they meet (separating axes; else some
    corner is nearest)."""
    offset = ti.Vector([b[0] - a[0], b[1] - a[1]])
    split = 0
    out = FAR_M + 0.0
    for i in range(4):
        axis = ti.Vector([a[2], a[3]])
        if i & 1:
            axis = ti.Vector([b[2], b[3]])
        if i & 2:
            axis = ti.Vector([-axis[1], axis[0]])
        split |= ti.cast(ti.abs(offset.dot(axis)) > half_width(a, axis) + half_width(b, axis), ti.i32)
        out = ti.min(out, nearest_squared(b, corner_of(a, i)), nearest_squared(a, corner_of(b, i)))
    return out * split


@ti.func
def is_apart(a, b, gap_m):
    """1 where two footprints' surfaces are at least ``gap_m`` apart."""
    reach = gap_m + a[6] + b[6]
    squared = between_squared(a, b)
    return ti.cast(squared > 0.0 and squared >= reach * reach, ti.i32)


@ti.func
def is_off_ring(shape, center, radius, obstacle_radius):
    """1 where a disc that goes around a circle never meets the footprint."""
    outer = radius + obstacle_radius + shape[6]
    inner = radius - obstacle_radius - shape[6]
    outside = nearest_squared(shape, center) > outer * outer
    inside = inner > 0.0 and farthest_squared(shape, center) < inner * inner
    return ti.cast(outside or inside, ti.i32)


@ti.func
def is_inside(shape, margin_m, tank_cfg: Const[TankConfig]):
    """1 where the whole footprint lies within the side walls, ``margin_m`` off them."""
    out = 0
    if ti.static(tank_cfg.shape == "circle"):
        center = ti.Vector(
            [0.5 * (tank_cfg.x_m[0] + tank_cfg.x_m[1]), 0.5 * (tank_cfg.y_m[0] + tank_cfg.y_m[1])]
        )
        room = tank_cfg.radius_m - margin_m - shape[6]
        out = ti.cast(room > 0.0 and farthest_squared(shape, center) <= room * room, ti.i32)
    else:
        reach_x = half_width(shape, ti.Vector([1.0, 0.0])) + shape[6] + margin_m
        reach_y = half_width(shape, ti.Vector([0.0, 1.0])) + shape[6] + margin_m
        in_x = shape[0] - reach_x >= tank_cfg.x_m[0] and shape[0] + reach_x <= tank_cfg.x_m[1]
        in_y = shape[1] - reach_y >= tank_cfg.y_m[0] and shape[1] + reach_y <= tank_cfg.y_m[1]
        out = ti.cast(in_x and in_y, ti.i32)
    return out
