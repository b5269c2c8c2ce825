"""Which cluster of a scan is which track's body (part of the tracking stage)."""

import taichi as ti

from uuvtai.config import SonarConfig, TrackingConfig
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.signature import Const, In, Out
from uuvtai.kernels.perception.sighting import pair_surprise
from uuvtai.state import ClusterState, TrackState

_REACH_M = 2.0
"""No match is looked for beyond this; saves the arithmetic."""


@ti.func
def associate(env, dt, tracks: Out[TrackState], clusters: Out[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]):
    """Pair tracks and clusters, cheapest pair first.

    Each track asks for its cheapest cluster; a cluster keeps the cheapest of the tracks that ask, and who is turned away asks for its next.
    With a cost both sides agree on, that ends in the pairs of the greedy rule, without sorting (Gale and Shapley).
    """
    for track in range(tracks.alive.shape[1]):
        tracks.pick_cost[env, track] = -FAR_M
        asking = ti.select(tracks.alive[env, track] == 1, track, -1)
        while asking >= 0:
            ask_next(env, asking, dt, tracks, clusters, tracking, sonar)
            wanted = tracks.pick[env, asking]
            if wanted < 0:
                asking = -1
            else:
                holder = clusters.match[env, wanted]
                if holder < 0 or tracks.pick_cost[env, asking] < tracks.pick_cost[env, holder]:
                    clusters.match[env, wanted] = asking
                    asking = holder


@ti.func
def ask_next(
    env, track, dt, tracks: Out[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]
):
    """Set ``pick`` to the cheapest cluster that costs more than the last one asked for, -1 = none."""
    best, best_cost = -1, FAR_M
    for c in range(clusters.count[env]):
        cost = pair_cost(env, track, c, dt, tracks, clusters, tracking, sonar)
        if cost > tracks.pick_cost[env, track] and cost < best_cost:
            best, best_cost = c, cost
    tracks.pick[env, track] = best
    tracks.pick_cost[env, track] = best_cost


@ti.func
def pair_cost(
    env, track, c, dt, tracks: In[TrackState], clusters: In[ClusterState], tracking: Const[TrackingConfig], sonar: Const[SonarConfig]
):
    """-2 log likelihood (up to a constant) of the cluster being this track's body; FAR_M outside the gate."""
    cost = FAR_M
    mean = tracks.state[env, track]
    offset = clusters.pos_w[env, c] - ti.Vector([mean[0], mean[1]])
    square = offset.dot(offset)
    if square < _REACH_M * _REACH_M:
        surprise, volume, near = pair_surprise(env, track, c, offset, tracks, clusters, sonar)
        free = tracking.gate_m + dt * ti.sqrt(mean[2] * mean[2] + mean[3] * mean[3])
        if near < tracking.turn_gate or square < free * free:
            cost = surprise + ti.log(volume)
    return cost
