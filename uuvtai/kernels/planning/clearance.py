"""Clearance delta = min(d_occ, d_bnd): exact Euclidean distance transform, truncated at ``max_m``, with the
nearest site of every cell.

Sites are the occupied cells and the cells outside the tank, so one transform gives the minimum of both
distances. Two passes (the separation of Felzenszwalb and Huttenlocher): the nearest site within each row,
then the best row of each cell's window, sixteen columns at a time (rows are the short way across the tank,
and packets of one column range stay aligned). Both carry one integer key per cell that orders candidates by
distance and holds the site, so that taking the smallest key settles everything:

    key = (2 * d^2 + right) << bits | row offset + reach      [cells]; right = 1 where the site's column is
    the larger one

Equally near sites: one to the left (or straight above or below) wins over one to the right, then the one in
the lower row.

Most of the water is far from everything, and little changes from one map to the next. So packets without a
site in reach of their row cost nothing in the second pass (``near_up``, ``near_down``: a bit a row), and of a
map that changed only those packets are redone that a new or a vanished site can concern: those it lies no
farther from than the farthest of their own sites. The result is the same.

``inflate_m`` shortens the distance to a nearest site that is an obstacle. Where the boundary is nearest it
alone counts, though a little beyond it, by less than ``inflate_m``, an inflated obstacle may be nearer.
"""

import math

import taichi as ti

from uuvtai.common.enums import NO_SITE
from uuvtai.compile.launch import quick_launch, with_cse
from uuvtai.kernels.core.simd import (
    LANES,
    WORD,
    cell_bit,
    highest_bit,
    i16x,
    lowest_bit,
    n_item,
    put_bit,
    without_lowest,
)
from uuvtai.kernels.core.stage import Bundle, Const, In, loop_end
from uuvtai.kernels.planning.clearance_gpu import (
    find_changes,
    is_due,
    no_site,
    note_farthest,
    note_obstacle,
    offset_bits,
    redo_cells,
    site_word,
    squared_limit,
    window_reach,
)
from uuvtai.kernels.planning.io import ClearanceIO

_FAR_COLS = 1 << 12
"""[cells] stands for "no site in this row"; its square fits an int32."""

_MAX_CHANGES = 48
"""Sites that may change before redoing everything is cheaper than finding what they concern."""


# ------------------------------------------------------------------------------------------------------ sites


@ti.func
def take_sites(env, slot, limit: Const[int], io: Bundle[ClearanceIO]):
    """Read the sites, and mark the packets that those which changed may concern; how many changed."""
    n_row, n_word = ti.static(io.clearance_memory.sites.shape[1:])
    known = io.clearance_memory.limit[env] == limit
    changed = ti.select(known, 0, _MAX_CHANGES + 1)
    for row in range(n_row):
        for word in range(n_word):
            sites = site_word(env, row, word, io)
            different = sites ^ io.clearance_memory.sites[env, row, word]
            if different != 0:
                io.clearance_memory.sites[env, row, word] = sites
                while different != 0 and changed <= _MAX_CHANGES:
                    mark_stale(env, slot, row, word * WORD + lowest_bit(different), limit, io)
                    different = without_lowest(different)
                    changed += 1
    io.clearance_memory.limit[env] = limit
    return changed


@ti.func
def mark_stale(env, slot, site_row, site_col, limit: Const[int], io: Bundle[ClearanceIO]):
    """Mark the packets that a changed site may concern: it lies no farther from them than the farthest of
    their sites."""
    n_row, n_packet = ti.static(io.clearance_memory.farthest.shape[1:])
    reach = ti.static(math.isqrt(limit))
    for packet in range(
        ti.max(site_col - reach, 0) // LANES, ti.min((site_col + reach) // LANES, n_packet - 1) + 1
    ):
        cols = ti.max(packet * LANES - site_col, site_col - packet * LANES - (LANES - 1), 0)
        for row in range(ti.max(site_row - reach, 0), ti.min(site_row + reach + 1, n_row)):
            if (row - site_row) ** 2 + cols * cols <= io.clearance_memory.farthest[env, row, packet]:
                put_bit(io.clearance_memory.stale, slot, packet, row)


# ----------------------------------------------------------------------------------------------------- passes


@ti.func
def next_site(env, row, first_col, io: Bundle[ClearanceIO]):
    """Column of the first site from a column on, far away if there is none."""
    n_word = ti.static(io.clearance_memory.sites.shape[2])
    word = first_col // WORD
    found = ti.cast(0, ti.u64)
    if word < n_word:
        found = io.clearance_memory.sites[env, row, word] & (
            ~ti.cast(0, ti.u64) << ti.cast(first_col % WORD, ti.u64)
        )
    while found == 0 and word + 1 < n_word:
        word += 1
        found = io.clearance_memory.sites[env, row, word]
    return ti.select(found != 0, word * WORD + lowest_bit(found), _FAR_COLS)


@ti.func
def site_before(env, row, col, io: Bundle[ClearanceIO]):
    """Column of the last site before a column, far away if there is none."""
    word = col // WORD
    found = io.clearance_memory.sites[env, row, word] & (cell_bit(col) - ti.cast(1, ti.u64))
    while found == 0 and word > 0:
        word -= 1
        found = io.clearance_memory.sites[env, row, word]
    return ti.select(found != 0, word * WORD + highest_bit(found), -_FAR_COLS)


@ti.func
def row_keys(sites, left_gap, right_gap, io: Bundle[ClearanceIO]):
    """Keys of the nearest site in the same row for sixteen cells; gaps [cells] lie between their ends and the
    sites beyond."""
    reach, bits = ti.static(
        window_reach(io.clearance_cfg, io.mapping_cfg), offset_bits(io.clearance_cfg, io.mapping_cfg)
    )
    to_left, to_right = i16x(0), i16x(0)
    if sites == 0:
        for i in ti.static(range(LANES)):
            to_left[i], to_right[i] = left_gap + i, right_gap + (LANES - 1 - i)
    else:
        left, right = left_gap - 1, right_gap - 1
        for i in ti.static(range(LANES)):
            left = ti.select((sites >> i) & 1 == 1, 0, left + 1)
            to_left[i] = left
        for back in ti.static(range(LANES)):
            right = ti.select((sites >> (LANES - 1 - back)) & 1 == 1, 0, right + 1)
            to_right[LANES - 1 - back] = right
    keys = i16x(0)
    for i in ti.static(range(LANES)):
        gap = ti.min(to_left[i], to_right[i])
        key = ((2 * gap * gap + ti.cast(to_right[i] < to_left[i], ti.i32)) << bits) + reach
        keys[i] = ti.select(gap <= reach, key, ti.static(no_site(io.clearance_cfg, io.mapping_cfg)))
    return keys


@ti.func
def scan_packet(env, slot, row, packet, io: Bundle[ClearanceIO]):
    """Keys of the nearest site in the same row for sixteen cells, and whether one is in reach."""
    n_row, first = ti.static(io.clearance_memory.farthest.shape[1]), packet * LANES
    sites = ti.cast(
        (io.clearance_memory.sites[env, row, first // WORD] >> ti.cast(first % WORD, ti.u64))
        & ti.cast(0xFFFF, ti.u64),
        ti.i32,
    )
    left_gap = first - site_before(env, row, first, io)
    right_gap = next_site(env, row, first + LANES, io) - (first + LANES - 1)
    near = ti.min(left_gap, right_gap) <= ti.static(window_reach(io.clearance_cfg, io.mapping_cfg))
    if sites != 0 or near:
        io.clearance_memory.row_key[slot, row, packet] = row_keys(sites, left_gap, right_gap, io)
        put_bit(io.clearance_memory.near_up, slot, packet, row)
        put_bit(io.clearance_memory.near_down, slot, packet, n_row - 1 - row)
    else:
        io.clearance_memory.row_key[slot, row, packet] = i16x(
            ti.static(no_site(io.clearance_cfg, io.mapping_cfg))
        )


@ti.func
def stale_rows(slot, packet, changed, io: Bundle[ClearanceIO]):
    """(first, last) row of a packet that is to be redone; first > last where none is."""
    n_row = ti.static(io.clearance_memory.farthest.shape[1])
    first, last = n_row, -1
    for word in range(ti.static(io.clearance_memory.stale.shape[2])):
        rows = io.clearance_memory.stale[slot, packet, word]
        if rows != 0:
            first, last = ti.min(first, word * WORD + lowest_bit(rows)), word * WORD + highest_bit(rows)
    if changed > _MAX_CHANGES:
        first, last = 0, n_row - 1
    return first, last


@ti.func
def bits_from(words: In[ti.Field], slot, packet, first):
    """Sixty-four bits of a row of words, from one on."""
    n_word = ti.static(words.shape[2])
    word, shift = first // WORD, ti.cast(first % WORD, ti.u64)
    found = words[slot, packet, word] >> shift
    if word + 1 < n_word and shift > 0:
        found |= words[slot, packet, word + 1] << (ti.cast(WORD, ti.u64) - shift)
    return found


@ti.func
def keys_at(slot, row, packet, offset, io: Bundle[ClearanceIO]):
    """Keys of the rows ``offset`` below and above; beyond the grid its last row stands in, taken for farther
    than it is."""
    last = ti.static(io.clearance_memory.farthest.shape[1] - 1)
    farther = 2 * offset * offset << ti.static(offset_bits(io.clearance_cfg, io.mapping_cfg))
    below = io.clearance_memory.row_key[slot, ti.max(row - offset, 0), packet] + (farther - offset)
    above = io.clearance_memory.row_key[slot, ti.min(row + offset, last), packet] + (farther + offset)
    return below, above


@ti.func
def best_keys(slot, row, packet, io: Bundle[ClearanceIO]):
    """Smallest keys over the rows with a site, nearest first; it ends where no farther row can be better for
    any of the sixteen cells."""
    n_row = ti.static(io.clearance_memory.farthest.shape[1])
    reach, bits = ti.static(
        window_reach(io.clearance_cfg, io.mapping_cfg), offset_bits(io.clearance_cfg, io.mapping_cfg)
    )
    # d^2 = min over rows k of gap_k^2 + (k - row)^2 (Felzenszwalb and Huttenlocher 2012, Theory of Computing
    # 8), in keys: row_key[k] plus 2 (k - row)^2, shifted. Rows are taken by growing |k - row|. No key is
    # negative, so once that term alone exceeds the worst of the sixteen, no farther row can win.
    offsets = bits_from(io.clearance_memory.near_up, slot, packet, row) | bits_from(
        io.clearance_memory.near_down, slot, packet, n_row - 1 - row
    )
    offsets &= (ti.cast(2, ti.u64) << ti.cast(reach, ti.u64)) - ti.cast(2, ti.u64)
    best = io.clearance_memory.row_key[slot, row, packet]
    worst = best.max()
    while offsets != 0:
        offset = lowest_bit(offsets)
        offsets = without_lowest(offsets)
        if 2 * offset * offset << bits > worst:
            offsets = ti.cast(0, ti.u64)
        else:
            below, above = keys_at(slot, row, packet, offset, io)
            for i in ti.static(range(LANES)):
                best[i] = ti.min(best[i], below[i], above[i])
            worst = best.max()
    return best, worst


@ti.func
def write_packet(env, slot, row, packet, io: Bundle[ClearanceIO]):
    """Sites of sixteen cells, decoded from their keys."""
    reach, bits, limit = ti.static(
        window_reach(io.clearance_cfg, io.mapping_cfg),
        offset_bits(io.clearance_cfg, io.mapping_cfg),
        squared_limit(io.clearance_cfg, io.mapping_cfg),
    )
    key, worst = best_keys(slot, row, packet, io)
    io.clearance_memory.farthest[env, row, packet] = worst >> (bits + 1)
    # d^2 = rows^2 + cols^2 gives the site's column back; the bit below d^2 says on which side it lies
    squared = key >> (bits + 1)
    rows = (key & ti.static((1 << bits) - 1)) - reach
    cols = ti.cast(ti.sqrt(ti.cast(squared - rows * rows, ti.f32)), ti.i32)
    signed_cols = cols * (2 * ((key >> bits) & 1) - 1)
    site = (rows << 8) | ((signed_cols & 127) << 1)
    for i in ti.static(range(LANES)):
        io.clearance.site[env, row, packet * LANES + i] = ti.cast(
            ti.select(squared[i] <= limit, site[i], NO_SITE), ti.i16
        )
    if ti.static(io.clearance_cfg.inflate_m > 0):
        for col in range(packet * LANES, (packet + 1) * LANES):
            note_obstacle(env, row, col, io)


# ----------------------------------------------------------------------------------------------------- kernel


@ti.func
def transform(env, slot, changed, io: Bundle[ClearanceIO]):
    """Both passes for an env, over everything or over what is stale and the rows in its reach; the marks are
    used up."""
    n_row, n_packet = ti.static(io.clearance_memory.farthest.shape[1:])
    reach = ti.static(window_reach(io.clearance_cfg, io.mapping_cfg))
    for packet in range(n_packet):
        for word in range(ti.static(io.clearance_memory.near_up.shape[2])):
            io.clearance_memory.near_up[slot, packet, word] = ti.cast(0, ti.u64)
            io.clearance_memory.near_down[slot, packet, word] = ti.cast(0, ti.u64)
        first, last = stale_rows(slot, packet, changed, io)
        if first <= last:
            for row in range(ti.max(first - reach, 0), ti.min(last + reach + 1, n_row)):
                scan_packet(env, slot, row, packet, io)
            redo_packets(env, slot, packet, changed, io)


@ti.func
def redo_packets(env, slot, packet, changed, io: Bundle[ClearanceIO]):
    """The second pass for the stale rows of a packet's columns."""
    for word in range(ti.static(io.clearance_memory.stale.shape[2])):
        rows = ti.select(
            changed > _MAX_CHANGES, ~ti.cast(0, ti.u64), io.clearance_memory.stale[slot, packet, word]
        )
        io.clearance_memory.stale[slot, packet, word] = ti.cast(0, ti.u64)
        while rows != 0:
            row = word * WORD + lowest_bit(rows)
            rows = without_lowest(rows)
            if row < ti.static(io.clearance_memory.farthest.shape[1]):
                write_packet(env, slot, row, packet, io)


@ti.func
def bring_up_to_date(env, slot, io: Bundle[ClearanceIO]):
    """One env's turn: where it is due, everything that changed since its last one."""
    if io.clock.active[env] == 1:
        io.clearance.fresh[env] = is_due(env, io)
    if is_due(env, io) == 1:
        changed = take_sites(env, slot, ti.static(squared_limit(io.clearance_cfg, io.mapping_cfg)), io)
        if changed > 0:
            transform(env, slot, changed, io)


@quick_launch
@with_cse()
@ti.kernel
def compute_clearance(io: Bundle[ClearanceIO]):
    """Clearance of every cell from the layer that the planner must avoid (``voronoi.use``), where it is
    due."""
    n_env, n_slot = ti.static(io.clock.active.shape[0], io.clearance_memory.row_key.shape[0])
    if ti.static(n_item() > 1):  # each loop ends before the next begins
        for env, item in ti.ndrange(loop_end(n_env, io.clock), ti.static(n_item())):
            find_changes(env, item, io)
        for env, item in ti.ndrange(loop_end(n_env, io.clock), ti.static(n_item())):
            if is_due(env, io) == 1:
                redo_cells(env, item, io)
        for env, item in ti.ndrange(loop_end(n_env, io.clock), ti.static(n_item())):
            if is_due(env, io) == 1:
                note_farthest(env, item, io)
    else:
        for slot in range(loop_end(n_slot, io.clock)):
            for env in range(slot * n_env // n_slot, (slot + 1) * n_env // n_slot):
                bring_up_to_date(env, slot, io)
