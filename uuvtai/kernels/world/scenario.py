"""Scenarios and moving obstacles: all that is true of the world as a pure function of (world preset, seed,
episode, time).

Draws of different purposes have keys of their own, so that the number of moving obstacles or their speed
changes neither the static obstacles nor start and goal, and obstacle i of S is drawn alike for every S. Every
search is bounded; where its draws run out, ``WorldState.faults`` says so: a scenario is never silently made
easier.
"""

import math

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.geometry import (
    BOX,
    CYLINDER,
    NONE,
    TWO_PI,
    disc,
    footprint_of,
    is_apart,
    is_inside,
    nearest_squared,
)
from uuvtai.kernels.core.noise import STREAM_SCENARIO, stream_key, uniform, uniform_in
from uuvtai.kernels.core.simd import WORD, bit_of, cell_bit
from uuvtai.kernels.core.stage import Bundle, Const, loop_end, n_envs, shares
from uuvtai.kernels.world.io import WorldIO
from uuvtai.kernels.world.motion import (
    draw_moving_obstacles,
    first_moving,
    is_chosen,
    path_point,
    polyline_length,
    put_obstacle,
    set_speed,
)

# ------------------------------------------------------------------------------------------------------------
# Layout of a scenario: start, goal and static obstacles, drawn again until free space joins start and goal.
# Floor of ``world.py``.
#
# Every search is bounded; where its draws run out, ``WorldState.faults`` says so and the scenario counts as
# not placed.


COARSE_M = 0.2
"""Cell of the grid on which free space is flooded from the start [m]."""

FAULT_ENDPOINTS = 1
FAULT_STATIC = 2
FAULT_JOINED = 4

_LAYOUTS = 16  # Static layouts drawn for one pair of start and goal.
_PAIRS = 32
"""Pairs of start and goal that are tried: where a wall parts the water, half of them cannot be joined."""
_PAIR_DRAWS = 64
_PLACE_DRAWS = 64
_SWEEPS = 64  # Pairs of raster sweeps of the flood; what needs more counts as not joined.
_PAIR_STEP = 1 << 20  # Keeps the keys of start and goal apart from those of layouts.


@ti.func
def draw_layout(env, io: Bundle[WorldIO]):
    """Start, goal and static obstacles, drawn again until free space joins start and goal."""
    joined = 0
    draws = 0
    fault = 0
    while joined == 0 and draws < _LAYOUTS * _PAIRS:
        if draws % _LAYOUTS == 0:
            pair = draws // _LAYOUTS
            fault = draw_endpoints(env, pair, io)
        layout_fault = fault
        if ti.static(io.world_cfg.static_slots > 0):
            if draw_static_obstacles(env, draws, io) == 0:
                layout_fault |= FAULT_STATIC
        if ti.static(io.world_cfg.n_fixed_static + io.world_cfg.static_slots > 0):
            if layout_fault == 0 and is_joined(env, io) == 0:
                layout_fault |= FAULT_JOINED
        joined = ti.cast(layout_fault == 0, ti.i32)
        io.world.faults[env] = layout_fault
        draws += 1
    io.world.draws[env] = draws


@ti.func
def draw_endpoints(env, pair, io: Bundle[WorldIO]):
    """Start, goal and heading; a fault where no draw keeps the gaps."""
    key = stream_key(io.episode.key[env], _PAIR_STEP + pair, STREAM_SCENARIO)
    io.mission.start_yaw[env] = uniform_in(key, 0, -0.5 * TWO_PI, 0.5 * TWO_PI)
    found = 0
    draw = 0
    while found == 0 and draw < _PAIR_DRAWS:
        start = ti.Vector([0.0, 0.0, 0.0])
        goal = ti.Vector([0.0, 0.0, 0.0])
        for end in range(2):
            first = 8 + 8 * draw + 4 * end
            point = ti.Vector(
                [
                    uniform_in(key, first, io.world_cfg.spawn_x_m[0], io.world_cfg.spawn_x_m[1]),
                    uniform_in(key, first + 1, io.world_cfg.spawn_y_m[0], io.world_cfg.spawn_y_m[1]),
                    uniform_in(key, first + 2, io.world_cfg.spawn_z_m[0], io.world_cfg.spawn_z_m[1]),
                ]
            )
            if end == 0:
                start = point
            else:
                goal = point
        across = ti.Vector([goal[0] - start[0], goal[1] - start[1]])
        found = ti.cast(across.dot(across) >= io.world_cfg.start_goal_gap_m**2, ti.i32)
        io.mission.start_w[env] = start
        io.mission.goal_w[env] = goal
        for slot in range(ti.static(io.world_cfg.n_fixed_static)):
            found &= keeps_endpoints(env, io.scratch.footprint[env, slot], io)
        draw += 1
    return ti.cast(found == 0, ti.i32) * FAULT_ENDPOINTS


@ti.func
def keeps_endpoints(env, shape, io: Bundle[WorldIO]):
    """1 where a footprint's surface keeps its gap from start and goal."""
    reach = io.world_cfg.static.endpoint_gap_m + shape[6]
    nearest = ti.min(
        nearest_squared(shape, io.mission.start_w[env]), nearest_squared(shape, io.mission.goal_w[env])
    )
    return ti.cast(nearest > 0.0 and nearest >= reach * reach, ti.i32)


@ti.func
def draw_static_obstacles(env, layout, io: Bundle[WorldIO]):
    """Draw S static obstacles one after the other; 0 where one finds no place."""
    key = stream_key(io.episode.key[env], layout, STREAM_SCENARIO)
    n_static = ti.min(io.scene.n_static[env], ti.static(io.world_cfg.static_slots))
    first = ti.static(io.world_cfg.n_fixed_static)
    for i in range(ti.static(io.world_cfg.static_slots)):
        io.world.kind[env, first + i] = NONE
    placed = 1
    i = 0
    while placed == 1 and i < n_static:
        placed = draw_static_obstacle(env, first + i, i, key, io)
        i += 1
    return placed


@ti.func
def draw_static_obstacle(env, slot, i, key, io: Bundle[WorldIO]):
    """Draw size and heading once, then places until the gaps are kept; 0 where none keeps them."""
    first = i * (8 + 2 * _PLACE_DRAWS)
    half_height = 0.5 * (io.world_cfg.tank.z_m[1] - io.world_cfg.tank.z_m[0])
    radius = uniform_in(key, first, io.world_cfg.static.radius_m[0], io.world_cfg.static.radius_m[1])
    kind = CYLINDER
    size = ti.Vector([radius, radius, half_height])
    yaw = 0.0
    if is_chosen(i, io.world_cfg.static.box_fraction) == 1:
        kind = BOX
        size[0] = uniform_in(
            key, first + 1, io.world_cfg.static.half_extent_m[0], io.world_cfg.static.half_extent_m[1]
        )
        size[1] = uniform_in(
            key, first + 2, io.world_cfg.static.half_extent_m[0], io.world_cfg.static.half_extent_m[1]
        )
        yaw = TWO_PI * uniform(key, first + 3)
    found = 0
    draw = 0
    while found == 0 and draw < _PLACE_DRAWS:
        x = uniform_in(key, first + 8 + 2 * draw, io.world_cfg.tank.x_m[0], io.world_cfg.tank.x_m[1])
        y = uniform_in(key, first + 9 + 2 * draw, io.world_cfg.tank.y_m[0], io.world_cfg.tank.y_m[1])
        pos_w = ti.Vector([x, y, io.world_cfg.tank.z_m[0] + half_height])
        shape = footprint_of(kind, pos_w, size, yaw)
        if is_inside(shape, 0.0, io.world_cfg.tank) == 1 and keeps_endpoints(env, shape, io) == 1:
            found = keeps_gaps(env, shape, slot, io.world_cfg.static.gap_m, io)
        if found == 1:
            put_obstacle(env, slot, kind, pos_w, size, yaw, io)
            io.scratch.footprint[env, slot] = shape
        draw += 1
    return found


@ti.func
def keeps_gaps(env, shape, n_obstacle, gap_m, io: Bundle[WorldIO]):
    """1 where a footprint keeps its gap from the first obstacles of the list."""
    kept = 1
    for slot in range(n_obstacle):
        if kept == 1:
            kept = is_apart(shape, io.scratch.footprint[env, slot], gap_m)
    return kept


# ---------------------------------------------------------------------------- is the goal joined to the start


@ti.func
def is_joined(env, io: Bundle[WorldIO]):
    """1 where free space with the wanted clearance joins start and goal.

    Conservative: cells are neighbours over their edges, and a cell is free where its centre has half a cell
    more clearance than wanted, so that the straight way between neighbours has what is wanted (distance is
    1-Lipschitz).
    """
    block_cells(env, io.world_cfg.static.joined_clearance_m + 0.5 * COARSE_M, io)
    start = coarse_cell(io.mission.start_w[env], io)
    goal = coarse_cell(io.mission.goal_w[env], io)
    changed = 0
    if (io.scratch.open[env, start[0], start[1] // WORD] & cell_bit(start[1])) != 0:
        io.scratch.reach[env, start[0], start[1] // WORD] = cell_bit(start[1])
        changed = 1
    sweep = 0
    while changed == 1 and sweep < 2 * _SWEEPS and is_reached(env, goal, io) == 0:
        changed = flood_sweep(env, sweep & 1, io)
        if changed == 0 and sweep == 0:
            changed = 1  # the first sweep runs one way only
        sweep += 1
    return is_reached(env, goal, io)


@ti.func
def is_reached(env, cell, io: Bundle[WorldIO]):
    """1 where a coarse cell was reached from the start."""
    return bit_of(io.scratch.reach[env, cell[0], cell[1] // WORD], cell[1] % WORD)


def coarse_size(tank):
    """(rows, columns) of the coarse grid of a tank; plain Python."""
    return [math.ceil((high - low) / COARSE_M - 1e-9) for low, high in (tank.y_m, tank.x_m)]


@ti.func
def coarse_cell(pos_w, io: Bundle[WorldIO]):
    """(row, col) of the coarse cell that holds a position."""
    row = ti.cast((pos_w[1] - io.world_cfg.tank.y_m[0]) * (1.0 / COARSE_M), ti.i32)
    col = ti.cast((pos_w[0] - io.world_cfg.tank.x_m[0]) * (1.0 / COARSE_M), ti.i32)
    n_row, n_col = ti.static(coarse_size(io.world_cfg.tank))
    return ti.Vector([ti.math.clamp(row, 0, n_row - 1), ti.math.clamp(col, 0, n_col - 1)])


@ti.func
def coarse_centre(row, col, io: Bundle[WorldIO]):
    """World (x, y) [m] of a coarse cell's centre."""
    x = io.world_cfg.tank.x_m[0] + (col + 0.5) * COARSE_M
    y = io.world_cfg.tank.y_m[0] + (row + 0.5) * COARSE_M
    return ti.Vector([x, y])


@ti.func
def block_cells(env, clearance_m, io: Bundle[WorldIO]):
    """Leave open the cells whose centre is ``clearance_m`` or more from walls and static obstacles."""
    n_col = ti.static(coarse_size(io.world_cfg.tank)[1])
    for row, word in ti.ndrange(io.scratch.open.shape[1], io.scratch.open.shape[2]):
        free = ti.cast(0, ti.u64)
        for bit in range(ti.min(n_col - word * WORD, WORD)):
            center = coarse_centre(row, word * WORD + bit, io)
            inside = is_inside(disc(center, 0.0), clearance_m, io.world_cfg.tank)
            free |= ti.cast(inside, ti.u64) << ti.cast(bit, ti.u64)
        io.scratch.open[env, row, word] = free
        io.scratch.reach[env, row, word] = ti.cast(0, ti.u64)
    for slot in range(ti.static(io.world_cfg.n_fixed_static + io.world_cfg.static_slots)):
        if io.world.kind[env, slot] != NONE:
            shape = io.scratch.footprint[env, slot]
            block_around(env, shape, clearance_m + shape[6], io)


@ti.func
def block_around(env, shape, reach, io: Bundle[WorldIO]):
    """Close the cells whose centre is nearer than ``reach`` [m] to a footprint's core."""
    span = ti.Vector([1.0, 1.0]) * (reach + shape[4] + shape[5])  # bounds the turned rectangle
    low = coarse_cell(ti.Vector([shape[0], shape[1]]) - span, io)
    high = coarse_cell(ti.Vector([shape[0], shape[1]]) + span, io)
    for row in range(low[0], high[0] + 1):
        for col in range(low[1], high[1] + 1):
            if nearest_squared(shape, coarse_centre(row, col, io)) < reach * reach:
                word = col // WORD
                io.scratch.open[env, row, word] = io.scratch.open[env, row, word] & ~cell_bit(col)


@ti.func
def flood_sweep(env, backward, io: Bundle[WorldIO]):
    """Carry "reached" to free neighbours row by row, forward or backward; 1 where anything changed."""
    n_row, n_word = ti.static(io.scratch.open.shape[1:])
    changed = 0
    for i in range(n_row):
        row = i if backward == 0 else n_row - 1 - i
        last = row - 1 if backward == 0 else row + 1
        for up in ti.static((True, False)):
            carried = ti.cast(0, ti.u64)
            for k in range(n_word):
                word = k if ti.static(up) else n_word - 1 - k
                free, old = io.scratch.open[env, row, word], io.scratch.reach[env, row, word]
                new = old | carried
                if i > 0:
                    new |= io.scratch.reach[env, last, word]
                new = filled_along(new & free, free, up)
                carried = ti.bit_shr(new, ti.u64(WORD - 1)) if ti.static(up) else new << ti.u64(WORD - 1)
                if new != old:
                    io.scratch.reach[env, row, word] = new
                    changed = 1
    return changed


@ti.func
def filled_along(seed, free, up: Const[bool]):
    """The seeds' bits and, next to them towards higher bits (``up``) or lower ones, all that are free."""
    out, run = seed, free
    for shift in ti.static((1, 2, 4, 8, 16, 32)):
        far = ti.u64(shift)
        out |= run & (out << far if ti.static(up) else ti.bit_shr(out, far))
        run &= run << far if ti.static(up) else ti.bit_shr(run, far)
    return out


# ------------------------------------------------------------------------------------------------------------


@quick_launch
@ti.kernel
def generate_scenarios(io: Bundle[WorldIO]):
    """Draw start, goal, static and moving obstacles of every active row; ``move_obstacles`` then puts the
    moving ones in place."""
    n = n_envs(io.clock)
    for env in range(n):
        if io.clock.active[env] == 1:
            clear_obstacles(env, io)
            place_fixed(env, io)
            draw_layout(env, io)
    if ti.static(io.world_cfg.dynamic_slots > 0):
        for env in range(n):  # a loop of its own compiles in half the time
            if io.clock.active[env] == 1:
                draw_moving_obstacles(env, io)


@ti.func
def clear_obstacles(env, io: Bundle[WorldIO]):
    """Empty every slot, so that nothing of the last episode stays."""
    for slot in range(io.world.kind.shape[1]):
        put_obstacle(env, slot, NONE, ti.Vector([0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0]), 0.0, io)
    io.world.draws[env] = 0
    io.world.unclear_paths[env] = 0
    io.world.faults[env] = 0


@ti.func
def place_fixed(env, io: Bundle[WorldIO]):
    """Explicit obstacles: those at rest in the first slots, those with a path in the first moving ones."""
    n_still = ti.static(io.world_cfg.n_fixed_static)
    for i in range(ti.static(len(io.world_cfg.fixed))):
        slot = i
        lane = i - n_still
        if lane >= 0:
            slot = first_moving(io.world, io.path) + lane
            io.path.n_way[env, lane] = io.fixed.n_way[i]
            io.path.radius_m[env, lane] = 0.0
            io.path.phase_m[env, lane] = 0.0
            for j in range(io.path.way_w.shape[2]):
                io.path.way_w[env, lane, j] = io.fixed.way_w[i, j]
            io.path.length_m[env, lane] = polyline_length(env, lane, io)
            wanted = io.fixed.speed_m_s[i] if io.fixed.speed_m_s[i] >= 0.0 else io.scene.speed_m_s[env]
            set_speed(env, lane, wanted, io)
        put_obstacle(env, slot, io.fixed.kind[i], io.fixed.pos_w[i], io.fixed.size[i], io.fixed.yaw[i], io)
        io.scratch.footprint[env, slot] = footprint_of(
            io.fixed.kind[i], io.fixed.pos_w[i], io.fixed.size[i], io.fixed.yaw[i]
        )


@quick_launch
@ti.kernel
def move_obstacles(io: Bundle[WorldIO]):
    """Put every moving obstacle of the active rows where it is at time step * dt, with its velocity; depth
    stays."""
    n, n_lane = ti.static(io.path.n_way.shape[:2])
    n_share = ti.static(shares(n_lane))
    for env, share in ti.ndrange(loop_end(n, io.clock), n_share):
        if io.clock.active[env] == 1:
            time_s = io.clock.step[env] * ti.static(io.episode_cfg.control_dt_s)
            for lane in range(share * n_lane // n_share, (share + 1) * n_lane // n_share):
                slot = first_moving(io.world, io.path) + lane
                if io.world.kind[env, slot] != NONE:
                    speed = io.path.speed_m_s[env, lane]
                    at = path_point(env, lane, io.path.phase_m[env, lane] + speed * time_s, io)
                    io.world.pos_w[env, slot] = ti.Vector([at[0], at[1], io.world.pos_w[env, slot][2]])
                    io.world.vel_w[env, slot] = ti.Vector([speed * at[2], speed * at[3], 0.0])
