"""How high a tracked obstacle may be, and whether it is still where it is expected: a memory in 3-D of what a
horizontal sonar cannot show.

The fan opens by a known angle: an obstacle that is hit at a distance lies within the fan there, one that is
expected there and is not hit lies above or below it, or has gone elsewhere. Per track sixteen hypotheses are
weighed by Bayes' rule: the centre at one of fifteen heights from floor to surface, or an obstacle through the
full water column; beside them the probability that the obstacle is where it is expected at all. Neither sign
of the height is known from the sonar alone; it shows when the own depth changes. Sees sensor data and tracks
only.
"""

import math

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.config import HeightConfig, TankConfig
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.kalman import largest_position_variance
from uuvtai.kernels.core.simd import LANES, f16x, ramp
from uuvtai.kernels.core.stage import Bundle, Const, In, Out, loop_end, shares
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.state import TrackState

COLUMN = LANES - 1
"""Lane of the hypothesis "through the full water column"; the others are centre heights from floor to
surface."""

_LEAST = 0.01  # Likelihood of what cannot be, for one scan may be wrong.

_LEAST_SHARE = 1.0e-3
"""Share that every hypothesis keeps: many scans may be wrong (two obstacles that cross swap their tracks),
and nothing comes back from 0."""

_WELL_THERE = 0.95  # Probability of an obstacle that has just been matched to be where it is expected.

EDGE_M = 0.06
"""Half width of the soft edge of the fan (EC)."""

HIT_SHARE, EVIDENCE_S = 0.9, 0.15
"""Probability that an obstacle in the fan is hit, where its place is known exactly; scans closer together are
not independent evidence (EC)."""

TAIL_SHARE, COLUMN_TAIL_SHARE = 0.02, 0.15
"""Heights, and the full column, that are less likely are taken to be free. Fifteen of the first and the
second sum to less than 1: an obstacle is somewhere (EC)."""


@ti.func
def heights(tank_cfg: Const[TankConfig]):
    """[m] centre heights of the hypotheses, world z; the last lane (full column) holds the middle of the
    water."""
    floor, top = ti.static(tank_cfg.z_m)
    step = ti.static((tank_cfg.z_m[1] - tank_cfg.z_m[0]) / COLUMN)
    out = ramp(0.5, LANES) * step + floor
    out[COLUMN] = 0.5 * (floor + top)
    return out


@ti.func
def shared(weighed):
    """Weights as shares that sum to 1, none below the least one but for rounding."""
    scale, held = 1.0 / weighed.sum(), f16x(0.0)
    for i in ti.static(range(LANES)):
        held[i] = ti.max(weighed[i] * scale, _LEAST_SHARE)
    return held * (1.0 / held.sum())


@ti.func
def begin_height(env, track, tracks: Out[TrackState], height_cfg: Const[HeightConfig]):
    """Nothing known but that it is there."""
    share = f16x(ti.static((1.0 - height_cfg.column_share) / COLUMN))
    share[COLUMN] = height_cfg.column_share
    tracks.height[env, track, 0] = share
    tracks.present[env, track] = _WELL_THERE


@ti.func
def half_height(env, track, tracks: In[TrackState], height_cfg: Const[HeightConfig]):
    """[m] half height of an obstacle that is no column: that of a ball of the tracked radius, or the
    configured usual one."""
    return ti.max(tracks.radius_m[env, track], ti.static(height_cfg.half_height_m))


@ti.func
def in_fan(env, track, own, half, io: Bundle[TrackingIO]):
    """Per hypothesis the probability that a beam from ``own`` [m, world] hits the obstacle where it is
    expected.

    ``half`` = its half height [m], guessed: large for hits and small for misses, so that neither says more
    than it knows. Soft at the fan's edge.
    """
    mean = io.tracks.state[env, track]
    away = ti.Vector([mean[0] - own[0], mean[1] - own[1]]).norm()
    opening = ti.static(math.tan(math.radians(io.sonar_cfg.vertical_half_aperture_deg)))
    reach = half + opening * ti.max(away - 0.5 * io.tracks.radius_m[env, track], 0.0)
    at = heights(io.tank_cfg)
    out = f16x(0.0)
    for i in ti.static(range(LANES)):
        out[i] = ti.math.clamp((reach - ti.abs(at[i] - own[2])) * ti.static(0.5 / EDGE_M) + 0.5, 0.0, 1.0)
    out[COLUMN] = 1.0
    return out


@ti.func
def weigh_seen(env, track, own, io: Bundle[TrackingIO]):
    """The sonar at ``own`` hit it: it is there, and within the fan."""
    half = half_height(env, track, io.tracks, io.height_cfg)
    likely = in_fan(env, track, own, half + EDGE_M, io)
    weighed = io.tracks.height[env, track, 0] * ti.max(likely, _LEAST)
    io.tracks.height[env, track, 0] = shared(weighed)
    io.tracks.present[env, track] = _WELL_THERE


@ti.func
def weigh_unseen(env, track, own, dt, io: Bundle[TrackingIO]):
    """Beams from ``own`` went through where it is expected: it is above or below the fan, or elsewhere.

    The less surely the filter knows where it is, the less it says that beams through the middle of that place
    met nothing; and neighbouring scans say the same again, so only one in ``EVIDENCE_S`` counts in full.
    """
    radius = io.tracks.radius_m[env, track]
    spread_var = largest_position_variance(io.tracks.cov[env, track], 0.0)
    sure = HIT_SHARE * radius * radius / (radius * radius + spread_var)
    hit = 1.0 - (1.0 - sure) ** ti.min(dt * ti.static(1.0 / EVIDENCE_S), 1.0)
    likely = in_fan(env, track, own, io.height_cfg.least_half_height_m - EDGE_M, io)
    weighed = io.tracks.height[env, track, 0] * ti.max(1.0 - likely * hit, _LEAST)
    total = weighed.sum()
    io.tracks.height[env, track, 0] = shared(weighed)
    there = io.tracks.present[env, track] * total
    io.tracks.present[env, track] = there / (there + 1.0 - io.tracks.present[env, track])


@ti.func
def weigh_camera(env, track, likely, missing, tracks: Out[TrackState]):
    """An image's likelihood per hypothesis; where it shows no body (``missing`` 1) the obstacle is also less
    surely where it is expected."""
    weighed = tracks.height[env, track, 0] * likely
    total = weighed.sum()
    tracks.height[env, track, 0] = shared(weighed)
    if missing == 1:
        there = tracks.present[env, track] * total
        tracks.present[env, track] = there / (there + 1.0 - tracks.present[env, track])


@quick_launch
@ti.kernel
def bound_heights(io: Bundle[TrackingIO]):
    """Free water above and below the own height: ``above_w`` is the lowest edge of what may be above,
    ``below_w`` the highest edge of what may be below; both are the own height where the obstacle may be level
    with the vehicle, and for tracks that do not move.
    """
    n, n_track = ti.static(io.tracks.alive.shape[0], io.tracks.alive.shape[1])
    n_share = ti.static(shares(n_track))
    for env, share in ti.ndrange(loop_end(n, io.clock), n_share):
        if io.clock.active[env] == 1:
            own_z = io.ego.pos_w[env][2]
            for track in range(share * n_track // n_share, (share + 1) * n_track // n_share):
                above, below = own_z, own_z
                if (
                    ti.static(io.height_cfg.memory_s > 0)
                    and io.tracks.alive[env, track] * io.tracks.moving[env, track] == 1
                ):
                    above, below = free_water(env, track, own_z, io)
                io.forecast.above_w[env, track] = above
                io.forecast.below_w[env, track] = below


@ti.func
def free_water(env, track, own_z, io: Bundle[TrackingIO]):
    """(lowest edge above, highest edge below) [m] of the hypotheses that hold more than ``TAIL_SHARE``."""
    at, share = heights(io.tank_cfg), io.tracks.height[env, track, 0]
    half = half_height(env, track, io.tracks, io.height_cfg)
    above, below = FAR_M, -FAR_M
    for i in ti.static(range(COLUMN)):
        if share[i] > TAIL_SHARE:
            if at[i] >= own_z:
                above = ti.min(above, ti.max(at[i] - half, own_z))
            if at[i] <= own_z:
                below = ti.max(below, ti.min(at[i] + half, own_z))
    if share[COLUMN] > COLUMN_TAIL_SHARE:
        above, below = own_z, own_z
    return above, below
