"""What the policy over a set of obstacles is told: the same columns of the surrogate, and of the simulator
as the vehicle senses and remembers it."""

import taichi as ti

from uuvtai.common.enums import EGO_COLUMNS, N_OBSTACLE, N_RAY, OBSTACLE_WIDTH, OWN_WIDTH
from uuvtai.envs.vector_env import ObservationColumn
from uuvtai.kernels.core.geometry import FAR_M, TWO_PI, turned_z
from uuvtai.kernels.core.grid import cell_of, clearance_of
from uuvtai.kernels.core.stage import AnyTensor, Bundle, FloatMatrix, IntVector
from uuvtai.surrogate.arrays import RAW_WIDTH, At, ObserverIO
from uuvtai.surrogate.motion import hull_command, part, wished_velocity

CONTROL_S = 0.02
SIGHT_M = 4.3  # rays end here
MARCHES = 14
LARGEST_TURN = 3.5  # [rad/s] a forecast that bends more has a corner in it


@ti.func
def put_row(row, env, lane, out: AnyTensor):
    for i in ti.static(range(row.n)):
        out[env, lane, i] = row[i]


@ti.func
def free_ray(env, x, y, ux, uy, io: Bundle[ObserverIO]):
    """[m] along a ray to the nearest occupied cell or wall of the map, in steps of the clearance."""
    far, hit = 0.0, 0
    n_row, n_col = ti.static(io.clearance.site.shape[1:])
    for _ in range(MARCHES):
        if hit == 0 and far <= SIGHT_M:
            cell = cell_of(ti.Vector([x + far * ux, y + far * uy]), io.tank_cfg, io.mapping_cfg.cell_m)
            row, col = ti.math.clamp(cell[0], 0, n_row - 1), ti.math.clamp(cell[1], 0, n_col - 1)
            clear = clearance_of(io.clearance.site[env, row, col], io.clearance_cfg, io.mapping_cfg.cell_m)
            if clear < 0.08:
                hit = 1
            else:
                far += ti.max(clear - 0.03, 0.05)
    return far


@ti.func
def row_of_track(env, track, io: Bundle[ObserverIO]):
    """One track as a row of the policy's obstacles (RAW_WIDTH,)."""
    pos_w, z = io.forecast.pos_w[env, track, 0], io.ego.pos_w[env][2]
    state = io.tracks.state[env, track]
    first = io.forecast.pos_w[env, track, 1] - pos_w
    second = io.forecast.pos_w[env, track, 2] - io.forecast.pos_w[env, track, 1]
    bend = ti.atan2(first[0] * second[1] - first[1] * second[0], first.dot(second))
    turn = bend / io.tracking_cfg.forecast_dt_s
    per_s = ti.static(round(1.0 / io.tracking_cfg.forecast_dt_s))
    one = io.forecast.pos_w[env, track, per_s] - pos_w
    two = io.forecast.pos_w[env, track, 2 * per_s] - pos_w
    unseen_s = (io.clock.step[env] - io.tracks.seen_step[env, track]) * CONTROL_S
    return ti.Vector([
        pos_w[0], pos_w[1], state[2], state[3],
        ti.select(ti.abs(turn) <= LARGEST_TURN, turn, 0.0), io.tracks.radius_m[env, track],
        io.forecast.above_w[env, track] - z, z - io.forecast.below_w[env, track], unseen_s,
        one[0], one[1], two[0], two[1], 1.0,
    ])  # fmt: skip


@ti.func
def next_track(env, after, slot, io: Bundle[ObserverIO]):
    """Gap [m] and slot (-1 = none) of the nearest track behind that in ``slot``, whose gap is ``after``."""
    best, chosen = FAR_M + 0.0, -1
    own = io.ego.pos_w[env]
    for track in range(ti.static(io.tracks.alive.shape[1])):
        if io.forecast.radius_m[env, track, 0] >= 0.0:
            away = io.forecast.pos_w[env, track, 0] - ti.Vector([own[0], own[1]])
            gap = away.norm() - io.tracks.radius_m[env, track]
            is_next = gap > after or (gap == after and track > slot)
            if is_next and gap < best:
                best, chosen = gap, track
    return best, chosen


@ti.func
def flip_of(env, io: Bundle[ObserverIO]):
    """Signs (1 or -1) of the way from the start to the goal in x and y."""
    goal_w, start_w = io.mission.goal_w[env], io.mission.start_w[env]
    return ti.Vector([ti.select(goal_w[i] < start_w[i], -1.0, 1.0) for i in ti.static(range(2))])


@ti.kernel
def observe_obstacles(
    io: Bundle[ObserverIO], due: IntVector, ego: FloatMatrix, raw: AnyTensor, ray: FloatMatrix
):
    """Rows of the vehicle, of its nearest tracks and of the free distances, where ``due`` is 1."""
    for env in range(due.shape[0]):
        if due[env] == 1:
            pos_w, vel_b, flip = io.ego.pos_w[env], io.ego.vel_b[env], flip_of(env, io)
            for i in ti.static(range(3)):
                ego[env, At.POS + i], ego[env, At.VEL + i] = pos_w[i], vel_b[i]
                ego[env, At.GOAL + i] = io.mission.goal_w[env][i]
            ego[env, At.YAW], ego[env, At.RATE] = io.ego.rpy[env][2], io.ego.rate_b[env][2]
            for i in ti.static(range(2)):
                ego[env, At.FLIP + i] = flip[i]
                ego[env, At.AHEAD + i] = io.route.lookahead_w[env][i]
                if io.route.n_way[env] == 0:  # straight on
                    ego[env, At.AHEAD + i] = io.mission.goal_w[env][i]
            ego[env, At.LEFT], ego[env, At.ASIDE] = io.route.remaining_m[env], io.route.cross_track_m[env]
            after, slot = -FAR_M, -1
            for lane in range(raw.shape[1]):
                after, slot = next_track(env, after, slot, io)
                row = ti.Vector.zero(ti.f32, RAW_WIDTH)
                if slot >= 0:
                    row = row_of_track(env, slot, io)
                put_row(row, env, lane, raw)
            for i in range(ray.shape[1]):
                angle = i * (TWO_PI / ray.shape[1])
                ray[env, i] = free_ray(env, pos_w[0], pos_w[1], ti.cos(angle), ti.sin(angle), io)


@ti.kernel
def command_hull(io: Bundle[ObserverIO], gap_m: float, action: FloatMatrix, command: FloatMatrix):
    """Commands (n, 4) of the policy's actions (n, 3), where each vehicle is now."""
    for env in range(action.shape[0]):
        wish = wished_velocity(part(action, env, 0, 3), flip_of(env, io), io.vehicle_cfg)
        out = hull_command(wish, io.ego.rpy[env][2], io.ego.pos_w[env][2], gap_m, io.vehicle_cfg, io.tank_cfg)
        for i in ti.static(range(4)):
            command[env, i] = out[i]


# ------------------------------------------------------------------------------------------------------------
# The columns. Everything is seen in the world mirrored so that the goal lies ahead and to the left at the
# start: four situations that mirror each other are one to the policy.


_END = EGO_COLUMNS + N_OBSTACLE * OBSTACLE_WIDTH
SET_TABLE = tuple(
    ObservationColumn(name, columns, unit, "mirrored world", meaning)
    for name, columns, unit, meaning in (
        ("set_own", slice(0, OWN_WIDTH), "mixed", "vehicle, route, goal, last action"),
        ("set_rays", slice(OWN_WIDTH, EGO_COLUMNS), "1/m", "nearness of walls"),
        ("set_obstacles", slice(EGO_COLUMNS, _END), "mixed", "nearest tracks"),
    )
)
"""for a checkpoint's manifest: the vehicle's own columns, then one obstacle's after the other"""

HULL_M = 0.22  # hull radius and half of its half length


@ti.func
def mirrored(env, ego: FloatMatrix):
    """Flips of x and y; velocity [m/s] and ways to goal and look-ahead point [m] in the mirrored frame."""
    flip, pos_w = part(ego, env, At.FLIP, 2), part(ego, env, At.POS, 2)
    speed = flip * turned_z(part(ego, env, At.VEL, 2), ego[env, At.YAW])
    way = flip * (part(ego, env, At.GOAL, 2) - pos_w)
    return flip, speed, way, flip * (part(ego, env, At.AHEAD, 2) - pos_w)


@ti.func
def length_of(way):
    """[m] never 0."""
    return ti.max(ti.sqrt(way[0] * way[0] + way[1] * way[1]), 1e-3)


@ti.func
def obstacle_columns(env, lane, flip, speed, ahead, ego: FloatMatrix, raw: AnyTensor):
    """What the policy is told of a track."""
    fx, fy, to_point = flip[0], flip[1], length_of(ahead)
    dx = fx * (raw[env, lane, 0] - ego[env, At.POS])
    dy = fy * (raw[env, lane, 1] - ego[env, At.POS + 1])
    bx, by = fx * raw[env, lane, 2], fy * raw[env, lane, 3]
    rx, ry, radius = bx - speed[0], by - speed[1], raw[env, lane, 5]
    gap = length_of(ti.Vector([dx, dy])) - radius
    when = ti.math.clamp(-(dx * rx + dy * ry) / ti.max(rx * rx + ry * ry, 1e-3), 0.0, 3.0)
    miss = ti.sqrt((dx + when * rx) ** 2 + (dy + when * ry) ** 2) - radius - HULL_M
    return ti.Vector([
        1.0, dx / 4, dy / 4, rx, ry, bx, by, 2 * radius,
        ti.math.clamp(raw[env, lane, 6], 0.0, 1.6), ti.math.clamp(raw[env, lane, 7], 0.0, 1.6),
        ti.min(raw[env, lane, 8], 4.0) / 2, ti.math.clamp(fx * fy * raw[env, lane, 4], -3.0, 3.0) / 2,
        (dx + fx * raw[env, lane, 9]) / 4, (dy + fy * raw[env, lane, 10]) / 4,
        (dx + fx * raw[env, lane, 11]) / 4, (dy + fy * raw[env, lane, 12]) / 4,
        ti.min(gap, 8.0) / 4, 1.0 / (0.3 + ti.max(gap - HULL_M, 0.0)),
        when, ti.math.clamp(miss, -1.0, 3.0), ahead[0] / to_point, ahead[1] / to_point,
    ])  # fmt: skip


@ti.func
def own_columns(env, flip, speed, way, ahead, ego: FloatMatrix):
    """What the policy is told of the vehicle, its route and its goal."""
    to_goal, to_point = length_of(way), length_of(ahead)
    x, y, z, yaw = ego[env, At.POS], ego[env, At.POS + 1], ego[env, At.POS + 2], ego[env, At.YAW]
    return ti.Vector([
        way[0] / 10, way[1] / 4, ego[env, At.GOAL + 2] - z,
        ahead[0] / to_point, ahead[1] / to_point, ti.min(to_goal, 4.0) / 4,
        speed[0], speed[1], 2 * ego[env, At.VEL + 2], z + 0.8,
        ego[env, At.LAST], ego[env, At.LAST + 1], ego[env, At.LAST + 2],
        ti.cos(4 * yaw), flip[0] * flip[1] * ti.sin(4 * yaw), flip[1] * (y - 3) / 3, flip[0] * (x - 10) / 10,
        way[0] / to_goal, way[1] / to_goal, ti.min(to_point, 2.0),
        ego[env, At.LEFT] / 10, ti.math.clamp(flip[0] * flip[1] * ego[env, At.ASIDE], -2.0, 2.0),
    ])  # fmt: skip


@ti.func
def mirrored_ray(i, env, ego: FloatMatrix):
    """Number of the ray that is number ``i`` in the mirrored frame."""
    at = i
    if ego[env, At.FLIP] < 0.0:
        at = (N_RAY // 2 - at + N_RAY) % N_RAY
    if ego[env, At.FLIP + 1] < 0.0:
        at = (N_RAY - at) % N_RAY
    return at


@ti.func
def write_columns_of(
    env, ego: FloatMatrix, raw: AnyTensor, ray: FloatMatrix, obstacles: AnyTensor, own: FloatMatrix
):
    flip, speed, way, ahead = mirrored(env, ego)
    for lane in range(raw.shape[1]):
        columns = ti.Vector.zero(ti.f32, OBSTACLE_WIDTH)
        if raw[env, lane, 13] > 0.5:
            columns = obstacle_columns(env, lane, flip, speed, ahead, ego, raw)
        put_row(columns, env, lane, obstacles)
    values = own_columns(env, flip, speed, way, ahead, ego)
    for i in ti.static(range(OWN_WIDTH)):
        own[env, i] = values[i]
    for i in range(N_RAY):
        free = ray[env, mirrored_ray(i, env, ego)]
        own[env, OWN_WIDTH + i] = 1.0 / (0.3 + ti.math.clamp(free - HULL_M, 0.0, 4.0)) - 0.5


@ti.kernel
def write_set_columns(
    ego: FloatMatrix, raw: AnyTensor, ray: FloatMatrix, obstacles: AnyTensor, own: FloatMatrix
):
    """``obstacles`` (n, lanes, OBSTACLE_WIDTH) and ``own`` (n, EGO_COLUMNS) from rows of the vehicle
    (``arrays.At``), tracks (n, lanes, RAW_WIDTH) and free distances (n, N_RAY) [m]."""
    for env in range(ego.shape[0]):
        write_columns_of(env, ego, raw, ray, obstacles, own)
