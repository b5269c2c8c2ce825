"""What the tracker delivers of the surrogate's obstacles: a model of its delays, noise, field of view and
memory, in place of sonar and camera. Rays of free distance are those of the true walls and static
obstacles."""

import math

import taichi as ti

from uuvtai.common.enums import N_RAY
from uuvtai.kernels.core.geometry import BOX, NONE, TWO_PI, wrapped_angle
from uuvtai.kernels.core.noise import episode_key, normal_pair_lanes, uniform
from uuvtai.kernels.core.stage import AnyTensor, Bundle, FloatMatrix, IntVector
from uuvtai.surrogate.arrays import (
    AT_FLIP,
    AT_POS,
    AT_TIME,
    AT_YAW,
    RAW_WIDTH,
    TRACK_WIDTH,
    TRUTH_WIDTH,
    SurrogateRules,
)
from uuvtai.surrogate.motion import aim, path_places
from uuvtai.surrogate.observation import write_columns_of

DT_S = 0.1
RANGE_M = 12.0
FAN_SLOPE = 0.1763
"""the sonar's fan: 10 degrees up and down"""
CAMERA_RANGE_M, HEIGHT_RANGE_M = 4.0, 3.0
"""the camera sees an obstacle up to the first, and knows how high it is up to the second"""
SPELL = 10
"""decisions for which an obstacle is seen equally well: part of it, at an edge of the fan, beside another"""
BEST, SPREAD, MISSED, MISSED_HIDDEN = 0.35, 0.325, 0.985, 0.94
"""how badly: the first, and the second over one minus a uniform number; beyond the third, or the fourth out
of sight, it is not tracked"""
BORN_S, SETTLED_S = 0.05, 0.07
"""seen so long, times how badly: a track; its velocity across the line of sight is known"""
TURN_KNOWN_S = 0.8
"""seen so long, its turn rate is known"""
LOST_S, LOST_HEIGHT_S = 2.5, 6.0
"""out of sight so long a track ends, later where its height is known"""
POSITION_SIGMA, VELOCITY_SIGMA_M_S, VELOCITY_SIGMA_S = 0.0042, 0.009, 0.0062
"""errors of the tracks, times how badly: of position per metre of distance; of velocity at no distance, and
per metre. EC, as are the constants around: by quantiles of the simulator's tracks (docs/learning.md)"""
CAMERA_ALONE = 12.0
"""times as badly is an obstacle seen that the camera sees and the sonar does not"""
QUICKEST, SLOWER, LAG_S = 0.6, 1.1, 0.04
"""share of a change of velocity that is seen at once; less of it beyond the middle uniform number; the place
is behind by so much of what is not seen yet"""
HIDDEN_SIGMA_M, HIDDEN_SIGMA = 0.02, 0.04
"""errors of position, and of velocity as a share of it, times how badly, when an obstacle goes out of sight,
which it does part by part"""
FIRST_NORMAL = 1024
"""number of the first draw of an error; those before it say how badly each obstacle is seen"""
UNBOUNDED_M = 99.0
"""nothing in the way of a ray"""
RAY_SLACK = 0.01
"""share of the angle between two rays by which an obstacle is looked for wider than it is: rounding"""
COLUMN_M = 1.6
"""free water above and below is cut off here"""


@ti.func
def is_hidden(number, slot_count, x, y, to_x, to_y, obstacle: AnyTensor):
    """1 where a static obstacle stands between a place and another."""
    dx, dy = to_x - x, to_y - y
    far = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3)
    ux, uy = dx / far, dy / far
    out = 0
    for slot in range(slot_count):
        kind = ti.cast(obstacle[number, slot, 0], ti.i32)
        if out == 0 and kind != NONE:
            rx, ry = obstacle[number, slot, 1] - x, obstacle[number, slot, 2] - y
            wide, deep = obstacle[number, slot, 4], obstacle[number, slot, 5]
            along, across = rx * ux + ry * uy, ti.abs(rx * uy - ry * ux)
            if kind == BOX:
                if across < ti.sqrt(wide * wide + deep * deep):
                    c, s = ti.cos(obstacle[number, slot, 7]), ti.sin(obstacle[number, slot, 7])
                    if free_to_box(rx, ry, ti.Vector([ux, uy]), c, s, wide, deep) < far:
                        out = 1
            elif along > 0.0 and along < far and across < 0.9 * wide:
                out = 1
    return out


def rays():
    """Unit vectors (x, y) of the rays; plain Python, constants of the kernel."""
    angles = [i * TWO_PI / N_RAY for i in range(N_RAY)]
    return [[math.cos(angle), math.sin(angle)] for angle in angles]


@ti.func
def free_to_wall(x, y, to, io: Bundle[SurrogateRules]):
    """[m] from a place in a direction to the nearest side wall."""
    out = UNBOUNDED_M + 0.0
    if to[0] > 1e-6:
        out = ti.min(out, (io.tank_cfg.x_m[1] - x) / to[0])
    elif to[0] < -1e-6:
        out = ti.min(out, (io.tank_cfg.x_m[0] - x) / to[0])
    if to[1] > 1e-6:
        out = ti.min(out, (io.tank_cfg.y_m[1] - y) / to[1])
    elif to[1] < -1e-6:
        out = ti.min(out, (io.tank_cfg.y_m[0] - y) / to[1])
    return out


@ti.func
def free_to_box(dx, dy, to, c, s, wide, deep):
    """[m] in a direction to a box whose middle is (dx, dy) away, turned by an angle of this cosine and
    sine."""
    vx, vy = c * to[0] + s * to[1], c * to[1] - s * to[0]
    px, py = -(c * dx + s * dy), -(c * dy - s * dx)
    vx = vx if ti.abs(vx) > 1e-6 else 1e-6
    vy = vy if ti.abs(vy) > 1e-6 else 1e-6
    a, b = (-wide - px) / vx, (wide - px) / vx
    e, f = (-deep - py) / vy, (deep - py) / vy
    enter, leave = ti.max(ti.min(a, b), ti.min(e, f)), ti.min(ti.max(a, b), ti.max(e, f))
    return ti.max(enter, 0.0) if leave >= enter and leave > 0.0 else UNBOUNDED_M


@ti.func
def free_to_circle(dx, dy, to, wide):
    """[m] in a direction to a circle whose middle is (dx, dy) away."""
    along = dx * to[0] + dy * to[1]
    inside = along * along - (dx * dx + dy * dy) + wide * wide
    return along - ti.sqrt(inside) if inside > 0.0 and along > 0.0 else UNBOUNDED_M


@ti.func
def rays_towards(dx, dy, reach):
    """(first, count) of the rays that can meet an obstacle of this radius whose middle is (dx, dy) away: its
    half angle is at most pi/2 times the ratio of radius to distance."""
    first, count = 0, N_RAY
    far = ti.sqrt(dx * dx + dy * dy)
    if far > 1.01 * reach:
        half = (0.25 * TWO_PI * reach / far) * (N_RAY / TWO_PI) + RAY_SLACK
        at = ti.atan2(dy, dx) * (N_RAY / TWO_PI)
        first = ti.cast(ti.ceil(at - half), ti.i32)
        count = ti.min(ti.cast(ti.floor(at + half), ti.i32) - first + 1, N_RAY)
    return first, count


@ti.func
def write_rays(
    env, number, slot_count, x, y, obstacle: AnyTensor, ray: FloatMatrix, io: Bundle[SurrogateRules]
):
    """[m] from a place along each ray to the nearest wall or static obstacle, without the hull."""
    towards = ti.Matrix(ti.static(rays()))
    for i in ti.static(range(N_RAY)):
        ray[env, i] = free_to_wall(x, y, ti.Vector([towards[i, 0], towards[i, 1]]), io)
    for slot in range(slot_count):
        kind = ti.cast(obstacle[number, slot, 0], ti.i32)
        if kind != NONE:
            dx, dy = obstacle[number, slot, 1] - x, obstacle[number, slot, 2] - y
            wide, deep, c, s = obstacle[number, slot, 4], 0.0, 1.0, 0.0
            if kind == BOX:
                deep = obstacle[number, slot, 5]
                c, s = ti.cos(obstacle[number, slot, 7]), ti.sin(obstacle[number, slot, 7])
            first, count = rays_towards(dx, dy, ti.sqrt(wide * wide + deep * deep))
            for k in range(count):
                i = (first + k + N_RAY) % N_RAY
                to = ti.Vector([towards[i, 0], towards[i, 1]])
                free_m = 0.0
                if kind == BOX:
                    free_m = free_to_box(dx, dy, to, c, s, wide, deep)
                else:
                    free_m = free_to_circle(dx, dy, to, wide)
                ray[env, i] = ti.min(ray[env, i], free_m)


@ti.func
def sight_of(number, slot_count, here, at, radius, high, level, obstacle: AnyTensor):
    """(1 = seen, 1 = its height is seen, 1 = in the sonar's fan) of a moving obstacle at ``at`` (x, y), from
    ``here`` (x, y, z, yaw)."""
    dx, dy = at[0] - here[0], at[1] - here[1]
    far = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3)
    fan = ti.abs(here[2] - level) - high < ti.max(far - radius, 0.0) * FAN_SLOPE
    bearing = wrapped_angle(ti.atan2(dy, dx) - here[3])
    camera = ti.abs(bearing) < TWO_PI / 8 and far < CAMERA_RANGE_M
    visible, knows = False, False
    if far < RANGE_M and (fan or camera):
        visible = is_hidden(number, slot_count, here[0], here[1], at[0], at[1], obstacle) == 0
        knows = visible and camera and far < HEIGHT_RANGE_M
    return ti.Vector([ti.cast(visible, ti.i32), ti.cast(knows, ti.i32), ti.cast(fan, ti.i32)])


@ti.func
def how_badly(drawn):
    """How badly an obstacle is seen, by a uniform number: 1 in the middle, with a long tail."""
    return BEST + SPREAD / (1.0 - ti.min(drawn, MISSED))


@ti.func
def updated_track(old, lane, at, bend_m, speed, ego_at, is_visible, knows_height, in_fan, key):
    """The row of ``track`` after a decision, of an obstacle that is at ``at`` (x, y, vx, vy): born late, its
    velocity across the line of sight known later, in error by what this spell (``key``) has for it; while it
    is not seen straight on, or on its circle (``bend_m``: signed radius, else 0)."""
    new = old
    drawn = uniform(key, lane)
    first, second = normal_pair_lanes(key, FIRST_NORMAL + 2 * lane, 2)
    badly = how_badly(drawn)
    new[8] = drawn
    if bend_m != 0.0 and old[4] > SETTLED_S:
        turn = DT_S * speed / bend_m
        c, s = ti.cos(turn), ti.sin(turn)
        new[2], new[3] = c * old[2] - s * old[3], s * old[2] + c * old[3]
    if knows_height:
        new[6] = 1.0
    if is_visible:
        if new[5] > LOST_S:
            new[4], new[2], new[3] = 0.0, 0.0, 0.0
        new[4] += DT_S
        new[5] = 0.0
        new[7] += ti.abs(speed) * DT_S
        share = 1.0 if new[4] < 0.25 else QUICKEST - SLOWER * ti.max(drawn - 0.5, 0.0)
        dx, dy = at[0] - ego_at[0], at[1] - ego_at[1]
        square = ti.max(dx * dx + dy * dy, 1e-6)
        far, vx, vy = ti.sqrt(square), at[2], at[3]
        if new[4] < SETTLED_S * badly:
            radial = (vx * dx + vy * dy) / square
            vx, vy = 0.5 * (vx + radial * dx), 0.5 * (vy + radial * dy)
        if not in_fan:
            badly *= CAMERA_ALONE
        away, faster = badly * far * POSITION_SIGMA, badly * (VELOCITY_SIGMA_M_S + far * VELOCITY_SIGMA_S)
        new[2] += share * (vx + faster * first[0] - new[2])
        new[3] += share * (vy + faster * first[1] - new[3])
        new[0] = at[0] + LAG_S * (new[2] - at[2]) + away * second[0]
        new[1] = at[1] + LAG_S * (new[3] - at[3]) + away * second[1]
    else:
        if new[5] < 0.5 * DT_S:
            away, faster = badly * HIDDEN_SIGMA_M, badly * HIDDEN_SIGMA * ti.abs(speed)
            new[2] += faster * first[0]
            new[3] += faster * first[1]
            new[0] += away * second[0]
            new[1] += away * second[1]
        new[5] += DT_S
        new[0] += DT_S * new[2]
        new[1] += DT_S * new[3]
    return new


@ti.func
def is_tracked(track):
    """1 while the tracker has the obstacle of this row of ``track``."""
    unseen_s, drawn = track[5], track[8]
    limit_s = LOST_HEIGHT_S if track[6] > 0.5 else LOST_S
    is_born = track[4] >= BORN_S * how_badly(drawn) - 1e-4
    return unseen_s < limit_s and is_born and drawn < (MISSED_HIDDEN if unseen_s > 0.0 else MISSED)


@ti.func
def write_raw(env, lane, track, places, is_known, turn_rate, over, under, radius, raw: AnyTensor):
    """What the tracker delivers of an obstacle that is tracked. A closed way that was watched once around
    (``is_known``) is foreseen as it is (``places``: ``now_and_later``), a circle after a while, other ways
    straight on."""
    turn = turn_rate if track[4] > TURN_KNOWN_S else 0.0
    for i in ti.static(range(4)):
        raw[env, lane, i] = track[i]
    raw[env, lane, 4], raw[env, lane, 5], raw[env, lane, 8] = turn, radius, track[5]
    if track[6] > 0.5:
        raw[env, lane, 6] = over if over > 0.0 else (COLUMN_M if under > 0.0 else 0.0)
        raw[env, lane, 7] = under if under > 0.0 else (COLUMN_M if over > 0.0 else 0.0)
    for k in ti.static(range(2)):
        x, y = places[k + 1, 0] - places[0, 0], places[k + 1, 1] - places[0, 1]
        if not is_known:
            half = 0.5 * turn * (k + 1.0)
            arc = 1.0 if ti.abs(half) < 1e-4 else ti.sin(half) / half
            c, s = arc * (k + 1.0) * ti.cos(half), arc * (k + 1.0) * ti.sin(half)
            x, y = c * track[2] - s * track[3], s * track[2] + c * track[3]
        raw[env, lane, 9 + 2 * k], raw[env, lane, 10 + 2 * k] = x, y
    raw[env, lane, 13] = 1.0


@ti.func
def now_and_later(number, lane, t_s, path: AnyTensor):
    """Rows of (x, y, vx, vy) of a moving obstacle, now and in 1, 2 and 3 s."""
    return path_places(number, lane, ti.Vector([t_s, t_s + 1.0, t_s + 2.0, t_s + 3.0]), path)


@ti.func
def write_truth(env, lane, places, over, flip, x, y, truth: AnyTensor):
    """Where an obstacle is and will be (``places``: ``now_and_later``), for the critic."""
    fx, fy = 0.25 * flip[0], 0.25 * flip[1]
    truth[env, lane, 0], truth[env, lane, 1] = fx * (places[0, 0] - x), fy * (places[0, 1] - y)
    truth[env, lane, 2], truth[env, lane, 3] = 1.0, ti.math.clamp(over, -COLUMN_M, COLUMN_M)
    for k in ti.static(range(1, 4)):
        truth[env, lane, 2 + 2 * k] = fx * (places[k, 0] - x)
        truth[env, lane, 3 + 2 * k] = fy * (places[k, 1] - y)


@ti.kernel
def sense_surrogate(
    io: Bundle[SurrogateRules],
    seed: int,
    count: int,
    obstacle: AnyTensor,
    path: AnyTensor,
    route: AnyTensor,
    scenario: IntVector,
    ego: FloatMatrix,
    track: AnyTensor,
    raw: AnyTensor,
    ray: FloatMatrix,
    truth: AnyTensor,
    obstacles: AnyTensor,
    own: FloatMatrix,
):
    """Tracks, rays, what only a critic may see, and the columns of a policy, after a decision or a reset. The
    noise is a function of (``seed``, ``count``) and the env.

    ``track`` (n, lanes, 9): estimated x, y, vx, vy; seen for [s]; not seen for [s]; 1 = height known; watched
    way [m]; uniform number of this spell.
    """
    for env in range(ego.shape[0]):
        number, t_s = scenario[env], ego[env, AT_TIME]
        n_rest = obstacle.shape[1] - path.shape[1]
        x, y, z = ego[env, AT_POS], ego[env, AT_POS + 1], ego[env, AT_POS + 2]
        flip = ti.Vector([ego[env, AT_FLIP], ego[env, AT_FLIP + 1]])
        yaw = ego[env, AT_YAW]
        for lane in range(path.shape[1]):
            slot = n_rest + lane
            for i in ti.static(range(RAW_WIDTH)):
                raw[env, lane, i] = 0.0
            for i in ti.static(range(TRUTH_WIDTH)):
                truth[env, lane, i] = 0.0
            if obstacle[number, slot, 0] > 0.5:
                key = episode_key(seed + (count + 3 * lane) // SPELL, env)  # spells do not begin all at once
                places = now_and_later(number, lane, t_s, path)
                at = ti.Vector([places[0, i] for i in ti.static(range(4))])
                is_circle, speed = path[number, lane, 0] < 0.5, path[number, lane, 4]
                bend_m = path[number, lane, 1] if is_circle else 0.0
                turn_rate = speed / bend_m if is_circle else 0.0
                radius, high, level = (
                    obstacle[number, slot, 4],
                    obstacle[number, slot, 6],
                    obstacle[number, slot, 3],
                )
                here = ti.Vector([x, y, z, yaw])
                seen = sight_of(number, n_rest, here, at, radius, high, level, obstacle)
                old = ti.Vector([track[env, lane, i] for i in ti.static(range(TRACK_WIDTH))])
                new = updated_track(old, lane, at, bend_m, speed, here, seen[0], seen[1], seen[2], key)
                for i in ti.static(range(TRACK_WIDTH)):
                    track[env, lane, i] = new[i]
                over, under = level - high - z, z - level - high
                if is_tracked(new):
                    is_known = not is_circle and new[7] > path[number, lane, 2]
                    write_raw(env, lane, new, places, is_known, turn_rate, over, under, radius, raw)
                write_truth(env, lane, places, over, flip, x, y, truth)
        write_rays(env, number, n_rest, x, y, obstacle, ray, io)
        aim(env, number, route, ego, io)
        write_columns_of(env, ego, raw, ray, obstacles, own)
