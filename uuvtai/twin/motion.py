"""The twin's kernel of motion: a vehicle by fitted lags, bodies in closed form, the simulator's referee."""

import math
from typing import TYPE_CHECKING, Any

import taichi as ti

from uuvtai.config import TankConfig, VehicleConfig
from uuvtai.kernels.core.geometry import NONE
from uuvtai.kernels.core.hull import hull_to_body, hull_to_side_wall, is_in_tank
from uuvtai.kernels.core.signature import AnyTensor as Tensor3
from uuvtai.kernels.core.signature import Const, FloatVector, IntVector
from uuvtai.kernels.core.signature import FloatMatrix as Tensor2
from uuvtai.outcomes import COLLISION, OUT_OF_TANK, RUNNING, SUCCESS, TIMEOUT, TTC
from uuvtai.twin.tensors import AXIS_M_S, CLIMB_M_S, CRUISE_M_S, DECISION_S, MARGIN_M, MOVERS, STATICS, WAY

if TYPE_CHECKING:
    Seconds = Rules = Any
else:
    Seconds, Rules = ti.f32, ti.template()

SURGE_LAG_S, SWAY_LAG_S, HEAVE_LAG_S, RATE_LAG_S = 0.25, 0.33, 0.34, 0.15
"""time constants, by eye from step responses of the simulator; no overshoot"""
TURN_GAIN = 2.5
"""[1/s] turn rate per angle between a hull diagonal and the way"""
SLOW_M_S = 0.1
"""below this the way has no direction worth turning to"""
SUBSTEPS = 5
"""of a decision: the referee judges at the simulator's 50 Hz"""
_NEAR_M = 1.2
"""a body farther than this can neither touch nor count as near"""
_QUARTER = math.pi / 2


@ti.func
def body_on_path(mover: Tensor3, env, lane, time_s):
    """(x, y, vx, vy) of a moving body at a time since the episode's start."""
    n_way = int(mover[env, lane, 4])
    length, speed = mover[env, lane, 6], mover[env, lane, 8]
    arc = mover[env, lane, 7] + speed * time_s
    rest = arc - length * ti.floor(arc / ti.max(length, 1e-6))
    out = ti.Vector([mover[env, lane, WAY], mover[env, lane, WAY + 1], 0.0, 0.0])
    if n_way == 0:
        turn = mover[env, lane, 5]
        angle = rest / turn
        c, s, sign = ti.cos(angle), ti.sin(angle), ti.select(turn > 0.0, 1.0, -1.0)
        out += ti.Vector([ti.abs(turn) * c, ti.abs(turn) * s, -sign * s * speed, sign * c * speed])
    else:
        on_it = 0
        for j in range(n_way):
            k = (j + 1) % n_way
            x, y = mover[env, lane, WAY + 2 * j], mover[env, lane, WAY + 2 * j + 1]
            dx, dy = mover[env, lane, WAY + 2 * k] - x, mover[env, lane, WAY + 2 * k + 1] - y
            leg_m = ti.sqrt(dx * dx + dy * dy)
            if on_it == 0 and (rest < leg_m or j == n_way - 1):
                on_it = 1
                ux, uy, d = dx / ti.max(leg_m, 1e-9), dy / ti.max(leg_m, 1e-9), ti.min(rest, leg_m)
                out = ti.Vector([x + d * ux, y + d * uy, ux * speed, uy * speed])
            rest -= leg_m
    return out


@ti.func
def laid_on_hull(wish, yaw, z, tank_cfg: Const[TankConfig]):
    """(surge, sway, heave [m/s], turn rate [rad/s]) for a wished world velocity: a hull diagonal is turned
    along the way, where both axes together are fastest, and the depth stays off floor and surface."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    surge, sway = c * wish[0] + s * wish[1], c * wish[1] - s * wish[0]
    over = ti.max(1.0, ti.max(ti.abs(surge), ti.abs(sway)) / AXIS_M_S)
    turn = 0.0
    if ti.sqrt(wish[0] * wish[0] + wish[1] * wish[1]) > SLOW_M_S:
        off = ti.atan2(wish[1], wish[0]) - yaw
        turn = off - _QUARTER * (ti.floor(off / _QUARTER) + 0.5)
    heave = ti.max(wish[2], ti.min(tank_cfg.z_m[0] + MARGIN_M - z, 0.0))
    heave = ti.min(heave, ti.max(tank_cfg.z_m[1] - MARGIN_M - z, 0.0))
    heave = ti.math.clamp(heave, -CLIMB_M_S, CLIMB_M_S)
    return ti.Vector([surge / over, sway / over, heave, ti.math.clamp(TURN_GAIN * turn, -1.0, 1.0)])


@ti.kernel
def command_of(ego: Tensor2, wish: Tensor2, out: Tensor2, tank_cfg: Const[TankConfig]):
    """``laid_on_hull`` of every row, in parts of the limits: (n, 4) for the simulator. ``ego``: (n, 2) of
    heading and depth; ``wish``: (n, 3) world velocity [m/s]."""
    for env in range(ego.shape[0]):
        wished = ti.Vector([wish[env, 0], wish[env, 1], wish[env, 2]])
        found = laid_on_hull(wished, ego[env, 0], ego[env, 1], tank_cfg)
        out[env, 0], out[env, 1] = found[0] / AXIS_M_S, found[1] / AXIS_M_S
        out[env, 2], out[env, 3] = found[2] / CLIMB_M_S, found[3]


@ti.func
def nearest_of(
    pos,
    axis,
    vel,
    rate,
    env,
    time_s,
    static: Tensor3,
    mover: Tensor3,
    closing_m_s,
    vehicle_cfg: Const[VehicleConfig],
):
    """(clearance to the nearest body [m], time to collision [s]) as the referee finds them, of what is
    near."""
    clearance, ttc = 99.0, 99.0
    for i in range(STATICS + MOVERS):
        kind, place, vel_b, size, yaw = 0, pos, ti.Vector([0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0]), 0.0
        if i < STATICS:
            kind = ti.cast(static[env, i, 0], ti.i32)
            place = ti.Vector([static[env, i, 1], static[env, i, 2], pos[2]])
            size = ti.Vector([static[env, i, 3], static[env, i, 4], 9.0])
            yaw = static[env, i, 5]
        else:
            lane = i - STATICS
            kind = ti.cast(mover[env, lane, 0], ti.i32)
            if kind != NONE:
                at = body_on_path(mover, env, lane, time_s)
                place = ti.Vector([at[0], at[1], mover[env, lane, 1]])
                vel_b = ti.Vector([at[2], at[3], 0.0])
                size = ti.Vector([mover[env, lane, 2], mover[env, lane, 2], mover[env, lane, 3]])
        dx, dy = place[0] - pos[0], place[1] - pos[1]
        reach = size[0] + size[1] + _NEAR_M
        if kind != NONE and dx * dx + dy * dy < reach * reach:
            gap, normal, along = hull_to_body(pos, axis, kind, place, size, yaw, vehicle_cfg)
            turning = ti.Vector([-rate * axis[1], rate * axis[0], 0.0])
            closing = (vel + along * turning - vel_b).dot(normal)
            clearance = ti.min(clearance, gap)
            if closing > closing_m_s:
                ttc = ti.min(ttc, ti.max(gap, 0.0) / closing)
    return ti.Vector([clearance, ttc])


@ti.kernel
def drive(
    static: Tensor3,
    mover: Tensor3,
    ego: Tensor2,
    action: Tensor2,
    nearest: FloatVector,
    outcome: IntVector,
    vehicle_cfg: Const[VehicleConfig],
    tank_cfg: Const[TankConfig],
    rules: Rules,
):
    """One decision of every env: motion, clearance at its least, outcome by the referee's rules."""
    for env in range(ego.shape[0]):
        dt = DECISION_S / SUBSTEPS
        # action: flipped frame, parts of the limits
        ax, ay = action[env, 0], action[env, 1]
        over = ti.max(1.0, ti.sqrt(ax * ax + ay * ay))
        ax, ay, az = ax / over, ay / over, ti.math.clamp(action[env, 2], -1.0, 1.0)
        ego[env, 14], ego[env, 15], ego[env, 16] = ax, ay, az
        wish = ti.Vector([ax * CRUISE_M_S * ego[env, 12], ay * CRUISE_M_S * ego[env, 13], az * CLIMB_M_S])
        pos = ti.Vector([ego[env, 0], ego[env, 1], ego[env, 2]])
        goal = ti.Vector([ego[env, 9], ego[env, 10], ego[env, 11]])
        vel = ti.Vector([ego[env, 3], ego[env, 4], ego[env, 5]])
        yaw, rate, time_s = ego[env, 6], ego[env, 7], ego[env, 8]
        least, out = 9.0, RUNNING
        for _ in range(SUBSTEPS):
            if out == RUNNING:
                asked = laid_on_hull(wish, yaw, pos[2], tank_cfg)
                c, s = ti.cos(yaw), ti.sin(yaw)
                surge, sway = c * vel[0] + s * vel[1], c * vel[1] - s * vel[0]
                surge += (asked[0] - surge) * (1.0 - ti.exp(-dt / SURGE_LAG_S))
                sway += (asked[1] - sway) * (1.0 - ti.exp(-dt / SWAY_LAG_S))
                rate += (asked[3] - rate) * (1.0 - ti.exp(-dt / RATE_LAG_S))
                heave = vel[2] + (asked[2] - vel[2]) * (1.0 - ti.exp(-dt / HEAVE_LAG_S))
                yaw += dt * rate
                c, s = ti.cos(yaw), ti.sin(yaw)
                vel = ti.Vector([c * surge - s * sway, s * surge + c * sway, heave])
                pos += dt * vel
                time_s += dt
                axis = ti.Vector([c, s, 0.0])
                near = nearest_of(
                    pos, axis, vel, rate, env, time_s, static, mover, rules.ttc_closing_m_s, vehicle_cfg
                )
                gap = ti.min(near[0], hull_to_side_wall(pos, axis, vehicle_cfg, tank_cfg))
                level = ti.min(pos[2] - tank_cfg.z_m[0], tank_cfg.z_m[1] - pos[2]) - vehicle_cfg.hull_radius_m
                least = ti.min(least, gap)
                if is_in_tank(pos, tank_cfg) == 0:
                    out = OUT_OF_TANK
                elif gap < rules.collision_clearance_m or level < 0.0:
                    out = COLLISION
                elif near[1] < rules.ttc_s:
                    out = TTC
                elif ti.math.length(goal - pos) <= rules.goal_radius_m:
                    out = SUCCESS
                elif time_s >= rules.horizon_steps * rules.control_dt_s - 1e-3:
                    out = TIMEOUT
        for i in ti.static(range(3)):
            ego[env, i], ego[env, 3 + i] = pos[i], vel[i]
        ego[env, 6], ego[env, 7], ego[env, 8] = yaw, rate, time_s
        nearest[env], outcome[env] = least, out
