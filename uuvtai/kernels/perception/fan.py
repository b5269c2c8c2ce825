"""The fan of free water around a ping: what two neighbouring beams both prove free is free between them.

Each beam proves free water up to a reach. Between beam b and b + 1 lies a triangle with its tip at the ping
and both legs as long as the smaller of their reaches; a cell is free where its centre lies in one of these
triangles. Their union is one star-shaped polygon, so it is filled the way printers fill polygons: every edge
leaves a bit where it crosses a column of cell centres (``fan_edge``), and whoever goes up a column is inside
after an odd number of bits. That takes some 600 bits where walking 256 beams cell by cell takes 10,000
stores, and far out, where beams are several cells apart, it leaves no gaps between them. Behind the last beam
of a partial fan there is no triangle: the outline goes back to the ping.
"""

import taichi as ti

from uuvtai.kernels.core.beams import beam_bearing, beam_lanes, beam_unit
from uuvtai.kernels.core.bits import flip_bit
from uuvtai.kernels.core.grid import grid_origin, grid_shape
from uuvtai.kernels.core.lanes import LANES, f16x, i16x, n_item, n_turn
from uuvtai.kernels.core.signature import Bundle, Const
from uuvtai.kernels.perception.bundles import MappingIO


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
def mark_fan(env, slot, io: Bundle[MappingIO]):
    """Bits of the fan's outline, triangle after triangle: along each chord, then along the beam to the next
    triangle's leg."""
    n_ray, n_col = ti.static(io.sonar_cfg.n_ray, grid_shape(io.tank_cfg, io.mapping_cfg.cell_m)[1])
    ping = ping_cell(env, io)
    first, last = ti.Vector([0.0, 0.0]), ti.Vector([0.0, 0.0])
    first_col, last_col = 0, 0
    for packet in range(ti.static(n_ray // LANES)):
        unit_x, unit_y = beam_lanes(io.scan.ping_yaw[env], packet * LANES, io.sonar_cfg)
        next_x, next_y = beam_lanes(io.scan.ping_yaw[env], packet * LANES + 1, io.sonar_cfg)
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
    mark_edge(slot, last, first, last_col, first_col, n_col, io)


@ti.func
def mark_fan_together(env, slot, item, io: Bundle[MappingIO]):
    """``mark_fan`` by all that share an env (``n_item``), each with triangles of its own: edges need no
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
    bits of ``mark_fan``."""
    lane = ray % LANES
    unit_x, unit_y = beam_unit(io.scan.ping_yaw[env], ray - lane + side, lane, io.sonar_cfg)
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


@ti.func
def mark_free(env, slot, item, io: Bundle[MappingIO]):
    """Bits of the outline of what the new beams prove free. ``item``: which of those that share the env
    (``n_item``)."""
    if ti.static(io.sonar_cfg.mechanical):
        if item == 0:  # a head has few new beams, each of which begins where the one before ended
            mark_sectors(env, slot, io)
    elif ti.static(n_item() > 1):
        mark_fan_together(env, slot, item, io)
    else:
        mark_fan(env, slot, io)
