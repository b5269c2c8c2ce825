"""Forward depth camera: a pinhole with the vehicle's full attitude, cast analytically in packets of sixteen
columns.

Optical axis = body x, image right = -y, down = -z; square pixels, fx = fy = cols / 2 / tan(fov / 2),
principal point in the middle of the image, pixel centres at + 0.5. z-depth = the parameter of a ray whose
body-x component is 1. It sees obstacles (caps and faces too) and side walls (without vertical bound), not
floor and surface. Each body is tested only inside the rectangle that bounds it in the image.
"""

import math

import taichi as ti

from uuvtai.compile.launch import is_gpu_shaped, quick_launch, with_cse
from uuvtai.kernels.core.geometry import BOX, FAR_M, NONE, SPHERE, rotation_wb
from uuvtai.kernels.core.noise import STREAM_DEPTH, normal_pair_lanes, stream_key
from uuvtai.kernels.core.simd import LANES, f16x, ramp
from uuvtai.kernels.core.stage import Bundle, loop_end, n_envs, shares
from uuvtai.kernels.sensors.io import DepthIO
from uuvtai.kernels.sensors.raycast import ball_span, disc_span, rim_distance, slab_span

_BLOCK = 36  # Image rows per loop item on a CPU: obstacles are projected once per item.

_BLOCK_GPU = 4  # Rows per loop item where items are threads and thousands of them must be there.

_NEAR_M = 0.02
"""A bounding corner nearer than this to the camera's plane is not projected: the obstacle is then tested in
the whole image."""

_MARGIN = 0.01  # [pixel] added around the bounding rectangle against rounding.

_POKED_M = 1.0e-6  # A camera nearer to a wall than this pokes through it.

CameraPose = ti.types.struct(pos=ti.math.vec3, R_wb=ti.math.mat3)
"""Truth of the camera as float32: world position [m], body to world."""


@quick_launch
@ti.kernel
def reset_depth(io: Bundle[DepthIO]):
    """Forget the image of the active rows (the shot of step 0 fills it)."""
    n, n_row, n_col = ti.static(io.image.depth_m.shape)
    n_share = ti.static(shares(n_row))
    for env, share in ti.ndrange(loop_end(n, io.clock), n_share):
        if io.clock.active[env] == 1:
            for row in range(share * n_row // n_share, (share + 1) * n_row // n_share):
                for col in range(n_col):
                    io.image.depth_m[env, row, col] = 0.0
            if share == 0:
                io.image.fresh[env] = 0
                io.image.shot_pos_w[env] = ti.zero(io.image.shot_pos_w[env])
                io.image.shot_rpy[env] = ti.zero(io.image.shot_rpy[env])


@quick_launch
@with_cse()
@ti.kernel
def cast_depth(io: Bundle[DepthIO]):
    """New image in the rows whose step is a multiple of period_steps (step 0 included); the others keep
    theirs with ``fresh`` = 0."""
    block_rows = ti.static(rows_per_item())
    n_block = ti.static(-(-io.depth_cfg.rows // block_rows))
    n_share = ti.static(shares(n_block))
    for env, share in ti.ndrange(n_envs(io.clock), n_share):
        if io.clock.active[env] == 1:
            due = io.clock.step[env] % io.depth_cfg.period_steps == 0
            if share == 0:
                label_image(env, due, io)
            if due:
                for block in range(share * n_block // n_share, (share + 1) * n_block // n_share):
                    fill_block(env, block * block_rows, io)
                    disturb_block(env, block * block_rows, io.clock.step[env], io)


def rows_per_item() -> int:
    """Image rows of one loop item."""
    return _BLOCK_GPU if is_gpu_shaped() else _BLOCK


@ti.func
def label_image(env, due, io: Bundle[DepthIO]):
    """Freshness, and the own pose estimate of a new image."""
    io.image.fresh[env] = ti.cast(due, ti.i32)
    if due:
        io.image.shot_pos_w[env] = io.ego.pos_w[env]
        io.image.shot_rpy[env] = io.ego.rpy[env]


@ti.func
def fill_block(env, first_row, io: Bundle[DepthIO]):
    """Noise-free depth of _BLOCK rows: walls first, then every obstacle over them inside its bounding
    rectangle."""
    R_wb = rotation_wb(io.vehicle.quat_wb[env]).cast(ti.f32)
    offset_b = ti.Vector(
        [io.depth_cfg.offset_b_m[0], io.depth_cfg.offset_b_m[1], io.depth_cfg.offset_b_m[2]], ti.f32
    )
    eye = CameraPose(pos=io.vehicle.pos_w[env].cast(ti.f32) + R_wb @ offset_b, R_wb=R_wb)
    last_row = ti.min(first_row + ti.static(rows_per_item()), io.depth_cfg.rows)
    for row in range(first_row, last_row):
        for packet in range(ti.static(io.depth_cfg.cols // LANES)):
            dx, dy, _dz = ray_directions(row, packet * LANES, eye.R_wb, io)
            seen = ti.min(wall_depth(eye, dx, dy, io), io.depth_cfg.max_range_m)
            paint(env, row, packet * LANES, seen, io)
    for obstacle in range(io.world.kind.shape[1]):
        if io.world.kind[env, obstacle] != NONE:
            draw_obstacle(env, obstacle, first_row, last_row, eye, io)


@ti.func
def paint(env, row, first_col, seen, io: Bundle[DepthIO]):
    """Write sixteen pixels."""
    for i in ti.static(range(LANES)):
        io.image.depth_m[env, row, first_col + i] = seen[i]


@ti.func
def paint_nearer(env, row, first_col, enter, io: Bundle[DepthIO]):
    """Write those of sixteen pixels in which ``enter`` lies before the camera and nearer than what is
    there."""
    for i in ti.static(range(LANES)):
        behind = io.image.depth_m[env, row, first_col + i]
        io.image.depth_m[env, row, first_col + i] = ti.select(
            (enter[i] > 0.0) & (enter[i] < behind), enter[i], behind
        )


@ti.func
def ray_directions(row, first_col, R_wb, io: Bundle[DepthIO]):
    """World directions (x, y, z) of sixteen pixels' rays, scaled so that their body-x component is 1."""
    inverse_focal = ti.static(2.0 * math.tan(math.radians(0.5 * io.depth_cfg.fov_deg)) / io.depth_cfg.cols)
    left = ramp(ti.cast(first_col, ti.f32) + ti.static(0.5 - 0.5 * io.depth_cfg.cols), LANES) * -inverse_focal
    up = (0.5 * io.depth_cfg.rows - 0.5 - row) * inverse_focal
    dx = left * R_wb[0, 1] + (R_wb[0, 0] + up * R_wb[0, 2])
    dy = left * R_wb[1, 1] + (R_wb[1, 0] + up * R_wb[1, 2])
    dz = left * R_wb[2, 1] + (R_wb[2, 0] + up * R_wb[2, 2])
    return dx, dy, dz


@ti.func
def wall_depth(eye, dx, dy, io: Bundle[DepthIO]):
    """z-depth of the side walls; 0 where the camera pokes through them."""
    seen = f16x(0.0)
    if ti.static(io.tank_cfg.shape == "circle"):
        x = eye.pos[0] - ti.static(0.5 * (io.tank_cfg.x_m[0] + io.tank_cfg.x_m[1]))
        y = eye.pos[1] - ti.static(0.5 * (io.tank_cfg.y_m[0] + io.tank_cfg.y_m[1]))
        seen = rim_distance(x, y, dx, dy, io.tank_cfg.radius_m)
    else:
        nearness_x = nearness(dx, io.tank_cfg.x_m[0] - eye.pos[0], io.tank_cfg.x_m[1] - eye.pos[0])
        nearness_y = nearness(dy, io.tank_cfg.y_m[0] - eye.pos[1], io.tank_cfg.y_m[1] - eye.pos[1])
        seen = 1.0 / ti.max(nearness_x, nearness_y, ti.static(1.0 / FAR_M))
    return seen


@ti.func
def nearness(direction, low, high):
    """Inverse of the ray parameter at which a coordinate between two walls, ``low`` < 0 and ``high`` > 0
    away, meets the one ahead of it.

    Division by a scalar once instead of by every lane. Beyond a wall that lies ahead: larger than any that
    matters.
    """
    return ti.max(direction * (1.0 / ti.max(high, _POKED_M)), direction * (1.0 / ti.min(low, -_POKED_M)))


@ti.func
def draw_obstacle(env, obstacle, first_row, last_row, eye, io: Bundle[DepthIO]):
    """Overwrite the pixels of these rows in which the obstacle is nearer than what is there."""
    kind = io.world.kind[env, obstacle]
    size = io.world.size[env, obstacle].cast(ti.f32)
    yaw = ti.cast(io.world.yaw[env, obstacle], ti.f32)
    offset = eye.pos - io.world.pos_w[env, obstacle].cast(ti.f32)
    if may_be_seen(offset, size.norm(), eye.R_wb, io):
        c, s = ti.cos(yaw), ti.sin(yaw)
        left, right, top, bottom = image_rectangle(offset, size, c, s, eye.R_wb, io)
        for row in range(ti.max(top, first_row), ti.min(bottom + 1, last_row)):
            for packet in range(left // LANES, (right + LANES) // LANES):
                dx, dy, dz = ray_directions(row, packet * LANES, eye.R_wb, io)
                enter = obstacle_entry(kind, size, c, s, offset, dx, dy, dz)
                paint_nearer(env, row, packet * LANES, enter, io)


@ti.func
def may_be_seen(offset, radius, R_wb, io: Bundle[DepthIO]):
    """Whether a ball of this radius around -offset (relative to the camera) reaches into the view and its
    range."""
    centre_b = -(R_wb.transpose() @ offset)
    half_width = ti.static(math.tan(math.radians(0.5 * io.depth_cfg.fov_deg)))
    half_height = ti.static(half_height_tangent(io.depth_cfg))
    # the sides of the view are planes |y| = w x through the camera: a centre lies
    # (|y| - w x) / sqrt(1 + w^2) outside of one
    beyond_x = ti.abs(centre_b[1]) - half_width * centre_b[0]
    beyond_z = ti.abs(centre_b[2]) - half_height * centre_b[0]
    return (
        centre_b[0] > -radius
        and centre_b[0] < io.depth_cfg.max_range_m + radius
        and beyond_x < radius * ti.static(math.hypot(1.0, math.tan(math.radians(0.5 * io.depth_cfg.fov_deg))))
        and beyond_z < radius * ti.static(math.hypot(1.0, half_height_tangent(io.depth_cfg)))
    )


def half_height_tangent(depth):
    """Tangent of half the vertical field of view of a DepthConfig."""
    return math.tan(math.radians(0.5 * depth.fov_deg)) * depth.rows / depth.cols


@ti.func
def image_rectangle(offset, size, c, s, R_wb, io: Bundle[DepthIO]):
    """Columns and rows (left, right, top, bottom; inclusive, inside the image) that a box of half extents
    ``size`` can cover.

    (c, s) turns the box about z; ``offset`` is the camera relative to its centre in the world. The whole
    image where a corner is not well in front of the camera.
    """
    focal = ti.static(0.5 * io.depth_cfg.cols / math.tan(math.radians(0.5 * io.depth_cfg.fov_deg)))
    low_u, high_u, low_v, high_v = FAR_M, -FAR_M, FAR_M, -FAR_M
    in_front = True
    for corner in range(8):
        x = ti.select(corner & 1 == 0, -size[0], size[0])
        y = ti.select(corner & 2 == 0, -size[1], size[1])
        z = ti.select(corner & 4 == 0, -size[2], size[2])
        corner_b = R_wb.transpose() @ (ti.Vector([c * x - s * y, s * x + c * y, z]) - offset)
        in_front = in_front and corner_b[0] > _NEAR_M
        scale = focal / ti.max(corner_b[0], _NEAR_M)
        u, v = -corner_b[1] * scale, -corner_b[2] * scale
        low_u, high_u, low_v, high_v = (
            ti.min(low_u, u),
            ti.max(high_u, u),
            ti.min(low_v, v),
            ti.max(high_v, v),
        )
    left, right, top, bottom = 0, ti.static(io.depth_cfg.cols - 1), 0, ti.static(io.depth_cfg.rows - 1)
    if in_front:
        left, right = pixel_span(low_u, high_u, io.depth_cfg.cols)
        top, bottom = pixel_span(low_v, high_v, io.depth_cfg.rows)
    return left, right, top, bottom


@ti.func
def pixel_span(low, high, count):
    """First and last pixel of ``count`` whose centres lie within image coordinates [low, high], counted from
    the image's middle."""
    first = ti.ceil(ti.max(low - _MARGIN + 0.5 * count - 0.5, 0.0))
    last = ti.floor(ti.min(high + _MARGIN + 0.5 * count - 0.5, count - 1.0))
    return ti.cast(ti.min(first, count), ti.i32), ti.cast(ti.max(last, -1.0), ti.i32)


@ti.func
def obstacle_entry(kind, size, c, s, offset, dx, dy, dz):
    """z-depth at which sixteen rays enter an obstacle from outside; not positive, or FAR_M, where they do
    not.

    A convex body is an intersection of simple sets, so its span is (largest enter, smallest leave).
    """
    enter, leave = f16x(FAR_M), f16x(-FAR_M)
    if kind == SPHERE:
        enter, leave = ball_span(offset[0], offset[1], offset[2], dx, dy, dz, size[0] * size[0])
    else:
        in_z, out_z = slab_span(offset[2], dz, size[2])
        if kind == BOX:
            in_x, out_x = slab_span(offset[0] * c + offset[1] * s, dx * c + dy * s, size[0])
            in_y, out_y = slab_span(offset[1] * c - offset[0] * s, dy * c - dx * s, size[1])
            enter, leave = ti.max(in_x, in_y, in_z), ti.min(out_x, out_y, out_z)
        else:
            in_disc, out_disc = disc_span(offset[0], offset[1], dx, dy, size[0] * size[0])
            enter, leave = ti.max(in_disc, in_z), ti.min(out_disc, out_z)
    return ti.select(enter <= leave, enter, FAR_M)


@ti.func
def disturb_block(env, first_row, step, io: Bundle[DepthIO]):
    """Normal error, sigma = a + b depth, on every return; what then lies beyond the range is no return."""
    if ti.static(io.depth_cfg.sigma_m > 0 or io.depth_cfg.sigma_slope > 0):
        key = stream_key(io.episode.key[env], step, STREAM_DEPTH)
        n_packet = ti.static(io.depth_cfg.cols // LANES)
        for row in range(first_row, ti.min(first_row + ti.static(rows_per_item()), io.depth_cfg.rows)):
            for pair in range(
                ti.static(-(-n_packet // 2))
            ):  # the two normals of a draw go to neighbouring packets
                one, other = normal_pair_lanes(key, row * io.depth_cfg.cols + pair * LANES, LANES)
                paint_noisy(env, row, 2 * pair * LANES, one, io)
                if ti.static(n_packet % 2 == 0) or 2 * pair + 1 < n_packet:
                    paint_noisy(env, row, (2 * pair + 1) * LANES, other, io)


@ti.func
def paint_noisy(env, row, first_col, error, io: Bundle[DepthIO]):
    """Add ``error`` standard deviations to sixteen pixels where they show a return."""
    for i in ti.static(range(LANES)):
        true_m = io.image.depth_m[env, row, first_col + i]
        noisy = true_m + (io.depth_cfg.sigma_m + io.depth_cfg.sigma_slope * true_m) * error[i]
        kept = ti.min(ti.max(noisy, 0.0), io.depth_cfg.max_range_m)
        io.image.depth_m[env, row, first_col + i] = ti.select(true_m < io.depth_cfg.max_range_m, kept, true_m)
