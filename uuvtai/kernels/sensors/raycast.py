"""Rays against convex primitives: each function returns the span (enter, leave) of the ray parameter inside
the primitive.

An obstacle is an intersection of such sets, so its own span is (largest enter, smallest leave); it is hit
from outside where 0 < enter <= leave. Arguments may be scalars or 16-lane packets: a scalar start with packet
directions is the usual mix.
"""

import math

import taichi as ti

from uuvtai.kernels.core.geometry import BOX, FAR_M, NONE, SPHERE
from uuvtai.kernels.core.simd import LANES, f16x, filled, lane_bits
from uuvtai.kernels.core.stage import Bundle, Const
from uuvtai.kernels.sensors.io import SonarIO

_TINY = 1.0e-9  # Below this a direction component counts as parallel.

_SKIN_M = 1.0e-4
"""A ray that starts on a surface (after a bounce) does not meet that surface again within this."""


@ti.func
def slab_span(start, direction, half):
    """Span of |start + t * direction| <= half."""
    inverse = 1.0 / ti.select(ti.abs(direction) < _TINY, _TINY, direction)
    one = (-half - start) * inverse
    other = (half - start) * inverse
    return ti.min(one, other), ti.max(one, other)


@ti.func
def disc_span(x, y, dx, dy, radius_squared):
    """Span inside a circle (or an infinite cylinder) around the origin; (x, y) = ray's start, (dx, dy) =
    direction of any length.

    The distance of the line to the centre comes from a cross product: b^2 - c would cancel badly in float32
    at 12 m.
    """
    length_squared = ti.max(dx * dx + dy * dy, _TINY)
    cross = x * dy - y * dx
    room = radius_squared * length_squared - cross * cross
    return _span(room, -(x * dx + y * dy), length_squared)


@ti.func
def ball_span(x, y, z, dx, dy, dz, radius_squared):
    """Span inside a sphere around the origin."""
    length_squared = dx * dx + dy * dy + dz * dz
    cx, cy, cz = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    room = radius_squared * length_squared - (cx * cx + cy * cy + cz * cz)
    return _span(room, -(x * dx + y * dy + z * dz), length_squared)


@ti.func
def _span(room, middle, length_squared):
    # |p + t d|^2 = r^2 is solved by t = (-p'd +- sqrt(r^2 |d|^2 - |p x d|^2)) / |d|^2, since
    # (p'd)^2 + |p x d|^2 = |p|^2 |d|^2 (Lagrange); ``room`` stands below the root, ``middle`` = -p'd.
    root = ti.sqrt(ti.max(room, 0.0))
    inverse = 1.0 / length_squared
    enter = ti.select(room < 0.0, FAR_M, (middle - root) * inverse)
    leave = ti.select(room < 0.0, -FAR_M, (middle + root) * inverse)
    return enter, leave


@ti.func
def plane_distance(start, direction, low, high):
    """Ray parameter at which a coordinate that starts within [low, high] leaves it; 0 if it starts beyond
    that end."""
    safe = ti.select(ti.abs(direction) < _TINY, _TINY, direction)
    return ti.max(ti.select(safe > 0.0, high - start, low - start) / safe, 0.0)


@ti.func
def rim_distance(x, y, dx, dy, radius):
    """Ray parameter at which a ray leaves a circle around the origin; FAR_M if it never meets it."""
    enter, leave = disc_span(x, y, dx, dy, radius * radius)
    return ti.select(enter > leave, FAR_M, ti.max(leave, 0.0))


# ------------------------------------------------------------------------------------ level rays in the world


@ti.func
def place_obstacles(env, x, y, io: Bundle[SonarIO]):
    """Write centre and reach of every obstacle's outline, as seen from (x, y), for ``obstacles_in_wedge``; an
    empty slot reaches nowhere."""
    n_obstacle = ti.static(io.world.kind.shape[1])
    for slot in range(io.sonar_memory.obstacle_reach_m.shape[1]):
        reach = -FAR_M
        if slot < n_obstacle:
            kind = io.world.kind[env, slot]
            if kind != NONE:
                size = io.world.size[env, slot]
                io.sonar_memory.obstacle_x_m[env, slot] = io.world.pos_w[env, slot][0] - x
                io.sonar_memory.obstacle_y_m[env, slot] = io.world.pos_w[env, slot][1] - y
                reach = ti.cast(
                    size[0] + ti.select(kind == BOX, size[1], 0.0), ti.f32
                )  # no less than half a box's diagonal
        io.sonar_memory.obstacle_reach_m[env, slot] = reach


@ti.func
def obstacles_in_wedge(env, first, wedge, io: Bundle[SonarIO]):
    """Bit set of those among sixteen obstacles whose outline may reach into a wedge at the sensor
    (conservative).

    ``wedge`` = (x, y) of its middle direction, then (cos, sin) of its half angle.
    """
    x, y, reach = f16x(0.0), f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        x[i], y[i], reach[i] = (
            io.sonar_memory.obstacle_x_m[env, first + i],
            io.sonar_memory.obstacle_y_m[env, first + i],
            io.sonar_memory.obstacle_reach_m[env, first + i],
        )
    along = x * wedge[0] + y * wedge[1]
    across = ti.abs(x * wedge[1] - y * wedge[0])
    return lane_bits(across * wedge[2] - along * wedge[3] <= reach)


@ti.func
def obstacles_there(env, first, io: Bundle[SonarIO]):
    """Bit set of the slots in use among sixteen."""
    reach = f16x(0.0)
    for i in ti.static(range(LANES)):
        reach[i] = io.sonar_memory.obstacle_reach_m[env, first + i]
    return lane_bits(reach >= 0.0)


@ti.func
def nearest_echo(env, x, y, ux, uy, travelled, wedge, direct: Const[bool], io: Bundle[SonarIO]):
    """Nearest surface along level rays (ux, uy) from (x, y) in the sonar's plane, after a path already
    ``travelled`` [m]: a struct of lanes, range [m] (FAR_M = nothing), outward unit normal and velocity [m/s]
    of the surface.

    An obstacle counts where its vertical gap is at most ``fan_slope`` x path. (x, y) and ``travelled`` are
    scalars, or lanes after a bounce. ``direct`` rays start at the sensor, where only obstacles in their
    ``wedge`` need a test.
    """
    echo = wall_echo(x, y, ux, uy, io)
    for group in range(ti.static(io.sonar_memory.obstacle_reach_m.shape[1] // LANES)):
        waiting = 0
        if ti.static(direct):
            waiting = obstacles_in_wedge(env, group * LANES, wedge, io)
        else:
            waiting = obstacles_there(env, group * LANES, io)
        while waiting != 0:
            obstacle = group * LANES + 31 - ti.math.clz(waiting & -waiting)  # the lowest bit
            waiting &= waiting - 1
            echo = nearer_echo(env, obstacle, echo, x, y, ux, uy, travelled, io)
    return echo


@ti.func
def nearer_echo(env, obstacle, echo, x, y, ux, uy, travelled, io: Bundle[SonarIO]):
    """The echo, or an obstacle's where that is nearer."""
    out = echo
    slope = ti.static(fan_slope(io.sonar_cfg))
    kind = io.world.kind[env, obstacle]
    pos, size = io.world.pos_w[env, obstacle].cast(ti.f32), io.world.size[env, obstacle].cast(ti.f32)
    sx, sy, rise = x - pos[0], y - pos[1], pos[2] - ti.cast(io.sonar_memory.mount_w[env][2], ti.f32)
    enter, normal_x, normal_y = filled(FAR_M, ux.n), filled(0.0, ux.n), filled(0.0, ux.n)
    if kind == BOX:
        enter, normal_x, normal_y = box_entry(
            sx, sy, ux, uy, size, ti.cast(io.world.yaw[env, obstacle], ti.f32)
        )
    else:
        # a sphere's slice at height h over its centre is a disc of radius sqrt(R^2 - h^2); the beam, as high
        # as its path times the slope, meets the slice that is ``lost`` = rise less that height away
        lost = ti.max(ti.abs(rise) - (ti.sqrt(sx * sx + sy * sy) + travelled) * slope, 0.0)
        radius_squared = size[0] * size[0] - ti.select(kind == SPHERE, 1.0, 0.0) * lost * lost
        enter, normal_x, normal_y = disc_entry(sx, sy, ux, uy, radius_squared)
    gap = ti.select(kind == SPHERE, 0.0, ti.max(ti.abs(rise) - size[2], 0.0))
    nearer = (enter > _SKIN_M) & (enter < echo.range_m) & ((enter + travelled) * slope >= gap)
    vel = io.world.vel_w[env, obstacle].cast(ti.f32)
    out.range_m = ti.select(nearer, enter, echo.range_m)
    out.normal_x = ti.select(nearer, normal_x, echo.normal_x)
    out.normal_y = ti.select(nearer, normal_y, echo.normal_y)
    out.vel_x = ti.select(nearer, vel[0], echo.vel_x)
    out.vel_y = ti.select(nearer, vel[1], echo.vel_y)
    return out


@ti.func
def box_entry(sx, sy, ux, uy, size, yaw):
    """(range, normal x, normal y) where rays from (sx, sy), relative to an upright box's centre, enter it;
    FAR_M where they do not."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    dx, dy = ux * c + uy * s, uy * c - ux * s
    # in the box's own axes: the ray is inside from the later of both entries on; that one's face is hit
    in_x, out_x = slab_span(sx * c + sy * s, dx, size[0])
    in_y, out_y = slab_span(sy * c - sx * s, dy, size[1])
    enter, leave = ti.max(in_x, in_y), ti.min(out_x, out_y)
    face_x = ti.select(in_x > in_y, ti.select(dx > 0.0, -1.0, 1.0), 0.0)
    face_y = ti.select(in_x > in_y, 0.0, ti.select(dy > 0.0, -1.0, 1.0))
    range_m = ti.select(enter <= leave, enter, FAR_M)
    return range_m, face_x * c - face_y * s, face_x * s + face_y * c


@ti.func
def disc_entry(sx, sy, ux, uy, radius_squared):
    """(range, normal x, normal y) where rays from (sx, sy) enter a circle around the origin."""
    enter, _ = disc_span(sx, sy, ux, uy, radius_squared)
    inverse = 1.0 / ti.sqrt(ti.max(radius_squared, 1.0e-12))
    return enter, (sx + enter * ux) * inverse, (sy + enter * uy) * inverse


def fan_slope(sonar_cfg):
    """Rise per metre at the edge of the sonar's vertical fan."""
    return math.tan(math.radians(sonar_cfg.vertical_half_aperture_deg))


@ti.func
def wall_echo(x, y, ux, uy, io: Bundle[SonarIO]):
    """Side walls of the tank: nothing moves, normals point inwards."""
    range_m, normal_x, normal_y = filled(0.0, ux.n), filled(0.0, ux.n), filled(0.0, ux.n)
    if ti.static(io.tank_cfg.shape == "circle"):
        sx = x - ti.static(0.5 * (io.tank_cfg.x_m[0] + io.tank_cfg.x_m[1]))
        sy = y - ti.static(0.5 * (io.tank_cfg.y_m[0] + io.tank_cfg.y_m[1]))
        range_m = rim_distance(sx, sy, ux, uy, io.tank_cfg.radius_m)
        normal_x = (sx + range_m * ux) * ti.static(-1.0 / io.tank_cfg.radius_m)
        normal_y = (sy + range_m * uy) * ti.static(-1.0 / io.tank_cfg.radius_m)
    else:
        to_x = plane_distance(x, ux, io.tank_cfg.x_m[0], io.tank_cfg.x_m[1])
        to_y = plane_distance(y, uy, io.tank_cfg.y_m[0], io.tank_cfg.y_m[1])
        range_m = ti.min(to_x, to_y)
        normal_x = ti.select(to_x < to_y, ti.select(ux > 0.0, -1.0, 1.0), 0.0)
        normal_y = ti.select(to_x < to_y, 0.0, ti.select(uy > 0.0, -1.0, 1.0))
    still = filled(0.0, ux.n)
    return ti.Struct(range_m=range_m, normal_x=normal_x, normal_y=normal_y, vel_x=still, vel_y=still)
