"""Sector features of the newest sonar scan (nearest range, fastest approach, smallest time to collision), and
the policy's observation.

``columns`` declares the observation once: the kernels write by it and the environment's table is read off it.
"""

import taichi as ti

from uuvtai.common import tree_codes as codes
from uuvtai.compile.launch import quick_launch
from uuvtai.config import ObservationConfig
from uuvtai.kernels.core.beams import range_rate
from uuvtai.kernels.core.geometry import FAR_M, TWO_PI, quaternion_wb, rotation_wb, turned_z
from uuvtai.kernels.core.stage import Bundle, ColumnGroup, FloatMatrix, Out, loop_end, n_envs, shares
from uuvtai.kernels.perception.prediction import expected_turn_rate
from uuvtai.kernels.planning.io import ObservationIO

# ------------------------------------------------------------------------------------------------------------
# Columns of the moving obstacles that the vehicle remembers: where each is, how it moves, and how close it is
# going to come.
#
# A policy without memory sees no motion in one observation; track and forecast hold what many scans have
# told. Sees sensor data and memory only, never the truth.


@ti.func
def closest_approach(env, track, io: Bundle[ObservationIO]):
    """(distance [m] from the own centre to an obstacle's surface where it is smallest within the forecast,
    time [s] until then).

    The own velocity is taken to stay as it was measured; the obstacle keeps to its forecast, straight from
    one of its points to the next.
    """
    own = ti.Vector([io.ego.pos_w[env][0], io.ego.pos_w[env][1]])
    step = _own_velocity(env, io) * ti.static(io.tracking_cfg.forecast_dt_s)
    best_m, best_s = FAR_M + 0.0, 0.0
    for k in range(io.forecast.radius_m.shape[2] - 1):
        away = io.forecast.pos_w[env, track, k] - own - k * step
        change = io.forecast.pos_w[env, track, k + 1] - io.forecast.pos_w[env, track, k] - step
        share = ti.math.clamp(-away.dot(change) / ti.max(change.dot(change), 1e-9), 0.0, 1.0)
        radius = (1.0 - share) * io.forecast.radius_m[env, track, k] + share * io.forecast.radius_m[
            env, track, k + 1
        ]
        gap = (away + share * change).norm() - radius
        if gap < best_m:
            best_m, best_s = gap, (k + share) * ti.static(io.tracking_cfg.forecast_dt_s)
    return best_m, best_s


@ti.func
def next_obstacle(env, after, io: Bundle[ObservationIO]):
    """Track that follows ``after`` in the order of closest approach (equals: of slots), -1 = none; the first
    one follows -1."""
    after_m = -FAR_M
    if after >= 0:
        after_m = io.observation.closest_m[env, after]
    found, found_m = -1, FAR_M + 0.0
    for track in range(io.observation.closest_m.shape[1]):
        gap = io.observation.closest_m[env, track]
        if (gap > after_m or (gap == after_m and track > after)) and gap < found_m:
            found, found_m = track, gap
    return found


@ti.func
def _own_velocity(env, io: Bundle[ObservationIO]):
    """Measured horizontal velocity in the world frame."""
    rpy = io.ego.rpy[env]
    vel = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2])) @ io.ego.vel_b[env]
    return ti.Vector([vel[0], vel[1]])


@ti.func
def obstacle_values(env, track, io: Bundle[ObservationIO]):
    """All values of ``OBSTACLE_COLUMNS`` of one moving obstacle, in their order."""
    yaw, own_z = io.ego.rpy[env][2], io.ego.pos_w[env][2]
    at = turned_z(
        io.forecast.pos_w[env, track, 0] - ti.Vector([io.ego.pos_w[env][0], io.ego.pos_w[env][1]]), -yaw
    )
    moving = ti.Vector([io.tracks.state[env, track][2], io.tracks.state[env, track][3]])
    vel = turned_z(moving - _own_velocity(env, io), -yaw)
    water = ti.static(io.tank_cfg.z_m[1] - io.tank_cfg.z_m[0])
    return ti.Vector(
        [
            1.0,
            at[0],
            at[1],
            vel[0],
            vel[1],
            expected_turn_rate(env, track, io.tracks, io.forecast_cfg, io.tracking_cfg),
            io.forecast.radius_m[env, track, 0],
            ti.min(io.forecast.above_w[env, track] - own_z, water),
            ti.min(own_z - io.forecast.below_w[env, track], water),
            (io.clock.step[env] - io.tracks.seen_step[env, track]) * ti.static(io.episode_cfg.control_dt_s),
            io.observation.closest_m[env, track],
            io.observation.closest_s[env, track],
        ]
    )


OBSTACLE_COLUMNS = (
    ColumnGroup(
        "obstacle_valid",
        1,
        "1",
        "level",
        "1 = a moving obstacle is remembered, 0 = no more obstacles: all of its columns are 0",
        obstacle_values,
        "body",
    ),
    ColumnGroup(
        "obstacle_position",
        2,
        "m",
        "level",
        "where it is now, from the position estimate",
        obstacle_values,
        "body",
    ),
    ColumnGroup("obstacle_velocity", 2, "m/s", "level", "its velocity less the own", obstacle_values, "body"),
    ColumnGroup(
        "obstacle_turn_rate",
        1,
        "rad/s",
        "level",
        "rate at which its velocity turns, left positive; 0 = straight on",
        obstacle_values,
        "body",
    ),
    ColumnGroup(
        "obstacle_radius",
        1,
        "m",
        "level",
        "its radius and what the uncertainty of its place adds",
        obstacle_values,
        "body",
    ),
    ColumnGroup(
        "obstacle_free_water",
        2,
        "m",
        "level",
        "above and below the own depth, up to where it may be; 0 = level",
        obstacle_values,
        "body",
    ),
    ColumnGroup("obstacle_age", 1, "s", "level", "since it was last seen", obstacle_values, "body"),
    ColumnGroup(
        "obstacle_closest",
        1,
        "m",
        "level",
        "to its surface at the closest approach, if the own velocity stays as it is",
        obstacle_values,
        "body",
    ),
    ColumnGroup(
        "obstacle_closest_time",
        1,
        "s",
        "level",
        "until then; at most the forecast's horizon",
        obstacle_values,
        "body",
    ),
)
"""Of each of the obstacles that come closest, the closest first: how close matters more than how soon, and a
body that recedes, whose closest approach is now, does not push one out that is still to come.
"""


# ------------------------------------------------------------------------------------------------------------
# Columns of what the behaviour tree says: its action, and why. It sees sensor data and memory only, so
# whoever reads it does too.


CLASSES = (
    (codes.BACK_OFF,),
    (codes.EVADE,),
    (codes.HOLD,),
    (codes.UNSTICK,),
    (codes.FOLLOW_ROUTE, codes.DRIVE_STRAIGHT),
)
"""Leaves by class: emergency, evade, wait, unstick, travel."""

N_CLASS = len(CLASSES)


@ti.func
def _leaf(env, io: Bundle[ObservationIO]):
    """Code of the leaf that acts, -1 = none."""
    node, leaf = io.behavior.leaf[env], -1
    if node >= 0:
        leaf = io.table.leaf[node]
    return leaf


@ti.func
def _action(env, io: Bundle[ObservationIO]):
    return io.behavior.action[env]


@ti.func
def _conflict(env, io: Bundle[ObservationIO]):
    return ti.Vector([ti.min(io.behavior.conflict_s[env], io.observation_cfg.ttc_cap_s)])


@ti.func
def _evade_cost(env, io: Bundle[ObservationIO]):
    return ti.Vector([ti.select(_leaf(env, io) == codes.EVADE, io.behavior.evade_cost[env], 0.0)])


@ti.func
def _class(env, io: Bundle[ObservationIO]):
    leaf = _leaf(env, io)
    out = ti.Vector([0.0] * N_CLASS)
    for i, leaves in ti.static(enumerate(CLASSES)):
        for code in ti.static(leaves):
            if leaf == code:
                out[i] = 1.0
    return out


TEACHER_COLUMNS = (
    ColumnGroup(
        "teacher_action",
        4,
        "1",
        "body",
        "surge, sway, heave, yaw rate of the tree, in parts of the vehicle's limits",
        _action,
    ),
    ColumnGroup(
        "behavior_conflict",
        1,
        "s",
        "route",
        "until following the route comes too close to a forecast obstacle, capped",
        _conflict,
    ),
    ColumnGroup(
        "behavior_evade_cost", 1, "1", "route", "cost of the evasion that is driven; 0 = none is", _evade_cost
    ),
    ColumnGroup(
        "behavior_class",
        N_CLASS,
        "1",
        "route",
        "1 = acts: emergency, evade, wait, unstick, travel; all 0 = no leaf",
        _class,
    ),
)


# ------------------------------------------------------------------------------------------------------------


@quick_launch
@ti.kernel
def sense_sectors(io: Bundle[ObservationIO]):
    """Sector s is centred at s * 360 / n_sector degrees from ahead, counter-clockwise."""
    n, n_sector = ti.static(io.observation.sector_range_m.shape[0], io.observation.sector_range_m.shape[1])
    n_share = ti.static(shares(n_sector))
    for env, share in ti.ndrange(loop_end(n, io.clock), n_share):
        if io.clock.active[env] == 1:
            turned = io.ego.rpy[env][2] - io.scan.ping_yaw[env] - ti.static(io.sonar_cfg.first_beam_rad)
            for sector in range(share * n_sector // n_share, (share + 1) * n_sector // n_share):
                first, last = sector_beams(sector, turned, n_sector, ti.static(io.sonar_cfg.circle_beams))
                _summarise(env, sector, first, last, io)


@ti.func
def _summarise(env, sector, first, last, io: Bundle[ObservationIO]):
    """A range's rate already holds the own motion, so a beam's time to collision is its range over its
    closing speed."""
    circle, n_ray = ti.static(io.sonar_cfg.circle_beams, io.sonar_cfg.n_ray)
    nearest, ttc, closing, hits = (
        0.0 + io.sonar_cfg.max_range_m,
        0.0 + io.observation_cfg.ttc_cap_s,
        -FAR_M,
        0,
    )
    begin = first % circle
    for i in range(last - first):  # no branches: signs of noisy rates cannot be predicted
        beam = begin + i
        beam -= ti.select(beam >= circle, circle, 0)
        wanted = 1
        if ti.static(
            not io.sonar_cfg.is_ring
        ):  # where the fan has no beam there is no return: hit is never 2
            wanted, beam = ti.select(beam < n_ray, 1, 2), ti.min(beam, n_ray - 1)
        hit, gap, rate = (
            io.scan.hit[env, beam] == wanted,
            io.scan.range_m[env, beam],
            -range_rate(env, beam, io.scan, io.tracks, io.sonar_cfg),
        )
        hits += ti.cast(hit, ti.i32)
        closing = ti.max(closing, ti.select(hit, rate, -FAR_M))
        nearest = ti.min(nearest, ti.select(hit, gap, io.sonar_cfg.max_range_m))
        ttc = ti.min(ttc, ti.select(hit & (rate > 0.0), gap / rate, io.observation_cfg.ttc_cap_s))
    io.observation.sector_range_m[env, sector] = nearest
    io.observation.sector_ttc_s[env, sector] = ttc
    io.observation.sector_closing_m_s[env, sector] = ti.select(hits > 0, closing, 0.0)
    io.observation.sector_valid[env, sector] = ti.cast(hits > 0, ti.i32)


@ti.func
def sector_beams(sector, turned, n_sector, n_ray):
    """Half-open range of beams in a sector now, of ``n_ray`` in the circle, after the vehicle has turned by
    ``turned`` [rad] since the ping, which is seen from beam 0; take it modulo the circle."""
    shift = turned * n_sector / TWO_PI
    per_sector = n_ray / n_sector
    first = ti.ceil((sector - 0.5 + shift) * per_sector)
    last = ti.ceil((sector + 0.5 + shift) * per_sector)
    return ti.cast(first, ti.i32), ti.cast(last, ti.i32)


# ------------------------------------------------------------------------------------------------ observation


@ti.func
def _in_body(vector_w, rpy):
    """World vector in the body frame of the measured attitude."""
    return rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2])).transpose() @ vector_w


@ti.func
def _goal(env, io: Bundle[ObservationIO]):
    return _in_body(io.mission.goal_w[env] - io.ego.pos_w[env], io.ego.rpy[env])


@ti.func
def _heading_error(env, io: Bundle[ObservationIO]):
    return ti.Vector([ti.sin(io.route.heading_error[env]), ti.cos(io.route.heading_error[env])])


@ti.func
def _velocity(env, io: Bundle[ObservationIO]):
    return io.ego.vel_b[env]


@ti.func
def _yaw_rate(env, io: Bundle[ObservationIO]):
    return ti.Vector([io.ego.rate_b[env][2]])


@ti.func
def _depth(env, io: Bundle[ObservationIO]):
    return ti.Vector([io.ego.depth_m[env]])


@ti.func
def _tilt(env, io: Bundle[ObservationIO]):
    return ti.Vector([io.ego.rpy[env][0], io.ego.rpy[env][1]])


@ti.func
def _lookahead(env, io: Bundle[ObservationIO]):
    return _in_body(io.route.lookahead_w[env] - io.ego.pos_w[env], io.ego.rpy[env])


@ti.func
def _cross_track(env, io: Bundle[ObservationIO]):
    return ti.Vector([io.route.cross_track_m[env]])


@ti.func
def _remaining(env, io: Bundle[ObservationIO]):
    return ti.Vector([io.route.remaining_m[env]])


@ti.func
def _path_risk(env, io: Bundle[ObservationIO]):
    return ti.Vector([io.route.path_risk[env]])


@ti.func
def _tilt_rate(env, io: Bundle[ObservationIO]):
    return ti.Vector([io.ego.rate_b[env][0], io.ego.rate_b[env][1]])


@ti.func
def _sector_range(env, sector, io: Bundle[ObservationIO]):
    return io.observation.sector_range_m[env, sector]


@ti.func
def _sector_ttc(env, sector, io: Bundle[ObservationIO]):
    return io.observation.sector_ttc_s[env, sector]


@ti.func
def _sector_closing(env, sector, io: Bundle[ObservationIO]):
    return io.observation.sector_closing_m_s[env, sector]


COLUMNS = (
    ColumnGroup("goal", 3, "m", "body", "from the position estimate to the goal", _goal),
    ColumnGroup(
        "heading_error",
        2,
        "1",
        "level",
        "sine, cosine of the look-ahead point's bearing, left positive",
        _heading_error,
    ),
    ColumnGroup("velocity", 3, "m/s", "body", "over ground, as the DVL measured it last", _velocity),
    ColumnGroup("yaw_rate", 1, "rad/s", "body", "of the gyro", _yaw_rate),
    ColumnGroup("depth", 1, "m", "world", "pressure depth, positive down", _depth),
    ColumnGroup("tilt", 2, "rad", "level", "roll, pitch of the IMU", _tilt),
    ColumnGroup(
        "sector_range",
        1,
        "m",
        "body",
        "smallest range; maximum range where nothing returned",
        _sector_range,
        "sector",
    ),
    ColumnGroup(
        "lookahead", 3, "m", "body", "to the look-ahead point of the route; zero without a route", _lookahead
    ),
    ColumnGroup(
        "cross_track", 1, "m", "route", "distance from the route, positive = left of it", _cross_track
    ),
    ColumnGroup(
        "remaining",
        1,
        "m",
        "route",
        "route length still ahead; the straight distance without a route",
        _remaining,
    ),
    ColumnGroup("path_risk", 1, "1", "route", "mean risk over the look-ahead segment", _path_risk),
    ColumnGroup("tilt_rate", 2, "rad/s", "body", "roll rate, pitch rate of the gyro", _tilt_rate),
    ColumnGroup("sector_ttc", 1, "s", "body", "smallest time to collision, capped", _sector_ttc, "sector"),
    ColumnGroup(
        "sector_closing",
        1,
        "m/s",
        "body",
        "largest closing speed, own motion included; 0 = no return",
        _sector_closing,
        "sector",
    ),
)
"""The observation, in order: the paper's phi and what it names as the world model's targets, which are the
first 24 (with 12 sectors).

A config may add columns behind them (``columns``).
"""


def columns(observation_cfg: ObservationConfig) -> tuple[ColumnGroup, ...]:
    """The groups of a config's observation: ``COLUMNS``, then the obstacles' where any are asked for, then
    the tree's."""
    return (
        COLUMNS
        + (OBSTACLE_COLUMNS if observation_cfg.n_track > 0 else ())
        + (TEACHER_COLUMNS if observation_cfg.behavior else ())
    )


def placed_columns(observation_cfg: ObservationConfig) -> list[tuple[ColumnGroup, int, int]]:
    """(group, first column, number of columns) of every group."""
    out, first = [], 0
    for column in columns(observation_cfg):
        width = (
            column.width
            * {"": 1, "sector": observation_cfg.n_sector, "body": observation_cfg.n_track}[column.per]
        )
        out.append((column, first, width))
        first += width
    return out


def observation_width(observation_cfg: ObservationConfig) -> int:
    """Columns of the observation."""
    return sum(width for _column, _first, width in placed_columns(observation_cfg))


def _sources(group, cfg):
    """(source, first column, width of one) of the groups of ``group`` (a tuple of columns); plain Python,
    unrolled by the kernels."""
    return [(c.source, first, c.width) for c, first, _width in placed_columns(cfg) if c in group]


def _obstacle_places(cfg):
    """(place in ``obstacle_values``, first column of the first body, width of one) of the groups of
    OBSTACLE_COLUMNS; plain Python."""
    widths = [column.width for column in OBSTACLE_COLUMNS]
    return [
        (sum(widths[:n]), first, width) for n, (_, first, width) in enumerate(_sources(OBSTACLE_COLUMNS, cfg))
    ]


_OBSTACLE_WIDTH = sum(column.width for column in OBSTACLE_COLUMNS)
_SECTOR_COLUMNS = tuple(column for column in COLUMNS if column.per == "sector")
_OWN_COLUMNS = tuple(column for column in COLUMNS if not column.per)


@quick_launch
@ti.kernel
def write_observation(io: Bundle[ObservationIO], obs: FloatMatrix):
    """Observation (n_env, n_obs) of the active rows, raw SI units, in the order of ``COLUMNS``."""
    n, n_sector = ti.static(io.observation.sector_range_m.shape[0], io.observation.sector_range_m.shape[1])
    for env in range(loop_end(n, io.clock)):
        if io.clock.active[env] == 1:
            for source, first, width in ti.static(_sources(_OWN_COLUMNS, io.observation_cfg)):
                value = source(env, io)
                for i in ti.static(range(width)):
                    obs[env, first + i] = ti.cast(value[i], ti.f32)
            for sector in range(n_sector):
                for source, first, _width in ti.static(_sources(_SECTOR_COLUMNS, io.observation_cfg)):
                    obs[env, first + sector] = ti.cast(source(env, sector, io), ti.f32)


@quick_launch
@ti.kernel
def write_obstacles(io: Bundle[ObservationIO], obs: FloatMatrix):
    """Columns of the ``n_track`` moving obstacles that come closest to the active rows, in the order of
    ``OBSTACLE_COLUMNS``."""
    n, n_track = ti.static(io.tracks.alive.shape[0], io.tracks.alive.shape[1])
    n_share = ti.static(shares(n_track))
    for env, share in ti.ndrange(loop_end(n, io.clock), n_share):
        if io.clock.active[env] == 1:
            for track in range(share * n_track // n_share, (share + 1) * n_track // n_share):
                io.observation.closest_m[env, track] = FAR_M
                if io.forecast.radius_m[env, track, 0] >= 0.0:
                    gap, time = closest_approach(env, track, io)
                    io.observation.closest_m[env, track], io.observation.closest_s[env, track] = gap, time
    for env in range(loop_end(n, io.clock)):
        if io.clock.active[env] == 1:
            track, used = -1, 1
            for slot in range(ti.static(io.observation_cfg.n_track)):
                if used == 1:
                    track = next_obstacle(env, track, io)
                    used = ti.cast(track >= 0, ti.i32)
                value = ti.Vector.zero(ti.f32, ti.static(_OBSTACLE_WIDTH))
                if used == 1:
                    value = obstacle_values(env, track, io)
                put_obstacle_columns(env, slot, value, obs, io)


@ti.func
def put_obstacle_columns(env, slot, value, obs: Out[FloatMatrix], io: Bundle[ObservationIO]):
    """One body's values into the columns of its slot."""
    for at, first, width in ti.static(_obstacle_places(io.observation_cfg)):
        for i in ti.static(range(width)):
            obs[env, first + slot * width + i] = ti.cast(value[at + i], ti.f32)


@quick_launch
@ti.kernel
def write_advice(io: Bundle[ObservationIO], obs: FloatMatrix):
    """Columns of what the behaviour tree does now in the active rows, in the order of ``TEACHER_COLUMNS``."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            for source, first, width in ti.static(_sources(TEACHER_COLUMNS, io.observation_cfg)):
                value = source(env, io)
                for i in ti.static(range(width)):
                    obs[env, first + i] = ti.cast(value[i], ti.f32)
