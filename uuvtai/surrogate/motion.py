"""The surrogate's step: the vehicle's velocity loops axis by axis, obstacles in closed form, and the
termination check's rules, by the simulator's own distances.

Arrays are the caller's tensors. A scenario is three rows of a bank (``world.py``), which is never
written: an env knows the number of its scenario.
"""

import taichi as ti

from uuvtai.common.enums import (
    COLLISION,
    LEAST_SPEED_M_S,
    OUT_OF_TANK,
    RUNNING,
    SUCCESS,
    TIMEOUT,
    TTC,
    TURN_GAIN,
)
from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.kernels.core.geometry import (
    FAR_M,
    NONE,
    PI,
    foot_on,
    hull_to_floor_or_surface,
    hull_to_obstacle,
    hull_to_side_wall,
    is_in_tank,
    steady_direction,
    wrapped_angle,
)
from uuvtai.kernels.core.stage import AnyTensor, Bundle, Const, FloatMatrix, FloatVector, IntVector
from uuvtai.kernels.vehicle.control import axis_loops, integrated
from uuvtai.kernels.world.motion import corner_shift
from uuvtai.surrogate.arrays import (
    AT_AHEAD,
    AT_ARC,
    AT_ASIDE,
    AT_FLIP,
    AT_GOAL,
    AT_INTEGRAL,
    AT_LAST,
    AT_LEFT,
    AT_POS,
    AT_RATE,
    AT_TIME,
    AT_VEL,
    AT_YAW,
    SurrogateRules,
)

# ------------------------------------------------------------------------------------------------------------
# The fixed rule that lays a velocity in the world on the hull: where it is wanted to go, not how.


@ti.func
def hull_command(wish, yaw, z_m, gap_m, vehicle_cfg: Const[VehicleConfig], tank_cfg: Const[TankConfig]):
    """(surge, sway, heave, yaw rate) in parts of the vehicle's limits for a wished velocity [m/s] in the
    world.

    A diagonal of the hull is turned along the motion, for there surge and sway add up; heave is held back so
    that the centre stays ``gap_m`` from floor and surface.
    """
    c, s = ti.cos(yaw), ti.sin(yaw)
    surge = (c * wish[0] + s * wish[1]) / vehicle_cfg.max_surge_m_s
    sway = (c * wish[1] - s * wish[0]) / vehicle_cfg.max_sway_m_s
    over = ti.max(1.0, ti.max(ti.abs(surge), ti.abs(sway)))
    rise = ti.min(
        ti.max(wish[2], ti.min(tank_cfg.z_m[0] + gap_m - z_m, 0.0)),
        ti.max(tank_cfg.z_m[1] - gap_m - z_m, 0.0),
    )
    turn = 0.0
    if wish[0] * wish[0] + wish[1] * wish[1] > LEAST_SPEED_M_S**2:
        off = wrapped_angle(ti.atan2(wish[1], wish[0]) - yaw)
        turn = off - 0.5 * PI * (ti.floor(off / (0.5 * PI)) + 0.5)
    return ti.Vector(
        [
            surge / over,
            sway / over,
            ti.math.clamp(rise / vehicle_cfg.max_heave_m_s, -1.0, 1.0),
            ti.math.clamp(TURN_GAIN * turn / vehicle_cfg.max_yaw_rate_rad_s, -1.0, 1.0),
        ]
    )


@ti.func
def wished_velocity(x, y, z, flip_x, flip_y, vehicle_cfg: Const[VehicleConfig]):
    """Velocity [m/s] in the world of a policy's action (parts of the speed along the hull's diagonal, and of
    heave) in the frame in which the goal lies ahead and to the left."""
    fastest = ti.sqrt(vehicle_cfg.max_surge_m_s**2 + vehicle_cfg.max_sway_m_s**2)
    long = ti.max(1.0, ti.sqrt(x * x + y * y))
    return ti.Vector(
        [
            flip_x * x / long * fastest,
            flip_y * y / long * fastest,
            ti.math.clamp(z, -1.0, 1.0) * vehicle_cfg.max_heave_m_s,
        ]
    )


# ------------------------------------------------------------------------------------------------------------


STEPS = 5
"""control steps that a decision is held"""
NEAR_M = 1.5
"""obstacles whose surface is farther cannot matter to termination check or reward within a step"""
DRIVEN_M = 0.3
"""more than a hull moves while a decision is held"""
EVERY_SLOT = -1
"""as ``near_slots``, of all obstacles"""


@ti.func
def way_direction(number, lane, leg, path: AnyTensor):
    """Unit vector along a leg of a closed polyline; legs are counted on, round after round."""
    n_way = int(path[number, lane, 0])
    i, j = 5 + 2 * (leg % n_way), 5 + 2 * ((leg + 1) % n_way)
    way = ti.Vector([path[number, lane, j] - path[number, lane, i], 0.0])
    way[1] = path[number, lane, j + 1] - path[number, lane, i + 1]
    return way / ti.max(way.norm(), 1e-9)


@ti.func
def path_places(number, lane, times, path: AnyTensor):
    """Rows of (x, y, vx, vy) of a moving obstacle of scenario ``number`` at some times [s], as the simulator
    moves it."""
    length, speed = path[number, lane, 2], path[number, lane, 4]
    n_way = int(path[number, lane, 0])
    out = ti.Matrix.zero(ti.f32, times.n, 4)
    rest, on_it = ti.Vector.zero(ti.f32, times.n), ti.Vector.zero(ti.i32, times.n)
    for k in ti.static(range(times.n)):
        arc = path[number, lane, 3] + speed * times[k]
        rest[k] = arc - length * ti.floor(arc / length)
    if n_way == 0:
        turn = path[number, lane, 1]
        sign = 1.0 if turn > 0.0 else -1.0
        for k in ti.static(range(times.n)):
            ahead = steady_direction(rest[k] / turn)
            out[k, 0] = path[number, lane, 5] + ti.abs(turn) * ahead[0]
            out[k, 1] = path[number, lane, 6] + ti.abs(turn) * ahead[1]
            out[k, 2], out[k, 3] = -sign * ahead[1] * speed, sign * ahead[0] * speed
    for j in range(n_way):
        after = (j + 1) % n_way
        x, y = path[number, lane, 5 + 2 * j], path[number, lane, 6 + 2 * j]
        leg_x, leg_y = path[number, lane, 5 + 2 * after] - x, path[number, lane, 6 + 2 * after] - y
        leg_m = ti.sqrt(leg_x * leg_x + leg_y * leg_y)
        scale = 1.0 / ti.max(leg_m, 1e-9)
        for k in ti.static(range(times.n)):
            if on_it[k] == 0 and (rest[k] < leg_m or j == n_way - 1):
                gone = ti.min(rest[k], leg_m) * scale
                out[k, 0], out[k, 1] = x + gone * leg_x, y + gone * leg_y
                out[k, 2], out[k, 3] = speed * scale * leg_x, speed * scale * leg_y
                if path[number, lane, 15] > 0:
                    before = way_direction(number, lane, j + n_way - 1, path)
                    here, then = ti.Vector([leg_x, leg_y]) * scale, way_direction(number, lane, j + 1, path)
                    shift = corner_shift(before, here, then, rest[k], leg_m, path[number, lane, 15])
                    for i in ti.static(range(2)):
                        out[k, i] += shift[i]  # type: ignore[index]
                        out[k, 2 + i] += speed * shift[2 + i]  # type: ignore[index]
                on_it[k] = 1
            rest[k] -= leg_m
    return out


@ti.func
def path_place(number, lane, t_s, path: AnyTensor):
    """(x, y, vx, vy) of a moving obstacle at a time."""
    place = path_places(number, lane, ti.Vector([t_s]), path)
    return ti.Vector([place[0, 0], place[0, 1], place[0, 2], place[0, 3]])


def axis_drag(cfg, axis):
    """(inertia with added mass, linear, quadratic damping) of surge, sway, heave or yaw; plain Python,
    constants of the kernel."""
    at = axis if axis < 3 else 5
    inertia = cfg.mass_kg if axis < 3 else cfg.inertia_kg_m2[2]
    return inertia + cfg.added_mass[at], cfg.linear_damping[at], cfg.quadratic_damping[at]


@ti.func
def axis_step(vel, integral, command, axis: Const[int], io: Bundle[SurrogateRules]):
    """(velocity, integral) of one of surge, sway, heave, yaw rate after a control step: the simulator's
    velocity loop, whose feed-forward cancels Coriolis forces, against inertia and drag of this axis alone."""
    loops = ti.static(axis_loops(io.actuation_cfg))
    inertia, linear, quadratic = ti.static(axis_drag(io.vehicle_cfg, axis))
    error = command - vel
    force = loops[axis].gain * error + integral + linear * error
    force += quadratic * (ti.abs(command) * command - ti.abs(vel) * vel)
    per_step = loops[axis].integral_gain * io.episode_cfg.control_dt_s
    after = integrated(integral, error, False, per_step, loops[axis].band, loops[axis].bound)
    return ti.Vector([vel + io.episode_cfg.control_dt_s * force / inertia, after])


@ti.func
def reach_of(number, slot, obstacle: AnyTensor, io: Bundle[SurrogateRules]):
    """[m] between the centres of hull and body from which on the obstacle is left out."""
    hull = io.vehicle_cfg.hull_radius_m + io.vehicle_cfg.hull_half_length_m
    return obstacle[number, slot, 4] + obstacle[number, slot, 5] + hull + NEAR_M


@ti.func
def near_slots(number, pos_w, t_s, obstacle: AnyTensor, path: AnyTensor, io: Bundle[SurrogateRules]):
    """A bit for each slot whose body can come near while a decision is held; slots beyond the bits count as
    near."""
    out = 0
    n_obstacle, n_lane = obstacle.shape[1], path.shape[1]
    for slot in range(ti.min(n_obstacle, 31)):
        if obstacle[number, slot, 0] > 0.5:
            x, y, farthest = obstacle[number, slot, 1], obstacle[number, slot, 2], DRIVEN_M + 0.0
            lane = slot - (n_obstacle - n_lane)
            if lane >= 0:
                place = path_place(number, lane, t_s, path)
                x, y = place[0], place[1]
                farthest += path[number, lane, 4] * STEPS * io.episode_cfg.control_dt_s
            reach = reach_of(number, slot, obstacle, io) + farthest
            dx, dy = x - pos_w[0], y - pos_w[1]
            if dx * dx + dy * dy < reach * reach:
                out |= 1 << slot
    return out


@ti.func
def nearest_of(
    near,
    number,
    pos_w,
    axis_w,
    vel_w,
    rate,
    t_s,
    obstacle: AnyTensor,
    path: AnyTensor,
    io: Bundle[SurrogateRules],
):
    """(clearance [m] to the nearest obstacle or side wall, smallest time to collision [s]) as the termination
    check sees it; obstacles beyond ``NEAR_M``, and those whose bit is not in ``near``, are left out."""
    clearance = hull_to_side_wall(pos_w, axis_w, io.vehicle_cfg, io.tank_cfg)
    ttc = FAR_M + 0.0
    n_obstacle, n_lane = obstacle.shape[1], path.shape[1]
    for slot in range(n_obstacle):
        kind = ti.cast(obstacle[number, slot, 0], ti.i32)
        if kind != NONE and ((near >> ti.min(slot, 31)) & 1 == 1 or slot > 30):
            at = ti.Vector([obstacle[number, slot, 1], obstacle[number, slot, 2], obstacle[number, slot, 3]])
            obstacle_vel = ti.Vector([0.0, 0.0, 0.0])
            lane = slot - (n_obstacle - n_lane)
            if lane >= 0:
                place = path_place(number, lane, t_s, path)
                at[0], at[1] = place[0], place[1]
                obstacle_vel[0], obstacle_vel[1] = place[2], place[3]
            size = ti.Vector(
                [obstacle[number, slot, 4], obstacle[number, slot, 5], obstacle[number, slot, 6]]
            )
            reach = reach_of(number, slot, obstacle, io)
            dx, dy = at[0] - pos_w[0], at[1] - pos_w[1]
            if dx * dx + dy * dy < reach * reach:
                gap, normal, along = hull_to_obstacle(
                    pos_w, axis_w, kind, at, size, obstacle[number, slot, 7], io.vehicle_cfg
                )
                hull_vel = vel_w + along * ti.Vector([0.0, 0.0, rate]).cross(axis_w)
                closing = (hull_vel - obstacle_vel).dot(normal)
                clearance = ti.min(clearance, gap)
                if closing > io.episode_cfg.ttc_closing_m_s:
                    ttc = ti.min(ttc, ti.max(gap, 0.0) / closing)
    return ti.Vector([clearance, ttc])


@ti.func
def verdict_of(pos_w, axis_w, goal_w, clearance, ttc, t_s, io: Bundle[SurrogateRules]):
    """How the episode stands, in the order of the termination check's rules."""
    to_goal = goal_w - pos_w
    out = RUNNING
    if is_in_tank(pos_w, io.tank_cfg) == 0:
        out = OUT_OF_TANK
    elif (
        clearance < io.episode_cfg.collision_clearance_m
        or hull_to_floor_or_surface(pos_w, axis_w, io.vehicle_cfg, io.tank_cfg) < 0.0
    ):
        out = COLLISION
    elif ttc < io.episode_cfg.ttc_s:
        out = TTC
    elif to_goal.dot(to_goal) <= io.episode_cfg.goal_radius_m**2:
        out = SUCCESS
    elif t_s >= io.episode_cfg.horizon_steps * io.episode_cfg.control_dt_s - 1e-3:
        out = TIMEOUT
    return out


@ti.func
def earned(nearer_m, nearest_m, ended, io: Bundle[SurrogateRules]):
    """Reward of a decision that brought the vehicle ``nearer_m`` to its goal along the route and, at the
    worst, within ``nearest_m`` of anything."""
    held_s = ti.static(STEPS * io.episode_cfg.control_dt_s)
    close = ti.math.clamp(1.0 - nearest_m / io.surrogate_cfg.soft_clearance_m, 0.0, 1.0)
    out = io.surrogate_cfg.progress * nearer_m - held_s * (
        io.surrogate_cfg.time_cost + io.surrogate_cfg.closeness_cost * close
    )
    if ended == SUCCESS:
        out += 1.0
    elif ended != RUNNING:
        out -= 0.0 if ended == TIMEOUT else 1.0
    return out


@ti.func
def asked_speeds(wish, yaw, z, io: Bundle[SurrogateRules]):
    """[m/s, rad/s] surge, sway, heave and yaw rate that the hull is asked for at a depth."""
    part = hull_command(wish, yaw, z, io.surrogate_cfg.vertical_gap_m, io.vehicle_cfg, io.tank_cfg)
    return ti.Vector(
        [
            part[0] * io.vehicle_cfg.max_surge_m_s,
            part[1] * io.vehicle_cfg.max_sway_m_s,
            part[2] * io.vehicle_cfg.max_heave_m_s,
            part[3] * io.vehicle_cfg.max_yaw_rate_rad_s,
        ]
    )


# ------------------------------------------------------------------------------------------------------------
# The route: planned once per scenario by the simulator's planner, which then knows all that stands still;
# followed by the simulator's rules (``kernels/planning/route.py``). Its rows are x, y and the length left.


WINDOW_M = 1.5
"""so far ahead of the last foot the new one is looked for"""


@ti.func
def way_point(number, i, route: AnyTensor):
    """(x, y) [m] of a waypoint."""
    return ti.Vector([route[number, i, 0], route[number, i, 1]])


@ti.func
def segment_of(arc, route: AnyTensor):
    """Index of the segment that a fractional waypoint lies on."""
    return ti.math.clamp(ti.cast(ti.floor(arc), ti.i32), 0, route.shape[1] - 2)


@ti.func
def length_left(number, arc, route: AnyTensor):
    """[m] from the foot to the goal."""
    i = segment_of(arc, route)
    return route[number, i, 2] + (route[number, i + 1, 2] - route[number, i, 2]) * (arc - i)


@ti.func
def advanced_arc(number, arc, pos_w, route: AnyTensor):
    """Foot of the vehicle: the nearest point from the last foot on, within ``WINDOW_M``."""
    first = segment_of(arc, route)
    a = way_point(number, first, route)
    foot = a + (way_point(number, first + 1, route) - a) * (arc - first)
    nearest, out, i = (pos_w - foot).norm_sqr(), arc, first
    while i < route.shape[1] - 1 and route[number, first, 2] - route[number, i, 2] <= WINDOW_M:
        a = way_point(number, i, route)
        along = way_point(number, i + 1, route) - a
        share, gap = foot_on(pos_w, a, along, arc - first if i == first else 0.0)
        if gap < nearest:
            nearest, out = gap, i + share
        i += 1
        if route[number, i, 2] <= 0.0:
            break
    return out


@ti.func
def aim(env, number, route: AnyTensor, ego: FloatMatrix, io: Bundle[SurrogateRules]):
    """Look-ahead point and place beside the route, into the row of the vehicle."""
    arc, first = ego[env, AT_ARC], segment_of(ego[env, AT_ARC], route)
    wanted, i = ego[env, AT_LEFT] - io.route_cfg.lookahead_m, first
    while i < route.shape[1] - 2 and route[number, i + 1, 2] > wanted:
        i += 1
    length = ti.max(route[number, i, 2] - route[number, i + 1, 2], 1e-9)
    share = ti.math.clamp((route[number, i, 2] - wanted) / length, 0.0, 1.0)
    point = way_point(number, i, route)
    point += (way_point(number, i + 1, route) - point) * share
    a = way_point(number, first, route)
    along = way_point(number, first + 1, route) - a
    off = ti.Vector([ego[env, AT_POS], ego[env, AT_POS + 1]]) - a - along * (arc - first)
    ego[env, AT_AHEAD], ego[env, AT_AHEAD + 1] = point[0], point[1]
    is_left = along[0] * off[1] - along[1] * off[0] >= 0  # type: ignore[index]
    ego[env, AT_ASIDE] = ti.select(is_left, off.norm(), -off.norm())


# ------------------------------------------------------------------------------------------------------------


@ti.kernel
def drive_surrogate(
    io: Bundle[SurrogateRules],
    action: FloatMatrix,
    obstacle: AnyTensor,
    path: AnyTensor,
    route: AnyTensor,
    scenario: IntVector,
    ego: FloatMatrix,
    reward: FloatVector,
    outcome: IntVector,
):
    """One decision of every env: ``action`` (n, 3) held for ``STEPS`` control steps, or until the episode
    ends."""
    dt_s = ti.static(io.episode_cfg.control_dt_s)
    for env in range(ego.shape[0]):
        number = scenario[env]
        goal_w = ti.Vector([ego[env, AT_GOAL + i] for i in ti.static(range(3))])
        pos_w = ti.Vector([ego[env, AT_POS + i] for i in ti.static(range(3))])
        vel = ti.Vector([ego[env, AT_VEL], ego[env, AT_VEL + 1], ego[env, AT_VEL + 2], ego[env, AT_RATE]])
        yaw, t_s = ego[env, AT_YAW], ego[env, AT_TIME]
        wish = wished_velocity(
            action[env, 0],
            action[env, 1],
            action[env, 2],
            ego[env, AT_FLIP],
            ego[env, AT_FLIP + 1],
            io.vehicle_cfg,
        )
        nearest, ended = 9.0, RUNNING
        near = near_slots(number, pos_w, t_s, obstacle, path, io)
        for _ in range(STEPS):
            if ended == RUNNING:
                asked = asked_speeds(wish, yaw, pos_w[2], io)
                for axis in ti.static(range(4)):
                    after = axis_step(vel[axis], ego[env, AT_INTEGRAL + axis], asked[axis], axis, io)
                    vel[axis], ego[env, AT_INTEGRAL + axis] = after[0], after[1]
                yaw += dt_s * vel[3]
                c, s = ti.cos(yaw), ti.sin(yaw)
                vel_w = ti.Vector([c * vel[0] - s * vel[1], s * vel[0] + c * vel[1], vel[2]])
                pos_w += dt_s * vel_w
                t_s += dt_s
                axis_w = ti.Vector([c, s, 0.0])
                threat = nearest_of(near, number, pos_w, axis_w, vel_w, vel[3], t_s, obstacle, path, io)
                nearest = ti.min(nearest, threat[0])
                ended = verdict_of(pos_w, axis_w, goal_w, threat[0], threat[1], t_s, io)
        for i in ti.static(range(3)):
            ego[env, AT_POS + i] = pos_w[i]
            ego[env, AT_VEL + i] = vel[i]
        ego[env, AT_RATE], ego[env, AT_YAW], ego[env, AT_TIME] = vel[3], yaw, t_s
        long = ti.max(1.0, ti.sqrt(action[env, 0] ** 2 + action[env, 1] ** 2))
        ego[env, AT_LAST], ego[env, AT_LAST + 1] = action[env, 0] / long, action[env, 1] / long
        ego[env, AT_LAST + 2] = ti.math.clamp(action[env, 2], -1.0, 1.0)
        arc = advanced_arc(number, ego[env, AT_ARC], ti.Vector([pos_w[0], pos_w[1]]), route)
        left = length_left(number, arc, route)
        reward[env] = earned(ego[env, AT_LEFT] - left, nearest, ended, io)
        ego[env, AT_ARC], ego[env, AT_LEFT] = arc, left
        outcome[env] = ended


@ti.kernel
def begin_surrogate(
    begun: IntVector,
    mission: FloatMatrix,
    route: AnyTensor,
    scenario: IntVector,
    ego: FloatMatrix,
    track: AnyTensor,
):
    """At rest at the start of their scenarios, nothing seen, in the envs where ``begun`` is 1."""
    for env in range(ego.shape[0]):
        if begun[env] == 1:
            for i in range(ego.shape[1]):
                ego[env, i] = 0.0
            number = scenario[env]
            for i in ti.static(range(3)):
                ego[env, AT_POS + i] = mission[number, i]
                ego[env, AT_GOAL + i] = mission[number, 3 + i]
            ego[env, AT_YAW], ego[env, AT_LEFT] = mission[number, 6], route[number, 0, 2]
            ego[env, AT_FLIP] = 1.0 if mission[number, 3] >= mission[number, 0] else -1.0
            ego[env, AT_FLIP + 1] = 1.0 if mission[number, 4] >= mission[number, 1] else -1.0
            for lane in range(track.shape[1]):
                for i in range(track.shape[2]):
                    track[env, lane, i] = 0.0
                track[env, lane, 5] = 9.0


@ti.kernel
def check_states(
    io: Bundle[SurrogateRules],
    pose: FloatMatrix,
    obstacle: AnyTensor,
    path: AnyTensor,
    seen: FloatMatrix,
    outcome: IntVector,
):
    """Clearance [m] and time to collision [s] into ``seen`` (n, 2), and the verdict, of states (n, 12): x, y,
    z, yaw, velocity in the world, yaw rate, time, goal. State i is judged in scenario i; for comparisons."""
    for env in range(pose.shape[0]):
        pos_w = ti.Vector([pose[env, 0], pose[env, 1], pose[env, 2]])
        axis_w = ti.Vector([ti.cos(pose[env, 3]), ti.sin(pose[env, 3]), 0.0])
        vel_w = ti.Vector([pose[env, 4], pose[env, 5], pose[env, 6]])
        goal_w = ti.Vector([pose[env, 9], pose[env, 10], pose[env, 11]])
        t_s = pose[env, 8]
        threat = nearest_of(EVERY_SLOT, env, pos_w, axis_w, vel_w, pose[env, 7], t_s, obstacle, path, io)
        seen[env, 0], seen[env, 1] = threat[0], threat[1]
        outcome[env] = verdict_of(pos_w, axis_w, goal_w, threat[0], threat[1], t_s, io)
