"""Privileged reference: the tracks of moving bodies, taken from the truth instead of from tracking. It breaks observation-only sensing.

Launched only while ``Sim.privileged`` is on, which no config key and no preset can do. What reads tracks (forecast, heights, threats,
planning) works on as it does; what stands still is sensed and mapped as ever.
"""

import taichi as ti

from uuvtai.config import ElevationConfig, EpisodeConfig, SonarConfig, TankConfig
from uuvtai.kernels.core.geometry import BOX, NONE, TWO_PI
from uuvtai.kernels.core.lanes import LANES, f16x
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.kernels.perception.elevation import COLUMN, half_height
from uuvtai.kernels.perception.track_slots import clear_track
from uuvtai.kernels.perception.track_update import CONFIRMED
from uuvtai.kernels.world.bodies import first_moving
from uuvtai.state import ClockState, ClusterState, PathState, Proprioception, SonarScan, TrackState, WorldState

_VARIANCE = 1.0e-6
"""[m^2, m^2/s^2, rad^2/s^2] of what is known exactly: small, but a filter's variance is never 0."""

_NAMED_M = 0.15
"""A return so close to a body's outline is its own (EC: 3 sigma of the harsh sonar's range)."""

_COLUMN_SHARE = 0.9
"""A body that takes up so much of the water's depth goes through all of it."""


def take_true_tracks(
    tracks: TrackState,
    clusters: ClusterState,
    world: WorldState,
    path: PathState,
    ego: Proprioception,
    scan: SonarScan,
    clock: ClockState,
    elevation: ElevationConfig,
    sonar: SonarConfig,
    tank: TankConfig,
    rules: EpisodeConfig,
):
    """Tracks of the awake rows as they truly are in this very step, and which of them every beam of a fresh scan hit."""
    know_bodies(tracks, clusters, world, path, ego, clock, elevation, tank)
    name_beams_truly(tracks, scan, clock, sonar, rules)


@quick_launch
@ti.kernel
def know_bodies(
    tracks: Out[TrackState],
    clusters: Out[ClusterState],
    world: In[WorldState],
    path: In[PathState],
    ego: In[Proprioception],
    clock: In[ClockState],
    elevation: Const[ElevationConfig],
    tank: Const[TankConfig],
):
    """One track for every moving body, in the order of the bodies; the nearest bodies where the tracks are too few."""
    n, n_track = ti.static(tracks.alive.shape)
    for env, track, pad in ti.ndrange(n, n_track, ti.static(spread(n * n_track))):
        if pad == 0 and clock.awake[env] == 1:
            clusters.fresh[env] = 1  # tracks have changed: habits and forecasts are to be worked out anew
            tracks.scan_step[env] = clock.step[env]
            clear_track(env, track, tracks)
            lane = lane_of(env, track, ti.static(n_track), world, path, ego)
            if lane >= 0:
                know_motion(env, track, lane, tracks, world, path, clock)
                know_height(env, track, first_moving(world, path) + lane, tracks, world, elevation, tank)


@ti.func
def lane_of(env, track, n_track: Const[int], world: In[WorldState], path: In[PathState], ego: In[Proprioception]):
    """Which moving body a track holds, -1 = none."""
    n_lane = ti.static(path.n_way.shape[1])
    found = -1
    if ti.static(n_lane <= n_track):
        if track < n_lane:
            if world.kind[env, first_moving(world, path) + track] != NONE:
                found = track
    else:
        for lane in range(n_lane):
            if world.kind[env, first_moving(world, path) + lane] != NONE and rank_of(env, lane, world, path, ego) == track:
                found = lane
    return found


@ti.func
def rank_of(env, lane, world: In[WorldState], path: In[PathState], ego: In[Proprioception]):
    """How many moving bodies are nearer to the vehicle."""
    first, nearer = first_moving(world, path), 0
    own = (world.pos_w[env, first + lane] - ego.pos_w[env]).norm_sqr()
    for other in range(ti.static(path.n_way.shape[1])):
        away = (world.pos_w[env, first + other] - ego.pos_w[env]).norm_sqr()
        nearer += ti.cast(world.kind[env, first + other] != NONE and (away < own or (away == own and other < lane)), ti.i32)
    return nearer


@ti.func
def know_motion(env, track, lane, tracks: Out[TrackState], world: In[WorldState], path: In[PathState], clock: In[ClockState]):
    """Position, velocity, turn rate and radius; of a box the radius that holds it."""
    body = first_moving(world, path) + lane
    pos, vel, size = world.pos_w[env, body], world.vel_w[env, body], world.size[env, body]
    tracks.alive[env, track] = 1
    tracks.moving[env, track] = ti.cast(vel.norm() > 0.0, ti.i32)
    tracks.state[env, track] = ti.Vector([pos[0], pos[1], vel[0], vel[1]])
    for diagonal in ti.static((0, 4, 7, 9)):
        tracks.cov[env, track][diagonal] = _VARIANCE
    tracks.z_m[env, track] = pos[2]
    tracks.radius_m[env, track] = ti.select(world.kind[env, body] == BOX, ti.sqrt(size[0] ** 2 + size[1] ** 2), size[0])
    tracks.radius_var[env, track] = _VARIANCE
    tracks.turn_cov[env, track][4] = _VARIANCE
    if path.n_way[env, lane] == 0:
        tracks.turn_rate[env, track] = path.speed_m_s[env, lane] / path.radius_m[env, lane]
    tracks.age[env, track] = CONFIRMED
    tracks.seen_step[env, track] = clock.step[env]
    tracks.present[env, track] = 1.0


@ti.func
def know_height(
    env, track, body, tracks: Out[TrackState], world: In[WorldState], elevation: Const[ElevationConfig], tank: Const[TankConfig]
):
    """Equal shares for the fewest neighbouring heights whose bodies, as high as the stack takes them to be, cover this one."""
    step = ti.static((tank.z_m[1] - tank.z_m[0]) / COLUMN)
    half = world.size[env, body][2]
    beyond = ti.max(half - half_height(env, track, tracks, elevation), 0.0)
    at = world.pos_w[env, body][2] - ti.static(tank.z_m[0])
    low = ti.math.clamp(ti.floor((at - beyond) / step - 0.5), 0.0, COLUMN - 1.0)
    high = ti.math.clamp(ti.ceil((at + beyond) / step - 0.5), 0.0, COLUMN - 1.0)
    if 2.0 * half > ti.static(_COLUMN_SHARE * (tank.z_m[1] - tank.z_m[0])):
        low, high = ti.cast(COLUMN, ti.f32), ti.cast(COLUMN, ti.f32)
    share = f16x(0.0)
    for i in ti.static(range(LANES)):
        share[i] = ti.select(low <= i <= high, 1.0 / (high - low + 1.0), 0.0)
    tracks.height[env, track, 0] = share


@quick_launch
@ti.kernel
def name_beams_truly(
    tracks: Out[TrackState], scan: In[SonarScan], clock: In[ClockState], sonar: Const[SonarConfig], rules: Const[EpisodeConfig]
):
    """Every return of a fresh scan within ``_NAMED_M`` of a body's outline, where it was at the ping, belongs to the nearest such body."""
    n, n_ray = ti.static(tracks.beam_track.shape)
    for env, ray, pad in ti.ndrange(n, n_ray, ti.static(spread(n * n_ray))):
        if pad == 0 and clock.awake[env] == 1 and scan.fresh[env] == 1:
            ago = (clock.step[env] - scan.ping_step[env]) * rules.control_dt_s
            bearing = scan.ping_yaw[env] + ray * ti.static(TWO_PI / sonar.n_ray)
            hit_x = scan.ping_pos_w[env][0] + scan.range_m[env, ray] * ti.cos(bearing)
            hit_y = scan.ping_pos_w[env][1] + scan.range_m[env, ray] * ti.sin(bearing)
            named, nearest = -1, _NAMED_M
            for track in range(ti.static(tracks.alive.shape[1])):
                if tracks.alive[env, track] == 1 and scan.hit[env, ray] == 1:
                    body = tracks.state[env, track]
                    off = ti.Vector([hit_x - body[0] + ago * body[2], hit_y - body[1] + ago * body[3]])
                    gap = off.norm() - tracks.radius_m[env, track]
                    if gap < nearest:
                        named, nearest = track, gap
            tracks.beam_track[env, ray] = named
