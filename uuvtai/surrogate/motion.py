"""The surrogate's step: the vehicle's velocity loops axis by axis, obstacles in closed form, and the
termination check's rules. An env knows the number of its scenario, three rows of a bank (``world.py``)."""

import taichi as ti

from uuvtai.common.enums import HOLD_STEPS, LEAST_SPEED_M_S, RUNNING, SUCCESS, TIMEOUT, TURN_GAIN
from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.kernels.core import geometry
from uuvtai.kernels.core.geometry import FAR_M, NONE, PI, foot_on, steady_direction, turned_z, wrapped_angle
from uuvtai.kernels.core.stage import AnyTensor, Bundle, Const, FloatMatrix, FloatVector, IntVector
from uuvtai.kernels.task.episode import threat_of, verdict
from uuvtai.kernels.vehicle.control import axis_loops, integrated
from uuvtai.kernels.world.motion import corner_shift
from uuvtai.surrogate.arrays import At, Rules


@ti.func
def part(rows: FloatMatrix, env, first, count: Const[int]):
    """``count`` columns of an env's row, from ``first`` on."""
    return ti.Vector([rows[env, first + i] for i in ti.static(range(count))])


@ti.func
def hull_command(wish, yaw, z_m, gap_m, vehicle_cfg: Const[VehicleConfig], tank_cfg: Const[TankConfig]):
    """(surge, sway, heave, yaw rate) in parts of the limits for a wished velocity [m/s] in the world: the
    hull's diagonal turns to the motion, for there surge and sway add up; ``gap_m`` from floor and surface."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    surge = (c * wish[0] + s * wish[1]) / vehicle_cfg.max_surge_m_s
    sway = (c * wish[1] - s * wish[0]) / vehicle_cfg.max_sway_m_s
    over = ti.max(1.0, ti.max(ti.abs(surge), ti.abs(sway)))
    lowest, highest = tank_cfg.z_m[0] + gap_m, tank_cfg.z_m[1] - gap_m
    rise = ti.math.clamp(wish[2], ti.min(lowest - z_m, 0.0), ti.max(highest - z_m, 0.0))
    turn = 0.0
    if wish[0] * wish[0] + wish[1] * wish[1] > LEAST_SPEED_M_S**2:
        off = wrapped_angle(ti.atan2(wish[1], wish[0]) - yaw)
        turn = off - 0.5 * PI * (ti.floor(off / (0.5 * PI)) + 0.5)
    heave = ti.math.clamp(rise / vehicle_cfg.max_heave_m_s, -1.0, 1.0)
    yaw_rate = ti.math.clamp(TURN_GAIN * turn / vehicle_cfg.max_yaw_rate_rad_s, -1.0, 1.0)
    return ti.Vector([surge / over, sway / over, heave, yaw_rate])


@ti.func
def carried_out(action):
    """What is carried out of an action: parts of the speed along the hull's diagonal, and of heave."""
    long = ti.max(1.0, ti.sqrt(action[0] * action[0] + action[1] * action[1]))
    return ti.Vector([action[0] / long, action[1] / long, ti.math.clamp(action[2], -1.0, 1.0)])


@ti.func
def wished_velocity(action, flip, vehicle_cfg: Const[VehicleConfig]):
    """Velocity [m/s] in the world of a policy's action; ``flip``: signs of the way to the goal (x, y)."""
    fastest = ti.sqrt(vehicle_cfg.max_surge_m_s**2 + vehicle_cfg.max_sway_m_s**2)
    out = carried_out(action)
    ahead, left = flip[0] * out[0] * fastest, flip[1] * out[1] * fastest
    return ti.Vector([ahead, left, out[2] * vehicle_cfg.max_heave_m_s])


NEAR_M = 1.5  # obstacles whose surface is farther cannot matter to termination check or reward within a step


@ti.func
def corner_of(number, lane, leg, path: AnyTensor):
    """(x, y) [m] at the begin of a leg of a closed polyline, counted on round after round."""
    at = 5 + 2 * (leg % int(path[number, lane, 0]))
    return ti.Vector([path[number, lane, at], path[number, lane, at + 1]])


@ti.func
def leg_of(number, lane, leg, path: AnyTensor):
    """The whole of a leg (x, y) [m]."""
    begin, end = corner_of(number, lane, leg, path), corner_of(number, lane, leg + 1, path)
    return ti.Vector([end[0] - begin[0], end[1] - begin[1]])


@ti.func
def way_direction(number, lane, leg, path: AnyTensor):
    """Unit vector along a leg."""
    way = leg_of(number, lane, leg, path)
    return way / ti.max(way.norm(), 1e-9)


@ti.func
def path_places(number, lane, times, path: AnyTensor):
    """Rows of (x, y, vx, vy) of a moving obstacle at some times [s], as the simulator moves it."""
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
        corner, leg = corner_of(number, lane, j, path), leg_of(number, lane, j, path)
        leg_m = leg.norm()
        scale = 1.0 / ti.max(leg_m, 1e-9)
        for k in ti.static(range(times.n)):
            if on_it[k] == 0 and (rest[k] < leg_m or j == n_way - 1):
                gone = ti.min(rest[k], leg_m) * scale
                for i in ti.static(range(2)):
                    out[k, i], out[k, 2 + i] = corner[i] + gone * leg[i], speed * scale * leg[i]
                if path[number, lane, 15] > 0:
                    before = way_direction(number, lane, j + n_way - 1, path)
                    then = way_direction(number, lane, j + 1, path)
                    shift = corner_shift(before, leg * scale, then, rest[k], leg_m, path[number, lane, 15])
                    for i in ti.static(range(2)):
                        out[k, i] += shift[i]  # type: ignore[index]
                        out[k, 2 + i] += speed * shift[2 + i]  # type: ignore[index]
                on_it[k] = 1
            rest[k] -= leg_m
    return out


@ti.func
def place_of(number, slot, t_s, obstacle: AnyTensor, path: AnyTensor):
    """(x, y, vx, vy) of an obstacle at a time."""
    out = ti.Vector([obstacle[number, slot, 1], obstacle[number, slot, 2], 0.0, 0.0])
    lane = slot - (obstacle.shape[1] - path.shape[1])
    if lane >= 0:
        place = path_places(number, lane, ti.Vector([t_s]), path)
        out = ti.Vector([place[0, i] for i in ti.static(range(4))])
    return out


@ti.func
def axis_step(vel, integral, command, axis: Const[int], io: Bundle[Rules]):
    """(velocity, integral) of an axis after a control step: the velocity loop against inertia and drag."""
    loop, at = ti.static(axis_loops(io.actuation_cfg)[axis], axis if axis < 3 else 5)
    own = ti.static(io.vehicle_cfg.mass_kg if axis < 3 else io.vehicle_cfg.inertia_kg_m2[2])
    inertia = ti.static(own + io.vehicle_cfg.added_mass[at])
    error = command - vel
    force = loop.gain * error + integral + io.vehicle_cfg.linear_damping[at] * error
    force += io.vehicle_cfg.quadratic_damping[at] * (ti.abs(command) * command - ti.abs(vel) * vel)
    per_step = loop.integral_gain * io.episode_cfg.control_dt_s
    after = integrated(integral, error, False, per_step, loop.band, loop.bound)
    return ti.Vector([vel + io.episode_cfg.control_dt_s * force / inertia, after])


@ti.func
def nearest_of(
    number, pos_w, axis_w, vel_w, rate, t_s, obstacle: AnyTensor, path: AnyTensor, io: Bundle[Rules]
):
    """(clearance [m] to the nearest obstacle or side wall, smallest time to collision [s]) as the termination
    check sees it; obstacles beyond ``NEAR_M`` are left out."""
    clearance, ttc = geometry.hull_to_side_wall(pos_w, axis_w, io.vehicle_cfg, io.tank_cfg), FAR_M + 0.0
    hull = io.vehicle_cfg.hull_radius_m + io.vehicle_cfg.hull_half_length_m
    for slot in range(obstacle.shape[1]):
        kind = ti.cast(obstacle[number, slot, 0], ti.i32)
        if kind != NONE:
            place = place_of(number, slot, t_s, obstacle, path)
            reach = obstacle[number, slot, 4] + obstacle[number, slot, 5] + hull + NEAR_M
            dx, dy = place[0] - pos_w[0], place[1] - pos_w[1]
            if dx * dx + dy * dy < reach * reach:
                at = ti.Vector([place[0], place[1], obstacle[number, slot, 3]])
                size = ti.Vector([obstacle[number, slot, 4 + i] for i in ti.static(range(3))])
                threat = threat_of(
                    pos_w, axis_w, vel_w, ti.Vector([0.0, 0.0, rate]), kind, at, size,
                    obstacle[number, slot, 7], ti.Vector([place[2], place[3], 0.0]),
                    io.episode_cfg, io.vehicle_cfg,
                )  # fmt: skip
                clearance, ttc = ti.min(clearance, threat[0]), ti.min(ttc, threat[1])
    return ti.Vector([clearance, ttc])


@ti.func
def earned(nearer_m, nearest_m, ended, io: Bundle[Rules]):
    """Reward of a decision that went ``nearer_m`` to the goal, and within ``nearest_m`` of something."""
    held_s = ti.static(HOLD_STEPS * io.episode_cfg.control_dt_s)
    close = ti.math.clamp(1.0 - nearest_m / io.surrogate_cfg.soft_clearance_m, 0.0, 1.0)
    per_s = io.surrogate_cfg.time_cost + io.surrogate_cfg.closeness_cost * close
    out = io.surrogate_cfg.progress * nearer_m - held_s * per_s
    if ended == SUCCESS:
        out += 1.0
    elif ended != RUNNING:
        out -= 0.0 if ended == TIMEOUT else 1.0
    return out


# ------------------------------------------------------------------------------------------------------------
# The route: planned once per scenario by the simulator's planner, which then knows all that stands still;
# followed by the simulator's rules (``kernels/planning/route.py``). Its rows are x, y and the length left.


WINDOW_M = 1.5  # so far ahead of the last foot the new one is looked for


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
def aim(env, number, route: AnyTensor, ego: FloatMatrix, io: Bundle[Rules]):
    """Look-ahead point and place beside the route, into the row of the vehicle."""
    arc, first = ego[env, At.ARC], segment_of(ego[env, At.ARC], route)
    wanted, i = ego[env, At.LEFT] - io.route_cfg.lookahead_m, first
    while i < route.shape[1] - 2 and route[number, i + 1, 2] > wanted:
        i += 1
    length = ti.max(route[number, i, 2] - route[number, i + 1, 2], 1e-9)
    share = ti.math.clamp((route[number, i, 2] - wanted) / length, 0.0, 1.0)
    point = way_point(number, i, route)
    point += (way_point(number, i + 1, route) - point) * share
    a = way_point(number, first, route)
    along = way_point(number, first + 1, route) - a
    off = part(ego, env, At.POS, 2) - a - along * (arc - first)
    ego[env, At.AHEAD], ego[env, At.AHEAD + 1] = point[0], point[1]
    is_left = along[0] * off[1] - along[1] * off[0] >= 0  # type: ignore[index]
    ego[env, At.ASIDE] = ti.select(is_left, off.norm(), -off.norm())


@ti.kernel
def drive_surrogate(
    io: Bundle[Rules], action: FloatMatrix,
    obstacle: AnyTensor, path: AnyTensor, route: AnyTensor,
    scenario: IntVector, ego: FloatMatrix, reward: FloatVector, outcome: IntVector,
):  # fmt: skip
    """``action`` (n, 3) of every env, held for ``HOLD_STEPS`` control steps or until the episode ends."""
    dt_s, gap_m = ti.static(io.episode_cfg.control_dt_s, io.surrogate_cfg.vertical_gap_m)
    for env in range(ego.shape[0]):
        number, goal_w, pos_w = scenario[env], part(ego, env, At.GOAL, 3), part(ego, env, At.POS, 3)
        vel = ti.Vector([ego[env, At.VEL], ego[env, At.VEL + 1], ego[env, At.VEL + 2], ego[env, At.RATE]])
        yaw, t_s = ego[env, At.YAW], ego[env, At.TIME]
        wish = wished_velocity(part(action, env, 0, 3), part(ego, env, At.FLIP, 2), io.vehicle_cfg)
        fastest = ti.Vector([
            io.vehicle_cfg.max_surge_m_s, io.vehicle_cfg.max_sway_m_s, io.vehicle_cfg.max_heave_m_s,
            io.vehicle_cfg.max_yaw_rate_rad_s,
        ])  # fmt: skip
        nearest, ended = 9.0, RUNNING
        for _ in range(HOLD_STEPS):
            if ended == RUNNING:
                asked = hull_command(wish, yaw, pos_w[2], gap_m, io.vehicle_cfg, io.tank_cfg)
                for axis in ti.static(range(4)):
                    wanted = fastest[axis] * asked[axis]
                    after = axis_step(vel[axis], ego[env, At.INTEGRAL + axis], wanted, axis, io)
                    vel[axis], ego[env, At.INTEGRAL + axis] = after[0], after[1]
                yaw += dt_s * vel[3]
                axis_w, level = ti.Vector([ti.cos(yaw), ti.sin(yaw), 0.0]), turned_z(vel, yaw)
                vel_w = ti.Vector([level[0], level[1], vel[2]])
                pos_w += dt_s * vel_w
                t_s += dt_s
                threat = nearest_of(number, pos_w, axis_w, vel_w, vel[3], t_s, obstacle, path, io)
                nearest = ti.min(nearest, threat[0])
                is_late = t_s >= io.episode_cfg.horizon_steps * dt_s - 1e-3
                ended = verdict(
                    pos_w, axis_w, goal_w, threat, is_late, io.episode_cfg, io.vehicle_cfg, io.tank_cfg
                )
        said = carried_out(part(action, env, 0, 3))
        for i in ti.static(range(3)):
            ego[env, At.POS + i], ego[env, At.VEL + i], ego[env, At.LAST + i] = pos_w[i], vel[i], said[i]
        ego[env, At.RATE], ego[env, At.YAW], ego[env, At.TIME] = vel[3], yaw, t_s
        arc = advanced_arc(number, ego[env, At.ARC], ti.Vector([pos_w[0], pos_w[1]]), route)
        left = length_left(number, arc, route)
        reward[env] = earned(ego[env, At.LEFT] - left, nearest, ended, io)
        ego[env, At.ARC], ego[env, At.LEFT] = arc, left
        outcome[env] = ended
