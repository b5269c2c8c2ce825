"""Tracked bodies that the camera shows while the sonar does not: above or below the fan they are followed by the image.

Per column of the image the nearest thing before the known walls, at a height that matters; neighbouring columns make a spot. A spot
that the sonar's beams show too is the sonar's affair; of the others each corrects the moving track that is expected nearest to it, by a
position only: a depth camera measures no speed. Spots that are nobody's begin tracks. Sees the image, the scan and tracks only.
"""

import taichi as ti

from uuvtai.config import DepthConfig, ElevationConfig, EpisodeConfig, SonarConfig, SpottingConfig, TankConfig, TrackingConfig
from uuvtai.kernels.core.geometry import FAR_M, TWO_PI, quaternion_wb, rotation_wb, wrapped_angle
from uuvtai.kernels.core.kalman import born, corrected, position_variance
from uuvtai.kernels.core.lanes import LANES, f16x, ramp_lanes
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.perception.elevation import begin_height
from uuvtai.kernels.perception.evidence import NO_RETURN_SHARE, pinhole, wall_lanes
from uuvtai.kernels.perception.sighting import bearing_vector
from uuvtai.kernels.perception.track_slots import clear_track
from uuvtai.state import ClockState, DepthImage, SonarScan, SpotState, TrackState

_ROW_STRIDE = 2
"""Rows of the image that are looked at: every second one; a body fills several within the range that matters."""

_ROUNDING_M = 1.0e-3
"""Far more than float32 rounds a distance by."""

_PRESENT = 0.95
"""Probability of a body that has just been seen to be where it is expected."""

_NEWLY_SEEN_S = 0.15
"""[s] a track that the sonar saw this lately needs no image."""


@quick_launch
@ti.kernel
def scan_columns(
    spots: Out[SpotState],
    image: In[DepthImage],
    clock: In[ClockState],
    cfg: Const[SpottingConfig],
    depth: Const[DepthConfig],
    tank: Const[TankConfig],
):
    """Horizontal distance of the nearest thing in every column of a fresh image, FAR_M = none within range, height band and walls."""
    n, n_packet = ti.static(clock.awake.shape[0], depth.cols // LANES)
    for env, packet, pad in ti.ndrange(n, n_packet, ti.static(spread(n * n_packet))):
        if pad == 0 and clock.awake[env] == 1 and image.fresh[env] == 1:
            near, edge = column_distances(env, packet * LANES, image, cfg, depth, tank)
            for i in ti.static(range(LANES)):
                spots.column_m[env, packet * LANES + i] = near[i]
                spots.edge_m[env, packet * LANES + i] = edge[i]


@ti.func
def eye_of(env, image: In[DepthImage], depth: Const[DepthConfig]):
    """(position [m, world], body to world) of the camera when the image was taken, as estimated."""
    rpy = image.shot_rpy[env]
    R_wb = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2]))
    return image.shot_pos_w[env] + R_wb @ ti.Vector([depth.offset_b_m[0], depth.offset_b_m[1], depth.offset_b_m[2]]), R_wb


@ti.func
def column_distances(env, first_col, image: In[DepthImage], cfg: Const[SpottingConfig], depth: Const[DepthConfig], tank: Const[TankConfig]):
    """(nearest thing, nearest thing in the first or last row looked at): horizontal distances [m] of sixteen columns, FAR_M = none."""
    focal, middle_row, middle_col = ti.static(pinhole(depth))
    eye, R_wb = eye_of(env, image, depth)
    left = ramp_lanes(ti.cast(first_col, ti.f32) - middle_col) * ti.static(-1.0 / focal)
    level_x, level_y = left * R_wb[0, 1] + R_wb[0, 0], left * R_wb[1, 1] + R_wb[1, 0]
    length = f16x(0.0)
    for i in ti.static(range(LANES)):
        length[i] = ti.sqrt(level_x[i] * level_x[i] + level_y[i] * level_y[i])
    scale = 1.0 / length
    wall = wall_lanes(ti.Vector([eye[0], eye[1]]), level_x * scale, level_y * scale, tank)
    near, edge, limit = f16x(FAR_M), f16x(FAR_M), f16x(0.0)
    for i in ti.static(range(LANES)):
        limit[i] = ti.min(wall[i] - cfg.wall_margin_m, cfg.range_m)
    sway = ti.sqrt(R_wb[0, 2] * R_wb[0, 2] + R_wb[1, 2] * R_wb[1, 2])
    for k in range(ti.static(depth.rows // _ROW_STRIDE)):
        row = k * _ROW_STRIDE
        up = (middle_row - row) * ti.static(1.0 / focal)
        away, spare = f16x(0.0), f16x(0.0)
        for i in ti.static(range(LANES)):
            away[i] = image.depth_m[env, row, first_col + i]
            spare[i] = limit[i] - away[i] * (length[i] - sway * ti.abs(up))
        # a tilt changes a ray's level length by no more than ``sway``: most packets show nothing that is near enough
        if spare.max() > -_ROUNDING_M:
            for i in ti.static(range(LANES)):
                x = R_wb[0, 0] + R_wb[0, 1] * left[i] + R_wb[0, 2] * up
                y = R_wb[1, 0] + R_wb[1, 1] * left[i] + R_wb[1, 2] * up
                z = R_wb[2, 0] + R_wb[2, 1] * left[i] + R_wb[2, 2] * up
                level = away[i] * ti.sqrt(x * x + y * y)
                shown = (away[i] < ti.static(NO_RETURN_SHARE * depth.max_range_m)) & (ti.abs(away[i] * z) < cfg.band_m)
                shown = shown & (level < wall[i] - cfg.wall_margin_m) & (level < cfg.range_m)
                near[i] = ti.min(near[i], ti.select(shown, level, FAR_M))
                edge[i] = ti.min(edge[i], ti.select(shown & (row == 0 or row >= ti.static(depth.rows - _ROW_STRIDE)), level, FAR_M))
    return near, edge


@quick_launch
@ti.kernel
def follow_spots(
    tracks: Out[TrackState],
    spots: In[SpotState],
    image: In[DepthImage],
    scan: In[SonarScan],
    clock: In[ClockState],
    cfg: Const[SpottingConfig],
    depth: Const[DepthConfig],
    sonar: Const[SonarConfig],
    elevation: Const[ElevationConfig],
    tracking: Const[TrackingConfig],
    rules: Const[EpisodeConfig],
):
    """Gather columns to spots and correct the moving tracks that they show."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1 and image.fresh[env] == 1:
            take_spots(env, tracks, spots, image, scan, clock, cfg, depth, sonar, elevation, tracking, rules)


@ti.func
def take_spots(
    env,
    tracks: Out[TrackState],
    spots: In[SpotState],
    image: In[DepthImage],
    scan: In[SonarScan],
    clock: In[ClockState],
    cfg: Const[SpottingConfig],
    depth: Const[DepthConfig],
    sonar: Const[SonarConfig],
    elevation: Const[ElevationConfig],
    tracking: Const[TrackingConfig],
    rules: Const[EpisodeConfig],
):
    """A spot ends where the distance jumps, and at the image's edge."""
    eye, R_wb = eye_of(env, image, depth)
    first, near, edge, before = 0, FAR_M, FAR_M, FAR_M
    for col in range(ti.static(depth.cols + 1)):
        at = FAR_M
        if col < ti.static(depth.cols):
            at = spots.column_m[env, col]
        if ti.abs(at - before) > cfg.split_m:
            if before < FAR_M:
                use_spot(env, first, col - 1, near, edge, eye, R_wb, tracks, scan, clock, cfg, depth, sonar, elevation, tracking, rules)
            first, near, edge = col, FAR_M, FAR_M
        near = ti.min(near, at)
        if col < ti.static(depth.cols):
            edge = ti.min(edge, spots.edge_m[env, col])
        before = at


@ti.func
def bearing_of(col, R_wb, depth: Const[DepthConfig]):
    """[rad] world bearing of a place in the image, ``col`` in columns, at the height of the optical axis."""
    focal, _, middle_col = ti.static(pinhole(depth))
    left = (middle_col - col) / focal
    return ti.atan2(R_wb[1, 0] + R_wb[1, 1] * left, R_wb[0, 0] + R_wb[0, 1] * left)


@ti.func
def use_spot(
    env,
    first,
    last,
    near,
    edge,
    eye,
    R_wb,
    tracks: Out[TrackState],
    scan: In[SonarScan],
    clock: In[ClockState],
    cfg: Const[SpottingConfig],
    depth: Const[DepthConfig],
    sonar: Const[SonarConfig],
    elevation: Const[ElevationConfig],
    tracking: Const[TrackingConfig],
    rules: Const[EpisodeConfig],
):
    """Match one spot with a track and correct that; a spot that is nobody's begins a track.

    The spot: columns first..last; ``near`` [m] its smallest horizontal distance, ``edge`` [m] that in the image's first and last rows.
    """
    from_left, from_right = bearing_of(first - 0.5, R_wb, depth), bearing_of(last + 0.5, R_wb, depth)
    width = wrapped_angle(from_left - from_right)
    bearing = from_right + 0.5 * width
    along = bearing_vector(bearing)
    seen = ti.Vector([eye[0], eye[1]]) + near * along
    if width * near < tracking.max_width_m and is_off_fan(seen, env, scan, cfg, sonar) == 1:
        late = (clock.step[env] - tracks.scan_step[env]) * rules.control_dt_s
        best, best_offset = match_of(env, seen, along, late, tracks, clock, cfg, rules)
        cut = first == 0 or last == ti.static(depth.cols - 1)
        if best >= 0:
            correct_track(env, best, best_offset, along, cut, edge < near + cfg.split_m, tracks, cfg, tracking)
            tracks.spot_step[env, best] = clock.step[env]
        elif not cut and scan.ping_step[env] >= 0:
            radius = ti.max(0.5 * width * near, tracking.min_radius_m)
            begin_spotted(env, seen + radius * along, along, radius, late, eye[2], tracks, clock, cfg, tracking, elevation)


@ti.func
def match_of(
    env, seen, along, late, tracks: In[TrackState], clock: In[ClockState], cfg: Const[SpottingConfig], rules: Const[EpisodeConfig]
):
    """(track that most easily is what shows at ``seen`` [m], its centre minus where it is expected [m]); -1 where none is within reach.

    ``late`` [s] = how much newer the image is than the states.
    """
    best, best_gap, best_offset = -1, 0.0, ti.Vector([0.0, 0.0])
    for track in range(tracks.alive.shape[1]):
        if is_wanted(env, track, tracks, clock, rules) == 1:
            mean = tracks.state[env, track]
            offset = seen + tracks.radius_m[env, track] * along - ti.Vector([mean[0] + late * mean[2], mean[1] + late * mean[3]])
            gap = offset.norm() - reach_of(env, track, tracks, clock, cfg, rules)
            if gap < best_gap:
                best, best_gap, best_offset = track, gap, offset
    return best, best_offset


@ti.func
def is_off_fan(seen, env, scan: In[SonarScan], cfg: Const[SpottingConfig], sonar: Const[SonarConfig]):
    """1 where the sonar's beams towards a place met nothing near it: what is there lies above or below the fan."""
    own = scan.ping_pos_w[env]
    x, y = seen[0] - own[0], seen[1] - own[1]
    distance = ti.sqrt(x * x + y * y)
    step = ti.static(TWO_PI / sonar.n_ray)
    middle = ti.cast(ti.floor((ti.atan2(y, x) - scan.ping_yaw[env]) / step + 0.5), ti.i32)
    off = 1
    for k in range(-1, 2):
        ray = (middle + k + 2 * sonar.n_ray) % sonar.n_ray
        if scan.hit[env, ray] == 1 and ti.abs(scan.range_m[env, ray] - distance) < cfg.split_m:
            off = 0
    return off


@ti.func
def is_wanted(env, track, tracks: In[TrackState], clock: In[ClockState], rules: Const[EpisodeConfig]):
    """1 for a track that moves, or was begun by the camera, and that neither the sonar saw lately nor this image already."""
    moving = tracks.alive[env, track] == 1 and (tracks.moving[env, track] == 1 or tracks.spot_step[env, track] >= 0)
    unseen = (clock.step[env] - tracks.seen_step[env, track]) * rules.control_dt_s > _NEWLY_SEEN_S
    return ti.cast(moving and unseen and tracks.spot_step[env, track] != clock.step[env], ti.i32)


@ti.func
def reach_of(env, track, tracks: In[TrackState], clock: In[ClockState], cfg: Const[SpottingConfig], rules: Const[EpisodeConfig]):
    """[m] how far from its place a track may be found: as far as it went unseen, if it has turned, within bounds."""
    seen = ti.max(tracks.seen_step[env, track], tracks.spot_step[env, track])
    mean = tracks.state[env, track]
    way = ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3]) * (clock.step[env] - seen) * rules.control_dt_s
    return ti.min(cfg.gate_m + 2.0 * way, cfg.max_gate_m)


@ti.func
def correct_track(
    env, track, offset, along, cut, cut_high, tracks: Out[TrackState], cfg: Const[SpottingConfig], tracking: Const[TrackingConfig]
):
    """Correct position, and by it velocity; what surprises has turned: its velocity is opened up first."""
    across = ti.Vector([-along[1], along[0]])
    mean, cov = tracks.state[env, track], tracks.cov[env, track]
    rate, link = tracks.turn_rate[env, track], tracks.turn_cov[env, track]
    radial_var = ti.static(cfg.sigma_m**2) + tracks.radius_var[env, track] + ti.select(cut_high, tracks.radius_m[env, track] ** 2, 0.0)
    cross_var = ti.static(cfg.sigma_m**2) + ti.select(cut, tracks.radius_m[env, track] ** 2, 0.0)
    radial, cross = offset.dot(along), offset.dot(across)
    surprise = radial * radial / (position_variance(cov, along) + radial_var) + cross * cross / (position_variance(cov, across) + cross_var)
    if surprise > cfg.turn_gate:
        speed = ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        cov[7] += ti.max(speed, 0.5) ** 2
        cov[9] += ti.max(speed, 0.5) ** 2
        cov[0] += offset.norm_sqr()
        cov[4] += offset.norm_sqr()
    h = ti.Vector([along[0], along[1], 0.0, 0.0])
    mean_r, cov_r, rate_r, link_r = corrected(mean, cov, rate, link, h, radial, radial_var)
    left = offset - ti.Vector([mean_r[0] - mean[0], mean_r[1] - mean[1]])
    h_cross = ti.Vector([across[0], across[1], 0.0, 0.0])
    mean_c, cov_c, rate_c, link_c = corrected(mean_r, cov_r, rate_r, link_r, h_cross, left.dot(across), cross_var)
    tracks.state[env, track] = mean_c
    tracks.cov[env, track] = cov_c
    tracks.turn_rate[env, track] = rate_c
    tracks.turn_cov[env, track] = link_c
    tracks.present[env, track] = _PRESENT
    tracks.moving[env, track] = 1


@ti.func
def begin_spotted(
    env,
    at,
    along,
    radius,
    late,
    height,
    tracks: Out[TrackState],
    clock: In[ClockState],
    cfg: Const[SpottingConfig],
    tracking: Const[TrackingConfig],
    elevation: Const[ElevationConfig],
):
    """A track of a body that only the camera has seen yet, in a free slot, unless one is there already. It rests until it is seen again."""
    slot = -1
    known = False
    for track in range(tracks.alive.shape[1]):
        if tracks.alive[env, track] == 0:
            slot = track
        else:
            mean = tracks.state[env, track]
            x, y = mean[0] + late * mean[2] - at[0], mean[1] + late * mean[3] - at[1]
            reach = tracks.radius_m[env, track] + ti.static(cfg.apart_m)
            known = known or x * x + y * y < reach * reach
    if slot >= 0 and not known:
        var = ti.static(cfg.sigma_m**2)
        speed_var = ti.static(tracking.birth_speed_sigma_m_s**2)
        mean, cov = born(at, along, var, var, 0.0, speed_var, speed_var)
        clear_track(env, slot, tracks)
        tracks.alive[env, slot] = 1
        tracks.state[env, slot] = mean
        tracks.cov[env, slot] = cov
        tracks.z_m[env, slot] = height
        tracks.radius_m[env, slot] = radius
        tracks.radius_var[env, slot] = 0.25 * tracking.min_radius_m * tracking.min_radius_m
        tracks.sight_w[env, slot] = ti.atan2(along[1], along[0])
        tracks.doppler_var[env, slot] = speed_var
        tracks.seen_step[env, slot] = clock.step[env]
        tracks.spot_step[env, slot] = clock.step[env]
        tracks.misses[env, slot] = 1
        begin_height(env, slot, tracks, elevation)
