"""Which cluster of a scan is which track's body (part of the tracking stage)."""

import taichi as ti

from uuvtai.kernels.core.beams import beam_there, beam_towards
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.perception.bundles import TrackingIO
from uuvtai.kernels.perception.sighting import pair_surprise

_REACH_M = 2.0
"""No match is looked for beyond this; saves the arithmetic."""


@ti.func
def associate(env, dt, io: Bundle[TrackingIO]):
    """Pair tracks and clusters, cheapest pair first.

    Each track asks for its cheapest cluster; a cluster keeps the cheapest of the tracks that ask, and who is
    turned away asks for its next. With a cost both sides agree on, that ends in the pairs of the greedy rule,
    without sorting (Gale and Shapley).
    """
    for track in range(io.tracks.alive.shape[1]):
        io.tracks.pick_cost[env, track] = -FAR_M
        asking = ti.select(io.tracks.alive[env, track] == 1, track, -1)
        while asking >= 0:
            propose_next(env, asking, dt, io)
            wanted = io.tracks.pick[env, asking]
            if wanted < 0:
                asking = -1
            else:
                holder = io.clusters.match[env, wanted]
                if holder < 0 or io.tracks.pick_cost[env, asking] < io.tracks.pick_cost[env, holder]:
                    io.clusters.match[env, wanted] = asking
                    asking = holder


@ti.func
def propose_next(env, track, dt, io: Bundle[TrackingIO]):
    """Set ``pick`` to the cheapest cluster that costs more than the last one asked for, -1 = none."""
    best, best_cost = -1, FAR_M
    for c in range(io.clusters.count[env]):
        cost = pair_cost(env, track, c, dt, io)
        if cost > io.tracks.pick_cost[env, track] and cost < best_cost:
            best, best_cost = c, cost
    io.tracks.pick[env, track] = best
    io.tracks.pick_cost[env, track] = best_cost


@ti.func
def pair_cost(env, track, c, dt, io: Bundle[TrackingIO]):
    """-2 log likelihood (up to a constant) of the cluster being this track's body; FAR_M outside the gate."""
    cost = FAR_M
    mean = io.tracks.state[env, track]
    offset = io.clusters.pos_w[env, c] - ti.Vector([mean[0], mean[1]])
    square = offset.dot(offset)
    if square < _REACH_M * _REACH_M:
        surprise, volume, near = pair_surprise(env, track, c, offset, io)
        free = io.tracking_cfg.gate_m + dt * ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        within = near < io.tracking_cfg.turn_gate or square < free * free
        if ti.static(io.sonar_cfg.mechanical):
            within = within and square < swept_reach(env, track, io) ** 2
        if within:
            cost = surprise + ti.log(volume)
    return cost


@ti.func
def swept_reach(env, track, io: Bundle[TrackingIO]):
    """[m] from where it is expected to where a track may be found by a mechanical beam: as far as bodies get
    since it was seen, if the beam has looked there since; else it may still be there, and what is found
    elsewhere is another body."""
    own, mean = io.scan.ping_pos_w[env], io.tracks.state[env, track]
    bearing = ti.atan2(mean[1] - own[1], mean[0] - own[0]) - io.scan.ping_yaw[env]
    beam = beam_there(beam_towards(bearing, io.sonar_cfg), io.sonar_cfg)
    then = io.tracks.seen_step[env, track]
    reach = io.tracking_cfg.gate_m + io.tracks.radius_m[env, track]
    if beam >= 0 and io.echoes.step[env, ti.max(beam, 0)] > then:
        since = (io.scan.ping_step[env] - then) * io.episode_cfg.control_dt_s
        reach += io.tracking_cfg.birth_speed_sigma_m_s * since
    return reach
