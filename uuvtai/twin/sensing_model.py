"""What the tracker delivers of the twin's bodies: a model of its delays, noise, field of view and memory, in
place of sonar and camera. Rays of free distance are those of the true walls and resting bodies."""

import taichi as ti

from uuvtai.kernels.core.geometry import BOX, NONE, TWO_PI, wrapped_angle
from uuvtai.kernels.core.noise import episode_key, normal, uniform
from uuvtai.kernels.core.signature import AnyTensor, Bundle, FloatMatrix, IntVector
from uuvtai.twin.kinematics import path_place
from uuvtai.twin.set_codes import N_RAY
from uuvtai.twin.twin_arrays import AT_FLIP, AT_POS, AT_TIME, AT_YAW, TwinRules

DT_S = 0.1
RANGE_M = 12.0
FAN_SLOPE = 0.1763
"""the sonar's fan: 10 degrees up and down"""
CAMERA_RANGE_M, HEIGHT_RANGE_M = 4.0, 3.0
"""the camera sees a body up to the first, and knows how high it is up to the second"""
SPELL = 10
"""decisions for which a body is seen equally well: part of it, at an edge of the fan, beside another"""
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
"""times as badly is a body seen that the camera sees and the sonar does not"""
QUICKEST, SLOWER, LAG_S = 0.6, 1.1, 0.04
"""share of a change of velocity that is seen at once; less of it beyond the middle uniform number; the place
is behind by so much of what is not seen yet"""
HIDDEN_SIGMA_M, HIDDEN_SIGMA = 0.02, 0.04
"""errors of position, and of velocity as a share of it, times how badly, when a body goes out of sight, which
it does part by part"""
UNBOUNDED_M = 99.0
"""nothing in the way of a ray"""
RAY_SLACK = 0.01
"""share of the angle between two rays by which a body is looked for wider than it is: rounding"""
COLUMN_M = 1.6
"""free water above and below is cut off here"""


@ti.func
def is_hidden(number, slot_count, x, y, to_x, to_y, body: AnyTensor):
    """1 where a resting body stands between a place and another."""
    dx, dy = to_x - x, to_y - y
    far = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3)
    ux, uy = dx / far, dy / far
    out = 0
    for slot in range(slot_count):
        if body[number, slot, 0] > 0.5:
            rx, ry = body[number, slot, 1] - x, body[number, slot, 2] - y
            along, across = rx * ux + ry * uy, ti.abs(rx * uy - ry * ux)
            wide = 0.9 * ti.max(body[number, slot, 4], body[number, slot, 5])
            if along > 0.0 and along < far and across < wide:
                out = 1
    return out


@ti.func
def ray_of(i):
    """Unit vector (x, y) of a ray, by its number."""
    angle = i * (TWO_PI / N_RAY)
    return ti.Vector([ti.cos(angle), ti.sin(angle)])


@ti.func
def free_to_wall(x, y, to, io: Bundle[TwinRules]):
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
    """(first, count) of the rays that can meet a body of this radius whose middle is (dx, dy) away: its half
    angle is at most pi/2 times the ratio of radius to distance."""
    first, count = 0, N_RAY
    far = ti.sqrt(dx * dx + dy * dy)
    if far > 1.01 * reach:
        half = (0.25 * TWO_PI * reach / far) * (N_RAY / TWO_PI) + RAY_SLACK
        at = ti.atan2(dy, dx) * (N_RAY / TWO_PI)
        first = ti.cast(ti.ceil(at - half), ti.i32)
        count = ti.min(ti.cast(ti.floor(at + half), ti.i32) - first + 1, N_RAY)
    return first, count


@ti.func
def write_rays(env, number, slot_count, x, y, body: AnyTensor, ray: FloatMatrix, io: Bundle[TwinRules]):
    """[m] from a place along each ray to the nearest wall or resting body, without the hull."""
    for i in range(N_RAY):
        ray[env, i] = free_to_wall(x, y, ray_of(i), io)
    for slot in range(slot_count):
        kind = ti.cast(body[number, slot, 0], ti.i32)
        if kind != NONE:
            dx, dy = body[number, slot, 1] - x, body[number, slot, 2] - y
            wide, deep, c, s = body[number, slot, 4], 0.0, 1.0, 0.0
            if kind == BOX:
                deep = body[number, slot, 5]
                c, s = ti.cos(body[number, slot, 7]), ti.sin(body[number, slot, 7])
            first, count = rays_towards(dx, dy, ti.sqrt(wide * wide + deep * deep))
            for k in range(count):
                i = (first + k + N_RAY) % N_RAY
                free_m = 0.0
                if kind == BOX:
                    free_m = free_to_box(dx, dy, ray_of(i), c, s, wide, deep)
                else:
                    free_m = free_to_circle(dx, dy, ray_of(i), wide)
                ray[env, i] = ti.min(ray[env, i], free_m)


@ti.func
def how_badly(drawn):
    """How badly a body is seen, by a uniform number: 1 in the middle, with a long tail."""
    return BEST + SPREAD / (1.0 - ti.min(drawn, MISSED))


@ti.func
def update_track(
    env,
    lane,
    number,
    at,
    is_visible,
    knows_height,
    in_fan,
    key,
    ego: FloatMatrix,
    path: AnyTensor,
    track: AnyTensor,
):
    """The track of a body that is at ``at`` (x, y, vx, vy): born late, its velocity across the line of sight
    known later, in error by what this spell (``key``) has for it; while it is not seen straight on, or on its
    circle."""
    drawn = uniform(key, lane)
    badly = how_badly(drawn)
    track[env, lane, 8] = drawn
    if path[number, lane, 0] < 0.5 and track[env, lane, 4] > SETTLED_S:
        turn = DT_S * path[number, lane, 4] / path[number, lane, 1]
        c, s = ti.cos(turn), ti.sin(turn)
        vx, vy = track[env, lane, 2], track[env, lane, 3]
        track[env, lane, 2], track[env, lane, 3] = c * vx - s * vy, s * vx + c * vy
    if knows_height:
        track[env, lane, 6] = 1.0
    if is_visible:
        if track[env, lane, 5] > LOST_S:
            track[env, lane, 4] = 0.0
            track[env, lane, 2], track[env, lane, 3] = 0.0, 0.0
        track[env, lane, 4] += DT_S
        track[env, lane, 5] = 0.0
        track[env, lane, 7] += ti.abs(path[number, lane, 4]) * DT_S
        share = 1.0 if track[env, lane, 4] < 0.25 else QUICKEST - SLOWER * ti.max(drawn - 0.5, 0.0)
        dx, dy = at[0] - ego[env, AT_POS], at[1] - ego[env, AT_POS + 1]
        square = ti.max(dx * dx + dy * dy, 1e-6)
        far, vx, vy = ti.sqrt(square), at[2], at[3]
        if track[env, lane, 4] < SETTLED_S * badly:
            radial = (vx * dx + vy * dy) / square
            vx, vy = 0.5 * (vx + radial * dx), 0.5 * (vy + radial * dy)
        if not in_fan:
            badly *= CAMERA_ALONE
        away, faster = badly * far * POSITION_SIGMA, badly * (VELOCITY_SIGMA_M_S + far * VELOCITY_SIGMA_S)
        track[env, lane, 2] += share * (vx + faster * normal(key, 4 * lane) - track[env, lane, 2])
        track[env, lane, 3] += share * (vy + faster * normal(key, 4 * lane + 1) - track[env, lane, 3])
        behind_x, behind_y = LAG_S * (track[env, lane, 2] - at[2]), LAG_S * (track[env, lane, 3] - at[3])
        track[env, lane, 0] = at[0] + behind_x + away * normal(key, 4 * lane + 2)
        track[env, lane, 1] = at[1] + behind_y + away * normal(key, 4 * lane + 3)
    else:
        if track[env, lane, 5] < 0.5 * DT_S:
            away, faster = badly * HIDDEN_SIGMA_M, badly * HIDDEN_SIGMA * ti.abs(path[number, lane, 4])
            track[env, lane, 2] += faster * normal(key, 4 * lane)
            track[env, lane, 3] += faster * normal(key, 4 * lane + 1)
            track[env, lane, 0] += away * normal(key, 4 * lane + 2)
            track[env, lane, 1] += away * normal(key, 4 * lane + 3)
        track[env, lane, 5] += DT_S
        track[env, lane, 0] += DT_S * track[env, lane, 2]
        track[env, lane, 1] += DT_S * track[env, lane, 3]


@ti.func
def is_tracked(env, lane, track: AnyTensor):
    """1 while the tracker has this body."""
    unseen_s, drawn = track[env, lane, 5], track[env, lane, 8]
    limit_s = LOST_HEIGHT_S if track[env, lane, 6] > 0.5 else LOST_S
    is_born = track[env, lane, 4] >= BORN_S * how_badly(drawn) - 1e-4
    return unseen_s < limit_s and is_born and drawn < (MISSED_HIDDEN if unseen_s > 0.0 else MISSED)


@ti.func
def write_raw(
    env, lane, number, at, over, under, t_s, radius, path: AnyTensor, track: AnyTensor, raw: AnyTensor
):
    """What the tracker delivers of a body that is tracked. A closed way that was watched once around is
    foreseen as it is, a circle after a while, other ways straight on."""
    circle = path[number, lane, 0] < 0.5
    turn = 0.0
    if circle and track[env, lane, 4] > TURN_KNOWN_S:
        turn = path[number, lane, 4] / path[number, lane, 1]
    for i in ti.static(range(4)):
        raw[env, lane, i] = track[env, lane, i]
    raw[env, lane, 4], raw[env, lane, 5], raw[env, lane, 8] = turn, radius, track[env, lane, 5]
    if track[env, lane, 6] > 0.5:
        raw[env, lane, 6] = over if over > 0.0 else (COLUMN_M if under > 0.0 else 0.0)
        raw[env, lane, 7] = under if under > 0.0 else (COLUMN_M if over > 0.0 else 0.0)
    is_known = not circle and track[env, lane, 7] > path[number, lane, 2]
    for k in ti.static(range(2)):
        half = 0.5 * turn * (k + 1.0)
        arc = 1.0 if ti.abs(half) < 1e-4 else ti.sin(half) / half
        c, s = arc * (k + 1.0) * ti.cos(half), arc * (k + 1.0) * ti.sin(half)
        raw[env, lane, 9 + 2 * k] = c * track[env, lane, 2] - s * track[env, lane, 3]
        raw[env, lane, 10 + 2 * k] = s * track[env, lane, 2] + c * track[env, lane, 3]
        if is_known:
            later = path_place(number, lane, t_s + (k + 1.0), path)
            raw[env, lane, 9 + 2 * k], raw[env, lane, 10 + 2 * k] = later[0] - at[0], later[1] - at[1]
    raw[env, lane, 13] = 1.0


@ti.func
def write_truth(env, lane, number, at, over, t_s, ego: FloatMatrix, path: AnyTensor, truth: AnyTensor):
    """Where a body is and will be, for the critic."""
    fx, fy = 0.25 * ego[env, AT_FLIP], 0.25 * ego[env, AT_FLIP + 1]
    x, y = ego[env, AT_POS], ego[env, AT_POS + 1]
    truth[env, lane, 0], truth[env, lane, 1] = fx * (at[0] - x), fy * (at[1] - y)
    truth[env, lane, 2], truth[env, lane, 3] = 1.0, ti.math.clamp(over, -COLUMN_M, COLUMN_M)
    for k in ti.static(range(3)):
        later = path_place(number, lane, t_s + (k + 1.0), path)
        truth[env, lane, 4 + 2 * k] = fx * (later[0] - x)
        truth[env, lane, 5 + 2 * k] = fy * (later[1] - y)


@ti.kernel
def sense_twin(
    io: Bundle[TwinRules],
    seed: int,
    count: int,
    body: AnyTensor,
    path: AnyTensor,
    scenario: IntVector,
    ego: FloatMatrix,
    track: AnyTensor,
    raw: AnyTensor,
    ray: FloatMatrix,
    truth: AnyTensor,
):
    """Tracks, rays, and what only a critic may see, after a decision or a reset. The noise is a function of
    (``seed``, ``count``) and the env.

    ``track`` (n, lanes, 9): estimated x, y, vx, vy; seen for [s]; not seen for [s]; 1 = height known; watched
    way [m]; uniform number of this spell.
    """
    for env in range(ego.shape[0]):
        number, t_s = scenario[env], ego[env, AT_TIME]
        n_rest = body.shape[1] - path.shape[1]
        x, y, z = ego[env, AT_POS], ego[env, AT_POS + 1], ego[env, AT_POS + 2]
        for lane in range(path.shape[1]):
            slot = n_rest + lane
            for i in range(raw.shape[2]):
                raw[env, lane, i] = 0.0
            for i in range(truth.shape[2]):
                truth[env, lane, i] = 0.0
            if body[number, slot, 0] > 0.5:
                key = episode_key(seed + (count + 3 * lane) // SPELL, env)  # spells do not begin all at once
                at = path_place(number, lane, t_s, path)
                radius, high, level = body[number, slot, 4], body[number, slot, 6], body[number, slot, 3]
                dx, dy = at[0] - x, at[1] - y
                far = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3)
                clear = is_hidden(number, n_rest, x, y, at[0], at[1], body) == 0
                fan = ti.abs(z - level) - high < ti.max(far - radius, 0.0) * FAN_SLOPE
                bearing = wrapped_angle(ti.atan2(dy, dx) - ego[env, AT_YAW])
                camera = clear and ti.abs(bearing) < TWO_PI / 8 and far < CAMERA_RANGE_M
                visible = clear and far < RANGE_M and (fan or camera)
                knows = camera and far < HEIGHT_RANGE_M
                update_track(env, lane, number, at, visible, knows, fan, key, ego, path, track)
                over, under = level - high - z, z - level - high
                if is_tracked(env, lane, track):
                    write_raw(env, lane, number, at, over, under, t_s, radius, path, track, raw)
                write_truth(env, lane, number, at, over, t_s, ego, path, truth)
        write_rays(env, number, n_rest, x, y, body, ray, io)
