"""What the tracker delivers of the surrogate's obstacles: a model of its delays, noise, field of view and
memory. Rays of free distance are those of the true walls and static obstacles."""

import math

import taichi as ti

from uuvtai.common.enums import DECISION_S, N_RAY
from uuvtai.kernels.core.geometry import BOX, NONE, TWO_PI, turned_z, wrapped_angle
from uuvtai.kernels.core.noise import episode_key, normal_pair_lanes, uniform
from uuvtai.kernels.core.stage import AnyTensor, Bundle, FloatMatrix, IntVector
from uuvtai.surrogate.arrays import RAW_WIDTH, TRACK_WIDTH, TRUTH_WIDTH, At, Rules
from uuvtai.surrogate.motion import aim, part, path_places
from uuvtai.surrogate.observation import put_row, write_columns_of

RANGE_M = 12.0
FAN_SLOPE = 0.1763  # the sonar's fan: 10 degrees up and down
CAMERA_RANGE_M, HEIGHT_RANGE_M = 4.0, 3.0
"""the camera sees an obstacle up to the first, and knows how high it is up to the second"""
SPELL = 10  # decisions for which an obstacle is seen equally badly:
BEST, SPREAD, MISSED, MISSED_HIDDEN = 0.35, 0.325, 0.985, 0.94
"""first, and second over one minus a uniform number; no track beyond the third, or the fourth out of sight"""
BORN_S, SETTLED_S = 0.05, 0.07
"""seen so long, times how badly: a track; its velocity across the line of sight is known"""
TURN_KNOWN_S = 0.8  # seen so long, its turn rate is known
LOST_S, LOST_HEIGHT_S = 2.5, 6.0  # out of sight so long a track ends, later where its height is known
POSITION_SIGMA, VELOCITY_SIGMA_M_S, VELOCITY_SIGMA_S = 0.0042, 0.009, 0.0062
"""errors of the tracks, times how badly: of position per metre of distance; of velocity at no distance, and
per metre. EC, as are the constants around: by quantiles of the simulator's tracks"""
CAMERA_ALONE = 12.0  # times as badly is an obstacle seen that the camera sees and the sonar does not
QUICKEST, SLOWER, LAG_S = 0.6, 1.1, 0.04
"""share of a change of velocity that is seen at once, less beyond the middle uniform number; place lags"""
HIDDEN_SIGMA_M, HIDDEN_SIGMA = 0.02, 0.04
"""errors of position, and of velocity as a share of it, times how badly, when it goes out of sight"""
FIRST_NORMAL = 1024
"""number of the first draw of an error; those before it say how badly each obstacle is seen"""
UNBOUNDED_M = 99.0
RAY_SLACK = 0.01
"""of the angle between two rays, by which an obstacle is looked for wider than it is: rounding"""
COLUMN_M = 1.6  # free water above and below is cut off here
RAYS = [[math.cos(angle), math.sin(angle)] for angle in (i * TWO_PI / N_RAY for i in range(N_RAY))]
"""unit vectors (x, y)"""


@ti.func
def is_hidden(number, slot_count, here, at, obstacle: AnyTensor):
    """1 where a static obstacle stands between a place ``here`` and another (x, y)."""
    dx, dy = at[0] - here[0], at[1] - here[1]
    far = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3)
    to, out = ti.Vector([dx / far, dy / far]), 0
    for slot in range(slot_count):
        kind = ti.cast(obstacle[number, slot, 0], ti.i32)
        if out == 0 and kind != NONE:
            rx, ry = obstacle[number, slot, 1] - here[0], obstacle[number, slot, 2] - here[1]
            wide, deep = obstacle[number, slot, 4], obstacle[number, slot, 5]
            along, across = rx * to[0] + ry * to[1], ti.abs(rx * to[1] - ry * to[0])
            if kind == BOX:
                if across < ti.sqrt(wide * wide + deep * deep):
                    c, s = ti.cos(obstacle[number, slot, 7]), ti.sin(obstacle[number, slot, 7])
                    if free_to_box(rx, ry, to, c, s, wide, deep) < far:
                        out = 1
            elif along > 0.0 and along < far and across < 0.9 * wide:
                out = 1
    return out


@ti.func
def free_to_wall(at, to, io: Bundle[Rules]):
    """[m] from a place in a direction (x, y) to the nearest side wall."""
    out = UNBOUNDED_M + 0.0
    walls = ti.static((io.tank_cfg.x_m, io.tank_cfg.y_m))
    for i in ti.static(range(2)):
        if ti.abs(to[i]) > 1e-6:
            out = ti.min(out, (ti.select(to[i] > 0.0, walls[i][1], walls[i][0]) - at[i]) / to[i])
    return out


@ti.func
def free_to_box(dx, dy, to, c, s, wide, deep):
    """[m] in a direction to a box whose middle is (dx, dy) away, turned by an angle of cosine ``c``."""
    vx, vy = c * to[0] + s * to[1], c * to[1] - s * to[0]
    px, py = -(c * dx + s * dy), -(c * dy - s * dx)
    vx = vx if ti.abs(vx) > 1e-6 else 1e-6
    vy = vy if ti.abs(vy) > 1e-6 else 1e-6
    a, b = (-wide - px) / vx, (wide - px) / vx
    e, f = (-deep - py) / vy, (deep - py) / vy
    enter, leave = ti.max(ti.min(a, b), ti.min(e, f)), ti.min(ti.max(a, b), ti.max(e, f))
    return ti.max(enter, 0.0) if leave >= enter and leave > 0.0 else UNBOUNDED_M


@ti.func
def rays_towards(dx, dy, reach):
    """(first, count) of the rays that can meet an obstacle of this radius whose middle is (dx, dy) away."""
    first, count = 0, N_RAY
    far = ti.sqrt(dx * dx + dy * dy)
    if far > 1.01 * reach:
        half = (0.25 * TWO_PI * reach / far) * (N_RAY / TWO_PI) + RAY_SLACK
        at = ti.atan2(dy, dx) * (N_RAY / TWO_PI)
        first = ti.cast(ti.ceil(at - half), ti.i32)
        count = ti.min(ti.cast(ti.floor(at + half), ti.i32) - first + 1, N_RAY)
    return first, count


@ti.func
def write_rays(env, number, slot_count, at, obstacle: AnyTensor, ray: FloatMatrix, io: Bundle[Rules]):
    """[m] from a place (x, y) along each ray to the nearest wall or static obstacle, without the hull."""
    towards = ti.Matrix(ti.static(RAYS))
    for i in ti.static(range(N_RAY)):
        ray[env, i] = free_to_wall(at, ti.Vector([towards[i, 0], towards[i, 1]]), io)
    for slot in range(slot_count):
        kind = ti.cast(obstacle[number, slot, 0], ti.i32)
        if kind != NONE:
            dx, dy = obstacle[number, slot, 1] - at[0], obstacle[number, slot, 2] - at[1]
            wide, deep, c, s = obstacle[number, slot, 4], 0.0, 1.0, 0.0
            if kind == BOX:
                deep = obstacle[number, slot, 5]
                c, s = ti.cos(obstacle[number, slot, 7]), ti.sin(obstacle[number, slot, 7])
            first, count = rays_towards(dx, dy, ti.sqrt(wide * wide + deep * deep))
            for k in range(count):
                i = (first + k + N_RAY) % N_RAY
                to, free_m = ti.Vector([towards[i, 0], towards[i, 1]]), UNBOUNDED_M + 0.0
                along = dx * to[0] + dy * to[1]
                inside = along * along - (dx * dx + dy * dy) + wide * wide
                if kind == BOX:
                    free_m = free_to_box(dx, dy, to, c, s, wide, deep)
                elif inside > 0.0 and along > 0.0:
                    free_m = along - ti.sqrt(inside)
                ray[env, i] = ti.min(ray[env, i], free_m)


@ti.func
def sight_of(number, slot_count, here, yaw, at, radius, high, level, obstacle: AnyTensor):
    """Whether a moving obstacle at ``at`` (x, y) is seen from ``here``, its height is, it is in the fan."""
    dx, dy = at[0] - here[0], at[1] - here[1]
    far = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3)
    in_fan = ti.abs(here[2] - level) - high < ti.max(far - radius, 0.0) * FAN_SLOPE
    bearing = wrapped_angle(ti.atan2(dy, dx) - yaw)
    camera = ti.abs(bearing) < TWO_PI / 8 and far < CAMERA_RANGE_M
    is_visible, knows_height = False, False
    if far < RANGE_M and (in_fan or camera):
        is_visible = is_hidden(number, slot_count, here, at, obstacle) == 0
        knows_height = is_visible and camera and far < HEIGHT_RANGE_M
    return is_visible, knows_height, in_fan


@ti.func
def how_badly(drawn):
    """How badly an obstacle is seen, by a uniform number: 1 in the middle, with a long tail."""
    return BEST + SPREAD / (1.0 - ti.min(drawn, MISSED))


@ti.func
def updated_track(old, lane, at, bend_m, speed, ego_at, is_visible, knows_height, in_fan, key):
    """The row of ``track`` after a decision, of an obstacle at ``at`` (x, y, vx, vy), in error by the spell's
    ``key``; while unseen it goes straight on, or on its circle (``bend_m``: signed radius, else 0)."""
    new = old
    drawn = uniform(key, lane)
    first, second = normal_pair_lanes(key, FIRST_NORMAL + 2 * lane, 2)
    badly = how_badly(drawn)
    new[8] = drawn
    if bend_m != 0.0 and old[4] > SETTLED_S:
        turned = turned_z(ti.Vector([old[2], old[3]]), DECISION_S * speed / bend_m)
        new[2], new[3] = turned[0], turned[1]
    if knows_height:
        new[6] = 1.0
    if is_visible:
        if new[5] > LOST_S:
            new[4], new[2], new[3] = 0.0, 0.0, 0.0
        new[4] += DECISION_S
        new[5] = 0.0
        new[7] += ti.abs(speed) * DECISION_S
        share = 1.0 if new[4] < 0.25 else QUICKEST - SLOWER * ti.max(drawn - 0.5, 0.0)
        way = ti.Vector([at[0] - ego_at[0], at[1] - ego_at[1]])
        square = ti.max(way.norm_sqr(), 1e-6)
        far, vel = ti.sqrt(square), ti.Vector([at[2], at[3]])
        if new[4] < SETTLED_S * badly:
            vel = 0.5 * (vel + vel.dot(way) / square * way)
        if not in_fan:
            badly *= CAMERA_ALONE
        away, faster = badly * far * POSITION_SIGMA, badly * (VELOCITY_SIGMA_M_S + far * VELOCITY_SIGMA_S)
        for i in ti.static(range(2)):
            new[2 + i] += share * (vel[i] + faster * first[i] - new[2 + i])
            new[i] = at[i] + LAG_S * (new[2 + i] - at[2 + i]) + away * second[i]
    else:
        if new[5] < 0.5 * DECISION_S:
            away, faster = badly * HIDDEN_SIGMA_M, badly * HIDDEN_SIGMA * ti.abs(speed)
            for i in ti.static(range(2)):
                new[2 + i] += faster * first[i]
                new[i] += away * second[i]
        new[5] += DECISION_S
        for i in ti.static(range(2)):
            new[i] += DECISION_S * new[2 + i]
    return new


@ti.func
def is_tracked(track):
    """1 while the tracker has the obstacle of this row of ``track``."""
    unseen_s, drawn = track[5], track[8]
    limit_s = LOST_HEIGHT_S if track[6] > 0.5 else LOST_S
    is_born = track[4] >= BORN_S * how_badly(drawn) - 1e-4
    return unseen_s < limit_s and is_born and drawn < (MISSED_HIDDEN if unseen_s > 0.0 else MISSED)


@ti.func
def row_of_obstacle(track, places, is_known, turn_rate, over, under, radius):
    """What the tracker delivers (RAW_WIDTH,) of an obstacle that is tracked. A way that was watched once
    around (``is_known``) is foreseen as it is (``places``), a circle after a while, others straight on."""
    turn, out = turn_rate if track[4] > TURN_KNOWN_S else 0.0, ti.Vector.zero(ti.f32, RAW_WIDTH)
    for i in ti.static(range(4)):
        out[i] = track[i]
    out[4], out[5], out[8], out[13] = turn, radius, track[5], 1.0
    if track[6] > 0.5:
        out[6] = over if over > 0.0 else (COLUMN_M if under > 0.0 else 0.0)
        out[7] = under if under > 0.0 else (COLUMN_M if over > 0.0 else 0.0)
    for k in ti.static(range(2)):
        x, y = places[k + 1, 0] - places[0, 0], places[k + 1, 1] - places[0, 1]
        if not is_known:
            half = 0.5 * turn * (k + 1.0)
            arc = 1.0 if ti.abs(half) < 1e-4 else ti.sin(half) / half
            c, s = arc * (k + 1.0) * ti.cos(half), arc * (k + 1.0) * ti.sin(half)
            x, y = c * track[2] - s * track[3], s * track[2] + c * track[3]
        out[9 + 2 * k], out[10 + 2 * k] = x, y
    return out


@ti.func
def true_row(places, over, flip, here):
    """Where an obstacle is and will be, for the critic (TRUTH_WIDTH,)."""
    out = ti.Vector.zero(ti.f32, TRUTH_WIDTH)
    for k in ti.static(range(4)):
        first = ti.static(2 * k + 2 if k > 0 else 0)
        for i in ti.static(range(2)):
            out[first + i] = 0.25 * flip[i] * (places[k, i] - here[i])
    out[2], out[3] = 1.0, ti.math.clamp(over, -COLUMN_M, COLUMN_M)
    return out


@ti.kernel
def sense_surrogate(
    io: Bundle[Rules], seed: int, count: int,
    obstacle: AnyTensor, path: AnyTensor, route: AnyTensor,
    scenario: IntVector, ego: FloatMatrix, track: AnyTensor, raw: AnyTensor, ray: FloatMatrix,
    truth: AnyTensor, obstacles: AnyTensor, own: FloatMatrix,
):  # fmt: skip
    """Tracks, rays, truth for a critic, columns of a policy, after a decision or a reset. The noise is a
    function of (``seed``, ``count``) and the env. ``track`` (n, lanes, 9): estimated x, y, vx, vy; seen for
    [s]; not seen for [s]; 1 = height known; watched way [m]; uniform number of this spell."""
    for env in range(ego.shape[0]):
        number, n_static = scenario[env], obstacle.shape[1] - path.shape[1]
        here, flip = part(ego, env, At.POS, 3), part(ego, env, At.FLIP, 2)
        for lane in range(path.shape[1]):
            slot = n_static + lane
            told, real = ti.Vector.zero(ti.f32, RAW_WIDTH), ti.Vector.zero(ti.f32, TRUTH_WIDTH)
            if obstacle[number, slot, 0] > 0.5:
                key = episode_key(seed + (count + 3 * lane) // SPELL, env)  # spells do not begin all at once
                now = ego[env, At.TIME]
                places = path_places(number, lane, ti.Vector([now, now + 1.0, now + 2.0, now + 3.0]), path)
                at = ti.Vector([places[0, i] for i in ti.static(range(4))])
                is_circle, speed = path[number, lane, 0] < 0.5, path[number, lane, 4]
                bend_m = path[number, lane, 1] if is_circle else 0.0
                turn_rate = speed / bend_m if is_circle else 0.0
                level, radius = obstacle[number, slot, 3], obstacle[number, slot, 4]
                high = obstacle[number, slot, 6]
                is_visible, knows_height, in_fan = sight_of(
                    number, n_static, here, ego[env, At.YAW], at, radius, high, level, obstacle
                )
                old = ti.Vector([track[env, lane, i] for i in ti.static(range(TRACK_WIDTH))])
                new = updated_track(old, lane, at, bend_m, speed, here, is_visible, knows_height, in_fan, key)
                put_row(new, env, lane, track)
                over, under = level - high - here[2], here[2] - level - high
                if is_tracked(new):
                    is_known = not is_circle and new[7] > path[number, lane, 2]
                    told = row_of_obstacle(new, places, is_known, turn_rate, over, under, radius)
                real = true_row(places, over, flip, here)
            put_row(told, env, lane, raw)
            put_row(real, env, lane, truth)
        write_rays(env, number, n_static, here, obstacle, ray, io)
        aim(env, number, route, ego, io)
        write_columns_of(env, ego, raw, ray, obstacles, own)
