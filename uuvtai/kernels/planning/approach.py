"""Columns of the moving bodies that the vehicle remembers: where each is, how it moves, and how close it is
going to come.

A policy without memory sees no motion in one observation; track and forecast hold what many scans have told.
Sees sensor data and memory only, never the truth.
"""

import taichi as ti

from uuvtai.kernels.core.columns import ColumnGroup
from uuvtai.kernels.core.geometry import FAR_M, quaternion_wb, rotation_wb, turned_z
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.perception.habits import expected_turn_rate
from uuvtai.kernels.planning.bundles import FeaturesIO


@ti.func
def closest_approach(env, track, io: Bundle[FeaturesIO]):
    """(distance [m] from the own centre to a body's surface where it is smallest within the forecast, time
    [s] until then).

    The own velocity is taken to stay as it was measured; the body keeps to its forecast, straight from one of
    its points to the next.
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
def next_body(env, after, io: Bundle[FeaturesIO]):
    """Track that follows ``after`` in the order of closest approach (equals: of slots), -1 = none; the first
    one follows -1."""
    after_m = -FAR_M
    if after >= 0:
        after_m = io.features.closest_m[env, after]
    found, found_m = -1, FAR_M + 0.0
    for track in range(io.features.closest_m.shape[1]):
        gap = io.features.closest_m[env, track]
        if (gap > after_m or (gap == after_m and track > after)) and gap < found_m:
            found, found_m = track, gap
    return found


@ti.func
def _own_velocity(env, io: Bundle[FeaturesIO]):
    """Measured horizontal velocity in the world frame."""
    rpy = io.ego.rpy[env]
    vel = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2])) @ io.ego.vel_b[env]
    return ti.Vector([vel[0], vel[1]])


@ti.func
def body_values(env, track, io: Bundle[FeaturesIO]):
    """All values of ``BODY_COLUMNS`` of one moving body, in their order."""
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
            io.features.closest_m[env, track],
            io.features.closest_s[env, track],
        ]
    )


BODY_COLUMNS = (
    ColumnGroup(
        "body_valid",
        1,
        "1",
        "level",
        "1 = a moving body is remembered, 0 = no more bodies: all of its columns are 0",
        body_values,
        "body",
    ),
    ColumnGroup(
        "body_position", 2, "m", "level", "where it is now, from the position estimate", body_values, "body"
    ),
    ColumnGroup("body_velocity", 2, "m/s", "level", "its velocity less the own", body_values, "body"),
    ColumnGroup(
        "body_turn_rate",
        1,
        "rad/s",
        "level",
        "rate at which its velocity turns, left positive; 0 = straight on",
        body_values,
        "body",
    ),
    ColumnGroup(
        "body_radius",
        1,
        "m",
        "level",
        "its radius and what the uncertainty of its place adds",
        body_values,
        "body",
    ),
    ColumnGroup(
        "body_free_water",
        2,
        "m",
        "level",
        "above and below the own depth, up to where it may be; 0 = level",
        body_values,
        "body",
    ),
    ColumnGroup("body_age", 1, "s", "level", "since it was last seen", body_values, "body"),
    ColumnGroup(
        "body_closest",
        1,
        "m",
        "level",
        "to its surface at the closest approach, if the own velocity stays as it is",
        body_values,
        "body",
    ),
    ColumnGroup(
        "body_closest_time",
        1,
        "s",
        "level",
        "until then; at most the forecast's horizon",
        body_values,
        "body",
    ),
)
"""Of each of the bodies that come closest, the closest first: how close matters more than how soon, and a
body that recedes, whose closest approach is now, does not push one out that is still to come.
"""
