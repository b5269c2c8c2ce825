"""Two-layer occupancy map from sonar and depth: M^s (what stays) and M^d (what moves), fused by max.

One scan becomes binary indicators per cell (``evidence.py``), then one pass over the grid applies the paper's two equations:

    M^s = clip((1 - lambda_s) M^s + eta_occ I^s-hit - eta_free I^free + eta_depth I^depth, 0, 1)
    M^d = clip((1 - lambda_d) M^d + eta_dyn I^d-hit - eta_dyn,free I^free, 0, 1)

A return of either kind cancels I^free in its cell. What moves is told from observations only: compensated Doppler, a moving track, or a
return where the map was confident of free water; it feeds M^d alone. A body that stops is promoted after ``promote_s``: without newer
evidence of motion its returns then count as static ones, and M^d decays.

I^depth is "depth-gated consistency": a camera point at the vehicle's own depth counts where the sonar supports it (the cell is not free of
static occupancy, or has a static return in this scan) and does not contradict it (no beam passed through), and where nothing moves (no
dynamic return, M^d below the threshold): the camera alone cannot tell a passing body from a standing one.
"""

import math

import taichi as ti

from uuvtai.config import DepthConfig, EpisodeConfig, MappingConfig, SonarConfig, TankConfig
from uuvtai.kernels.evidence import DEPTH_HIT, DYNAMIC_HIT, STATIC_HIT, mark_depth, mark_free_beams, mark_hits
from uuvtai.kernels.lanes import LANES, f16x, i16x
from uuvtai.kernels.signature import Const, In, Out, spread
from uuvtai.state import ClockState, DepthImage, GridMask, MapState, SonarScan, TrackState

RATED_HZ = 10.0
"""Scan rate for which the gains of MappingConfig are given."""

COUNTER_MAX = 255
VANISHED = 1e-6
"""Occupancy below this is 0: decay alone would never end."""

_NO_SCAN = -(1 << 20)


# ----------------------------------------------------------------------------------- plain Python, evaluated when a kernel is compiled


def map_period_s(mapping, sonar, episode):
    """[s] between two mapped scans: the first multiple of the sonar's period that is no shorter than the map's own."""
    return sonar.period_steps * math.ceil(mapping.period_steps / sonar.period_steps) * episode.control_dt_s


def depth_period_s(mapping, sonar, depth, episode):
    """[s] between two mapped scans that can carry depth evidence."""
    return max(map_period_s(mapping, sonar, episode), depth.period_steps * episode.control_dt_s)


def per_scan(gain, period_s):
    """Gain per scan that keeps the gain per second of ``gain`` at 10 Hz; at most 1."""
    return min(1.0, gain * period_s * RATED_HZ)


def decay_per_scan(decay, period_s):
    """Decay per scan that forgets as much per second as ``decay`` does at 10 Hz."""
    return 1.0 - (1.0 - decay) ** (period_s * RATED_HZ)


def scans_in(seconds, period_s):
    """Scans that span ``seconds``, at least 1. Raises ValueError where the map's counters could not hold them."""
    count = max(1, math.ceil(seconds / period_s - 1e-6))
    if count > COUNTER_MAX:
        raise ValueError(
            f"mapping: {seconds} s are {count} mapped scans, but the counters end at {COUNTER_MAX}: raise mapping.period_steps"
        )
    return count


# ------------------------------------------------------------------------------------------------------------------------ merge


@ti.func
def is_due(env, scan: In[SonarScan], clock: In[ClockState], grid_map: In[MapState], mapping: Const[MappingConfig]):
    """1 where a scan arrived that is to be mapped."""
    due = clock.awake[env] == 1 and scan.fresh[env] == 1 and clock.step[env] - grid_map.map_step[env] >= mapping.period_steps
    return ti.cast(due, ti.i32)


@ti.func
def clipped(value):
    """Occupancy clipped to [0, 1]; what has all but decayed is 0."""
    return ti.select(value < VANISHED, 0.0, ti.min(value, 1.0))


@ti.func
def merge_cell(env, row, col, step, grid_map: Out[MapState], mapping: Const[MappingConfig], scan_s: Const[float], depth_s: Const[float]):
    """Both equations and the counters for one cell; the scan's marks are used up."""
    bits = ti.cast(grid_map.evidence[env, row, col], ti.i32)
    static_old, dynamic_old = grid_map.static_occ[env, row, col], grid_map.dynamic_occ[env, row, col]
    static_hit, dynamic_hit = bits & STATIC_HIT != 0, bits & DYNAMIC_HIT != 0
    hit = static_hit or dynamic_hit
    free = grid_map.seen_step[env, row, col] == step and not hit
    supported = static_hit or static_old > 0.0
    depth_hit = bits & DEPTH_HIT != 0 and supported and not dynamic_hit and not free and dynamic_old < mapping.occupied
    grid_map.static_occ[env, row, col] = clipped(
        ti.static(1.0 - decay_per_scan(mapping.static_decay, scan_s)) * static_old
        + ti.static(per_scan(mapping.static_hit, scan_s)) * static_hit
        - ti.static(per_scan(mapping.static_free, scan_s)) * free
        + ti.static(per_scan(mapping.depth_hit, depth_s)) * depth_hit
    )
    grid_map.dynamic_occ[env, row, col] = clipped(
        ti.static(1.0 - decay_per_scan(mapping.dynamic_decay, scan_s)) * dynamic_old
        + ti.static(per_scan(mapping.dynamic_hit, scan_s)) * dynamic_hit
        - ti.static(per_scan(mapping.dynamic_free, scan_s)) * free
    )
    if hit:
        grid_map.free_scans[env, row, col] = ti.u8(0)
    if dynamic_hit:
        raised = ti.min(ti.cast(grid_map.dynamic_scans[env, row, col], ti.i32) + 1, COUNTER_MAX)
        grid_map.dynamic_scans[env, row, col] = ti.cast(raised, ti.u8)
    if free:
        raised = ti.min(ti.cast(grid_map.free_scans[env, row, col], ti.i32) + 1, COUNTER_MAX)
        grid_map.free_scans[env, row, col] = ti.cast(raised, ti.u8)
        grid_map.dynamic_scans[env, row, col] = ti.u8(0)
    if bits != 0:
        grid_map.seen_step[env, row, col] = ti.cast(step, ti.i16)
        grid_map.evidence[env, row, col] = ti.u8(0)


@ti.func
def merge_quiet_cells(env, row, first_col, step, grid_map: Out[MapState], mapping: Const[MappingConfig], scan_s: Const[float]):
    """``merge_cell`` for sixteen cells without returns, points or dynamic evidence: decay, free water and its counter remain."""
    seen, free_scans = i16x(0), i16x(0)
    static_old, dynamic_old = f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        seen[i] = ti.cast(grid_map.seen_step[env, row, first_col + i], ti.i32)
        free_scans[i] = ti.cast(grid_map.free_scans[env, row, first_col + i], ti.i32)
        static_old[i] = grid_map.static_occ[env, row, first_col + i]
        dynamic_old[i] = grid_map.dynamic_occ[env, row, first_col + i]
    free = f16x(0.0)
    for i in ti.static(range(LANES)):
        free[i] = ti.select(seen[i] == step, 1.0, 0.0)
    static_new = ti.static(1.0 - decay_per_scan(mapping.static_decay, scan_s)) * static_old
    static_freed = static_new - ti.static(per_scan(mapping.static_free, scan_s)) * free
    dynamic_new = ti.static(1.0 - decay_per_scan(mapping.dynamic_decay, scan_s)) * dynamic_old
    dynamic_freed = dynamic_new - ti.static(per_scan(mapping.dynamic_free, scan_s)) * free
    for i in ti.static(range(LANES)):
        grid_map.static_occ[env, row, first_col + i] = clipped(static_freed[i])
    for i in ti.static(range(LANES)):
        grid_map.dynamic_occ[env, row, first_col + i] = clipped(dynamic_freed[i])
    for i in ti.static(range(LANES)):
        raised = ti.min(free_scans[i] + ti.cast(free[i], ti.i32), COUNTER_MAX)
        grid_map.free_scans[env, row, first_col + i] = ti.cast(raised, ti.u8)


@ti.func
def is_busy(env, row, first_col, grid_map: In[MapState]):
    """Non-zero where one of sixteen cells has evidence bits or is held by dynamic evidence."""
    busy = ti.u8(0)
    for i in ti.static(range(LANES)):
        busy |= grid_map.evidence[env, row, first_col + i] | grid_map.dynamic_scans[env, row, first_col + i]
    return busy


@ti.func
def merge_row(env, row, step, grid_map: Out[MapState], mapping: Const[MappingConfig], scan_s: Const[float], depth_s: Const[float]):
    """One row of the grid, sixteen cells at a time."""
    for packet in range(ti.static(grid_map.evidence.shape[2] // LANES)):
        if is_busy(env, row, packet * LANES, grid_map) != 0:
            for col in range(packet * LANES, (packet + 1) * LANES):
                merge_cell(env, row, col, step, grid_map, mapping, scan_s, depth_s)
        else:
            merge_quiet_cells(env, row, packet * LANES, step, grid_map, mapping, scan_s)


# ---------------------------------------------------------------------------------------------------------------------- kernels


@ti.kernel
def update_map(
    grid_map: Out[MapState],
    scan: In[SonarScan],
    image: In[DepthImage],
    tracks: In[TrackState],
    mask: In[GridMask],
    clock: In[ClockState],
    mapping: Const[MappingConfig],
    sonar: Const[SonarConfig],
    depth: Const[DepthConfig],
    tank: Const[TankConfig],
    episode: Const[EpisodeConfig],
):
    """Take a fresh image's points and fold a fresh scan that is due into both layers; else the map stays as it is."""
    n_env, n_row, _ = ti.static(grid_map.static_occ.shape)
    scan_s = ti.static(map_period_s(mapping, sonar, episode))
    depth_s = ti.static(depth_period_s(mapping, sonar, depth, episode))
    confident, promote = ti.static(scans_in(mapping.free_confident_s, scan_s), scans_in(mapping.promote_s, scan_s))
    for env, group in ti.ndrange(n_env, ti.static(scan.range_m.shape[1] // LANES)):
        if is_due(env, scan, clock, grid_map, mapping) == 1:
            mark_free_beams(env, group, clock.step[env], grid_map, scan, mapping, sonar, tank)
    # bits are or-ed into a byte, so one thread has all of an env's returns and image points
    for env, pad in ti.ndrange(n_env, ti.static(spread(n_env))):
        if pad == 0 and clock.awake[env] == 1:
            if image.fresh[env] == 1:
                mark_depth(env, grid_map, image, mask, mapping, depth, tank)
            if is_due(env, scan, clock, grid_map, mapping) == 1:
                mark_hits(env, grid_map, scan, tracks, mask, mapping, sonar, tank, confident, promote)
                grid_map.map_step[env] = clock.step[env]
    for env, row in ti.ndrange(n_env, n_row):
        if clock.awake[env] == 1 and scan.fresh[env] == 1 and grid_map.map_step[env] == clock.step[env]:
            merge_row(env, row, clock.step[env], grid_map, mapping, scan_s, depth_s)


@ti.kernel
def reset_map(grid_map: Out[MapState], clock: In[ClockState]):
    """An empty map: nothing occupied, nothing seen."""
    n_env, n_row, n_col = ti.static(grid_map.static_occ.shape)
    for env, row in ti.ndrange(n_env, n_row):
        if clock.awake[env] == 1:
            grid_map.map_step[env] = _NO_SCAN
            for col in range(n_col):
                grid_map.static_occ[env, row, col] = 0.0
                grid_map.dynamic_occ[env, row, col] = 0.0
                grid_map.evidence[env, row, col] = ti.u8(0)
                grid_map.seen_step[env, row, col] = ti.i16(-1)
                grid_map.free_scans[env, row, col] = ti.u8(0)
                grid_map.dynamic_scans[env, row, col] = ti.u8(0)
