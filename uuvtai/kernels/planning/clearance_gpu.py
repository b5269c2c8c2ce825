"""The clearance on a GPU, to the bits of ``clearance.py``: the items of an env (``n_item``) share its cells.

A cell's key is the smallest over the rows of its window, nearest first, as there; but nothing is kept of a
row. Sites are bits, so the nearest one of a row to either side is found in a few instructions, and an env's
bits stay in the cache, where sixteen numbers per packet and row would not.
"""

import math

import taichi as ti

from uuvtai.common.enums import NO_SITE
from uuvtai.kernels.core.grid import away_of
from uuvtai.kernels.core.simd import (
    LANES,
    WORD,
    bit_of,
    cell_bit,
    highest_bit,
    lowest_bit,
    n_item,
    n_turn,
    without_lowest,
)
from uuvtai.kernels.core.stage import Bundle, Const
from uuvtai.kernels.planning.io import ClearanceIO

# ------------------------------------------------------------------------------------------------------------
# What the clearance on a CPU (``clearance.py``) and on a GPU (here) share: keys, sites, when it is due.


# ---------------------------------------------------------- plain Python, evaluated when a kernel is compiled


def squared_limit(cfg, mapping):
    """[cells^2] largest squared distance that is not beyond ``max_m``."""
    return math.floor((cfg.max_m / mapping.cell_m) ** 2 + 1e-6)


def window_reach(cfg, mapping):
    """[cells] farthest row that can hold a site within ``max_m``."""
    return math.isqrt(squared_limit(cfg, mapping))


def offset_bits(cfg, mapping):
    """Bits of a key that hold the row offset. Raises ValueError where keys would not fit an int32."""
    bits = (2 * window_reach(cfg, mapping)).bit_length()
    if window_reach(cfg, mapping) >= WORD or 4 * (squared_limit(cfg, mapping) + 1) << bits >= 1 << 31:
        raise ValueError(f"clearance.max_m {cfg.max_m} is too many cells of {mapping.cell_m} m")
    return bits


def no_site(cfg, mapping):
    """Key of a cell without a site within ``max_m``: larger than that of any cell with one."""
    return 2 * (squared_limit(cfg, mapping) + 1) << offset_bits(cfg, mapping)


# ------------------------------------------------------------------------------------------------------ sites


@ti.func
def site_word(env, row, word, io: Bundle[ClearanceIO]):
    """Cells that are occupied or outside the tank."""
    sites = io.grid_map.static_occupied[env, row, word] | io.mask.outside_bits[row, word]
    if ti.static(io.voronoi_cfg.use == "fused"):
        sites |= io.grid_map.dynamic_occupied[env, row, word]
    return sites


@ti.func
def is_due(env, io: Bundle[ClearanceIO]):
    """1 where the clearance is computed in this step."""
    return ti.cast(
        io.clock.active[env] == 1 and io.clock.step[env] % io.clearance_cfg.period_steps == 0, ti.i32
    )


@ti.func
def note_obstacle(env, row, col, io: Bundle[ClearanceIO]):
    """Mark the site kept of a cell where it is an obstacle's, not the boundary's."""
    site = ti.cast(io.clearance.site[env, row, col], ti.i32)
    rows, cols = away_of(site)
    if site != NO_SITE and io.mask.outside[row + rows, col + cols] == 0:
        io.clearance.site[env, row, col] = ti.cast(site | 1, ti.i16)


# ------------------------------------------------------------------------------------------------------------


# ------------------------------------------------------------------------------------------------------ sites


@ti.func
def find_changes(env, item, io: Bundle[ClearanceIO]):
    """Take an item's share of an env's sites, and mark what those that changed may concern, or everything
    where nothing is known."""
    if item == 0 and io.clock.active[env] == 1:
        io.clearance.fresh[env] = is_due(env, io)
    if is_due(env, io) == 1:
        n_row, n_word = ti.static(io.clearance_memory.sites.shape[1:])
        limit = ti.static(squared_limit(io.clearance_cfg, io.mapping_cfg))
        known = io.clearance_memory.limit[env] == limit
        if not known:
            mark_everything(env, item, io)
        for turn in range(ti.static(n_turn(n_row * n_word))):
            place = turn * ti.static(n_item()) + item
            if place < n_row * n_word:
                take_word(env, place // n_word, place % n_word, known, io)


@ti.func
def take_word(env, row, word, known, io: Bundle[ClearanceIO]):
    """Take the sites of a word; where something is ``known``, mark what those that changed may concern."""
    sites = site_word(env, row, word, io)
    different = sites ^ io.clearance_memory.sites[env, row, word]
    if different != 0:
        io.clearance_memory.sites[env, row, word] = sites
        while known and different != 0:
            mark_around(
                env,
                row,
                word * WORD + lowest_bit(different),
                ti.static(squared_limit(io.clearance_cfg, io.mapping_cfg)),
                io,
            )
            different = without_lowest(different)


@ti.func
def mark_around(env, site_row, site_col, limit: Const[int], io: Bundle[ClearanceIO]):
    """Mark the packets that a changed site may concern, as ``clearance.mark_stale`` does; the bits of a word
    at once."""
    n_row, n_packet = ti.static(io.clearance_memory.farthest.shape[1:])
    reach = ti.static(math.isqrt(limit))
    for packet in range(
        ti.max(site_col - reach, 0) // LANES, ti.min((site_col + reach) // LANES, n_packet - 1) + 1
    ):
        cols = ti.max(packet * LANES - site_col, site_col - packet * LANES - (LANES - 1), 0)
        for word in range(
            ti.max(site_row - reach, 0) // WORD, ti.min(site_row + reach, n_row - 1) // WORD + 1
        ):
            rows = ti.cast(0, ti.u64)
            for row in range(
                ti.max(site_row - reach, word * WORD), ti.min(site_row + reach + 1, (word + 1) * WORD, n_row)
            ):
                if (row - site_row) ** 2 + cols * cols <= io.clearance_memory.farthest[env, row, packet]:
                    rows |= cell_bit(row)
            if rows != 0:
                ti.atomic_or(io.clearance_memory.stale[env, packet, word], rows)


@ti.func
def mark_everything(env, item, io: Bundle[ClearanceIO]):
    """Mark an item's share of an env's packets."""
    n_packet, n_word = ti.static(io.clearance_memory.stale.shape[1:])
    for turn in range(ti.static(n_turn(n_packet * n_word))):
        place = turn * ti.static(n_item()) + item
        if place < n_packet * n_word:
            beyond = ti.max((place % n_word + 1) * WORD - io.clearance_memory.farthest.shape[1], 0)
            io.clearance_memory.stale[env, place // n_word, place % n_word] = ~ti.cast(0, ti.u64) >> ti.cast(
                beyond, ti.u64
            )


# ------------------------------------------------------------------------------------------------------ cells


@ti.func
def redo_cells(env, item, io: Bundle[ClearanceIO]):
    """Sites of an item's share of the cells that are marked: in every few packets one column."""
    n_packet, n_word = ti.static(io.clearance_memory.stale.shape[1:])
    for turn in range(ti.static(n_turn(n_packet * LANES))):
        col = turn * ti.static(n_item()) + item
        if col < n_packet * LANES:
            for word in range(n_word):
                rows = io.clearance_memory.stale[env, col // LANES, word]
                while rows != 0:
                    row = word * WORD + lowest_bit(rows)
                    rows = without_lowest(rows)
                    write_cell(env, row, col, io)


@ti.func
def row_key(env, row, col, io: Bundle[ClearanceIO]):
    """Key of the site of a row that is nearest to a column."""
    n_word = ti.static(io.clearance_memory.sites.shape[2])
    reach, bits = ti.static(
        window_reach(io.clearance_cfg, io.mapping_cfg), offset_bits(io.clearance_cfg, io.mapping_cfg)
    )
    word, bit = col // WORD, ti.cast(col % WORD, ti.u64)
    here, before, behind = io.clearance_memory.sites[env, row, word], ti.cast(0, ti.u64), ti.cast(0, ti.u64)
    if word > 0:
        before = io.clearance_memory.sites[env, row, word - 1]
    if word + 1 < n_word:
        behind = io.clearance_memory.sites[env, row, word + 1]
    # sixty-four cells each, the column's own is the last and the first of them
    back, one = ti.cast(WORD - 1, ti.u64) - bit, ti.cast(1, ti.u64)
    left, right = (here << back) | ((before >> one) >> bit), (here >> bit) | ((behind << one) << back)
    to_left = ti.select(left != 0, WORD - 1 - highest_bit(left), WORD)
    to_right = ti.select(right != 0, lowest_bit(right), WORD)
    gap = ti.min(to_left, to_right)
    key = ((2 * gap * gap + ti.cast(to_right < to_left, ti.i32)) << bits) + reach
    return ti.select(gap <= reach, key, ti.static(no_site(io.clearance_cfg, io.mapping_cfg)))


@ti.func
def best_key(env, row, col, io: Bundle[ClearanceIO]):
    """Smallest key of a cell over the rows of its window, nearest first; it ends where no farther row can be
    better."""
    n_row = ti.static(io.clearance_memory.farthest.shape[1])
    reach, bits = ti.static(
        window_reach(io.clearance_cfg, io.mapping_cfg), offset_bits(io.clearance_cfg, io.mapping_cfg)
    )
    best, offset = row_key(env, row, col, io), 1
    while offset <= reach and 2 * offset * offset << bits <= best:
        farther = 2 * offset * offset << bits
        if row >= offset:
            best = ti.min(best, row_key(env, row - offset, col, io) + (farther - offset))
        if row + offset < n_row:
            best = ti.min(best, row_key(env, row + offset, col, io) + (farther + offset))
        offset += 1
    return best


@ti.func
def write_cell(env, row, col, io: Bundle[ClearanceIO]):
    """Site of a cell, decoded from its key as ``clearance.write_packet`` does."""
    reach, bits, limit = ti.static(
        window_reach(io.clearance_cfg, io.mapping_cfg),
        offset_bits(io.clearance_cfg, io.mapping_cfg),
        squared_limit(io.clearance_cfg, io.mapping_cfg),
    )
    key = best_key(env, row, col, io)
    squared = key >> (bits + 1)
    site = NO_SITE
    if squared <= limit:
        rows = (key & ti.static((1 << bits) - 1)) - reach
        cols = ti.cast(ti.sqrt(ti.cast(squared - rows * rows, ti.f32)), ti.i32)
        site = (rows << 8) | ((cols * (2 * ((key >> bits) & 1) - 1) & 127) << 1)
    io.clearance.site[env, row, col] = ti.cast(site, ti.i16)
    if ti.static(io.clearance_cfg.inflate_m > 0):
        note_obstacle(env, row, col, io)


# --------------------------------------------------------------------------------------------------- farthest


@ti.func
def note_farthest(env, item, io: Bundle[ClearanceIO]):
    """How far the sites of an item's share of what was redone are; the marks are used up."""
    n_row, n_packet = ti.static(io.clearance_memory.farthest.shape[1:])
    limit = ti.static(squared_limit(io.clearance_cfg, io.mapping_cfg))
    for turn in range(ti.static(n_turn(n_row * n_packet))):
        place = turn * ti.static(n_item()) + item
        row, packet = place // n_packet, place % n_packet
        if row < n_row and bit_of(io.clearance_memory.stale[env, packet, row // WORD], row % WORD) == 1:
            ti.atomic_and(io.clearance_memory.stale[env, packet, row // WORD], ~cell_bit(row))
            farthest = 0
            for col in range(packet * LANES, (packet + 1) * LANES):
                rows, cols = away_of(io.clearance.site[env, row, col])
                farthest = ti.max(farthest, ti.min(rows**2 + cols**2, limit + 1))
            io.clearance_memory.farthest[env, row, packet] = farthest
    if item == 0:
        io.clearance_memory.limit[env] = limit
