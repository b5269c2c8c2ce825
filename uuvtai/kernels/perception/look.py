"""What the camera says about the height of a tracked body: the column of pixels through its middle shows
where it begins and ends.

Only what lies in the image and at the body's distance counts; a body cut by the image's edge or by something
nearer tells one end, a column through which the camera sees farther tells where no body is. Feeds the height
hypotheses of ``elevation.py``; sees the image and tracks only.
"""

import taichi as ti

from uuvtai.kernels.core.geometry import FAR_M, quaternion_wb, rotation_wb
from uuvtai.kernels.core.lanes import LANES, f16x
from uuvtai.kernels.core.signature import Bundle, spread
from uuvtai.kernels.perception.bundles import LookIO
from uuvtai.kernels.perception.elevation import COLUMN, heights, weigh_camera
from uuvtai.kernels.perception.evidence import pinhole
from uuvtai.native.launch import quick_launch

_DEPTH_SLACK_M = 0.25
"""A pixel this close to the body's expected distance shows the body (track errors and the size's)."""

_TRUNCATED_M = 0.4
"""[m] farthest that the middle of a body may be from its one visible end."""

_EDGE_M = 0.1
"""[m] a column through the full water column must reach this close to floor and surface, and a middle is
known this well."""

_LEAST = 0.05
"""Likelihood of a height that the image contradicts."""

# what a pixel of the column shows: something nearer than the body (or the image's edge), the body, something
# beyond it
_HIDES = 0
_BODY = 1
_PAST = 2


@quick_launch
@ti.kernel
def look_at_bodies(io: Bundle[LookIO]):
    """Weigh the heights of every moving track in the view of a fresh image."""
    n, n_track = ti.static(io.tracks.alive.shape[0], io.tracks.alive.shape[1])
    for env, track, pad in ti.ndrange(n, n_track, ti.static(spread(n, n_track))):
        if (
            pad == 0
            and io.clock.awake[env] == 1
            and io.image.fresh[env] == 1
            and io.tracks.alive[env, track] * io.tracks.moving[env, track] == 1
        ):
            late = (io.clock.step[env] - io.tracks.scan_step[env]) * io.episode_cfg.control_dt_s
            mean = io.tracks.state[env, track]
            at = ti.Vector([mean[0] + late * mean[2], mean[1] + late * mean[3]])
            look_at(env, track, at, io)


@ti.func
def look_at(env, track, at, io: Bundle[LookIO]):
    """One track, expected at ``at`` [m, world, horizontal]."""
    focal, _, middle_col = ti.static(pinhole(io.depth_cfg))
    rpy = io.image.shot_rpy[env]
    R_wb = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2]))
    eye = io.image.shot_pos_w[env] + R_wb @ ti.Vector(
        [io.depth_cfg.offset_b_m[0], io.depth_cfg.offset_b_m[1], io.depth_cfg.offset_b_m[2]]
    )
    yaw_c, yaw_s = ti.cos(rpy[2]), ti.sin(rpy[2])
    off = at - ti.Vector([eye[0], eye[1]])
    ahead, left = yaw_c * off[0] + yaw_s * off[1], yaw_c * off[1] - yaw_s * off[0]
    radius = io.tracks.radius_m[env, track]
    col = ti.cast(ti.floor(middle_col - focal * left / ti.max(ahead, 1e-3) + 0.5), ti.i32)
    if (
        ahead > radius + ti.static(_DEPTH_SLACK_M)
        and ahead < io.depth_cfg.max_range_m - _DEPTH_SLACK_M
        and col >= 0
        and col < ti.static(io.depth_cfg.cols)
    ):
        ends, cut = column_ends(env, col, ahead, radius, eye[2], R_wb, io)
        if ends[0] <= ends[1]:
            weigh_camera(env, track, shown_heights(ends, cut, io), 0, io.tracks)
        else:
            likely = missing_heights(env, col, ahead, radius, eye[2], R_wb, io)
            if likely[COLUMN] < 1.0:
                weigh_camera(env, track, likely, 1, io.tracks)


@ti.func
def column_ends(env, col, ahead, radius, eye_z, R_wb, io: Bundle[LookIO]):
    """What one column of pixels shows of a body ``ahead`` [m] of the camera.

    (lowest, highest) z of its pixels, low > high where there are none; and whether it goes on unseen at its
    (lower, upper) end: beyond the image's edge or behind something nearer.
    """
    focal, middle_row, middle_col = ti.static(pinhole(io.depth_cfg))
    left = (middle_col - col) / focal
    low, high = FAR_M, -FAR_M
    cut = ti.Vector([0, 0])
    before = _HIDES
    for row in range(ti.static(io.depth_cfg.rows)):
        away = io.image.depth_m[env, row, col]
        shown = _PAST
        if away <= ahead - radius - _DEPTH_SLACK_M:
            shown = _HIDES
        elif away < ahead + _DEPTH_SLACK_M:
            shown = _BODY
        if shown == _BODY:
            z = eye_z + (R_wb[2, 0] + R_wb[2, 2] * (middle_row - row) / focal + R_wb[2, 1] * left) * away
            low, high = ti.min(low, z), ti.max(high, z)
        if shown == _BODY and before == _HIDES:
            cut[1] = 1
        if before == _BODY and shown == _HIDES:
            cut[0] = 1
        before = shown
    if before == _BODY:
        cut[0] = 1
    return ti.Vector([low, high]), cut


@ti.func
def shown_heights(ends, cut, io: Bundle[LookIO]):
    """Likelihood per hypothesis of a body that shows between ends[0] and ends[1] and goes on beyond an edge
    where ``cut``."""
    step = ti.static((io.tank_cfg.z_m[1] - io.tank_cfg.z_m[0]) / COLUMN)
    middle = 0.5 * (ends[0] + ends[1])
    first, last = middle, middle
    if cut[0] == 1 and cut[1] == 1:
        first, last = ends[0], ends[1]
    elif cut[0] == 1:
        first = ends[1] - _TRUNCATED_M
    elif cut[1] == 1:
        last = ends[0] + _TRUNCATED_M
    reach = _EDGE_M + 0.5 * step
    at = heights(io.tank_cfg)
    out = f16x(_LEAST)
    for i in ti.static(range(LANES)):
        if at[i] >= first - reach and at[i] <= last + reach:
            out[i] = 1.0
    bottom = cut[0] == 1 or ends[0] < ti.static(io.tank_cfg.z_m[0] + 2.0 * _EDGE_M)
    top = cut[1] == 1 or ends[1] > ti.static(io.tank_cfg.z_m[1] - 2.0 * _EDGE_M)
    out[COLUMN] = ti.select(bottom and top, 1.0, _LEAST)
    return out


@ti.func
def missing_heights(env, col, ahead, radius, eye_z, R_wb, io: Bundle[LookIO]):
    """Likelihood per hypothesis of a body that does not show: less where the camera sees past the place of
    its middle."""
    focal, middle_row, middle_col = ti.static(pinhole(io.depth_cfg))
    tilt = R_wb[2, 0] + R_wb[2, 1] * (middle_col - col) / focal
    front = ahead - 0.5 * radius
    at = heights(io.tank_cfg)
    out = f16x(1.0)
    for i in ti.static(range(COLUMN)):
        up = ((at[i] - eye_z) / front - tilt) / R_wb[2, 2]
        row = ti.cast(ti.floor(middle_row - focal * up + 0.5), ti.i32)
        held = ti.math.clamp(row, 0, io.depth_cfg.rows - 1)
        if row == held and io.image.depth_m[env, held, col] > ahead - radius - _DEPTH_SLACK_M:
            out[i] = 1.0 - io.elevation_cfg.camera_hit_share
            out[COLUMN] = 1.0 - io.elevation_cfg.camera_hit_share
    return out
