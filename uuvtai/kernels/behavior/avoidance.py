"""Search for an evasive velocity: headings times speeds, stop, the last command and the follow velocity,
rolled out in packets."""

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.config.behavior import BURST, CHANGE, CONTACT, DEVIATION, HEAVE, MEAN, PEAK, STATIC, TEMPERATURE
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.kernels.behavior.rollout import (
    depth_band,
    drive_of,
    edge_gap,
    obstacle_depths,
    place_doubt,
    static_depths,
    tuned,
)
from uuvtai.kernels.core.geometry import FAR_M, TWO_PI
from uuvtai.kernels.core.simd import filled, n_lane, put_column, row_lanes
from uuvtai.kernels.core.stage import Bundle, Const, loop_end, shares


@quick_launch
@ti.kernel
def plan_evasion(io: Bundle[BehaviorIO]):
    """Best evasive velocity of the envs with ``want_evade``: the softmax mean of the candidates where that is
    as good as the best one."""
    n, lanes = ti.static(io.clock.active.shape[0], n_lane())
    n_packet = ti.static(io.behavior.candidate_cost.shape[1] // lanes)
    n_share = ti.static(shares(n_packet))
    for env, share in ti.ndrange(loop_end(n, io.clock), n_share):
        if io.clock.active[env] == 1 and io.behavior.want_evade[env] == 1:
            for packet in range(share * n_packet // n_share, (share + 1) * n_packet // n_share):
                first = packet * lanes
                cx, cy, cz = candidate_lanes(env, first, lanes, io)
                burst_s = ti.select(
                    first >= io.behavior_cfg.first_burst,
                    io.behavior_cfg.burst_s * tuned(env, BURST, io),
                    FAR_M,
                )
                cost = cost_lanes(env, cx, cy, cz, burst_s, io)
                for i in ti.static(range(lanes)):
                    io.behavior.candidate_cost[env, first + i] = cost[i]
    for env in range(loop_end(n, io.clock)):
        if io.clock.active[env] == 1 and io.behavior.want_evade[env] == 1:
            index, best_cost, mean = _chosen(env, io)
            cx, cy, cz = filled(mean[0], lanes), filled(mean[1], lanes), filled(mean[2], lanes)
            cost = cost_lanes(env, cx, cy, cz, FAR_M, io)
            good = cost[0] <= best_cost + io.behavior_cfg.temperature * tuned(env, TEMPERATURE, io)
            io.behavior.evade_vel_w[env] = ti.select(good, mean, candidate(env, index, io))
            io.behavior.evade_candidate[env] = ti.select(good, -1, index)
            io.behavior.evade_cost[env] = ti.select(good, cost[0], best_cost)


@ti.func
def candidate_lanes(env, first, lanes: Const[int], io: Bundle[BehaviorIO]):
    """World velocities (lanes x, y, z [m/s]) of as many candidates from ``first`` on."""
    velocities = ti.Matrix.zero(ti.f32, 3, lanes)
    for lane in range(lanes):
        put_column(velocities, lane, candidate(env, first + lane, io))
    return row_lanes(velocities, 0), row_lanes(velocities, 1), row_lanes(velocities, 2)


@ti.func
def candidate(env, index, io: Bundle[BehaviorIO]):
    """World velocity of one candidate. Heading 0 is the follow direction, so that slowing down on the route
    is among them.

    First the level ones (they keep the heave of following), then stop, last command and follow, then those
    that climb and those that dive, and from ``first_burst`` on the level dashes, which last ``burst_s`` only.
    Padding repeats standing still.
    """
    n_level, n_heave = ti.static(
        io.behavior_cfg.n_heading * io.behavior_cfg.n_speed, io.behavior_cfg.n_heave_heading
    )
    follow = io.behavior.follow_vel_w[env]
    out = ti.Vector([0.0, 0.0, 0.0])
    if index >= ti.static(io.behavior_cfg.first_burst):
        turn = ti.static(TWO_PI / 32) * (index - ti.static(io.behavior_cfg.first_burst))
        out = _towards(env, turn, 1.0, follow[2], io)
    elif index < n_level:
        speed = 1.0 / ti.static(io.behavior_cfg.n_speed) * (index // ti.static(io.behavior_cfg.n_heading) + 1)
        turn = ti.static(TWO_PI / io.behavior_cfg.n_heading) * (index % ti.static(io.behavior_cfg.n_heading))
        out = _towards(env, turn, speed, follow[2], io)
    elif index == n_level + 1:
        out = io.behavior.last_vel_w[env]
        out[2] = edge_limited(env, out[2], io)
    elif index == n_level + 2:
        out = follow
    elif index > n_level + 2 and index < ti.static(io.behavior_cfg.n_held):
        nth = index - n_level - 3
        heave = ti.select(nth % 2 == 0, 1.0, -1.0) * io.behavior_cfg.heave_m_s * tuned(env, HEAVE, io)
        heave = edge_limited(env, heave, io)
        turn = ti.static(TWO_PI / io.behavior_cfg.n_heave_heading) * (nth // 2)
        out = _towards(env, turn, ti.select(nth >= 2 * n_heave, 0.0, 1.0), heave, io)
    return out


@ti.func
def _towards(env, turn, share, heave, io: Bundle[BehaviorIO]):
    """World velocity at an angle from the follow direction, at a share of the speed possible there."""
    follow = io.behavior.follow_vel_w[env]
    heading = ti.atan2(follow[1], follow[0]) + turn
    speed = share * ti.min(
        ti.static(io.behavior_cfg.evade_m_s), speed_limit(heading - io.ego.rpy[env][2], io)
    )
    return ti.Vector([ti.cos(heading) * speed, ti.sin(heading) * speed, heave])


@ti.func
def edge_limited(env, heave, io: Bundle[BehaviorIO]):
    """Heave [m/s] that stops at the band's edges instead of running into floor or surface."""
    low, high = depth_band(edge_gap(env, io), io)
    own_z = io.ego.pos_w[env][2]
    return ti.math.clamp(heave, ti.min(low - own_z, 0.0), ti.max(high - own_z, 0.0))


@ti.func
def speed_limit(angle, io: Bundle[BehaviorIO]):
    """Fastest level speed in a direction of the body frame: surge and sway are limited one by one, so
    diagonals are faster."""
    along = ti.abs(ti.cos(angle)) / ti.static(io.vehicle_cfg.max_surge_m_s)
    across = ti.abs(ti.sin(angle)) / ti.static(io.vehicle_cfg.max_sway_m_s)
    return 1.0 / ti.max(along, across)


@ti.func
def cost_lanes(env, cx, cy, cz, burst_s, io: Bundle[BehaviorIO]):
    """Cost of a packet of commanded velocities. Violations count by depth: a flat penalty drives straight on
    when every candidate is bad."""
    drive = drive_of(env, cx, cy, cz, burst_s, io)
    peak, mean, contact, _ = obstacle_depths(env, drive, io)
    doubt = place_doubt(env, io)
    static_mean, static_contact = static_depths(env, drive, doubt, io)
    off = _distance_lanes(cx, cy, cz, io.behavior.follow_vel_w[env]) * (
        ti.static(io.behavior_cfg.weight_deviation / io.behavior_cfg.cruise_m_s) * tuned(env, DEVIATION, io)
    )
    change = _distance_lanes(cx, cy, cz, io.behavior.last_vel_w[env]) * (
        ti.static(io.behavior_cfg.weight_change / io.behavior_cfg.cruise_m_s) * tuned(env, CHANGE, io)
    )
    of_peak = io.behavior_cfg.weight_peak * tuned(env, PEAK, io)
    of_mean = io.behavior_cfg.weight_mean * tuned(env, MEAN, io)
    of_contact = io.behavior_cfg.weight_contact * tuned(env, CONTACT, io)
    of_static = io.behavior_cfg.weight_static * tuned(env, STATIC, io)
    moving = peak * of_peak + mean * of_mean
    touching = contact * of_contact + static_contact * ti.static(io.behavior_cfg.weight_static_contact)
    return moving + touching + static_mean * of_static + off + change


@ti.func
def _distance_lanes(cx, cy, cz, velocity):
    dx = cx - velocity[0]
    dy = cy - velocity[1]
    dz = cz - velocity[2]
    return ti.sqrt(dx * dx + dy * dy + dz * dz)


@ti.func
def _chosen(env, io: Bundle[BehaviorIO]):
    """Candidate of least cost (first of equals), and the mean of the candidates weighted by exp(-cost /
    temperature)."""
    n_used = ti.static(io.behavior_cfg.n_candidate)
    best_cost, best = FAR_M, 0
    for index in range(n_used):
        if io.behavior.candidate_cost[env, index] < best_cost:
            best_cost = io.behavior.candidate_cost[env, index]
            best = index
    total, mean = 0.0, ti.Vector([0.0, 0.0, 0.0])
    sharpness = ti.static(1.0 / io.behavior_cfg.temperature) / tuned(env, TEMPERATURE, io)
    for index in range(n_used):
        excess = (io.behavior.candidate_cost[env, index] - best_cost) * sharpness
        if excess < 12.0:
            weight = ti.exp(-excess)
            total += weight
            mean += weight * candidate(env, index, io)
    average = ti.Vector([mean[i] / total for i in range(3)])
    return best, best_cost, average
