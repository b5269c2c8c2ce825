"""Two-layer occupancy map from sonar and depth: M^s (what stays) and M^d (what moves), fused by max.

One scan becomes binary indicators per cell (``sensor_model.py``), then the paper's two equations
apply:

    M^s = clip((1 - lambda_s) M^s + eta_occ I^s-hit - eta_free I^free + eta_depth I^depth, 0, 1)
    M^d = clip((1 - lambda_d) M^d + eta_dyn I^d-hit - eta_dyn,free I^free, 0, 1)

A return of either kind cancels I^free in its cell. What moves is told from observations only: compensated
Doppler, a moving track, or a return where the map was confident of free water; it feeds M^d alone. An
obstacle that stops is promoted after ``promote_s``: without newer evidence of motion its returns then count
as static ones, and M^d decays.

I^depth is "depth-gated consistency": a camera point at the vehicle's own depth counts where the sonar
supports it (the cell is not free of static occupancy, or has a static return in this scan) and does not
contradict it (no beam passed through), and where nothing moves (no dynamic return, M^d below the threshold):
the camera alone cannot tell a passing body from a standing one.

Nearly all of a map is water where both layers are 0 and stay so. Indicators and facts about cells are bits
therefore, sixty-four cells a word; counters of free water are numbers written vertically (bit k of sixty-four
counters is a word), and the equations run over the few cells that have a return, a point, or a layer that is
not 0.
"""

import math

import taichi as ti

from uuvtai.common.enums import FULL
from uuvtai.compile.launch import quick_launch, with_cse
from uuvtai.kernels.core.grid import occupancy_of
from uuvtai.kernels.core.simd import WORD, bit_of, lowest_bit, n_item, n_turn, taken, with_bit, without_lowest
from uuvtai.kernels.core.stage import Bundle, Const, fetch, loop_end, shares
from uuvtai.kernels.perception.io import MappingIO
from uuvtai.kernels.perception.sensor_model import mark_depth, mark_scan

RATED_HZ = 10.0
"""Scan rate for which the gains of MappingConfig are given."""

COUNTER_MAX = 255
_LINE, _ROWS_AHEAD = 16, 8
"""Cells of both layers in a line of memory; rows of words that memory is asked for before they are needed."""
_NO_SCAN = -(1 << 20)


# ---------------------------------------------------------- plain Python, evaluated when a kernel is compiled


def map_period_s(mapping, sonar, episode):
    """[s] between two mapped scans: the first multiple of the sonar's period that is no shorter than the
    map's own; with a mechanical beam every beam is mapped."""
    if sonar.mechanical:
        return max(sonar.step_us / 1e6, episode.control_dt_s)
    return sonar.period_steps * math.ceil(mapping.period_steps / sonar.period_steps) * episode.control_dt_s


def look_period_s(mapping, sonar, episode):
    """[s] between two mapped looks at the same water: a mechanical beam has to come round again."""
    return max(map_period_s(mapping, sonar, episode), sonar.sweep_s)


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
    """Scans that span ``seconds``, at least 1. Raises ValueError where the map's counters could not hold
    them."""
    count = max(1, math.ceil(seconds / period_s - 1e-6))
    if count > COUNTER_MAX:
        raise ValueError(
            f"mapping: {seconds} s are {count} mapped scans, but the counters end at {COUNTER_MAX}: raise "
            "mapping.period_steps"
        )
    return count


# ------------------------------------------------------------------------------------------------------ merge


@ti.func
def is_due(env, io: Bundle[MappingIO]):
    """1 where a scan arrived that is to be mapped."""
    due = (
        io.clock.active[env] == 1
        and io.scan.fresh[env] == 1
        and io.clock.step[env] - io.grid_map.map_step[env]
        >= ti.static(1 if io.sonar_cfg.mechanical else io.mapping_cfg.period_steps)
    )
    return ti.cast(due, ti.i32)


@ti.func
def kept(value):
    """Occupancy clipped to [0, 1], as a layer keeps it: rounded down, so that decay ends."""
    return ti.cast(ti.math.clamp(value, 0.0, 1.0) * FULL, ti.u16)


@ti.func
def count_free(env, row, word, free, returned, confident_scans: Const[int], io: Bundle[MappingIO]):
    """Counters of free water: one more where a cell is free and not yet confident, 0 where it has a
    return."""
    sure = io.grid_map.confident[env, row, word]
    more = free & ~sure
    reset = returned & io.grid_map.seen[env, row, word]
    if more | reset != 0:
        old = io.grid_map.free_scans[env, row, word]
        new, full = old, more
        for k in ti.static(range(confident_scans.bit_length())):
            new[k] = (old[k] ^ more) & ~returned
            more &= old[k]
            full &= new[k] if ti.static(confident_scans >> k & 1) else ~new[k]
        io.grid_map.free_scans[env, row, word] = new
        io.grid_map.confident[env, row, word] = (sure & ~returned) | full


@ti.func
def count_dynamic(env, row, word, free, dynamics, io: Bundle[MappingIO]):
    """Counters of dynamic evidence: one more where there is some, 0 where the cell is free."""
    held = io.grid_map.held[env, row, word]
    gone = free & held
    if gone | dynamics != 0:
        io.grid_map.held[env, row, word] = (held & ~gone) | dynamics
        while gone != 0:
            io.grid_map.dynamic_scans[env, row, word * WORD + lowest_bit(gone)] = ti.u8(0)
            gone = without_lowest(gone)
        more = dynamics
        while more != 0:
            col = word * WORD + lowest_bit(more)
            raised = ti.min(ti.cast(io.grid_map.dynamic_scans[env, row, col], ti.i32) + 1, COUNTER_MAX)
            io.grid_map.dynamic_scans[env, row, col] = ti.cast(raised, ti.u8)
            more = without_lowest(more)


@ti.func
def folded(static_old, dynamic_old, static_hit, dynamic_hit, free, point, io: Bundle[MappingIO]):
    """Both equations for one cell, as the layers keep it; indicators are 0 or 1."""
    scan_s = ti.static(map_period_s(io.mapping_cfg, io.sonar_cfg, io.episode_cfg))
    look_s = ti.static(look_period_s(io.mapping_cfg, io.sonar_cfg, io.episode_cfg))
    depth_s = ti.static(depth_period_s(io.mapping_cfg, io.sonar_cfg, io.depth_cfg, io.episode_cfg))
    supported = (static_hit == 1) | (static_old > 0.0)
    depth_hit = ti.select(
        supported & (dynamic_old < io.mapping_cfg.occupied), point & ~dynamic_hit & ~free, 0
    )
    static_new = kept(
        ti.static(1.0 - decay_per_scan(io.mapping_cfg.static_decay, scan_s)) * static_old
        + ti.static(per_scan(io.mapping_cfg.static_hit, look_s)) * static_hit
        - ti.static(per_scan(io.mapping_cfg.static_free, look_s)) * free
        + ti.static(per_scan(io.mapping_cfg.depth_hit, depth_s)) * depth_hit
    )
    dynamic_new = kept(
        ti.static(1.0 - decay_per_scan(io.mapping_cfg.dynamic_decay, scan_s)) * dynamic_old
        + ti.static(per_scan(io.mapping_cfg.dynamic_hit, look_s)) * dynamic_hit
        - ti.static(per_scan(io.mapping_cfg.dynamic_free, look_s)) * free
    )
    return static_new, dynamic_new


@ti.func
def fold_cells(env, row, word, statics, dynamics, free, points, io: Bundle[MappingIO]):
    """Both equations for the cells of a word that have anything to fold, and what is then true of them."""
    alive = io.grid_map.alive[env, row, word]
    left = alive | statics | dynamics | points
    if left != 0:
        static_occupied = io.grid_map.static_occupied[env, row, word]
        dynamic_occupied = io.grid_map.dynamic_occupied[env, row, word]
        while left != 0:
            i = lowest_bit(left)
            left = without_lowest(left)
            col = word * WORD + i
            static, dynamic = folded(
                occupancy_of(io.grid_map.static_occ[env, row, col]),
                occupancy_of(io.grid_map.dynamic_occ[env, row, col]),
                bit_of(statics, i),
                bit_of(dynamics, i),
                bit_of(free, i),
                bit_of(points, i),
                io,
            )
            io.grid_map.static_occ[env, row, col] = static
            io.grid_map.dynamic_occ[env, row, col] = dynamic
            alive = with_bit(alive, i, (static | dynamic) != 0)
            static_occupied = with_bit(static_occupied, i, occupancy_of(static) >= io.mapping_cfg.occupied)
            dynamic_occupied = with_bit(dynamic_occupied, i, occupancy_of(dynamic) >= io.mapping_cfg.occupied)
        io.grid_map.alive[env, row, word] = alive
        io.grid_map.static_occupied[env, row, word] = static_occupied
        io.grid_map.dynamic_occupied[env, row, word] = dynamic_occupied


@ti.func
def fetch_word(env, row, word, io: Bundle[MappingIO]):
    """Ask memory for what a merge will touch of a word's cells, as far as the word tells."""
    fetch(io.grid_map.alive[env, ti.min(row + _ROWS_AHEAD, ti.static(io.grid_map.alive.shape[1] - 1)), word])
    left = io.grid_map.alive[env, row, word]
    while left != 0:
        i = lowest_bit(left)
        fetch(io.grid_map.static_occ[env, row, word * WORD + i])
        left &= ~(ti.cast(ti.static((1 << _LINE) - 1), ti.u64) << ti.cast(i // _LINE * _LINE, ti.u64))
    if io.grid_map.seen[env, row, word] & ~io.grid_map.confident[env, row, word] != 0:
        fetch(io.grid_map.free_scans[env, row, word][0])
    if io.grid_map.held[env, row, word] != 0:
        fetch(io.grid_map.dynamic_scans[env, row, word * WORD])


@ti.func
def merge_scan(env, slot, confident_scans: Const[int], io: Bundle[MappingIO]):
    """Fold everything marked in the slot's scratch into an env's map, word by word; the marks are used up.

    Each strip of sixty-four columns goes upwards: an odd number of the fan's edges below means inside. Most
    words are water where nothing is new. Meanwhile memory gets the next env ready.
    """
    waits, after = io.grid_map.depth_waits[env], ti.min(env + 1, ti.static(io.clock.active.shape[0] - 1))
    for word in range(ti.static(io.map_scratch.fan_edge.shape[2])):
        in_fan = ti.cast(0, ti.u64)
        for row in range(ti.static(io.map_scratch.fan_edge.shape[1])):
            fetch_word(after, row, word, io)
            edge = io.map_scratch.fan_edge[slot, row, word]
            in_fan ^= edge
            news = in_fan & ~io.mask.outside_bits[row, word]
            news &= io.grid_map.held[env, row, word] | ~io.grid_map.confident[env, row, word]
            news |= io.grid_map.alive[env, row, word] | edge
            news |= io.map_scratch.static_hit[slot, row, word] | io.map_scratch.dynamic_hit[slot, row, word]
            if waits == 1:
                news |= io.grid_map.depth_hit[env, row, word]
            if news != 0:
                io.map_scratch.fan_edge[slot, row, word] = ti.cast(0, ti.u64)
                merge_word(env, slot, row, word, in_fan, waits, confident_scans, io)
    io.grid_map.depth_waits[env] = 0


@ti.func
def merge_word(env, slot, row, word, in_fan, waits, confident_scans: Const[int], io: Bundle[MappingIO]):
    """Fold what is marked of a word's cells; ``in_fan``: those within the fan of free water; ``waits``: 1
    where points of the camera wait."""
    inside, points = ~io.mask.outside_bits[row, word], ti.cast(0, ti.u64)
    if waits == 1:
        points = taken(io.grid_map.depth_hit, env, row, word) & inside
    statics, dynamics = (
        taken(io.map_scratch.static_hit, slot, row, word) & inside,
        taken(io.map_scratch.dynamic_hit, slot, row, word) & inside,
    )
    free = in_fan & inside & ~(statics | dynamics)
    count_free(env, row, word, free, statics | dynamics, confident_scans, io)
    count_dynamic(env, row, word, free, dynamics, io)
    fold_cells(env, row, word, statics, dynamics, free, points, io)
    seen = io.grid_map.seen[env, row, word]
    if (free | statics | dynamics | points) & ~seen != 0:
        io.grid_map.seen[env, row, word] = seen | free | statics | dynamics | points


@ti.func
def take_alone(env, slot, confident_scans: Const[int], promote_scans: Const[int], io: Bundle[MappingIO]):
    """One env's turn, by one thread: a fresh image's points and a fresh scan that is due."""
    if io.clock.active[env] == 1 and io.image.fresh[env] == 1:
        mark_depth(env, 0, io)
        io.grid_map.depth_waits[env] = 1
    if is_due(env, io) == 1:
        mark_scan(env, slot, 0, promote_scans, io)
        merge_scan(env, slot, confident_scans, io)
        io.grid_map.map_step[env] = io.clock.step[env]


# ---------------------------------------------------------------------------- an env's items on a GPU


@ti.func
def mark_together(env, item, promote_scans: Const[int], io: Bundle[MappingIO]):
    """What an item marks of an env's image and scan; on a GPU an env has its own slot."""
    if io.clock.active[env] == 1 and io.image.fresh[env] == 1:
        mark_depth(env, item, io)
        if item == 0:
            io.grid_map.depth_waits[env] = 1
    due = is_due(env, io)
    if item == 0:
        io.map_scratch.due[env] = due * (1 + io.grid_map.depth_waits[env])
    if due == 1:
        mark_scan(env, env, item, promote_scans, io)


@ti.func
def fill_fan(env, word, io: Bundle[MappingIO]):
    """Edges of the fan in a column of words become the cells within it, upwards. Who has the first column
    notes that the scan is in the map: all others go by ``due`` from here on."""
    in_fan = ti.cast(0, ti.u64)
    for row in range(ti.static(io.map_scratch.fan_edge.shape[1])):
        in_fan ^= io.map_scratch.fan_edge[env, row, word]
        io.map_scratch.fan_edge[env, row, word] = in_fan
    if word == 0:
        io.grid_map.depth_waits[env] = 0
        io.grid_map.map_step[env] = io.clock.step[env]


@ti.func
def merge_together(env, item, confident_scans: Const[int], io: Bundle[MappingIO]):
    """``merge_scan`` of an item's share of an env's words."""
    n_row, n_word = ti.static(io.map_scratch.fan_edge.shape[1:])
    for turn in range(ti.static(n_turn(n_row * n_word))):
        place = turn * ti.static(n_item()) + item
        row, word = place // n_word, place % n_word
        if row < n_row:
            in_fan = taken(io.map_scratch.fan_edge, env, row, word)
            merge_word(env, env, row, word, in_fan, io.map_scratch.due[env] - 1, confident_scans, io)


# ---------------------------------------------------------------------------------------------------- kernels


@quick_launch
@ti.kernel
def update_map(io: Bundle[MappingIO]):
    """Take a fresh image's points and fold a fresh scan that is due into both layers; else the map stays as
    it is."""
    n_env, n_slot = ti.static(io.clock.active.shape[0], io.map_scratch.fan_edge.shape[0])
    look_s = ti.static(look_period_s(io.mapping_cfg, io.sonar_cfg, io.episode_cfg))
    confident, promote = ti.static(
        scans_in(io.mapping_cfg.free_confident_s, look_s), scans_in(io.mapping_cfg.promote_s, look_s)
    )
    if ti.static(n_item() > 1):  # each loop ends before the next begins
        for env, item in ti.ndrange(loop_end(n_env, io.clock), ti.static(n_item())):
            mark_together(env, item, promote, io)
        for env, word in ti.ndrange(loop_end(n_env, io.clock), ti.static(io.map_scratch.fan_edge.shape[2])):
            if io.map_scratch.due[env] != 0:
                fill_fan(env, word, io)
        for env, item in ti.ndrange(loop_end(n_env, io.clock), ti.static(n_item())):
            if io.map_scratch.due[env] != 0:
                merge_together(env, item, confident, io)
    else:  # one thread has all of an env's bits, and does all of it while its scratch is in the cache
        for slot in range(loop_end(n_slot, io.clock)):
            for env in range(slot * n_env // n_slot, (slot + 1) * n_env // n_slot):
                take_alone(env, slot, confident, promote, io)


@quick_launch
@with_cse()
@ti.kernel
def reset_map(io: Bundle[MappingIO]):
    """An empty map: nothing occupied, nothing seen."""
    n_env, n_row, n_col = ti.static(io.grid_map.static_occ.shape)
    n_share = ti.static(shares(n_row))
    for env, share in ti.ndrange(loop_end(n_env, io.clock), n_share):
        if io.clock.active[env] == 1:
            io.grid_map.map_step[env] = _NO_SCAN
            io.grid_map.depth_waits[env] = 0
            for row in range(share * n_row // n_share, (share + 1) * n_row // n_share):
                for col in range(n_col):
                    io.grid_map.static_occ[env, row, col] = ti.u16(0)
                    io.grid_map.dynamic_occ[env, row, col] = ti.u16(0)
                    io.grid_map.dynamic_scans[env, row, col] = ti.u8(0)
                for word in range(ti.static(io.grid_map.seen.shape[2])):
                    io.grid_map.free_scans[env, row, word] = ti.Vector.zero(
                        ti.u64, ti.static(io.grid_map.free_scans.n)
                    )
                    for words in ti.static((io.grid_map.confident, io.grid_map.held, io.grid_map.alive)):
                        words[env, row, word] = ti.cast(0, ti.u64)
                    for words in ti.static((io.grid_map.seen, io.grid_map.depth_hit)):
                        words[env, row, word] = ti.cast(0, ti.u64)
                    for words in ti.static((io.grid_map.static_occupied, io.grid_map.dynamic_occupied)):
                        words[env, row, word] = ti.cast(0, ti.u64)
