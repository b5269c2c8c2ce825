"""Plan view of bodies: rectangles with rounded corners, and how far apart they are. Floor of the scenario's
drawing.

A footprint is seven numbers (centre x, y; direction x, y; half extents along and across, in units of the
direction's length; rounding radius [m]): a disc has no extents, a box no rounding, a straight stroke of a
moving disc has length and rounding. What is decided here must be decided alike on every device, so distances
are compared as squares and directions come from a fixed polynomial: no square root, sine or cosine, which
differ in the last bit between devices.
"""

import taichi as ti

from uuvtai.config import TankConfig
from uuvtai.kernels.core.geometry import BOX, FAR_M, PI
from uuvtai.kernels.core.signature import Const

_TINY = 1e-12


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
def nearest_squared(shape, point):
    """Squared distance [m^2] from a point to the unrounded rectangle, 0 inside."""
    ahead = ti.Vector([shape[2], shape[3]])
    side = ti.Vector([-shape[3], shape[2]])
    offset = ti.Vector([point[0] - shape[0], point[1] - shape[1]])
    inverse = 1.0 / ti.max(ahead.dot(ahead), _TINY)
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
def is_off_ring(shape, center, radius, body_radius):
    """1 where a disc that goes around a circle never meets the footprint."""
    outer = radius + body_radius + shape[6]
    inner = radius - body_radius - shape[6]
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
