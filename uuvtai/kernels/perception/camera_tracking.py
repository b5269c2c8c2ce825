"""Tracked obstacles that the camera shows while the sonar does not: above or below the fan they are followed
by the image.

Per column of the image the nearest thing before the known walls, at a height that matters; neighbouring
columns make a spot. A spot that the sonar's beams show too is the sonar's affair; of the others each corrects
the moving track that is expected nearest to it, by a position only: a depth camera measures no speed. Spots
that are nobody's begin tracks. Sees the image, the scan and tracks only.
"""

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.beams import beam_there, beam_towards
from uuvtai.kernels.core.geometry import FAR_M, quaternion_wb, rotation_wb, wrapped_angle
from uuvtai.kernels.core.kalman import born, corrected, position_variance
from uuvtai.kernels.core.simd import LANES, f16x, ramp
from uuvtai.kernels.core.stage import Bundle, loop_end, n_envs, shares
from uuvtai.kernels.perception.height import COLUMN, begin_height, heights, weigh_camera
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.kernels.perception.sensor_model import NO_RETURN_SHARE, pinhole, wall_lanes
from uuvtai.kernels.perception.track_filter import bearing_vector
from uuvtai.kernels.perception.tracking import clear_track

_ROW_STRIDE = 2
"""Rows of the image that are looked at: every second one; an obstacle fills several within the range that
matters."""

_ROUNDING_M = 1.0e-3  # Far more than float32 rounds a distance by.

_PRESENT = 0.95  # Probability of an obstacle that has just been seen to be where it is expected.

_NEWLY_SEEN_S = 0.15  # [s] a track that the sonar saw this lately needs no image.

BAND_M, WALL_MARGIN_M = 0.9, 0.25
"""Nothing farther above or below the camera is looked at, nor what is nearer to a known wall (EC)."""

SPLIT_M = 0.25
"""A larger jump of distance between columns separates spots; a sonar return within it explains one (EC)."""

GATE_M, MAX_GATE_M = 0.3, 1.2
"""A spot this close to where a track is expected may match it, and farther for obstacles that were not seen
for long, up to the second (EC)."""

APART_M = 0.35
"""A spot farther than this from every track is an obstacle of its own (EC)."""

TURN_GATE = 12.0
"""Squared normalised innovation (2 values) beyond which an obstacle is taken to have turned (EC)."""

HIT_SHARE = 0.5
"""Probability that an obstacle in the image and at a free distance shows in the column through its middle
(EC)."""


@quick_launch
@ti.kernel
def scan_columns(io: Bundle[TrackingIO]):
    """Horizontal distance of the nearest thing in every column of a fresh image, FAR_M = none within range,
    height band and walls."""
    n, n_packet = ti.static(io.clock.active.shape[0], io.depth_cfg.cols // LANES)
    n_share = ti.static(shares(n_packet))
    for env, share in ti.ndrange(loop_end(n, io.clock), n_share):
        if io.clock.active[env] == 1 and io.image.fresh[env] == 1:
            for packet in range(share * n_packet // n_share, (share + 1) * n_packet // n_share):
                near, edge = column_distances(env, packet * LANES, io)
                for i in ti.static(range(LANES)):
                    io.spots.column_m[env, packet * LANES + i] = near[i]
                    io.spots.edge_m[env, packet * LANES + i] = edge[i]


@ti.func
def eye_of(env, io: Bundle[TrackingIO]):
    """(position [m, world], body to world) of the camera when the image was taken, as estimated."""
    rpy = io.image.shot_rpy[env]
    R_wb = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2]))
    return io.image.shot_pos_w[env] + R_wb @ ti.Vector(
        [io.depth_cfg.offset_b_m[0], io.depth_cfg.offset_b_m[1], io.depth_cfg.offset_b_m[2]]
    ), R_wb


@ti.func
def column_distances(env, first_col, io: Bundle[TrackingIO]):
    """(nearest thing, nearest thing in the first or last row looked at): horizontal distances [m] of sixteen
    columns, FAR_M = none."""
    focal, middle_row, middle_col = ti.static(pinhole(io.depth_cfg))
    eye, R_wb = eye_of(env, io)
    left = ramp(ti.cast(first_col, ti.f32) - middle_col, LANES) * ti.static(-1.0 / focal)
    level_x, level_y = left * R_wb[0, 1] + R_wb[0, 0], left * R_wb[1, 1] + R_wb[1, 0]
    length = f16x(0.0)
    for i in ti.static(range(LANES)):
        length[i] = ti.sqrt(level_x[i] * level_x[i] + level_y[i] * level_y[i])
    scale = 1.0 / length
    wall = wall_lanes(ti.Vector([eye[0], eye[1]]), level_x * scale, level_y * scale, io.tank_cfg)
    near, edge, limit = f16x(FAR_M), f16x(FAR_M), f16x(0.0)
    for i in ti.static(range(LANES)):
        limit[i] = ti.min(wall[i] - WALL_MARGIN_M, io.camera_tracking_cfg.range_m)
    sway = ti.sqrt(R_wb[0, 2] * R_wb[0, 2] + R_wb[1, 2] * R_wb[1, 2])
    for k in range(ti.static(io.depth_cfg.rows // _ROW_STRIDE)):
        row = k * _ROW_STRIDE
        up = (middle_row - row) * ti.static(1.0 / focal)
        away, spare = f16x(0.0), f16x(0.0)
        for i in ti.static(range(LANES)):
            away[i] = io.image.depth_m[env, row, first_col + i]
            spare[i] = limit[i] - away[i] * (length[i] - sway * ti.abs(up))
        # a tilt changes a ray's level length by no more than ``sway``: most packets show nothing that is near
        # enough
        if spare.max() > -_ROUNDING_M:
            for i in ti.static(range(LANES)):
                x = R_wb[0, 0] + R_wb[0, 1] * left[i] + R_wb[0, 2] * up
                y = R_wb[1, 0] + R_wb[1, 1] * left[i] + R_wb[1, 2] * up
                z = R_wb[2, 0] + R_wb[2, 1] * left[i] + R_wb[2, 2] * up
                level = away[i] * ti.sqrt(x * x + y * y)
                shown = (away[i] < ti.static(NO_RETURN_SHARE * io.depth_cfg.max_range_m)) & (
                    ti.abs(away[i] * z) < BAND_M
                )
                near_m = ti.select(shown & (level < limit[i]), level, FAR_M)
                near[i] = ti.min(near[i], near_m)
                if row == 0 or row >= ti.static(io.depth_cfg.rows - _ROW_STRIDE):
                    edge[i] = ti.min(edge[i], near_m)
    return near, edge


@quick_launch
@ti.kernel
def follow_spots(io: Bundle[TrackingIO]):
    """Gather columns to spots and correct the moving tracks that they show."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1 and io.image.fresh[env] == 1:
            take_spots(env, io)


@ti.func
def take_spots(env, io: Bundle[TrackingIO]):
    """A spot ends where the distance jumps, and at the image's edge."""
    eye, R_wb = eye_of(env, io)
    first, near, edge, before = 0, FAR_M, FAR_M, FAR_M
    for col in range(ti.static(io.depth_cfg.cols + 1)):
        at = FAR_M
        if col < ti.static(io.depth_cfg.cols):
            at = io.spots.column_m[env, col]
        if ti.abs(at - before) > SPLIT_M:
            if before < FAR_M:
                use_spot(env, first, col - 1, near, edge, eye, R_wb, io)
            first, near, edge = col, FAR_M, FAR_M
        near = ti.min(near, at)
        if col < ti.static(io.depth_cfg.cols):
            edge = ti.min(edge, io.spots.edge_m[env, col])
        before = at


@ti.func
def bearing_of(col, R_wb, io: Bundle[TrackingIO]):
    """[rad] world bearing of a place in the image, ``col`` in columns, at the height of the optical axis."""
    focal, _, middle_col = ti.static(pinhole(io.depth_cfg))
    left = (middle_col - col) / focal
    return ti.atan2(R_wb[1, 0] + R_wb[1, 1] * left, R_wb[0, 0] + R_wb[0, 1] * left)


@ti.func
def use_spot(env, first, last, near, edge, eye, R_wb, io: Bundle[TrackingIO]):
    """Match one spot with a track and correct that; a spot that is nobody's begins a track.

    The spot: columns first..last; ``near`` [m] its smallest horizontal distance, ``edge`` [m] that in the
    image's first and last rows.
    """
    from_left, from_right = bearing_of(first - 0.5, R_wb, io), bearing_of(last + 0.5, R_wb, io)
    width = wrapped_angle(from_left - from_right)
    bearing = from_right + 0.5 * width
    along = bearing_vector(bearing)
    seen = ti.Vector([eye[0], eye[1]]) + near * along
    if width * near < io.tracking_cfg.max_width_m and is_off_fan(seen, env, io) == 1:
        late = (io.clock.step[env] - io.tracks.scan_step[env]) * io.episode_cfg.control_dt_s
        best, best_offset = match_of(env, seen, along, late, io)
        cut = first == 0 or last == ti.static(io.depth_cfg.cols - 1)
        if best >= 0:
            correct_track(env, best, best_offset, along, cut, edge < near + SPLIT_M, io)
            io.tracks.spot_step[env, best] = io.clock.step[env]
        elif not cut and io.scan.ping_step[env] >= 0:
            radius = ti.max(0.5 * width * near, io.tracking_cfg.min_radius_m)
            begin_spotted(env, seen + radius * along, along, radius, late, eye[2], io)


@ti.func
def match_of(env, seen, along, late, io: Bundle[TrackingIO]):
    """(track that most easily is what shows at ``seen`` [m], its centre minus where it is expected [m]); -1
    where none is within reach.

    ``late`` [s] = how much newer the image is than the states.
    """
    best, best_gap, best_offset = -1, 0.0, ti.Vector([0.0, 0.0])
    for track in range(io.tracks.alive.shape[1]):
        if is_wanted(env, track, io) == 1:
            mean = io.tracks.state[env, track]
            offset = (
                seen
                + io.tracks.radius_m[env, track] * along
                - ti.Vector([mean[0] + late * mean[2], mean[1] + late * mean[3]])
            )
            gap = offset.norm() - reach_of(env, track, io)
            if gap < best_gap:
                best, best_gap, best_offset = track, gap, offset
    return best, best_offset


@ti.func
def is_off_fan(seen, env, io: Bundle[TrackingIO]):
    """1 where the sonar's beams towards a place met nothing near it: what is there lies above or below the
    fan."""
    own = io.scan.ping_pos_w[env]
    x, y = seen[0] - own[0], seen[1] - own[1]
    distance = ti.sqrt(x * x + y * y)
    middle = beam_towards(ti.atan2(y, x) - io.scan.ping_yaw[env], io.sonar_cfg)
    off = 1
    for k in range(-1, 2):
        ray = ti.max(beam_there(middle + k, io.sonar_cfg), 0)
        if (
            beam_there(middle + k, io.sonar_cfg) >= 0
            and io.scan.hit[env, ray] == 1
            and ti.abs(io.scan.range_m[env, ray] - distance) < SPLIT_M
        ):
            off = 0
    return off


@ti.func
def is_wanted(env, track, io: Bundle[TrackingIO]):
    """1 for a track that moves, or was begun by the camera, and that neither the sonar saw lately nor this
    image already."""
    moving = io.tracks.alive[env, track] == 1 and (
        io.tracks.moving[env, track] == 1 or io.tracks.spot_step[env, track] >= 0
    )
    unseen = (
        io.clock.step[env] - io.tracks.seen_step[env, track]
    ) * io.episode_cfg.control_dt_s > _NEWLY_SEEN_S
    return ti.cast(moving and unseen and io.tracks.spot_step[env, track] != io.clock.step[env], ti.i32)


@ti.func
def reach_of(env, track, io: Bundle[TrackingIO]):
    """[m] how far from its place a track may be found: as far as it went unseen, if it has turned, within
    bounds."""
    seen = ti.max(io.tracks.seen_step[env, track], io.tracks.spot_step[env, track])
    mean = io.tracks.state[env, track]
    way = (
        ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        * (io.clock.step[env] - seen)
        * io.episode_cfg.control_dt_s
    )
    return ti.min(GATE_M + 2.0 * way, MAX_GATE_M)


@ti.func
def correct_track(env, track, offset, along, cut, cut_high, io: Bundle[TrackingIO]):
    """Correct position, and by it velocity; what surprises has turned: its velocity is opened up first."""
    across = ti.Vector([-along[1], along[0]])
    mean, cov = io.tracks.state[env, track], io.tracks.cov[env, track]
    rate, link = io.tracks.turn_rate[env, track], io.tracks.turn_cov[env, track]
    radial_var = (
        ti.static(io.camera_tracking_cfg.sigma_m**2)
        + io.tracks.radius_var[env, track]
        + ti.select(cut_high, io.tracks.radius_m[env, track] ** 2, 0.0)
    )
    cross_var = ti.static(io.camera_tracking_cfg.sigma_m**2) + ti.select(
        cut, io.tracks.radius_m[env, track] ** 2, 0.0
    )
    radial, cross = offset.dot(along), offset.dot(across)
    surprise = radial * radial / (position_variance(cov, along) + radial_var) + cross * cross / (
        position_variance(cov, across) + cross_var
    )
    if surprise > TURN_GATE:
        speed = ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        cov[7] += ti.max(speed, 0.5) ** 2
        cov[9] += ti.max(speed, 0.5) ** 2
        cov[0] += offset.norm_sqr()
        cov[4] += offset.norm_sqr()
    h = ti.Vector([along[0], along[1], 0.0, 0.0])
    mean_r, cov_r, rate_r, link_r = corrected(mean, cov, rate, link, h, radial, radial_var)
    left = offset - ti.Vector([mean_r[0] - mean[0], mean_r[1] - mean[1]])
    h_cross = ti.Vector([across[0], across[1], 0.0, 0.0])
    mean_c, cov_c, rate_c, link_c = corrected(
        mean_r, cov_r, rate_r, link_r, h_cross, left.dot(across), cross_var
    )
    io.tracks.state[env, track] = mean_c
    io.tracks.cov[env, track] = cov_c
    io.tracks.turn_rate[env, track] = rate_c
    io.tracks.turn_cov[env, track] = link_c
    io.tracks.present[env, track] = _PRESENT
    io.tracks.moving[env, track] = 1


@ti.func
def begin_spotted(env, at, along, radius, late, height, io: Bundle[TrackingIO]):
    """A track of an obstacle that only the camera has seen yet, in a free slot, unless one is there already.
    It rests until it is seen again."""
    slot = -1
    known = False
    for track in range(io.tracks.alive.shape[1]):
        if io.tracks.alive[env, track] == 0:
            slot = track
        else:
            mean = io.tracks.state[env, track]
            x, y = mean[0] + late * mean[2] - at[0], mean[1] + late * mean[3] - at[1]
            reach = io.tracks.radius_m[env, track] + APART_M
            known = known or x * x + y * y < reach * reach
    if slot >= 0 and not known:
        var = ti.static(io.camera_tracking_cfg.sigma_m**2)
        speed_var = ti.static(io.tracking_cfg.birth_speed_sigma_m_s**2)
        mean, cov = born(at, along, var, var, 0.0, speed_var, speed_var)
        clear_track(env, slot, io.tracks)
        io.tracks.alive[env, slot] = 1
        io.tracks.state[env, slot] = mean
        io.tracks.cov[env, slot] = cov
        io.tracks.z_m[env, slot] = height
        io.tracks.radius_m[env, slot] = radius
        io.tracks.radius_var[env, slot] = 0.25 * io.tracking_cfg.min_radius_m * io.tracking_cfg.min_radius_m
        io.tracks.sight_w[env, slot] = ti.atan2(along[1], along[0])
        io.tracks.doppler_var[env, slot] = speed_var
        io.tracks.seen_step[env, slot] = io.clock.step[env]
        io.tracks.spot_step[env, slot] = io.clock.step[env]
        io.tracks.misses[env, slot] = 1
        begin_height(env, slot, io.tracks, io.height_cfg)


# ------------------------------------------------------------------------------------------------------------
# What the camera says about the height of a tracked obstacle: the column of pixels through its middle shows
# where it begins and ends.
#
# Only what lies in the image and at the obstacle's distance counts; an obstacle cut by the image's edge or by
# something nearer tells one end, a column through which the camera sees farther tells where no obstacle is.
# Feeds the height hypotheses of ``elevation.py``; sees the image and tracks only.


_DEPTH_SLACK_M = 0.25
"""A pixel this close to the obstacle's expected distance shows the obstacle (track errors and the size's)."""

_TRUNCATED_M = 0.4  # [m] farthest that the middle of an obstacle may be from its one visible end.

_EDGE_M = 0.1
"""[m] a column through the full water column must reach this close to floor and surface, and a middle is
known this well."""

_LEAST = 0.05  # Likelihood of a height that the image contradicts.

# what a pixel of the column shows: something nearer than the obstacle (or the image's edge), the obstacle,
# something beyond it
_HIDES = 0
_OBSTACLE = 1
_PAST = 2


@quick_launch
@ti.kernel
def look_at_obstacles(io: Bundle[TrackingIO]):
    """Weigh the heights of every moving track in the view of a fresh image."""
    n, n_track = ti.static(io.tracks.alive.shape[0], io.tracks.alive.shape[1])
    n_share = ti.static(shares(n_track))
    for env, share in ti.ndrange(loop_end(n, io.clock), n_share):
        if io.clock.active[env] == 1 and io.image.fresh[env] == 1:
            late = (io.clock.step[env] - io.tracks.scan_step[env]) * io.episode_cfg.control_dt_s
            for track in range(share * n_track // n_share, (share + 1) * n_track // n_share):
                if io.tracks.alive[env, track] * io.tracks.moving[env, track] == 1:
                    mean = io.tracks.state[env, track]
                    at = ti.Vector([mean[0] + late * mean[2], mean[1] + late * mean[3]])
                    look_at(env, track, at, io)


@ti.func
def look_at(env, track, at, io: Bundle[TrackingIO]):
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
def column_ends(env, col, ahead, radius, eye_z, R_wb, io: Bundle[TrackingIO]):
    """What one column of pixels shows of an obstacle ``ahead`` [m] of the camera.

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
            shown = _OBSTACLE
        if shown == _OBSTACLE:
            z = eye_z + (R_wb[2, 0] + R_wb[2, 2] * (middle_row - row) / focal + R_wb[2, 1] * left) * away
            low, high = ti.min(low, z), ti.max(high, z)
        if shown == _OBSTACLE and before == _HIDES:
            cut[1] = 1
        if before == _OBSTACLE and shown == _HIDES:
            cut[0] = 1
        before = shown
    if before == _OBSTACLE:
        cut[0] = 1
    return ti.Vector([low, high]), cut


@ti.func
def shown_heights(ends, cut, io: Bundle[TrackingIO]):
    """Likelihood per hypothesis of an obstacle that shows between ends[0] and ends[1] and goes on beyond an
    edge where ``cut``."""
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
def missing_heights(env, col, ahead, radius, eye_z, R_wb, io: Bundle[TrackingIO]):
    """Likelihood per hypothesis of an obstacle that does not show: less where the camera sees past the place
    of its middle."""
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
            out[i] = 1.0 - HIT_SHARE
            out[COLUMN] = 1.0 - HIT_SHARE
    return out
