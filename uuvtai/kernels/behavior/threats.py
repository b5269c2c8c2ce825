"""Assessment of threats for the behaviour tree: what the sonar feels, what the map holds, and whether
following the route conflicts."""

import math

import taichi as ti

from uuvtai.common.enums import NO_SITE
from uuvtai.compile.launch import quick_launch
from uuvtai.config.behavior import ARRIVAL, DEPTH_CHANGE, GOAL_DEPTH, HEADING_RANGE, HYSTERESIS, SLOPE, TTC
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.kernels.behavior.rollout import (
    depth_band,
    drive_of,
    edge_gap,
    held_heave,
    obstacle_depths,
    place_doubt,
    tuned,
)
from uuvtai.kernels.core.beams import beam_bearing, range_rate
from uuvtai.kernels.core.geometry import FAR_M, turned_z3, wrapped_angle
from uuvtai.kernels.core.grid import away_of, cell_of, centre_of, clearance_of
from uuvtai.kernels.core.simd import filled, n_lane
from uuvtai.kernels.core.stage import Bundle, n_envs

WAITING_M_S = 0.2
"""As long as a vehicle comes on along its way more slowly than this it waits; faster, it forgets that it did
(EC)."""

EMERGENCY_CLOSING_M_S = 0.15
"""Slower approach is no emergency (EC)."""

SETTLE_S = 1.0
"""Time constant of the mean of the fastest obstacle's speed, by which ``slow`` or ``fast`` holds (EC)."""

# ------------------------------------------------------------------------------------------------------------
# Where a vehicle may drive whose sonar is a fan ahead: not where it has not looked. A ring looks everywhere,
# and none of this is compiled for it.


def edge_of_sight(sonar_cfg):
    """[rad] from ahead to the fan's edge; plain Python."""
    return math.radians(0.5 * sonar_cfg.horizontal_aperture_deg)


def widest_way(sonar_cfg, behavior_cfg):
    """[rad] from ahead within which the way is well in sight; plain Python."""
    return max(edge_of_sight(sonar_cfg) - math.radians(behavior_cfg.sight_margin_deg), 0.0)


@ti.func
def sight_share(off, io: Bundle[BehaviorIO]):
    """Share of the speed at which a way may be driven that lies ``off`` [rad] from ahead."""
    share = 1.0
    if ti.static(not io.sonar_cfg.is_ring):
        edge, wide = ti.static(edge_of_sight(io.sonar_cfg), widest_way(io.sonar_cfg, io.behavior_cfg))
        inside = edge - ti.abs(wrapped_angle(off))
        share = ti.math.clamp(inside / ti.static(max(edge - wide, 1.0e-3)), 0.0, 1.0)
    return share


@ti.func
def sweep_share(age_s, io: Bundle[BehaviorIO]):
    """Share of the cruising speed that a mechanical beam allows, ``age_s`` after the start: what it has not
    looked at for long may have changed. None in the first sweep."""
    share = 1.0
    if ti.static(io.sonar_cfg.mechanical):
        allowed = ti.static(
            min(io.behavior_cfg.sweep_way_m / io.sonar_cfg.sweep_s / io.behavior_cfg.cruise_m_s, 1.0)
        )
        share = ti.select(age_s < ti.static(io.sonar_cfg.sweep_s), 0.0, allowed)
    return share


@ti.func
def kept_in_sight(turn, way, io: Bundle[BehaviorIO]):
    """Angle to turn by, next to ``turn``, after which a way that lies ``way`` [rad] from ahead is well in
    sight."""
    wide = ti.static(widest_way(io.sonar_cfg, io.behavior_cfg))
    return wrapped_angle(way + ti.math.clamp(wrapped_angle(turn - way), -wide, wide))


# ------------------------------------------------------------------------------------------------------------
# Which depth to cruise at: where the fewest moving obstacles are to be met, as far as the goal's depth can
# still be reached in time; with a dead vertical thruster at the goal's.


_BLUR_M = 0.1  # An obstacle's edge is known to this, vertically.


@ti.func
def choose_depth(env, io: Bundle[BehaviorIO]):
    """Set ``cruise_z_m``: the cheapest of ``depth_choices`` depths from edge to edge."""
    low, high = depth_band(edge_gap(env, io), io)
    goal, pos = io.mission.goal_w[env], io.ego.pos_w[env]
    wanted = ti.math.clamp(goal[2], low, high)
    if ti.static(io.behavior_cfg.free_depth):
        best_cost, best = FAR_M, wanted
        of_goal = io.behavior_cfg.weight_goal_depth * tuned(env, GOAL_DEPTH, io)
        of_change = io.behavior_cfg.weight_depth_change * tuned(env, DEPTH_CHANGE, io)
        n = ti.static(io.behavior_cfg.depth_choices)
        before = ti.math.clamp(io.behavior.cruise_z_m[env], low, high)
        for choice in range(n):
            z = low + (high - low) * (choice / ti.max(n - 1, 1))
            cost = level_share(z, io)
            cost += of_goal * ti.abs(z - goal[2])
            cost += of_change * ti.abs(z - before)
            if cost < best_cost:
                best_cost, best = cost, z
        away = ti.Vector([goal[0] - pos[0], goal[1] - pos[1]]).norm()
        radius = ti.static(io.episode_cfg.goal_radius_m)
        slope = io.behavior_cfg.return_slope * tuned(env, SLOPE, io)
        share = io.behavior_cfg.arrival_depth_share * tuned(env, ARRIVAL, io)
        off = share * radius + slope * ti.max(away - radius, 0.0)
        io.behavior.cruise_z_m[env] = best
        if io.ego.given_up[env] == 0:
            wanted = ti.math.clamp(ti.math.clamp(best, goal[2] - off, goal[2] + off), low, high)
    return wanted


@ti.func
def level_share(z, io: Bundle[BehaviorIO]):
    """Share of the expected obstacles that a vehicle at ``z`` [m] would touch, were it at the same place."""
    low, high = ti.static(io.traffic_cfg.z_m)
    reach = ti.static(
        0.25 * sum(io.traffic_cfg.height_m) + io.vehicle_cfg.hull_radius_m + io.behavior_cfg.contact_m
    )
    blur = ti.static(0.5 * _BLUR_M)
    above = ti.min(high + blur, z + reach)
    below = ti.max(low - blur, z - reach)
    share = ti.math.clamp((above - below) * ti.static(1.0 / (high - low + 2 * blur)), 0.0, 1.0)
    return io.height_cfg.column_share + (1.0 - io.height_cfg.column_share) * share


# ------------------------------------------------------------------------------------------------------------


_PATH_SAMPLES = 8

_NEARER = 3
"""Points of the route before the look-ahead point that are tried where the straight way to it is narrow,"""
_NEARER_M = 0.2  # [m] so far apart, from the foot of the route on.


@quick_launch
@ti.kernel
def assess_threats(io: Bundle[BehaviorIO]):
    """Fill the blackboard, and decide which envs must plan an evasion in this step."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            if io.scan.fresh[env] == 1:
                _sense_contact(env, io)
            _read_clearance(env, io)
            _follow_velocity(env, io)
            _foresee_conflict(env, io)


@ti.func
def _sense_contact(env, io: Bundle[BehaviorIO]):
    """Smallest time to contact and nearest return. Two neighbouring beams must agree on a time, so that one
    outlier is no emergency."""
    n_ray = ti.static(io.scan.range_m.shape[1])
    ttc, threat, nearest, nearest_beam = FAR_M, 0, FAR_M, 0
    before = FAR_M
    if ti.static(io.sonar_cfg.is_ring):
        before = _beam_ttc(env, n_ray - 1, io)
    for beam in range(n_ray):
        own = _beam_ttc(env, beam, io)
        agreed = ti.max(own, before)
        before = own
        if agreed < ttc:
            ttc = agreed
            threat = beam
        if io.scan.hit[env, beam] == 1:
            gap = io.scan.range_m[env, beam]
            if gap < nearest:
                nearest = gap
                nearest_beam = beam
    turned = io.scan.ping_yaw[env] - io.ego.rpy[env][2]
    io.behavior.ttc_s[env] = ttc
    io.behavior.threat_bearing[env] = wrapped_angle(turned + beam_bearing(threat, io.sonar_cfg))
    io.behavior.nearest_m[env] = nearest - ti.static(io.behavior_cfg.hull_reach_m)
    io.behavior.nearest_bearing[env] = wrapped_angle(turned + beam_bearing(nearest_beam, io.sonar_cfg))


@ti.func
def _beam_ttc(env, beam, io: Bundle[BehaviorIO]):
    """Time until what the beam hit reaches the hull's contact distance; FAR_M where it does not approach."""
    closing = -range_rate(env, beam, io.scan, io.tracks, io.sonar_cfg)
    out = FAR_M
    if io.scan.hit[env, beam] == 1 and closing > EMERGENCY_CLOSING_M_S:
        out = (
            ti.max(
                io.scan.range_m[env, beam]
                - ti.static(io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m),
                0.0,
            )
            / closing
        )
    return out


@ti.func
def _read_clearance(env, io: Bundle[BehaviorIO]):
    """Mapped clearance here, the way out of it, and the smallest one up to the look-ahead point; both less
    what the own place is not sure of."""
    pos = io.ego.pos_w[env]
    n_row, n_col = ti.static(io.clearance.site.shape[1:])
    cell = _held_cell(pos, n_row, n_col, io)
    doubt = place_doubt(env, io)
    nearest = io.clearance.site[env, cell[0], cell[1]]
    io.behavior.clearance_m[env] = clearance_of(nearest, io.clearance_cfg, io.mapping_cfg.cell_m) - doubt
    away = ti.Vector([0.0, 0.0])
    if nearest != NO_SITE:
        rows, cols = away_of(nearest)
        site = centre_of(cell[0] + rows, cell[1] + cols, io.tank_cfg, ti.static(io.mapping_cfg.cell_m))
        away = _unit(ti.Vector([pos[0] - site[0], pos[1] - site[1]]))
    io.behavior.away_w[env] = away
    here = ti.Vector([pos[0], pos[1]])
    steer, room = (
        ti.Vector([io.route.lookahead_w[env][0], io.route.lookahead_w[env][1]]),
        io.behavior.clearance_m[env],
    )
    if io.route.n_way[env] > 0:
        room = _room_to(env, here, steer, doubt, io)
        for nearer in range(_NEARER):
            nth = (_NEARER - nearer) * ti.static(round(_NEARER_M / io.mapping_cfg.cell_m))
            if (
                room
                < ti.static(
                    io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m + io.behavior_cfg.static_margin_m
                )
                and nth < io.route.n_ahead[env]
            ):
                point = io.route.ahead_w[env, nth]
                wider = _room_to(env, here, point, doubt, io)
                if wider > room:
                    steer, room = point, wider
    io.behavior.path_clearance_m[env] = room
    io.behavior.steer_w[env] = steer - here


@ti.func
def _room_to(env, here, there, doubt, io: Bundle[BehaviorIO]):
    """Smallest mapped clearance [m] on the straight way to a place, the own one included, less ``doubt``."""
    n_row, n_col = ti.static(io.clearance.site.shape[1:])
    smallest = io.behavior.clearance_m[env]
    for k in range(1, _PATH_SAMPLES + 1):
        on_way = _held_cell(here + (there - here) * (k / _PATH_SAMPLES), n_row, n_col, io)
        site = io.clearance.site[env, on_way[0], on_way[1]]
        smallest = ti.min(smallest, clearance_of(site, io.clearance_cfg, io.mapping_cfg.cell_m) - doubt)
    return smallest


@ti.func
def _held_cell(pos, n_row, n_col, io: Bundle[BehaviorIO]):
    cell = cell_of(pos, io.tank_cfg, ti.static(io.mapping_cfg.cell_m))
    return ti.Vector([ti.math.clamp(cell[0], 0, n_row - 1), ti.math.clamp(cell[1], 0, n_col - 1)])


@ti.func
def _unit(v):
    return v / ti.max(v.norm(), 1.0e-6)


@ti.func
def _follow_velocity(env, io: Bundle[BehaviorIO]):
    """Level velocity towards the point that is steered for, slower in narrow places; zero without a route."""
    level = io.behavior.steer_w[env]
    room = (
        io.behavior.clearance_m[env] - ti.static(io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m)
    ) / ti.static(io.behavior_cfg.slow_clearance_m)
    share = ti.static(io.behavior_cfg.slow_fraction) + ti.static(
        1.0 - io.behavior_cfg.slow_fraction
    ) * ti.math.clamp(room, 0.0, 1.0)
    sideways = ti.abs(ti.sin(ti.atan2(level[1], level[0]) - io.ego.rpy[env][2]))
    if io.behavior.path_clearance_m[env] < ti.static(
        io.behavior_cfg.sideslip_clearance_m
    ):  # across the way the hull is wider: let it turn first
        share *= 1.0 - 0.6 * sideways
    share *= sight_share(ti.atan2(level[1], level[0]) - io.ego.rpy[env][2], io)
    age_s = io.clock.step[env] * ti.static(io.episode_cfg.control_dt_s)
    share *= sweep_share(age_s, io)
    io.behavior.speed_share[env] = ti.select(io.route.n_way[env] > 0, share, 0.0)
    wanted = _unit(level) * cruising_speed(
        ti.static(io.behavior_cfg.cruise_m_s),
        io.behavior.speed_share[env],
        io.behavior.path_clearance_m[env],
        io,
    )
    io.behavior.follow_vel_w[env] = ti.Vector([wanted[0], wanted[1], io.behavior.follow_vel_w[env][2]])


@ti.func
def cruising_speed(top_m_s, share, room_m, io: Bundle[BehaviorIO]):
    """[m/s] along the route: a ``share`` of the wanted speed, and in narrow places, where the nose lies along
    the way and no diagonal of the body is faster, no more than the nose drives ahead."""
    speed = top_m_s * share
    if room_m <= ti.static(io.behavior_cfg.heading_clearance_m):
        speed = ti.min(speed, ti.static(io.vehicle_cfg.max_surge_m_s))
    return speed


@ti.func
def _note_speeds(env, io: Bundle[BehaviorIO]):
    """Take the track that is surely the fastest into ``alert``; while none moves it stays as it is."""
    fastest = -1.0
    for track in range(ti.static(io.tracks.alive.shape[1])):
        if io.tracks.alive[env, track] * io.tracks.moving[env, track] == 1:
            state, cov = io.tracks.state[env, track], io.tracks.cov[env, track]
            unsure = ti.sqrt(ti.max(cov[7], cov[9], 0.0))
            fastest = ti.max(fastest, ti.Vector([state[2], state[3]]).norm() - unsure, 0.0)
    if fastest >= 0.0:
        slow, fast = ti.static(io.fast_cfg.from_m_s, io.fast_cfg.full_m_s)
        now = ti.math.clamp((fastest - slow) / ti.static(max(fast - slow, 1e-6)), 0.0, 1.0)
        before = io.behavior.alert[env]
        rate = ti.static(
            min(1.0, io.behavior_cfg.decide_period_steps * io.episode_cfg.control_dt_s / SETTLE_S)
        )
        io.behavior.alert[env] = ti.select(before < 0.0, now, before + rate * (now - before))


@ti.func
def _note_waiting(env, io: Bundle[BehaviorIO]):
    """Count the time in which the vehicle does not come on along its way, and what patience it leaves."""
    vel, way = turned_z3(io.ego.vel_b[env], io.ego.rpy[env][2]), _unit(io.behavior.steer_w[env])
    slow = 1.0 - ti.Vector([vel[0], vel[1]]).dot(way) / WAITING_M_S
    period_s = ti.static(io.behavior_cfg.decide_period_steps * io.episode_cfg.control_dt_s)
    waited = ti.max(io.behavior.waited_s[env] + period_s * slow, 0.0)
    io.behavior.waited_s[env] = waited
    if io.behavior_cfg.patience_s > 0:
        io.behavior.patience[env] = ti.min(1.0, io.behavior_cfg.patience_s / ti.max(waited, 1.0e-3))


@ti.func
def _foresee_conflict(env, io: Bundle[BehaviorIO]):
    """Roll the follow velocity out against the forecasts, in decision steps only, with and without a change
    of depth; and a stop.

    Depth is changed only where that comes no nearer to any body: what is above or below is easily forgotten.
    """
    io.behavior.want_evade[env] = 0
    io.behavior.hysteresis_steps[env] += 1
    if io.clock.step[env] % ti.static(io.behavior_cfg.decide_period_steps) == 0:
        _note_speeds(env, io)
        _note_waiting(env, io)
        pos = io.ego.pos_w[env]
        follow = io.behavior.follow_vel_w[env]
        heave = held_heave(choose_depth(env, io) - pos[2], io)
        # lanes 0 to 2: follow at this depth, follow and change depth, stop; the others repeat lane 0
        lanes = ti.static(max(n_lane(), 3))
        cz = filled(0.0, lanes)
        cz[1] = heave
        cx, cy = filled(follow[0], lanes), filled(follow[1], lanes)
        cx[2], cy[2] = 0.0, 0.0
        drive = drive_of(env, cx, cy, cz, FAR_M, io)
        peak, _, _, first = obstacle_depths(env, drive, io)
        climbs = peak[1] <= peak[0] + 1.0e-3
        io.behavior.follow_vel_w[env][2] = ti.select(climbs, heave, 0.0)
        io.behavior.conflict_s[env] = ti.select(climbs, first[1], first[0])
        io.behavior.hold_conflict_s[env] = first[2]
        gap, way = _nearest_obstacle(env, pos, io)
        io.behavior.obstacle_near_m[env] = gap
        io.behavior.heading_w[env] = way * ti.cast(
            io.behavior.path_clearance_m[env] > ti.static(io.behavior_cfg.heading_clearance_m), ti.f32
        )
        if io.behavior.conflict_s[env] < FAR_M:
            io.behavior.hysteresis_steps[env] = 0
        quiet_s = io.behavior.hysteresis_steps[env] * ti.static(io.episode_cfg.control_dt_s)
        urgent = io.behavior.ttc_s[env] < io.behavior_cfg.emergency_ttc_s * tuned(env, TTC, io)
        if (
            io.behavior.conflict_s[env] < FAR_M
            or urgent
            or (
                io.behavior.evading_steps[env] > 0
                and quiet_s <= io.behavior_cfg.hysteresis_s * tuned(env, HYSTERESIS, io) + 0.2
            )
        ):
            io.behavior.want_evade[env] = 1


@ti.func
def _nearest_obstacle(env, pos, io: Bundle[BehaviorIO]):
    """(distance [m] from the hull to the nearest forecast obstacle, horizontal way [m] to the one that needs
    to be looked at).

    An obstacle above or below the sonar's fan needs it most. FAR_M and zero where there is none.
    """
    nearest, need, way = (
        FAR_M,
        io.behavior_cfg.heading_range_m * tuned(env, HEADING_RANGE, io),
        ti.Vector([0.0, 0.0]),
    )
    for track in range(ti.static(io.forecast.radius_m.shape[1])):
        radius = io.forecast.radius_m[env, track, 0]
        if radius >= 0:
            off = io.forecast.pos_w[env, track, 0] - ti.Vector([pos[0], pos[1]])
            gap = off.norm() - radius - ti.static(io.behavior_cfg.hull_reach_m)
            nearest = ti.min(nearest, gap)
            level = io.forecast.above_w[env, track] <= pos[2] and io.forecast.below_w[env, track] >= pos[2]
            wanted = gap + ti.select(level, ti.static(io.behavior_cfg.heading_level_m), 0.0)
            if wanted < need:
                need, way = wanted, off
    return nearest, way
