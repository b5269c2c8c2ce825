"""Rigid body in water: Fossen's six degrees of freedom with current, added mass, damping, buoyancy and
rotors.

(M_RB + M_A) dnu/dt + C_RB(nu) nu + C_A(nu_r) nu_r + D(nu_r) nu_r + g(eta) = tau   (T. Fossen, Handbook of
Marine Craft, 2011)

Origin at the centre of mass and diagonal added mass make the full mass matrix diagonal, so it is solved
exactly; the acceleration is never filtered (that is unstable when M_A > M_RB). Each substep is one explicit
midpoint step, second order in dt.

Vehicles move in packets of neighbouring rows (lanes.py, second way): a packet is copied into a local
``fleet``, whose matrices have a column per vehicle, moved by a loop over the columns that touches nothing
else, and copied back.
"""

from typing import Any

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.config import VehicleConfig
from uuvtai.kernels.core.geometry import quaternion_wb, rotation_wb
from uuvtai.kernels.core.noise import (
    STREAM_CURRENT,
    STREAM_THRUSTER,
    STREAM_VEHICLE,
    normal,
    stream_key,
    uniform_in,
)
from uuvtai.kernels.core.simd import column, is_active, n_active, n_column, put_column
from uuvtai.kernels.core.stage import Bundle, Const, In, Out, loop_end, n_envs
from uuvtai.kernels.vehicle.io import DynamicsIO

# ------------------------------------------------------------------------------------------------------------
# Thruster: rotor lag, thrust curve and its inverse. Floor file: actuation asks for thrusts, dynamics
# produces them.
#
# The curve is the T200 fit of MarineGym's BlueROV asset: one quadratic in rotor speed per direction, nothing
# inside a dead band.


KGF = 9.81
"""[N] in one kilogram-force, in which the curve is given"""


def edge_rpm(curve, dead_rpm, sign):
    """Smallest speed [rpm, signed] that pushes: the dead band's edge, or the vertex below which the fit turns
    round."""
    return sign * max(dead_rpm, -sign * curve[1] / (2.0 * curve[0]))


def thrust_at(curve, rpm, scale):
    """Thrust [N] on one branch of the curve; plain Python."""
    return scale * KGF * (curve[0] * rpm * rpm + curve[1] * rpm + curve[2])


def thrust_limits(cfg):
    """(forward, reverse) thrust [N] at full speed; reverse is negative."""
    return (
        thrust_at(cfg.thrust_forward, cfg.top_rpm, cfg.thrust_scale),
        thrust_at(cfg.thrust_reverse, -cfg.top_rpm, cfg.thrust_scale),
    )


@ti.func
def thrust_of_rpm(rpm, vehicle_cfg: Const[VehicleConfig]):
    """Thrust [N] at a rotor speed [rpm]."""
    forward, reverse = ti.static(vehicle_cfg.thrust_forward, vehicle_cfg.thrust_reverse)
    thrust = 0.0 * rpm
    if rpm >= ti.static(edge_rpm(vehicle_cfg.thrust_forward, vehicle_cfg.dead_band_rpm[0], 1.0)):
        thrust = ti.static(KGF * vehicle_cfg.thrust_scale) * (
            (forward[0] * rpm + forward[1]) * rpm + forward[2]
        )
    elif rpm <= ti.static(edge_rpm(vehicle_cfg.thrust_reverse, vehicle_cfg.dead_band_rpm[1], -1.0)):
        thrust = ti.static(KGF * vehicle_cfg.thrust_scale) * (
            (reverse[0] * rpm + reverse[1]) * rpm + reverse[2]
        )
    return thrust


@ti.func
def rpm_of_thrust(thrust, vehicle_cfg: Const[VehicleConfig]):
    """Rotor speed [rpm] that gives a thrust [N]; a thrust below the smallest one is rounded to it or to
    nothing, whichever is nearer."""
    rpm = 0.0 * thrust
    if thrust > 0:
        rpm = _branch_rpm(
            thrust, vehicle_cfg.thrust_forward, vehicle_cfg.dead_band_rpm[0], 1.0, vehicle_cfg.thrust_scale
        )
    else:
        rpm = _branch_rpm(
            thrust, vehicle_cfg.thrust_reverse, vehicle_cfg.dead_band_rpm[1], -1.0, vehicle_cfg.thrust_scale
        )
    return ti.math.clamp(rpm, -vehicle_cfg.top_rpm, vehicle_cfg.top_rpm)


@ti.func
def _branch_rpm(thrust, curve: Const[tuple], dead_rpm: Const[float], sign: Const[float], scale: Const[float]):
    edge = ti.static(edge_rpm(curve, dead_rpm, sign))
    least = ti.static(thrust_at(curve, edge, scale))
    rpm = 0.0 * thrust
    if sign * thrust >= ti.static(sign * least):
        # a n^2 + b n + c = T has the roots (-b +- sqrt(b^2 - 4 a (c - T))) / 2 a: the upper sign is that on
        # the outer side of the vertex, for either sign of a
        offset = curve[2] - thrust / ti.static(KGF * scale)
        root = ti.sqrt(ti.max(curve[1] * curve[1] - 4.0 * curve[0] * offset, 0.0))
        rpm = (root - curve[1]) / ti.static(2.0 * curve[0])
    elif sign * thrust >= ti.static(0.5 * sign * least):
        rpm = edge
    return rpm


# ------------------------------------------------------------------------------------------------------------


# draws of STREAM_VEHICLE (each spread has its own index, so switching one on does not change another)
_DRAW_MASS = 0
_DRAW_ADDED_MASS = 1
_DRAW_LINEAR = 7
_DRAW_QUADRATIC = 13


@quick_launch
@ti.kernel
def move_vehicle(io: Bundle[DynamicsIO], dt_s: float, n_substep: int):
    """One control step of dt_s [s] in n_substep substeps; then the current moves on to the end of the
    step."""
    n, lanes = ti.static(io.clock.active.shape[0], n_column())
    n_packet = ti.static(-(-n // lanes))
    for packet in range(loop_end(n_packet, io.clock)):
        if n_active(packet * lanes, lanes, io.clock) > 0:
            _move(packet * lanes, lanes, dt_s / n_substep, n_substep, io)
            if ti.static(io.disturbance_cfg.current_sigma_m_s > 0):
                _change_currents(packet * lanes, lanes, dt_s, io)


@quick_launch
@ti.kernel
def reset_vehicle(io: Bundle[DynamicsIO]):
    """At rest at the mission's start, with this episode's parameters and current."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            _place(env, io)
            _draw_body(env, io)
            _draw_thrusters(env, io)
            delay = ti.static(round(io.disturbance_cfg.thruster_delay_s / io.episode_cfg.control_dt_s))
            io.params.delay_steps[env] = delay
            _draw_current(env, io)


# --------------------------------------------------------------------------------------------------- one step


@ti.func
def _move(first, lanes: Const[int], dt, n_substep, io: Bundle[DynamicsIO]):
    """n_substep midpoint steps of the packet of vehicles that begins with ``first``."""
    n, n_thruster = ti.static(io.vehicle.rpm.shape[0], io.vehicle.rpm.shape[1])
    fleet = ti.Struct(
        pos=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        quat=ti.Matrix([[0.0] * lanes for _ in range(4)]),
        vel=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        rate=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        acc=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        hold=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        rpm=ti.Matrix([[0.0] * lanes for _ in range(n_thruster)]),
        thrust=ti.Matrix([[0.0] * lanes for _ in range(n_thruster)]),
        # from here on read only
        command=ti.Matrix([[0.0] * lanes for _ in range(n_thruster)]),
        gain=ti.Matrix([[0.0] * lanes for _ in range(n_thruster)]),
        outside=ti.Matrix([[0.0] * lanes for _ in range(6)]),
        current=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        mass=ti.Matrix([[0.0] * lanes for _ in range(6)]),
        added=ti.Matrix([[0.0] * lanes for _ in range(6)]),
        linear=ti.Matrix([[0.0] * lanes for _ in range(6)]),
        quadratic=ti.Matrix([[0.0] * lanes for _ in range(6)]),
        lift=ti.Matrix([[0.0] * lanes for _ in range(2)]),
    )
    for lane in range(lanes):
        _load_vehicle(lane, ti.min(first + lane, n - 1), fleet, io)
    geometry = ti.Matrix(
        [[io.allocation.wrench_of_thrust[axis, i] for i in range(n_thruster)] for axis in range(6)]
    )
    kept = ti.exp(-(0.5 * dt) / io.vehicle_cfg.rotor_tau_s)
    for _ in range(n_substep):
        for lane in range(lanes):
            _advance(lane, fleet, geometry, kept, dt, io)
    for lane in range(lanes):
        if is_active(first + lane, io.clock):
            _store_vehicle(lane, first + lane, fleet, io)


@ti.func
def _load_vehicle(lane, env, fleet: Out[Any], io: Bundle[DynamicsIO]):
    """Copy what moves one vehicle into its column."""
    put_column(fleet.pos, lane, io.vehicle.pos_w[env])
    put_column(fleet.quat, lane, io.vehicle.quat_wb[env])
    put_column(fleet.vel, lane, io.vehicle.vel_b[env])
    put_column(fleet.rate, lane, io.vehicle.rate_b[env])
    put_column(fleet.outside, lane, io.actuation.external_wrench_b[env])
    put_column(fleet.current, lane, io.current.vel_w[env])
    put_column(fleet.added, lane, io.params.added_mass[env])
    put_column(fleet.linear, lane, io.params.linear_damping[env])
    put_column(fleet.quadratic, lane, io.params.quadratic_damping[env])
    for axis in ti.static(range(3)):
        fleet.mass[axis, lane] = io.params.mass_kg[env]
        fleet.mass[axis + 3, lane] = io.params.inertia[env][axis]
    fleet.lift[0, lane] = io.params.buoyancy_n[env]
    fleet.lift[1, lane] = io.params.buoyancy_height_m[env]
    for i in ti.static(range(io.vehicle.rpm.shape[1])):
        fleet.rpm[i, lane] = io.vehicle.rpm[env, i]
        fleet.command[i, lane] = io.actuation.rpm_command[env, i]
        fleet.gain[i, lane] = io.params.thruster_gain[env, i]


@ti.func
def _store_vehicle(lane, env, fleet: In[Any], io: Bundle[DynamicsIO]):
    """Copy one vehicle's column back."""
    io.vehicle.pos_w[env] = column(fleet.pos, lane)
    io.vehicle.quat_wb[env] = column(fleet.quat, lane)
    io.vehicle.vel_b[env] = column(fleet.vel, lane)
    io.vehicle.rate_b[env] = column(fleet.rate, lane)
    io.vehicle.acc_b[env] = column(fleet.acc, lane)
    if ti.static(io.vehicle_cfg.attitude_hold == "ideal"):
        io.actuation.hold_moment_b[env] = column(fleet.hold, lane)
    for i in ti.static(range(io.vehicle.rpm.shape[1])):
        io.vehicle.rpm[env, i] = fleet.rpm[i, lane]
        io.actuation.thrust_n[env, i] = fleet.thrust[i, lane]


@ti.func
def _advance(lane, fleet: Out[Any], geometry: In[Any], kept, dt, io: Bundle[DynamicsIO]):
    """One midpoint step of one column. It touches local variables only, so that the loop over columns becomes
    vector code."""
    body = body_of(lane, fleet, io)
    current_w = column(fleet.current, lane)
    force, moment = _rotor_wrench(lane, fleet, geometry, kept, io)
    pos, q, v, w = (
        column(fleet.pos, lane),
        column(fleet.quat, lane),
        column(fleet.vel, lane),
        column(fleet.rate, lane),
    )
    # Explicit midpoint: x <- x + dt f(x + dt/2 f(x)), with dq/dt = q (0, w) / 2. acc is what an
    # accelerometer has from the motion, dv + w x v.
    dv, dw = acceleration(q, v, w, force, moment, current_w, body, io)
    q_mid = turned(q, w, 0.5 * dt)
    v_mid, w_mid = v + 0.5 * dt * dv, w + 0.5 * dt * dw
    dv_mid, dw_mid = acceleration(q_mid, v_mid, w_mid, force, moment, current_w, body, io)
    q_end = (q + 0.5 * dt * quaternion_product_pure(q_mid, w_mid)).normalized()
    w_end = w + dt * dw_mid
    put_column(fleet.pos, lane, pos + dt * (rotation_wb(q_mid) @ v_mid))
    put_column(fleet.quat, lane, q_end)
    put_column(fleet.vel, lane, v + dt * dv_mid)
    put_column(fleet.rate, lane, w_end)
    put_column(fleet.acc, lane, dv_mid + w_mid.cross(v_mid))
    if ti.static(io.vehicle_cfg.attitude_hold == "ideal"):
        put_column(fleet.hold, lane, hold_moment(up_b(q_end), w_end, io))


@ti.func
def _rotor_wrench(lane, fleet: Out[Any], geometry: In[Any], kept, io: Bundle[DynamicsIO]):
    """Force and moment of all thrusters at the middle of the substep, plus what acts from outside; the rotors
    move on by a substep.

    ``kept`` is what the lag leaves of the distance to the command after half a substep. The middle value
    keeps the midpoint rule second order although the lag is as short as a substep.
    """
    force = ti.Vector([fleet.outside[0, lane], fleet.outside[1, lane], fleet.outside[2, lane]])
    moment = ti.Vector([fleet.outside[3, lane], fleet.outside[4, lane], fleet.outside[5, lane]])
    for i in ti.static(range(fleet.rpm.n)):
        command = fleet.command[i, lane]
        middle = command + kept * (fleet.rpm[i, lane] - command)
        fleet.rpm[i, lane] = command + kept * (middle - command)
        thrust = fleet.gain[i, lane] * thrust_of_rpm(middle, io.vehicle_cfg)
        fleet.thrust[i, lane] = thrust
        for axis in ti.static(range(3)):
            force[axis] += geometry[axis, i] * thrust
            moment[axis] += geometry[axis + 3, i] * thrust
    return force, moment


# ----------------------------------------------------------------------------------------- equation of motion


@ti.func
def body_of(lane, fleet: In[Any], io: Bundle[DynamicsIO]):
    """Parameters of one vehicle in local variables, linear and angular parts apart."""
    added, linear, quadratic, inert = (
        column(fleet.added, lane),
        column(fleet.linear, lane),
        column(fleet.quadratic, lane),
        column(fleet.mass, lane),
    )
    return ti.Struct(
        mass=inert[0],
        inertia=ti.Vector([inert[3], inert[4], inert[5]]),
        added_v=ti.Vector([added[0], added[1], added[2]]),
        added_w=ti.Vector([added[3], added[4], added[5]]),
        linear_v=ti.Vector([linear[0], linear[1], linear[2]]),
        linear_w=ti.Vector([linear[3], linear[4], linear[5]]),
        quadratic_v=ti.Vector([quadratic[0], quadratic[1], quadratic[2]]),
        quadratic_w=ti.Vector([quadratic[3], quadratic[4], quadratic[5]]),
        weight=inert[0] * io.vehicle_cfg.gravity_m_s2,
        buoyancy=fleet.lift[0, lane],
        height=fleet.lift[1, lane],
        per_mass_v=1.0 / (inert[0] + ti.Vector([added[0], added[1], added[2]])),
        per_mass_w=1.0 / ti.Vector([inert[3] + added[3], inert[4] + added[4], inert[5] + added[5]]),
    )


@ti.func
def acceleration(q, v, w, force, moment, current_w, body: In[Any], io: Bundle[DynamicsIO]):
    """(dv/dt, dw/dt) in body axes [m/s^2, rad/s^2]: Fossen's equation solved for the derivative of nu."""
    # Kirchhoff's equations of a body in a uniform current (Fossen 2011, chapter 6), v_r = v - current:
    #   force   m (dv + w x v) + A dv_r + w x (A v_r) = tau - D(v_r) v_r + (B - W) up
    #   moment  (I + A_w) dw + w x ((I + A_w) w) + v_r x (A v_r) = tau - D(w) w + (0, 0, height) x B up
    # dv_r = dv + w x current, as the current stands still in the world (or dv, by ``added_mass_follows``);
    # the cross products are C_RB and C_A.
    up = up_b(q)
    current_b = rotation_wb(q).transpose() @ current_w
    v_r = v - current_b
    momentum = body.added_v * v_r
    tau_v = force + (body.buoyancy - body.weight) * up
    tau_v -= body.mass * w.cross(v) + w.cross(momentum)
    if ti.static(io.vehicle_cfg.added_mass_follows == "water"):
        tau_v -= body.added_v * w.cross(current_b)  # dnu_r/dt = dnu/dt + w x current_b in a uniform current
    tau_v -= (body.linear_v + body.quadratic_v * abs(v_r)) * v_r
    tau_w = moment + body.height * body.buoyancy * ti.Vector([-up[1], up[0], 0.0])
    tau_w -= w.cross((body.inertia + body.added_w) * w) + v_r.cross(momentum)
    tau_w -= (body.linear_w + body.quadratic_w * abs(w)) * w
    if ti.static(io.vehicle_cfg.tether_m > 0):
        pull = tether_pull(v_r, w, up, io.vehicle_cfg)
        tau_v += pull
        tau_w += ti.Vector(ti.static(list(io.vehicle_cfg.tether_at_b_m))).cross(pull)
    if ti.static(io.vehicle_cfg.attitude_hold == "ideal"):
        tau_w += hold_moment(up, w, io)
    return body.per_mass_v * tau_v, body.per_mass_w * tau_w


TETHER_DRAG = 1.2
"""coefficient of a cylinder across the flow (S. Hoerner, Fluid-Dynamic Drag, 1965)"""


@ti.func
def tether_pull(v_r, w, up, vehicle_cfg: Const[VehicleConfig]):
    """[N] body axes, of a tether that is towed across. It hangs upright, and its speed grows evenly from rest
    at the far end, so its drag is a third of that of a cylinder which moves as a whole."""
    at = ti.Vector(ti.static(list(vehicle_cfg.tether_at_b_m)))
    there = v_r + w.cross(at)
    across = there - there.dot(up) * up
    area = vehicle_cfg.tether_m * vehicle_cfg.tether_diameter_m
    return -(0.5 * TETHER_DRAG / 3.0) * vehicle_cfg.water_density_kg_m3 * area * across.norm() * across


@ti.func
def hold_moment(up, w, io: Bundle[DynamicsIO]):
    """[N m] ideal attitude hold: pulls body z upright and damps roll and pitch rate, bounded; yaw stays
    free."""
    k, d = io.actuation_cfg.hold_gain_n_m, io.actuation_cfg.hold_damping
    roll, pitch = -k * up[1] - d * w[0], k * up[0] - d * w[1]
    share = ti.min(1.0, io.actuation_cfg.hold_limit_n_m / ti.max(ti.sqrt(roll * roll + pitch * pitch), 1e-6))
    return share * ti.Vector([roll, pitch, 0.0])


@ti.func
def up_b(q):
    """World z axis seen in body axes."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ti.Vector([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


@ti.func
def quaternion_product_pure(q, w):
    """q times the pure quaternion (0, w): twice the time derivative of q under body rates w."""
    return ti.Vector(
        [
            -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
            q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
            q[0] * w[1] - q[1] * w[2] + q[3] * w[0],
            q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
        ]
    )


@ti.func
def turned(q, w, dt):
    """Unit quaternion after dt [s] of body rates w [rad/s], to first order."""
    return (q + 0.5 * dt * quaternion_product_pure(q, w)).normalized()


@ti.func
def _change_currents(first, lanes: Const[int], dt_s, io: Bundle[DynamicsIO]):
    """Move the current of a packet of envs on by dt_s [s]."""
    for env in range(first, first + lanes):
        if is_active(env, io.clock):
            key = stream_key(io.episode.key[env], io.clock.step[env], STREAM_CURRENT)
            io.current.vel_w[env] = current_after(
                io.current.mean_w[env], io.current.vel_w[env], key, dt_s, io
            )


@ti.func
def current_after(mean, velocity, key, dt_s, io: Bundle[DynamicsIO]):
    """[m/s] current after dt of a Gauss-Markov process about its mean, horizontal axes; exact for any dt."""
    keep = ti.exp(-dt_s / io.disturbance_cfg.current_tau_s)
    kick = io.disturbance_cfg.current_sigma_m_s * ti.sqrt(1.0 - keep * keep)
    noise = ti.Vector([normal(key, 0), normal(key, 1), 0.0])
    return mean + keep * (velocity - mean) + kick * noise


# ------------------------------------------------------------------------------------------------------ reset


@ti.func
def _place(env, io: Bundle[DynamicsIO]):
    io.vehicle.pos_w[env] = io.mission.start_w[env]
    io.vehicle.quat_wb[env] = quaternion_wb(0.0, 0.0, io.mission.start_yaw[env])
    io.vehicle.vel_b[env] = 0.0
    io.vehicle.rate_b[env] = 0.0
    io.vehicle.acc_b[env] = 0.0
    for i in range(ti.static(io.vehicle.rpm.shape[1])):
        io.vehicle.rpm[env, i] = 0.0


@ti.func
def _draw_body(env, io: Bundle[DynamicsIO]):
    """Nominal values times the factors of this episode. Buoyancy follows the mass: the vehicle is trimmed
    again, not sunk."""
    key = stream_key(io.episode.key[env], 0, STREAM_VEHICLE)
    heavier = _factor(key, _DRAW_MASS, io.disturbance_cfg.mass_spread)
    io.params.mass_kg[env] = heavier * io.vehicle_cfg.mass_kg
    io.params.buoyancy_n[env] = heavier * ti.static(
        io.vehicle_cfg.water_density_kg_m3 * io.vehicle_cfg.gravity_m_s2 * io.vehicle_cfg.volume_m3
    )
    io.params.buoyancy_height_m[env] = io.vehicle_cfg.buoyancy_height_m
    for axis in ti.static(range(3)):
        io.params.inertia[env][axis] = heavier * io.vehicle_cfg.inertia_kg_m2[axis]
    for axis in ti.static(range(6)):
        io.params.added_mass[env][axis] = io.vehicle_cfg.added_mass[axis] * _factor(
            key, _DRAW_ADDED_MASS + axis, io.disturbance_cfg.added_mass_spread
        )
        io.params.linear_damping[env][axis] = io.vehicle_cfg.linear_damping[axis] * _factor(
            key, _DRAW_LINEAR + axis, io.disturbance_cfg.damping_spread
        )
        io.params.quadratic_damping[env][axis] = io.vehicle_cfg.quadratic_damping[axis] * _factor(
            key, _DRAW_QUADRATIC + axis, io.disturbance_cfg.damping_spread
        )


@ti.func
def _factor(key, index, half_width: Const[float]):
    """Factor in [1 - half_width, 1 + half_width)."""
    return uniform_in(key, index, 1.0 - half_width, 1.0 + half_width)


@ti.func
def _draw_thrusters(env, io: Bundle[DynamicsIO]):
    key = stream_key(io.episode.key[env], 0, STREAM_THRUSTER)
    for i in ti.static(range(len(io.vehicle_cfg.thrusters))):
        gain = 1.0 - io.disturbance_cfg.thruster_gain_loss * uniform_in(key, i, 0.0, 1.0)
        io.params.thruster_gain[env, i] = 0.0 if ti.static(i == io.disturbance_cfg.dead_thruster) else gain


@ti.func
def _draw_current(env, io: Bundle[DynamicsIO]):
    """Mean plus a draw of the stationary distribution, so that the statistics are the same at every time of
    an episode."""
    mean = ti.Vector(
        [
            io.disturbance_cfg.current_m_s[0],
            io.disturbance_cfg.current_m_s[1],
            io.disturbance_cfg.current_m_s[2],
        ]
    )
    key = stream_key(io.episode.key[env], 0, STREAM_CURRENT)
    noise = ti.Vector([normal(key, 2), normal(key, 3), 0.0])  # draws 0 and 1 belong to the first step
    io.current.mean_w[env] = mean
    io.current.vel_w[env] = mean + io.disturbance_cfg.current_sigma_m_s * noise
