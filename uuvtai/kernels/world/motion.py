"""Moving obstacles: how they and their paths are drawn, and where they are at any time. Floor of
``world.py``."""

import taichi as ti

from uuvtai.kernels.core.geometry import (
    CYLINDER,
    NONE,
    SPHERE,
    TWO_PI,
    disc,
    is_apart,
    is_inside,
    is_off_ring,
    steady_direction,
    stroke,
)
from uuvtai.kernels.core.noise import STREAM_PATH, bits, stream_key, uniform, uniform_in
from uuvtai.kernels.core.stage import Bundle, Const, In
from uuvtai.kernels.world.io import WorldIO
from uuvtai.state import PathState, WorldState

# ------------------------------------------------------------------------------------------------------------
# The list of obstacles of each env: how slots are written and which of them move. Floor of the scenario's
# drawing.


@ti.func
def put_obstacle(env, slot, kind, pos_w, size, yaw, io: Bundle[WorldIO]):
    """Write one obstacle, at rest."""
    io.world.kind[env, slot] = kind
    io.world.pos_w[env, slot] = pos_w
    io.world.vel_w[env, slot] = ti.Vector([0.0, 0.0, 0.0])
    io.world.size[env, slot] = size
    io.world.yaw[env, slot] = yaw


@ti.func
def first_moving(world: In[WorldState], path: In[PathState]):
    """Slot of the first moving obstacle."""
    return ti.static(world.kind.shape[1] - path.n_way.shape[1])


@ti.func
def is_chosen(i, fraction: Const[float]):
    """1 for the indices that make up a fraction of any run of indices as evenly as can be: of an even number,
    half are exactly half."""
    return ti.cast(ti.floor((i + 1) * fraction) > ti.floor(i * fraction), ti.i32)


# ------------------------------------------------------------------------------------------------------------


FAULT_MOVING = 8
"""Continues the faults of ``scenario.py``."""

_PATH_DRAWS = 64
_CORNER_DRAWS = 16
_DRAW_STRIDE = 256
"""Random indices kept for one draw of a path: two per corner and corner draw, and a few more."""


@ti.func
def polyline_length(env, lane, io: Bundle[WorldIO]):
    """Once around the closed polyline [m]."""
    length = 0.0
    n_way = io.path.n_way[env, lane]
    for j in range(n_way):
        length += (io.path.way_w[env, lane, (j + 1) % n_way] - io.path.way_w[env, lane, j]).norm()
    return length


@ti.func
def direction(env, lane, leg, io: Bundle[WorldIO]):
    """Unit vector along a leg of the closed polyline; legs are counted on, round after round."""
    n_way = io.path.n_way[env, lane]
    along = io.path.way_w[env, lane, (leg + 1) % n_way] - io.path.way_w[env, lane, leg % n_way]
    return along / ti.max(along.norm(), 1e-9)


@ti.func
def bend(turn, away_m, easing_m):
    """(shift (2) [m], its slope (2)) ``away_m`` from a corner whose legs' directions differ by ``turn``."""
    # To turn from direction p to q takes the constant acceleration a along q - p for the time v |q - p| / a:
    # a parabola that leaves the one leg and meets the other easing_m |q - p| / 2 from the corner, when an
    # obstacle that turns at once would be there. After a way w of it the shift is w^2 / (2 easing_m).
    size = turn.norm()
    inside = ti.max(0.5 * easing_m * size - away_m, 0.0)
    shift = turn * (0.5 * inside * inside / (easing_m * ti.max(size, 1e-9)))
    slope = turn * (inside / (easing_m * ti.max(size, 1e-9)))
    return ti.Vector([shift[0], shift[1], slope[0], slope[1]])


@ti.func
def corner_shift(before, along, after, gone_m, leg_m, easing_m):
    """What a bounded acceleration adds to (place, velocity in parts of the speed) ``gone_m`` along a leg;
    ``before`` and ``after``: directions of the neighbouring legs, ``easing_m``: as in ``PathState``."""
    begun = bend(along - before, gone_m, easing_m)
    return bend(after - along, leg_m - gone_m, easing_m) + begun * ti.Vector([1.0, 1.0, -1.0, -1.0])


@ti.func
def set_speed(env, lane, wanted, io: Bundle[WorldIO]):
    """Speed along a path that is there: less than wanted where corners lie so close together, or a circle is
    so small, that it would take more than the acceleration."""
    io.path.speed_m_s[env, lane], io.path.easing_m[env, lane] = wanted, 0.0
    if ti.static(io.world_cfg.obstacle_acceleration_m_s2 > 0):
        most, n_way = ti.abs(io.path.radius_m[env, lane]), io.path.n_way[env, lane]
        for j in range(n_way):
            along = direction(env, lane, j, io)
            turns = (along - direction(env, lane, j + n_way - 1, io)).norm()
            turns += (direction(env, lane, j + 1, io) - along).norm()
            leg = io.path.way_w[env, lane, (j + 1) % n_way] - io.path.way_w[env, lane, j]
            room = 2.0 * leg.norm() / ti.max(turns, 1e-6)
            most = room if j == 0 else ti.min(most, room)
        speed = ti.min(wanted, ti.sqrt(most * io.world_cfg.obstacle_acceleration_m_s2))
        io.path.speed_m_s[env, lane] = speed
        io.path.easing_m[env, lane] = ti.max(speed * speed / io.world_cfg.obstacle_acceleration_m_s2, 1e-9)


@ti.func
def path_point(env, lane, arc_m, io: Bundle[WorldIO]):
    """(x, y, velocity x, velocity y in parts of the speed) at an arc length along the closed path."""
    length = io.path.length_m[env, lane]
    rest = arc_m - length * ti.floor(arc_m / length)
    n_way = io.path.n_way[env, lane]
    out = ti.Vector([io.path.way_w[env, lane, 0][0], io.path.way_w[env, lane, 0][1], 0.0, 0.0])
    if n_way == 0:
        turn = io.path.radius_m[env, lane]  # negative = clockwise
        ahead = steady_direction(rest / turn)
        sign = 1.0 if turn > 0.0 else -1.0
        out += ti.Vector(
            [ti.abs(turn) * ahead[0], ti.abs(turn) * ahead[1], -sign * ahead[1], sign * ahead[0]]
        )
    else:
        on_it = 0
        for j in range(n_way):
            corner = io.path.way_w[env, lane, j]
            leg = io.path.way_w[env, lane, (j + 1) % n_way] - corner
            leg_m = leg.norm()
            if on_it == 0 and (rest < leg_m or j == n_way - 1):
                along = leg / ti.max(leg_m, 1e-9)
                at = corner + ti.min(rest, leg_m) * along
                out = ti.Vector([at[0], at[1], along[0], along[1]])
                if ti.static(io.world_cfg.obstacle_acceleration_m_s2 > 0):
                    before, after = direction(env, lane, j + n_way - 1, io), direction(env, lane, j + 1, io)
                    out += corner_shift(before, along, after, rest, leg_m, io.path.easing_m[env, lane])
                on_it = 1
            rest -= leg_m
    return out


@ti.func
def draw_moving_obstacles(env, io: Bundle[WorldIO]):
    """Draw D moving obstacles with their paths; obstacle i is the same for every D and v."""
    n_moving = ti.min(io.scene.n_dynamic[env], ti.static(io.world_cfg.dynamic_slots))
    for i in range(n_moving):
        lane = ti.static(io.world_cfg.n_fixed_moving) + i
        slot = first_moving(io.world, io.path) + lane
        key = stream_key(io.episode.key[env], i, STREAM_PATH)
        draw_moving_obstacle(env, slot, i, key, io)
        draw_clear_path(env, lane, slot, i, key, io)


@ti.func
def draw_moving_obstacle(env, slot, i, key, io: Bundle[WorldIO]):
    """Kind, size and depth of a moving obstacle."""
    radius = uniform_in(key, 0, io.world_cfg.dynamic.radius_m[0], io.world_cfg.dynamic.radius_m[1])
    z = uniform_in(key, 2, io.world_cfg.dynamic.z_m[0], io.world_cfg.dynamic.z_m[1])
    kind = SPHERE
    size = ti.Vector([radius, radius, radius])
    if is_chosen(i, io.world_cfg.dynamic.cylinder_fraction) == 1:
        kind = CYLINDER
        size[2] = 0.5 * uniform_in(key, 1, io.world_cfg.dynamic.height_m[0], io.world_cfg.dynamic.height_m[1])
        if ti.static(io.world_cfg.dynamic.full_column_fraction > 0):
            nth = ti.cast(ti.floor(i * io.world_cfg.dynamic.cylinder_fraction), ti.i32)
            if (
                is_chosen(
                    nth, io.world_cfg.dynamic.full_column_fraction / io.world_cfg.dynamic.cylinder_fraction
                )
                == 1
            ):
                z = 0.5 * (io.world_cfg.tank.z_m[0] + io.world_cfg.tank.z_m[1])
                size[2] = 0.5 * (io.world_cfg.tank.z_m[1] - io.world_cfg.tank.z_m[0])
    put_obstacle(env, slot, kind, ti.Vector([0.0, 0.0, z]), size, 0.0, io)


@ti.func
def draw_clear_path(env, lane, slot, i, key, io: Bundle[WorldIO]):
    """Draw paths until one keeps clear of static obstacles, or the draws for that are used up; walls and the
    start's gap always hold."""
    radius = io.world.size[env, slot][0]
    found = 0
    draw = 0
    while found == 0 and draw < _PATH_DRAWS:
        if draw_path(env, lane, i, draw, radius, key, io) == 1:
            at = path_point(env, lane, io.path.phase_m[env, lane], io)
            away = ti.Vector([at[0] - io.mission.start_w[env][0], at[1] - io.mission.start_w[env][1]])
            if away.dot(away) >= io.world_cfg.dynamic.start_gap_m**2:
                clear = 1
                if ti.static(io.world_cfg.dynamic.keep_clear_draws > 0):
                    clear = is_path_clear(env, lane, radius, io)
                if clear == 1 or draw + 1 >= io.world_cfg.dynamic.keep_clear_draws:
                    found = 1
                    io.world.unclear_paths[env] += 1 - clear
        draw += 1
    if found == 0:
        io.world.faults[env] |= FAULT_MOVING


@ti.func
def crossed(i):
    """Index with its last two bits crossed, so that half of the spheres and half of the cylinders go around
    circles."""
    return i ^ ((i >> 1) & 1)


@ti.func
def draw_path(env, lane, i, draw, radius, key, io: Bundle[WorldIO]):
    """One draw of a path and phase; 0 where it does not stay within the walls or keep its shape's rules."""
    fits = 0
    first = 16 + _DRAW_STRIDE * draw
    if ti.static(io.world_cfg.dynamic.motion == "waypoints"):
        fits = draw_loop(env, lane, radius, key, first, io)
    else:
        fits = draw_line_or_circle(env, lane, i, radius, key, first, io)
    io.path.phase_m[env, lane] = io.path.length_m[env, lane] * uniform(key, first)
    set_speed(env, lane, io.scene.speed_m_s[env], io)
    return fits


@ti.func
def draw_line_or_circle(env, lane, i, radius, key, first, io: Bundle[WorldIO]):
    """One draw of the shape that obstacle i has; 0 where it does not stay within the walls."""
    fits = 0
    if is_chosen(crossed(i), io.world_cfg.dynamic.circle_fraction) == 1:
        fits = draw_circle(env, lane, radius, key, first, io)
    else:
        fits = draw_line(env, lane, radius, key, first, io)
    return fits


@ti.func
def point_within(key, first, reach_x, reach_y, io: Bundle[WorldIO]):
    """Uniform point in the world_cfg.tank's rectangle, so far from its sides."""
    x = uniform_in(key, first, io.world_cfg.tank.x_m[0] + reach_x, io.world_cfg.tank.x_m[1] - reach_x)
    y = uniform_in(key, first + 1, io.world_cfg.tank.y_m[0] + reach_y, io.world_cfg.tank.y_m[1] - reach_y)
    return ti.Vector([x, y])


@ti.func
def draw_line(env, lane, radius, key, first, io: Bundle[WorldIO]):
    """Back and forth on a line. The length is drawn once per obstacle, so that short lines are not
    favoured."""
    length = uniform_in(key, 3, io.world_cfg.dynamic.line_length_m[0], io.world_cfg.dynamic.line_length_m[1])
    half = 0.5 * length * steady_direction(0.5 * TWO_PI * uniform(key, first + 1))
    center = point_within(key, first + 2, ti.abs(half[0]) + radius, ti.abs(half[1]) + radius, io)
    io.path.n_way[env, lane] = 2
    io.path.radius_m[env, lane] = 0.0
    io.path.way_w[env, lane, 0] = center - half
    io.path.way_w[env, lane, 1] = center + half
    io.path.length_m[env, lane] = 2.0 * length
    return is_inside(stroke(center - half, center + half, radius), 0.0, io.world_cfg.tank)


@ti.func
def draw_circle(env, lane, radius, key, first, io: Bundle[WorldIO]):
    """Around a circle, either way. Radius and direction are drawn once per obstacle."""
    circle = uniform_in(
        key, 3, io.world_cfg.dynamic.circle_radius_m[0], io.world_cfg.dynamic.circle_radius_m[1]
    )
    center = point_within(key, first + 2, circle + radius, circle + radius, io)
    io.path.n_way[env, lane] = 0
    io.path.radius_m[env, lane] = circle if bits(key, 4) & 1 == 1 else -circle
    io.path.way_w[env, lane, 0] = center
    io.path.length_m[env, lane] = TWO_PI * circle
    return is_inside(disc(center, circle + radius), 0.0, io.world_cfg.tank)


@ti.func
def draw_loop(env, lane, radius, key, first, io: Bundle[WorldIO]):
    """Closed loop of sharp corners, any two of them at least ``corner_gap_m`` apart; 0 where a corner finds
    no place."""
    choices = io.world_cfg.dynamic.corners[1] - io.world_cfg.dynamic.corners[0] + 1
    n_way = io.world_cfg.dynamic.corners[0] + ti.cast(choices * uniform(key, 5), ti.i32)
    placed = 1
    corner = 0
    while placed == 1 and corner < n_way:
        placed = 0
        draw = 0
        while placed == 0 and draw < _CORNER_DRAWS:
            point = point_within(key, first + 2 + 2 * (corner * _CORNER_DRAWS + draw), radius, radius, io)
            placed = is_inside(disc(point, radius), 0.0, io.world_cfg.tank)
            for other in range(corner):
                gap = point - io.path.way_w[env, lane, other]
                placed &= ti.cast(gap.dot(gap) >= io.world_cfg.dynamic.corner_gap_m**2, ti.i32)
            io.path.way_w[env, lane, corner] = point
            draw += 1
        corner += 1
    io.path.n_way[env, lane] = n_way
    io.path.radius_m[env, lane] = 0.0
    io.path.length_m[env, lane] = polyline_length(env, lane, io)
    return placed


@ti.func
def is_path_clear(env, lane, radius, io: Bundle[WorldIO]):
    """1 where the moving disc meets no static obstacle anywhere on its path."""
    clear = 1
    n_way = io.path.n_way[env, lane]
    for slot in range(ti.static(io.world.kind.shape[1] - io.path.n_way.shape[1])):
        if clear == 1 and io.world.kind[env, slot] != NONE:
            shape = io.scratch.footprint[env, slot]
            if n_way == 0:
                clear = is_off_ring(
                    shape, io.path.way_w[env, lane, 0], ti.abs(io.path.radius_m[env, lane]), radius
                )
            for j in range(n_way):
                along = stroke(io.path.way_w[env, lane, j], io.path.way_w[env, lane, (j + 1) % n_way], radius)
                clear &= is_apart(along, shape, 0.0)
            if ti.static(io.world_cfg.obstacle_acceleration_m_s2 > 0):
                clear &= are_turns_clear(env, lane, radius, shape, io)
    return clear


@ti.func
def are_turns_clear(env, lane, radius, shape, io: Bundle[WorldIO]):
    """1 where a static obstacle lies in no turn: four chords each, the disc larger by what a parabola leaves
    its chord."""
    clear, corner_m, n_way = 1, 0.0, io.path.n_way[env, lane]
    for j in range(n_way):
        easing = io.path.easing_m[env, lane]
        turn = direction(env, lane, j, io) - direction(env, lane, j + n_way - 1, io)
        piece = 0.25 * easing * turn.norm()
        for k in range(-2, 2):
            a = path_point(env, lane, corner_m + k * piece, io)
            b = path_point(env, lane, corner_m + (k + 1) * piece, io)
            more = piece * piece / (8.0 * easing)
            chord = stroke(ti.Vector([a[0], a[1]]), ti.Vector([b[0], b[1]]), radius + more)
            clear &= is_apart(chord, shape, 0.0)
        leg = io.path.way_w[env, lane, (j + 1) % n_way] - io.path.way_w[env, lane, j]
        corner_m += leg.norm()
    return clear
