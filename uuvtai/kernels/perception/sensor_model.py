"""What a scan and a depth image say about the cells of the map: a return that stays or moves, a point seen by
the camera.

Each is a bit per cell, set by those that share an env's returns (``n_item``); ``mark_packets`` adds free
water, ``mapping.py`` merges all of it into the two layers.
"""

import math

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.config import SonarConfig, TankConfig
from uuvtai.kernels.core.beams import (
    beam_bearing,
    beam_lanes,
    beam_packet,
    beam_there,
    beam_towards,
    beam_unit,
)
from uuvtai.kernels.core.geometry import FAR_M, quaternion_wb, rotation_wb, turned_z
from uuvtai.kernels.core.grid import cell_of, grid_origin, grid_shape
from uuvtai.kernels.core.simd import (
    LANES,
    WORD,
    bit_of,
    cell_bit,
    f16x,
    filled,
    filled_int,
    flip_bit,
    i16x,
    n_item,
    n_lane,
    n_turn,
    put_bit,
    ramp,
)
from uuvtai.kernels.core.stage import Bundle, Const, In, fetch, n_envs
from uuvtai.kernels.perception.io import EchoesIO, MappingIO
from uuvtai.state import SonarScan

# ------------------------------------------------------------------------------------------------------------
# The fan of free water around a ping: what two neighbouring beams both prove free is free between them.
#
# Each beam proves free water up to a reach. Between beam b and b + 1 lies a triangle with its tip at the ping
# and both legs as long as the smaller of their reaches; a cell is free where its centre lies in one of these
# triangles. Their union is one star-shaped polygon, so it is filled the way printers fill polygons: every
# edge leaves a bit where it crosses a column of cell centres (``fan_edge``), and whoever goes up a column is
# inside after an odd number of bits. Behind the last beam of a partial fan there is no triangle: the outline
# goes back to the ping.


@ti.func
def free_reach(env, ray, io: Bundle[MappingIO]):
    """[m] up to which a beam proves free water: one cell and one sigma before its return, ``free_range_m``
    without one; at least 0."""
    range_m = io.scan.range_m[env, ray]
    before = (
        range_m
        - io.mapping_cfg.cell_m
        - (io.sonar_cfg.range_sigma_m + io.sonar_cfg.range_sigma_slope * range_m)
    )
    return ti.max(
        0.0,
        ti.select(
            io.scan.hit[env, ray] == 1,
            before,
            ti.static(min(io.mapping_cfg.free_range_m, io.sonar_cfg.max_range_m)),
        ),
    )


@ti.func
def triangle_legs(env, first_ray, io: Bundle[MappingIO]):
    """[cells] legs of the sixteen triangles from beam ``first_ray`` on: the smaller of two neighbours'
    reaches."""
    reach = f16x(0.0)
    for i in ti.static(range(LANES)):
        reach[i] = free_reach(env, first_ray + i, io)
    after = free_reach(env, (first_ray + LANES) % ti.static(io.sonar_cfg.n_ray), io)
    legs = f16x(0.0)
    for i in ti.static(range(LANES - 1)):
        legs[i] = ti.min(reach[i], reach[i + 1]) / io.mapping_cfg.cell_m
    legs[LANES - 1] = ti.min(reach[LANES - 1], after) / io.mapping_cfg.cell_m
    if ti.static(not io.sonar_cfg.is_ring):
        if first_ray + LANES == io.sonar_cfg.n_ray:
            legs[LANES - 1] = 0.0
    return legs


@ti.func
def mark_edge(slot, begin, end, first_col, end_col, n_col: Const[int], io: Bundle[MappingIO]):
    """A bit in the lowest cell of each column whose centres lie on or above the edge; ends are (x, y)
    [cells], centres whole numbers.

    ``first_col`` and ``end_col`` are the rounded-up x of both ends: whole numbers shared by neighbouring
    edges, so that no column can be crossed by one of two edges that meet in it and missed by the other.
    """
    n_row = ti.static(io.map_scratch.fan_edge.shape[1])
    if first_col != end_col:
        slope = (end[1] - begin[1]) / (end[0] - begin[0])
        for col in range(ti.max(ti.min(first_col, end_col), 0), ti.min(ti.max(first_col, end_col), n_col)):
            row = ti.max(ti.cast(ti.ceil(begin[1] + (col - begin[0]) * slope), ti.i32), 0)
            if row < n_row:
                flip_bit(io.map_scratch.fan_edge, slot, row, col)


@ti.func
def ping_cell(env, io: Bundle[MappingIO]):
    """(x, y) [cells] where the ping was taken, centres of cells whole numbers."""
    x0, y0 = ti.static(grid_origin(io.tank_cfg, io.mapping_cfg.cell_m))
    return ti.Vector(
        [
            (io.scan.ping_pos_w[env][0] - x0) / io.mapping_cfg.cell_m - 0.5,
            (io.scan.ping_pos_w[env][1] - y0) / io.mapping_cfg.cell_m - 0.5,
        ]
    )


@ti.func
def mark_packets(env, slot, promote_scans: Const[int], io: Bundle[MappingIO]):
    """Bits of the fan's outline, triangle after triangle, along each chord, then along the beam to the next
    triangle's leg; and those of the returns."""
    n_ray, n_col = ti.static(io.sonar_cfg.n_ray, grid_shape(io.tank_cfg, io.mapping_cfg.cell_m)[1])
    pos = ti.Vector([io.scan.ping_pos_w[env][0], io.scan.ping_pos_w[env][1]])
    vel, threshold = own_motion(env, io)
    ping = ping_cell(env, io)
    first, last = ti.Vector([0.0, 0.0]), ti.Vector([0.0, 0.0])
    first_col, last_col = 0, 0
    for packet in range(ti.static(n_ray // LANES)):
        unit_x, unit_y, next_x, next_y = beam_lanes(io.scan.ping_yaw[env], packet * LANES, io.sonar_cfg)
        legs = triangle_legs(env, packet * LANES, io)
        begin_x, begin_y = ping[0] + legs * unit_x, ping[1] + legs * unit_y
        end_x, end_y = ping[0] + legs * next_x, ping[1] + legs * next_y
        begin_col, end_col = i16x(0), i16x(0)
        for i in ti.static(range(LANES)):
            begin_col[i] = ti.cast(ti.ceil(begin_x[i]), ti.i32)
            end_col[i] = ti.cast(ti.ceil(end_x[i]), ti.i32)
        if packet == 0:
            first = ti.Vector([begin_x[0], begin_y[0]])
            first_col = begin_col[0]
            last, last_col = first, first_col
        for i in range(LANES):
            begin, end = ti.Vector([begin_x[i], begin_y[i]]), ti.Vector([end_x[i], end_y[i]])
            mark_edge(slot, last, begin, last_col, begin_col[i], n_col, io)
            mark_edge(slot, begin, end, begin_col[i], end_col[i], n_col, io)
            last, last_col = end, end_col[i]
        mark_returns(env, slot, packet * LANES, unit_x, unit_y, pos, vel, threshold, promote_scans, io)
    mark_edge(slot, last, first, last_col, first_col, n_col, io)


@ti.func
def mark_fan_together(env, slot, item, io: Bundle[MappingIO]):
    """``mark_packets`` by all that share an env (``n_item``), each with triangles of its own: edges need no
    order, and where the triangle before ends is computed once more."""
    n_ray, n_col = ti.static(io.sonar_cfg.n_ray, grid_shape(io.tank_cfg, io.mapping_cfg.cell_m)[1])
    ping = ping_cell(env, io)
    for turn in range(ti.static(n_turn(n_ray))):
        ray = turn * ti.static(n_item()) + item
        if ray < n_ray:
            last = leg_end(env, (ray + n_ray - 1) % n_ray, 1, ping, io)
            begin, end = leg_end(env, ray, 0, ping, io), leg_end(env, ray, 1, ping, io)
            last_col, begin_col, end_col = (
                ti.cast(ti.ceil(last[0]), ti.i32),
                ti.cast(ti.ceil(begin[0]), ti.i32),
                ti.cast(ti.ceil(end[0]), ti.i32),
            )
            mark_edge(slot, last, begin, last_col, begin_col, n_col, io)
            mark_edge(slot, begin, end, begin_col, end_col, n_col, io)


@ti.func
def leg_end(env, ray, side: Const[int], ping, io: Bundle[MappingIO]):
    """(x, y) [cells] of the end of a triangle's leg, along its own beam (``side`` 0) or the next (1); to the
    bits of ``mark_packets``."""
    lane = ray % LANES
    unit_x, unit_y = beam_unit(io.scan.ping_yaw[env], ray - lane, lane + side, io.sonar_cfg)
    leg = (
        ti.min(free_reach(env, ray, io), free_reach(env, (ray + 1) % io.sonar_cfg.n_ray, io))
        / io.mapping_cfg.cell_m
    )
    if ti.static(not io.sonar_cfg.is_ring):
        if ray + 1 == io.sonar_cfg.n_ray:
            leg = 0.0
    return ti.Vector([ping[0] + leg * unit_x, ping[1] + leg * unit_y])


@ti.func
def mark_sectors(env, slot, io: Bundle[MappingIO]):
    """Bits of the outline of what a mechanical head's new beams prove free: of each the triangle half a step
    of the head to either side, both legs as long as its reach."""
    n_col = ti.static(grid_shape(io.tank_cfg, io.mapping_cfg.cell_m)[1])
    half = ti.static(0.5 * io.sonar_cfg.beam_step_rad)
    ping = ping_cell(env, io)
    ping_col = ti.cast(ti.ceil(ping[0]), ti.i32)
    last, last_col = ping, ping_col
    for k in range(io.scan.new_count[env]):
        beam = (io.scan.new_from[env] + k) % io.sonar_cfg.n_ray
        bearing = io.scan.ping_yaw[env] + beam_bearing(beam, io.sonar_cfg)
        leg = free_reach(env, beam, io) / io.mapping_cfg.cell_m
        begin = ti.Vector([ping[0] + leg * ti.cos(bearing - half), ping[1] + leg * ti.sin(bearing - half)])
        end = ti.Vector([ping[0] + leg * ti.cos(bearing + half), ping[1] + leg * ti.sin(bearing + half)])
        begin_col, end_col = ti.cast(ti.ceil(begin[0]), ti.i32), ti.cast(ti.ceil(end[0]), ti.i32)
        mark_edge(slot, last, begin, last_col, begin_col, n_col, io)
        mark_edge(slot, begin, end, begin_col, end_col, n_col, io)
        last, last_col = end, end_col
    mark_edge(slot, last, ping, last_col, ping_col, n_col, io)


# ------------------------------------------------------------------------------------------------------------
# Memory of a mechanical beam: beams of different ages as one scan.
#
# Each bearing of the head keeps the last return, when it came and where the vehicle was. In every step in
# which a beam comes, the scan is made anew: the new beams as they are, and in the others the remembered
# returns where they would be seen from here, the nearest of each bearing. A new beam takes away the
# remembered returns that it goes through or replaces.


NEVER = -(1 << 20)
"""Step of a bearing along which no beam has looked."""

_SAME_M = 0.3  # A new return replaces a remembered one of its bearing up to so far behind it (EC).


@ti.func
def is_new(env, beam, scan: In[SonarScan], sonar_cfg: Const[SonarConfig]):
    """Whether a beam of the scan was taken at its ping; so are all but those of a mechanical sonar."""
    new = True
    if ti.static(sonar_cfg.mechanical):
        new = (beam - scan.new_from[env] + sonar_cfg.n_ray) % sonar_cfg.n_ray < scan.new_count[env]
    return new


@quick_launch
@ti.kernel
def reset_echoes(io: Bundle[EchoesIO]):
    """Nothing was heard yet, in the active rows."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            for slot in range(io.echoes.step.shape[1]):
                io.echoes.step[env, slot] = NEVER
                io.echoes.pos_x_m[env, slot] = 0.0
                io.echoes.pos_y_m[env, slot] = 0.0
                io.echoes.bearing_w[env, slot] = 0.0
                io.echoes.range_m[env, slot] = 0.0
                io.echoes.intensity[env, slot] = 0.0
                io.echoes.hit[env, slot] = 0
                io.echoes.told[env, slot] = 1
                io.echoes.shown[env, slot] = -1


@quick_launch
@ti.kernel
def recall_echoes(io: Bundle[EchoesIO]):
    """Keep the new beams, and fill the others of the scan with what is remembered."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1 and io.scan.fresh[env] == 1:
            keep_new(env, io)
            show_old(env, io)


@ti.func
def keep_new(env, io: Bundle[EchoesIO]):
    """Remember the new beams; the others of the scan are emptied."""
    for beam in range(io.sonar_cfg.n_ray):
        io.echoes.shown[env, beam] = -1
        if is_new(env, beam, io.scan, io.sonar_cfg):
            io.echoes.step[env, beam] = io.scan.ping_step[env]
            io.echoes.pos_x_m[env, beam] = io.scan.ping_pos_w[env][0]
            io.echoes.pos_y_m[env, beam] = io.scan.ping_pos_w[env][1]
            io.echoes.bearing_w[env, beam] = io.scan.ping_yaw[env] + beam_bearing(beam, io.sonar_cfg)
            io.echoes.range_m[env, beam] = io.scan.range_m[env, beam]
            io.echoes.intensity[env, beam] = io.scan.intensity[env, beam]
            io.echoes.hit[env, beam] = io.scan.hit[env, beam]
            io.echoes.told[env, beam] = 0
            io.echoes.shown[env, beam] = beam
        else:
            io.scan.range_m[env, beam] = io.sonar_cfg.max_range_m
            io.scan.doppler_m_s[env, beam] = 0.0
            io.scan.intensity[env, beam] = 0.0
            io.scan.hit[env, beam] = 0


@ti.func
def show_old(env, io: Bundle[EchoesIO]):
    """Put every remembered return into the beam that would see it from here."""
    here = io.scan.ping_pos_w[env]
    for slot in range(io.sonar_cfg.n_ray):
        if io.echoes.hit[env, slot] == 1 and not is_new(env, slot, io.scan, io.sonar_cfg):
            bearing, far = io.echoes.bearing_w[env, slot], io.echoes.range_m[env, slot]
            x = io.echoes.pos_x_m[env, slot] + far * ti.cos(bearing) - here[0]
            y = io.echoes.pos_y_m[env, slot] + far * ti.sin(bearing) - here[1]
            towards = beam_towards(ti.atan2(y, x) - io.scan.ping_yaw[env], io.sonar_cfg)
            show_in(env, slot, beam_there(towards, io.sonar_cfg), ti.sqrt(x * x + y * y), io)


@ti.func
def show_in(env, slot, beam, range_m, io: Bundle[EchoesIO]):
    """Show a remembered return at this range of a beam (-1 = none) if it is the nearest there; a new beam
    ends the memory of what is not behind its own return."""
    if beam >= 0:
        if is_new(env, beam, io.scan, io.sonar_cfg):
            if range_m < io.scan.range_m[env, beam] + _SAME_M:
                io.echoes.hit[env, slot] = 0
        elif range_m < io.scan.range_m[env, beam]:
            io.scan.range_m[env, beam] = range_m
            io.scan.intensity[env, beam] = io.echoes.intensity[env, slot]
            io.scan.hit[env, beam] = 1
            io.echoes.shown[env, beam] = slot


# ------------------------------------------------------------------------------------------------------------


_MAX_REACH = 4
"""[cells] farthest neighbour that may explain a surprising return as the edge of a static obstacle."""

NO_RETURN_SHARE = 0.999
"""A depth pixel beyond this share of the camera's range saw nothing."""


def doppler_threshold(mapping, sonar):
    """[m/s] compensated Doppler that counts as motion: the configured value, or 3 sigma of the sensor's
    noise."""
    return max(mapping.doppler_evidence_m_s, 3.0 * sonar.doppler_sigma_m_s)


def pinhole(depth):
    """(focal length, middle row, middle column) [pixels]: pixel [row, col] looks along (1, (middle_col -
    col)/f, (middle_row - row)/f)."""
    return (
        0.5 * depth.cols / math.tan(math.radians(0.5 * depth.fov_deg)),
        0.5 * depth.rows - 0.5,
        0.5 * depth.cols - 0.5,
    )


# ------------------------------------------------------------------------------------------------------ walls


@ti.func
def range_error(range_m, io: Bundle[MappingIO]):
    """[m] error that a return at this range may have: 3 sigma of its noise, jitter and quantum (data
    sheet)."""
    return (
        3.0
        * (
            io.sonar_cfg.range_sigma_m
            + io.sonar_cfg.range_sigma_slope * range_m
            + io.sonar_cfg.range_jitter_m
        )
        + io.sonar_cfg.range_quantum_m
    )


@ti.func
def wall_margins(range_m, io: Bundle[MappingIO]):
    """[m] off a known wall within which returns are the wall's; a wide beam ends on its nearer side."""
    margin = filled(io.mapping_cfg.wall_margin_m, range_m.n)
    if ti.static(io.sonar_cfg.half_width_rad > 0):
        margin += ti.static(io.sonar_cfg.half_width_rad) * range_m
    return margin


@ti.func
def wall_lanes(pos, unit_x, unit_y, tank_cfg: Const[TankConfig]):
    """[m] along horizontal beams to the known side wall through which each leaves the tank; negative where
    it misses the tank."""
    leave = filled(0.0, unit_x.n)
    if ti.static(tank_cfg.shape == "circle"):
        off = pos - ti.Vector(
            [0.5 * (tank_cfg.x_m[0] + tank_cfg.x_m[1]), 0.5 * (tank_cfg.y_m[0] + tank_cfg.y_m[1])]
        )
        along = unit_x * off[0] + unit_y * off[1]
        # distance of the line from the centre by a cross product: along^2 - off^2 would cancel badly
        across = unit_y * off[0] - unit_x * off[1]
        inside = ti.static(tank_cfg.radius_m**2) - across * across
        for i in ti.static(range(unit_x.n)):
            leave[i] = ti.select(inside[i] < 0.0, -1.0, ti.sqrt(ti.max(inside[i], 0.0)) - along[i])
    else:
        for i in ti.static(range(unit_x.n)):
            to_x = ti.select(unit_x[i] > 0.0, tank_cfg.x_m[1] - pos[0], pos[0] - tank_cfg.x_m[0])
            to_y = ti.select(unit_y[i] > 0.0, tank_cfg.y_m[1] - pos[1], pos[1] - tank_cfg.y_m[0])
            leave[i] = ti.min(to_x / ti.max(ti.abs(unit_x[i]), 1e-9), to_y / ti.max(ti.abs(unit_y[i]), 1e-9))
    return leave


@ti.func
def wall_gaps(x, y, io: Bundle[MappingIO]):
    """[m] from points to the nearest side wall, negative outside."""
    gap = filled(0.0, x.n)
    if ti.static(io.tank_cfg.shape == "circle"):
        off_x, off_y = (
            x - 0.5 * (io.tank_cfg.x_m[0] + io.tank_cfg.x_m[1]),
            y - 0.5 * (io.tank_cfg.y_m[0] + io.tank_cfg.y_m[1]),
        )
        squared = off_x * off_x + off_y * off_y
        for i in ti.static(range(x.n)):
            gap[i] = ti.static(io.tank_cfg.radius_m) - ti.sqrt(squared[i])
    else:
        for i in ti.static(range(x.n)):
            gap[i] = ti.min(
                x[i] - io.tank_cfg.x_m[0],
                io.tank_cfg.x_m[1] - x[i],
                y[i] - io.tank_cfg.y_m[0],
                io.tank_cfg.y_m[1] - y[i],
            )
    return gap


# ------------------------------------------------------------------------------------------------------- hits


@ti.func
def moves_by_track(env, ray, io: Bundle[MappingIO]):
    """1 where the beam belongs to a track that is confirmed as moving."""
    track = io.tracks.beam_track[env, ray]
    moving = 0
    if track >= 0:
        moving = io.tracks.moving[env, track]
    return moving


@ti.func
def edge_of_static(env, row, col, reach, io: Bundle[MappingIO]):
    """1 where a cell within ``reach`` cells (square) is statically occupied."""
    n_row, n_word = ti.static(io.grid_map.static_occupied.shape[1:])
    first_col = ti.max(col - reach, 0)
    word, shift = first_col // WORD, ti.cast(first_col % WORD, ti.u64)
    window = cell_bit(col + reach + 1 - first_col) - ti.cast(1, ti.u64)
    found = ti.cast(0, ti.u64)
    r, end = ti.max(row - reach, 0), ti.min(row + reach + 1, n_row)
    while (
        r < end and found == 0
    ):  # a second way out keeps LLVM from unrolling it: half of the time to compile the whole kernel
        found |= (io.grid_map.static_occupied[env, r, word] >> shift) & window
        if shift > 0 and word + 1 < n_word:
            found |= (
                io.grid_map.static_occupied[env, r, word + 1] << (ti.cast(WORD, ti.u64) - shift)
            ) & window
        r += 1
    return ti.cast(found != 0, ti.i32)


@ti.func
def is_inconsistent(env, row, col, range_m, promote_scans: Const[int], io: Bundle[MappingIO]):
    """1 where a return contradicts a cell that was confidently free, or one that such evidence holds and has
    not yet promoted.

    The edge of a static obstacle does this too: range noise and the gap between beams move its returns into
    cells that other beams cleared. So nothing counts near a statically occupied cell: within one cell plus
    beam spacing plus range error.
    """
    confident = bit_of(io.grid_map.confident[env, row, col // WORD], col % WORD)
    held = bit_of(io.grid_map.held[env, row, col // WORD], col % WORD)
    inconsistent = 0
    if confident == 1 or (
        held == 1 and ti.cast(io.grid_map.dynamic_scans[env, row, col], ti.i32) < promote_scans
    ):
        spacing = ti.static(max(io.sonar_cfg.beam_step_rad, io.sonar_cfg.half_width_rad)) * range_m
        reach = 1 + ti.cast((spacing + range_error(range_m, io)) / io.mapping_cfg.cell_m, ti.i32)
        inconsistent = 1 - edge_of_static(env, row, col, ti.min(reach, _MAX_REACH), io)
    return inconsistent


@ti.func
def own_motion(env, io: Bundle[MappingIO]):
    """Own velocity (x, y) [m/s] at the ping, as the tracking knows it, and the Doppler [m/s] beyond which a
    return then moves.

    It is the measured velocity less the error that the known walls show in the same scan. A scan between
    tracked ones takes the error of the last of them as long as the reading is only held, and trusts a valid
    reading as it is. Where neither a reading nor the walls tell the own velocity, Doppler proves little: the
    threshold is three standard deviations of what is left.
    """
    vel = turned_z(io.scan.ping_vel_b[env], io.scan.ping_yaw[env])
    threshold = ti.cast(ti.static(doppler_threshold(io.mapping_cfg, io.sonar_cfg)), ti.f32)
    held = io.scan.ping_vel_valid[env] != 1
    if held or io.clusters.scan_step[env] == io.scan.ping_step[env]:
        vel -= io.clusters.slip_w[env]
    if held:
        sigma = io.clusters.own_sigma_m_s[env]
        threshold = ti.max(
            threshold, 3.0 * ti.sqrt(ti.static(io.sonar_cfg.doppler_sigma_m_s**2) + sigma * sigma)
        )
    return vel, threshold


@ti.func
def mapped_lanes(env, first_ray, unit_x, unit_y, pos, vel, threshold, io: Bundle[MappingIO]):
    """Of a packet of beams along these unit vectors: kind of return (0 = none or from a known wall, 1 = at
    rest as far as it tells itself, 2 = moving by its Doppler), row, column, range [m].

    ``vel`` [m/s] is the own velocity along x and y, ``threshold`` [m/s] the compensated Doppler that counts
    as motion.
    """
    n_row, n_col = ti.static(grid_shape(io.tank_cfg, io.mapping_cfg.cell_m))
    lanes = ti.static(n_lane())
    x0, y0 = ti.static(grid_origin(io.tank_cfg, io.mapping_cfg.cell_m))
    range_m, hit = filled(0.0, lanes), filled_int(0, lanes)
    for i in ti.static(range(lanes)):
        range_m[i] = io.scan.range_m[env, first_ray + i]
        hit[i] = io.scan.hit[env, first_ray + i]
    x, y = pos[0] + unit_x * range_m, pos[1] + unit_y * range_m
    # noise along a slanting beam reaches deeper into the tank than the margin
    error = range_error(range_m, io)
    gap, beyond = wall_gaps(x, y, io), wall_gaps(x + unit_x * error, y + unit_y * error, io)
    moves = filled(0.0, lanes)
    if ti.static(io.sonar_cfg.doppler):
        # measured rate of range plus own velocity along the beam: motion through the water
        for i in ti.static(range(lanes)):
            moves[i] = io.scan.doppler_m_s[env, first_ray + i]
        moves = moves + unit_x * vel[0] + unit_y * vel[1]
    margin = wall_margins(range_m, io)
    kind, row, col = filled_int(0, lanes), filled_int(0, lanes), filled_int(0, lanes)
    for i in ti.static(range(lanes)):
        row[i] = ti.cast(ti.floor((y[i] - y0) / io.mapping_cfg.cell_m), ti.i32)
        col[i] = ti.cast(ti.floor((x[i] - x0) / io.mapping_cfg.cell_m), ti.i32)
    for i in ti.static(range(lanes)):
        known = (gap[i] < margin[i]) | (beyond[i] < 0.0)
        off = (row[i] < 0) | (row[i] >= n_row) | (col[i] < 0) | (col[i] >= n_col)
        moving = ti.abs(moves[i]) > threshold
        kind[i] = ti.select((hit[i] == 0) | known | off, 0, ti.select(moving, 2, 1))
    return kind, row, col, range_m


@ti.func
def mark_scan(env, slot, item, promote_scans: Const[int], io: Bundle[MappingIO]):
    """Bits of the outline of what the new beams prove free, and of the returns. ``item``: which of those that
    share the env (``n_item``)."""
    if ti.static(n_item() == 1 and not io.sonar_cfg.mechanical):
        mark_packets(env, slot, promote_scans, io)
    else:
        if ti.static(not io.sonar_cfg.mechanical):
            mark_fan_together(env, slot, item, io)
        elif item == 0:  # a head has few new beams, each of which begins where the one before ended
            mark_sectors(env, slot, io)
        mark_hits(env, slot, item, promote_scans, io)


@ti.func
def mark_hits(env, slot, item, promote_scans: Const[int], io: Bundle[MappingIO]):
    """Bit of every return's cell. ``item``: which of those that share the env (``n_item``)."""
    pos = ti.Vector([io.scan.ping_pos_w[env][0], io.scan.ping_pos_w[env][1]])
    vel, threshold = own_motion(env, io)
    for turn in range(ti.static(n_turn(io.sonar_cfg.n_ray // n_lane()))):
        first = (turn * ti.static(n_item()) + item) * ti.static(n_lane())
        if first < io.sonar_cfg.n_ray:
            unit_x, unit_y = beam_packet(io.scan.ping_yaw[env], first, io.sonar_cfg)
            mark_returns(env, slot, first, unit_x, unit_y, pos, vel, threshold, promote_scans, io)


@ti.func
def mark_returns(
    env, slot, first, unit_x, unit_y, pos, vel, threshold, promote_scans: Const[int], io: Bundle[MappingIO]
):
    """Bit of the cell of each return of a packet: what moves is a dynamic hit only, the rest static hits;
    returns from known walls are left out."""
    kind, row, col, range_m = mapped_lanes(env, first, unit_x, unit_y, pos, vel, threshold, io)
    for i in range(ti.static(n_lane())):
        if kind[i] != 0 and is_new(env, first + i, io.scan, io.sonar_cfg):
            moves = ti.cast(kind[i] == 2, ti.i32) | moves_by_track(env, first + i, io)
            mark_hit(env, slot, row[i], col[i], range_m[i], moves, promote_scans, io)


@ti.func
def mark_hit(env, slot, row, col, range_m, moves, promote_scans: Const[int], io: Bundle[MappingIO]):
    """Bit of a return's cell; ``moves``: 1 where the return or its track says so."""
    dynamic = moves
    fetch(io.grid_map.static_occ[env, row, col])
    if moves == 0:
        dynamic = is_inconsistent(env, row, col, range_m, promote_scans, io)
    if dynamic == 1:
        put_bit(io.map_scratch.dynamic_hit, slot, row, col)
        fetch(io.grid_map.dynamic_scans[env, row, col])
    else:
        put_bit(io.map_scratch.static_hit, slot, row, col)


# ------------------------------------------------------------------------------------------------------ depth


@ti.func
def nearest_in_gate(env, first_col, R_wb, gate_m: Const[float], io: Bundle[MappingIO]):
    """Per image column, a packet of them: smallest depth [m] whose point lies within ``gate_m`` of the
    vehicle's own depth, and its row."""
    focal, middle_row, middle_col = ti.static(pinhole(io.depth_cfg))
    lanes = ti.static(n_lane())
    # Pinhole: the pixel (row, col) at depth z shows the point offset + z (1, left, up) in body axes. Its
    # height over the vehicle is the third row of R_wb times that: mount + z climb.
    left = (middle_col - ramp(float(first_col), lanes)) / focal
    mount = (
        R_wb[2, 0] * io.depth_cfg.offset_b_m[0]
        + R_wb[2, 1] * io.depth_cfg.offset_b_m[1]
        + R_wb[2, 2] * io.depth_cfg.offset_b_m[2]
    )
    nearest, nearest_row = filled(FAR_M, lanes), filled_int(0, lanes)
    for row in range(ti.static(io.image.depth_m.shape[1])):
        z = filled(0.0, lanes)
        for i in ti.static(range(lanes)):
            z[i] = io.image.depth_m[env, row, first_col + i]
        climb = R_wb[2, 0] + R_wb[2, 2] * (middle_row - row) / focal + R_wb[2, 1] * left
        rise = mount + z * climb
        for i in ti.static(range(lanes)):
            seen = (
                (ti.abs(rise[i]) <= gate_m)
                & (z[i] < ti.static(io.depth_cfg.max_range_m * NO_RETURN_SHARE))
                & (z[i] > 0.0)
            )
            nearer = seen & (z[i] < nearest[i])
            nearest[i] = ti.select(nearer, z[i], nearest[i])
            nearest_row[i] = ti.select(nearer, row, nearest_row[i])
    return nearest, nearest_row


@ti.func
def mark_depth(env, item, io: Bundle[MappingIO]):
    """Depth hit in the cell of the nearest point at the vehicle's own depth, per image column; it waits there
    for the next merge. ``item``: which of those that share the env (``n_item``)."""
    lanes, n_col = ti.static(n_lane(), io.image.depth_m.shape[2])
    rpy = io.image.shot_rpy[env]
    R_wb = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2]))
    for turn in range(ti.static(n_turn(io.image.depth_m.shape[2] // n_lane()))):
        first = (turn * ti.static(n_item()) + item) * lanes
        if first < n_col:
            nearest, nearest_row = nearest_in_gate(env, first, R_wb, io.mapping_cfg.depth_gate_m, io)
            for i in range(lanes):
                if nearest[i] < FAR_M:
                    mark_point(env, first + i, nearest_row[i], nearest[i], R_wb, io)


@ti.func
def mark_point(env, pixel_col, pixel_row, depth_m, R_wb, io: Bundle[MappingIO]):
    """Depth hit in the cell of a pixel's point, if it is one of the grid's."""
    focal, middle_row, middle_col = ti.static(pinhole(io.depth_cfg))
    n_row, n_col = ti.static(grid_shape(io.tank_cfg, io.mapping_cfg.cell_m))
    offset = ti.Vector([io.depth_cfg.offset_b_m[0], io.depth_cfg.offset_b_m[1], io.depth_cfg.offset_b_m[2]])
    ray_b = ti.Vector([1.0, (middle_col - pixel_col) / focal, (middle_row - pixel_row) / focal])
    point = io.image.shot_pos_w[env] + R_wb @ (offset + depth_m * ray_b)
    cell = cell_of(point, io.tank_cfg, io.mapping_cfg.cell_m)
    if cell[0] >= 0 and cell[0] < n_row and cell[1] >= 0 and cell[1] < n_col:
        put_bit(io.grid_map.depth_hit, env, cell[0], cell[1])
