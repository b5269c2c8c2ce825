"""The map as it truly is. Never part of a preset that drives: it breaks observation-only sensing.

Static obstacles are drawn where routes are planned beforehand, for a surrogate (``Sim.draw_routes``).
"""

import taichi as ti

from uuvtai.common.enums import FULL
from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.geometry import BOX, NONE, turned_z
from uuvtai.kernels.core.grid import centre_of
from uuvtai.kernels.core.simd import LANES, f16x, put_bit
from uuvtai.kernels.core.stage import Bundle, Const, loop_end
from uuvtai.kernels.oracle.io import TrueMapIO, TrueTracksIO
from uuvtai.kernels.perception.height import COLUMN, half_height
from uuvtai.kernels.perception.track_filter import CONFIRMED
from uuvtai.kernels.perception.tracking import clear_track
from uuvtai.kernels.world.motion import first_moving


@ti.func
def covers(env, obstacle, point, io: Bundle[TrueMapIO]):
    """True where an obstacle lies over or under a horizontal point."""
    offset = point - ti.Vector([io.world.pos_w[env, obstacle][0], io.world.pos_w[env, obstacle][1]])
    size = io.world.size[env, obstacle]
    inside = offset.norm() <= size[0]
    if io.world.kind[env, obstacle] == BOX:
        local = turned_z(offset, -io.world.yaw[env, obstacle])
        inside = ti.abs(local[0]) <= size[0] and ti.abs(local[1]) <= size[1]
    return inside and io.world.kind[env, obstacle] != NONE


@ti.func
def is_covered(env, point, io: Bundle[TrueMapIO]):
    """1 where any obstacle does that does not move."""
    covered = 0
    for obstacle in range(ti.static(io.world.kind.shape[1])):
        if io.world.vel_w[env, obstacle].norm() == 0.0 and covers(env, obstacle, point, io):
            covered = 1
    return covered


@ti.kernel
def stamp_static(io: Bundle[TrueMapIO]):
    """Fill the static layer in every cell whose centre an obstacle covers that does not move."""
    n_env, n_row, n_col = ti.static(io.grid_map.static_occ.shape)
    for env, row in ti.ndrange(loop_end(n_env, io.clock), n_row):
        if io.clock.active[env] == 1:
            for col in range(n_col):
                if is_covered(env, centre_of(row, col, io.tank_cfg, io.mapping_cfg.cell_m), io) == 1:
                    io.grid_map.static_occ[env, row, col] = ti.cast(FULL, ti.u16)
                    put_bit(io.grid_map.alive, env, row, col)
                    put_bit(io.grid_map.static_occupied, env, row, col)


# ------------------------------------------------------------------------------------------------------------
# Privileged reference: the tracks of moving obstacles, taken from the truth instead of from tracking. It
# breaks observation-only sensing.
#
# Launched only while ``Sim.privileged`` is on, which no config key and no preset can do. What reads tracks
# (forecast, heights, threats, planning) works on as it does; what stands still is sensed and mapped as ever.


_VARIANCE = 1.0e-6
"""[m^2, m^2/s^2, rad^2/s^2] of what is known exactly: small, but a filter's variance is never 0."""

_NAMED_M = 0.15
"""A return so close to an obstacle's outline is its own (EC: 3 sigma of the harsh sonar's range)."""

_COLUMN_SHARE = 0.9  # An obstacle that takes up so much of the water's depth goes through all of it.


def take_true_tracks(io: TrueTracksIO) -> None:
    """Tracks of the active rows as they truly are in this very step, and which of them every beam of a fresh
    scan hit."""
    know_obstacles(io)
    name_beams_truly(io)


@quick_launch
@ti.kernel
def know_obstacles(io: Bundle[TrueTracksIO]):
    """One track for every moving obstacle, in the order of the obstacles; the nearest obstacles where the
    tracks are too few."""
    n, n_track = ti.static(io.tracks.alive.shape)
    for env, track in ti.ndrange(loop_end(n, io.clock), n_track):
        if io.clock.active[env] == 1:
            io.clusters.fresh[env] = (
                1  # tracks have changed: turn history and forecasts are to be worked out anew
            )
            io.tracks.scan_step[env] = io.clock.step[env]
            clear_track(env, track, io.tracks)
            lane = lane_of(env, track, ti.static(n_track), io)
            if lane >= 0:
                know_motion(env, track, lane, io)
                know_height(env, track, first_moving(io.world, io.path) + lane, io)


@ti.func
def lane_of(env, track, n_track: Const[int], io: Bundle[TrueTracksIO]):
    """Which moving obstacle a track holds, -1 = none."""
    n_lane = ti.static(io.path.n_way.shape[1])
    found = -1
    if ti.static(n_lane <= n_track):
        if track < n_lane:
            if io.world.kind[env, first_moving(io.world, io.path) + track] != NONE:
                found = track
    else:
        for lane in range(n_lane):
            if (
                io.world.kind[env, first_moving(io.world, io.path) + lane] != NONE
                and rank_of(env, lane, io) == track
            ):
                found = lane
    return found


@ti.func
def rank_of(env, lane, io: Bundle[TrueTracksIO]):
    """How many moving obstacles are nearer to the vehicle."""
    first, nearer = first_moving(io.world, io.path), 0
    own = (io.world.pos_w[env, first + lane] - io.ego.pos_w[env]).norm_sqr()
    for other in range(ti.static(io.path.n_way.shape[1])):
        away = (io.world.pos_w[env, first + other] - io.ego.pos_w[env]).norm_sqr()
        nearer += ti.cast(
            io.world.kind[env, first + other] != NONE and (away < own or (away == own and other < lane)),
            ti.i32,
        )
    return nearer


@ti.func
def know_motion(env, track, lane, io: Bundle[TrueTracksIO]):
    """Position, velocity, turn rate and radius; of a box the radius that holds it."""
    obstacle = first_moving(io.world, io.path) + lane
    pos, vel, size = (
        io.world.pos_w[env, obstacle],
        io.world.vel_w[env, obstacle],
        io.world.size[env, obstacle],
    )
    io.tracks.alive[env, track] = 1
    io.tracks.moving[env, track] = ti.cast(vel.norm() > 0.0, ti.i32)
    io.tracks.state[env, track] = ti.Vector([pos[0], pos[1], vel[0], vel[1]])
    for diagonal in ti.static((0, 4, 7, 9)):
        io.tracks.cov[env, track][diagonal] = _VARIANCE
    io.tracks.z_m[env, track] = pos[2]
    io.tracks.radius_m[env, track] = ti.select(
        io.world.kind[env, obstacle] == BOX, ti.sqrt(size[0] ** 2 + size[1] ** 2), size[0]
    )
    io.tracks.radius_var[env, track] = _VARIANCE
    io.tracks.turn_cov[env, track][4] = _VARIANCE
    if io.path.n_way[env, lane] == 0:
        io.tracks.turn_rate[env, track] = io.path.speed_m_s[env, lane] / io.path.radius_m[env, lane]
    io.tracks.age[env, track] = CONFIRMED
    io.tracks.seen_step[env, track] = io.clock.step[env]
    io.tracks.present[env, track] = 1.0


@ti.func
def know_height(env, track, obstacle, io: Bundle[TrueTracksIO]):
    """Equal shares for the fewest neighbouring heights whose obstacles, as high as the stack takes them to
    be, cover this one."""
    step = ti.static((io.tank_cfg.z_m[1] - io.tank_cfg.z_m[0]) / COLUMN)
    half = io.world.size[env, obstacle][2]
    beyond = ti.max(half - half_height(env, track, io.tracks, io.height_cfg), 0.0)
    at = io.world.pos_w[env, obstacle][2] - ti.static(io.tank_cfg.z_m[0])
    low = ti.math.clamp(ti.floor((at - beyond) / step - 0.5), 0.0, COLUMN - 1.0)
    high = ti.math.clamp(ti.ceil((at + beyond) / step - 0.5), 0.0, COLUMN - 1.0)
    if 2.0 * half > ti.static(_COLUMN_SHARE * (io.tank_cfg.z_m[1] - io.tank_cfg.z_m[0])):
        low, high = ti.cast(COLUMN, ti.f32), ti.cast(COLUMN, ti.f32)
    share = f16x(0.0)
    for i in ti.static(range(LANES)):
        share[i] = ti.select(low <= i <= high, 1.0 / (high - low + 1.0), 0.0)
    io.tracks.height[env, track, 0] = share


@quick_launch
@ti.kernel
def name_beams_truly(io: Bundle[TrueTracksIO]):
    """Every return of a fresh scan within ``_NAMED_M`` of an obstacle's outline, where it was at the ping,
    belongs to the nearest such body."""
    n, n_ray = ti.static(io.tracks.beam_track.shape)
    for env, ray in ti.ndrange(loop_end(n, io.clock), n_ray):
        if io.clock.active[env] == 1 and io.scan.fresh[env] == 1:
            ago = (io.clock.step[env] - io.scan.ping_step[env]) * io.episode_cfg.control_dt_s
            bearing = (io.scan.ping_yaw[env] + ti.static(io.sonar_cfg.first_beam_rad)) + ray * ti.static(
                io.sonar_cfg.beam_step_rad
            )
            hit_x = io.scan.ping_pos_w[env][0] + io.scan.range_m[env, ray] * ti.cos(bearing)
            hit_y = io.scan.ping_pos_w[env][1] + io.scan.range_m[env, ray] * ti.sin(bearing)
            named = -1
            if io.scan.hit[env, ray] == 1:
                named = nearest_track(env, hit_x, hit_y, ago, io)
            io.tracks.beam_track[env, ray] = named


@ti.func
def nearest_track(env, hit_x, hit_y, ago, io: Bundle[TrueTracksIO]):
    """The track whose outline lay nearest to a return ``ago`` [s], within ``_NAMED_M``; -1 = none."""
    named, nearest = -1, _NAMED_M
    for track in range(ti.static(io.tracks.alive.shape[1])):
        if io.tracks.alive[env, track] == 1:
            obstacle = io.tracks.state[env, track]
            off = ti.Vector(
                [hit_x - obstacle[0] + ago * obstacle[2], hit_y - obstacle[1] + ago * obstacle[3]]
            )
            gap = off.norm() - io.tracks.radius_m[env, track]
            if gap < nearest:
                named, nearest = track, gap
    return named
