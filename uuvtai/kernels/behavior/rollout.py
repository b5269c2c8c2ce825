"""Roll-outs of a packet of commanded velocities at once against forecast obstacles and the mapped clearance.

A commanded velocity c is reached with a first-order lag tau, so from velocity v0 the vehicle drives
x(t) = x0 + v0 A(t) + c B(t), A(t) = tau (1 - exp(-t / tau)), B(t) = t - A(t): linear in c, which is all the
lanes differ in. A burst that ends after T commands -c on top from then on: c (B(t) - B(t - T)).
"""

from typing import Any

import taichi as ti

from uuvtai.config.behavior import CAUTION, CLOSING, DOUBT, GROWTH, HORIZON, LAG, STATIC_MARGIN, VERTICAL
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.kernels.core.geometry import FAR_M, turned_z3
from uuvtai.kernels.core.grid import clearance_of, grid_origin
from uuvtai.kernels.core.simd import filled, filled_int
from uuvtai.kernels.core.stage import Bundle, Const, Out

_SLACK_S = 1.0e-3  # the last sample is within the horizon, however times are rounded
UNSTICK_M_S = 0.3
"""of creeping away from the nearest mapped obstacle, unless the leaf's port says (EC)"""


@ti.func
def tuned(env, number, io: Bundle[BehaviorIO]):
    """Factor on one of the config's numbers in this row and at this time (``tuned_numbers``)."""
    share, log_factor = ti.max(io.behavior.alert[env], 0.0), io.behavior.tuned[env, number]
    return ti.exp((1.0 - share) * log_factor[0] + share * log_factor[1])


@ti.func
def drive_of(env, cx, cy, cz, burst_s, io: Bundle[BehaviorIO]):
    """A packet of commanded velocities (lanes x, y, z [m/s]) from where the vehicle is, and what it is judged
    by: the struct ``drive`` of ``obstacle_depths``."""
    return ti.Struct(
        x=cx,
        y=cy,
        z=cz,
        burst_s=burst_s,
        pos=io.ego.pos_w[env],
        vel=turned_z3(io.ego.vel_b[env], io.ego.rpy[env][2]),
        gap=edge_gap(env, io),
        caution=io.behavior_cfg.caution * tuned(env, CAUTION, io) * io.behavior.patience[env],
        growth_m_s=io.behavior_cfg.margin_growth_m_s * tuned(env, GROWTH, io),
        closing_s=io.behavior_cfg.closing_s * tuned(env, CLOSING, io) * io.behavior.patience[env],
        horizon_s=io.behavior_cfg.horizon_s * tuned(env, HORIZON, io) + _SLACK_S,
        slower=tuned(env, LAG, io),
        vertical=io.behavior_cfg.vertical_weight * tuned(env, VERTICAL, io),
        doubt=io.behavior_cfg.obstacle_growth * tuned(env, DOUBT, io) - 1.0,
        static_margin_m=io.behavior_cfg.static_margin_m * tuned(env, STATIC_MARGIN, io),
    )


@ti.func
def obstacle_depths(env, drive, io: Bundle[BehaviorIO]):
    """How deep each commanded velocity violates the wanted clearance from the forecast obstacles.

    ``drive``: struct of the velocities (lanes x, y, z [m/s]), which are commanded for ``burst_s`` [s], then
    stop, and of the own position ``pos`` [m] and velocity ``vel`` [m/s] now, world, the ``gap`` [m] kept from
    floor and surface, and the row's own margins, weights, horizon and lag (``drive_of``). Returns lanes:
    largest depth [m]; depth averaged over the horizon and summed over obstacles [m]; largest depth below
    contact [m]; time of the first violation [s], FAR_M = none. Each body counts with the mean of its futures,
    weighted by their probabilities; a future that is less probable than ``evade_probability`` has no first
    violation. The clearance is reduced by closing_s times the closing speed, as the termination check also
    stops at a small time to collision. Obstacles are upright cylinders; water known to be free above or below
    them (``above_w``, ``below_w``) adds to the distance.
    """
    found = _no_depths(drive)
    for track in range(ti.static(io.forecast.radius_m.shape[1])):
        near = io.forecast.radius_m[env, track, 0] >= 0
        if near and _within_reach(env, track, drive, io):
            left, obstacle = 1.0, _no_depths(drive)
            for nth in range(ti.static(io.futures.share.shape[2] + 1)):
                future = ti.static(io.futures.share.shape[2]) - 1 - nth  # the forecast itself comes last: -1
                likely = left
                if future >= 0:
                    likely = io.futures.share[env, track, future]
                if likely > ti.static(io.behavior_cfg.least_share):
                    left -= likely
                    one = _future_depths(env, track, future, drive, io)
                    _take_future(found, obstacle, one, likely, io)
            for i in ti.static(range(drive.x.n)):
                found.peak[i] = ti.max(found.peak[i], obstacle.peak[i])
                found.contact[i] = ti.max(found.contact[i], obstacle.contact[i])
    return found.peak, found.mean, found.contact, found.first


@ti.func
def _take_future(found: Out[Any], obstacle: Out[Any], one, likely, io: Bundle[BehaviorIO]):
    """Add the depths of ``one`` future, as ``likely`` as it is, to those of its body and of all."""
    found.mean += likely * one.mean
    obstacle.peak += likely * one.peak
    obstacle.contact += likely * one.contact
    if likely >= ti.static(io.behavior_cfg.evade_probability):
        for i in ti.static(range(one.first.n)):
            found.first[i] = ti.min(found.first[i], one.first[i])


@ti.func
def _no_depths(drive):
    """Depths of no obstacle at all, a lane per velocity."""
    zero = filled(0.0, drive.x.n)
    return ti.Struct(peak=zero, mean=zero, contact=zero, first=filled(FAR_M, drive.x.n))


@ti.func
def _within_reach(env, track, drive, io: Bundle[BehaviorIO]):
    """Whether an obstacle can come so near within the horizon that any of its futures counts for any lane."""
    first, second = io.forecast.pos_w[env, track, 0], io.forecast.pos_w[env, track, 1]
    n = ti.static(_samples(io.forecast.radius_m.shape[2], io.behavior_cfg, io.tracking_cfg))
    time = ti.static((n - 1) * io.tracking_cfg.forecast_dt_s)
    closing = (second - first).norm() * ti.static(1.05 / io.tracking_cfg.forecast_dt_s)
    closing += ti.Vector([drive.vel[0], drive.vel[1]]).norm() + ti.static(_fastest(io.behavior_cfg))
    told = io.forecast.radius_m[env, track, n - 1]
    bound = told + ti.max(drive.doubt, 0.0) * ti.max(told - io.forecast.radius_m[env, track, 0], 0.0)
    bound += ti.static(io.behavior_cfg.hull_reach_m)
    bound += _wanted_m(time, drive, io) + closing * (time + drive.closing_s)
    return (first - ti.Vector([drive.pos[0], drive.pos[1]])).norm_sqr() < bound * bound


@ti.func
def _future_depths(env, track, future, drive, io: Bundle[BehaviorIO]):
    """The lanes' depths for one future of one obstacle; -1 = its forecast."""
    n_sample = ti.static(_samples(io.forecast.radius_m.shape[2], io.behavior_cfg, io.tracking_cfg))
    dt = ti.static(io.tracking_cfg.forecast_dt_s)
    low, high = depth_band(drive.gap, io)
    found = _no_depths(drive)
    level, level_vel = ti.Vector([drive.pos[0], drive.pos[1]]), ti.Vector([drive.vel[0], drive.vel[1]])
    reach_speed = level_vel.norm() + ti.static(_fastest(io.behavior_cfg))
    above, below = io.forecast.above_w[env, track], io.forecast.below_w[env, track]
    step_decay = ti.static(
        2.718281828459045 ** (-io.tracking_cfg.forecast_dt_s / io.behavior_cfg.lag_s)
    ) * ti.exp(ti.static(-io.tracking_cfg.forecast_dt_s / io.behavior_cfg.lag_s) * (1.0 / drive.slower - 1.0))
    lag_s = io.behavior_cfg.lag_s * drive.slower
    decay, rest, before = 1.0, 1.0, io.forecast.pos_w[env, track, 0]
    for k in range(1, n_sample):
        # exp(-t / tau) by one factor a sample: settle = A(t), gain = B(t) - B(t - T), and the
        # velocity is v0 decay + c (rest - decay), the derivative of x(t)
        decay *= step_decay
        time = k * dt
        over = ti.max(time - drive.burst_s, 0.0)
        if over > 0.0:
            rest = ti.exp(over * ti.static(-1.0 / io.behavior_cfg.lag_s) / drive.slower)
        settle = lag_s * (1.0 - decay)
        gain = time - settle - over + lag_s * (1.0 - rest)
        obstacle, wanted = io.forecast.pos_w[env, track, k], _wanted_m(time, drive, io)
        if future >= 0:
            obstacle = io.futures.pos_w[env, track, future, k]
            wanted -= ti.static(1.0 - io.behavior_cfg.future_margin) * (wanted - io.behavior_cfg.contact_m)
        obstacle_vel = (obstacle - before) / dt
        before = obstacle
        start = level + level_vel * settle - obstacle
        drift = level_vel * decay - obstacle_vel
        told = io.forecast.radius_m[env, track, k]
        radius = told + drive.doubt * (told - io.forecast.radius_m[env, track, 0])
        bound = _bound_m(radius, wanted, gain, drive.closing_s * (reach_speed + obstacle_vel.norm()), io)
        if told >= 0 and time <= drive.horizon_s and start.norm_sqr() < bound * bound:
            z = ti.math.clamp(drive.z * gain + (drive.pos[2] + drive.vel[2] * settle), low, high)
            gap = ti.max(ti.min(above - z, z - below), 0.0) * drive.vertical
            free = _free_lanes(
                drive.x, drive.y, gap, start, drift, gain, rest - decay, radius, drive.closing_s, io
            )
            _deepen(found, wanted, free, time, n_sample - 1, io)
    return found


@ti.func
def _bound_m(radius, wanted, gain, reserve, io: Bundle[BehaviorIO]):
    """Distance [m] of ``start`` beyond which no lane's depth is above 0: however c is chosen, a lane comes no
    nearer than |start| - fastest x gain, and what closing takes off is at most ``reserve`` [m]."""
    bound = radius + ti.static(io.behavior_cfg.hull_reach_m) + wanted
    bound += ti.static(_fastest(io.behavior_cfg)) * gain
    return bound + reserve


@ti.func
def _deepen(found: Out[Any], wanted, free, time, n_ahead: Const[int], io: Bundle[BehaviorIO]):
    """Take one sample of one obstacle into the lanes' largest and mean depths and first violations."""
    for i in ti.static(range(free.n)):
        depth = ti.max(wanted - free[i], 0.0)
        found.peak[i] = ti.max(found.peak[i], depth)
        found.mean[i] += depth * ti.static(1.0 / n_ahead)
        found.contact[i] = ti.max(found.contact[i], ti.static(io.behavior_cfg.contact_m) - free[i])
        found.first[i] = ti.min(found.first[i], ti.select(depth > 0.0, time, FAR_M))


@ti.func
def _wanted_m(time, drive, io: Bundle[BehaviorIO]):
    """Clearance [m] wanted ``time`` [s] ahead: it grows as the forecast's error does."""
    margin = io.behavior_cfg.margin_m + drive.growth_m_s * time
    return io.behavior_cfg.contact_m + drive.caution * margin


@ti.func
def _free_lanes(cx, cy, gap, start, drift, gain, share, radius, closing_s, io: Bundle[BehaviorIO]):
    """Surface-to-surface distance less closing_s times the closing speed, per lane; ``gap`` = weighted free
    water above or below.

    Position relative to the obstacle is start + c gain, relative velocity drift + c share. Level with the
    obstacle (gap 0) the distance goes on below zero inside its radius, so that deeper is worse.
    """
    dx = cx * gain + start[0]
    dy = cy * gain + start[1]
    middle = ti.sqrt(dx * dx + dy * dy + 1.0e-8)
    beyond = ti.max(middle - radius, 0.0)
    within = ti.select(gap > 0.0, 0.0, ti.min(middle - radius, 0.0))
    distance = ti.sqrt(beyond * beyond + gap * gap + 1.0e-8)
    approach = -(dx * (cx * share + drift[0]) + dy * (cy * share + drift[1])) / middle
    closing = ti.max(approach, 0.0) * ti.select(gap > 0.0, beyond / distance, 1.0)
    return distance + within - ti.static(io.behavior_cfg.hull_reach_m) - closing_s * closing


@ti.func
def static_depths(env, drive, doubt, io: Bundle[BehaviorIO]):
    """How deep each commanded velocity of ``drive_of`` violates the wanted static clearance, ``doubt`` [m]
    (of ``place_doubt``) more than is mapped: lanes mean depth and largest depth below contact [m]."""
    mean, contact = filled(0.0, drive.x.n), filled(0.0, drive.x.n)
    n_sample = ti.static(max(1, round(io.behavior_cfg.static_horizon_s / io.behavior_cfg.static_dt_s)))
    touch = ti.static(io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m)
    for k in range(1, n_sample + 1):
        time = k * ti.static(io.behavior_cfg.static_dt_s)
        settle = settling(time, drive.slower, io)
        over = ti.max(time - drive.burst_s, 0.0)
        gain = time - settle - over + settling(over, drive.slower, io)
        free = clearance_lanes(
            env,
            drive.x * gain + (drive.pos[0] + drive.vel[0] * settle),
            drive.y * gain + (drive.pos[1] + drive.vel[1] * settle),
            io,
        )
        for i in ti.static(range(drive.x.n)):
            below = touch + doubt - free[i]  # type: ignore[index]
            mean[i] += ti.max(below + drive.static_margin_m, 0.0) / n_sample
            contact[i] = ti.max(contact[i], below)
    return mean, contact


@ti.func
def settling(time, slower, io: Bundle[BehaviorIO]):
    """A(t) [s] of the module's text, with ``slower`` times the lag."""
    rate = ti.static(1.0 / io.behavior_cfg.lag_s) / slower
    return io.behavior_cfg.lag_s * slower * (1.0 - ti.exp(-time * rate))


@ti.func
def clearance_lanes(env, x, y, io: Bundle[BehaviorIO]):
    """Mapped clearance [m] of the cells that hold the lanes' positions; positions off the grid take its
    border, which is 0."""
    x0, y0 = ti.static(grid_origin(io.tank_cfg, io.mapping_cfg.cell_m))
    n_row, n_col = ti.static(io.clearance.site.shape[1:])
    at_col = (x - x0) * ti.static(1.0 / io.mapping_cfg.cell_m)
    at_row = (y - y0) * ti.static(1.0 / io.mapping_cfg.cell_m)
    site = filled_int(0, x.n)
    for i in ti.static(range(x.n)):
        row = ti.math.clamp(ti.cast(ti.floor(at_row[i]), ti.i32), 0, n_row - 1)
        col = ti.math.clamp(ti.cast(ti.floor(at_col[i]), ti.i32), 0, n_col - 1)
        site[i] = ti.cast(io.clearance.site[env, row, col], ti.i32)
    return clearance_of(site, io.clearance_cfg, io.mapping_cfg.cell_m)


@ti.func
def held_heave(error_m, io: Bundle[BehaviorIO]):
    """Vertical speed [m/s] that corrects a depth error [m]."""
    top = ti.static(io.vehicle_cfg.max_heave_m_s)
    return ti.math.clamp(error_m * ti.static(io.behavior_cfg.depth_gain), -top, top)


@ti.func
def edge_gap(env, io: Bundle[BehaviorIO]):
    """[m] to keep from floor and surface: the less sure of the own z, and with a dead vertical thruster, the
    more."""
    least = ti.select(io.ego.given_up[env] != 0, io.behavior_cfg.lost_edge_gap_m, 0.0)
    return ti.max(io.behavior_cfg.edge_gap_m, least) + io.behavior_cfg.place_sigmas * ti.sqrt(
        io.ego.z_var[env]
    )


@ti.func
def depth_band(gap, io: Bundle[BehaviorIO]):
    """(lowest, highest) own z [m] that the behaviour tree steers for, ``gap`` [m] off floor and surface."""
    floor, top = ti.static(io.tank_cfg.z_m)
    gap = ti.min(gap, ti.static(0.5 * (io.tank_cfg.z_m[1] - io.tank_cfg.z_m[0])))
    return floor + gap, top - gap


@ti.func
def place_doubt(env, io: Bundle[BehaviorIO]):
    """[m] by which the clearance from walls and mapped obstacles may be smaller than the map says: the less
    sure the own place is in its worst direction, the larger.
    """
    cov = io.ego.pose_cov[env]
    half, apart = 0.5 * (cov[0] + cov[3]), 0.5 * (cov[0] - cov[3])
    worst = half + ti.sqrt(apart * apart + cov[1] * cov[1])
    return io.behavior_cfg.place_sigmas * ti.sqrt(ti.max(worst, 0.0))


def _fastest(behavior_cfg):
    """[m/s] no level velocity that is ever rolled out is faster."""
    return max(behavior_cfg.evade_m_s, behavior_cfg.cruise_m_s, behavior_cfg.back_off_m_s, UNSTICK_M_S)


def _samples(n_forecast, behavior_cfg, tracking_cfg):
    """Forecast samples used: the horizon, or what there is."""
    return min(n_forecast, round(behavior_cfg.horizon_s / tracking_cfg.forecast_dt_s) + 1)
