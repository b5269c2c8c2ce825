"""Inner loop: commanded body velocity and yaw rate -> wrench -> thrusts -> rotor commands, from measured
motion only.

The vehicle knows its nominal parameters (vehicle section): drag, Coriolis and net buoyancy are fed forward,
PI feedback does the rest. Vehicles are driven in packets of neighbouring rows (lanes.py, second way).
"""

from typing import Any, NamedTuple

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.simd import column, is_active, n_active, n_column, put_column
from uuvtai.kernels.core.stage import Bundle, Const, FloatMatrix, In, Out, loop_end, n_envs
from uuvtai.kernels.vehicle.dynamics import rpm_of_thrust, thrust_limits, thrust_of_rpm
from uuvtai.kernels.vehicle.io import ActuationIO
from uuvtai.kernels.vehicle.thruster_fault import vertical_pair

_LARGEST = 3.4028234663852886e38  # of float32
BAND_M_S, BAND_RAD_S = 0.3, 0.5
"""errors beyond do not build up the integral: they are a step under way or a blocked vehicle, and both would
overshoot later (EC)"""


@quick_launch
@ti.kernel
def command_thrusters(io: Bundle[ActuationIO], action: FloatMatrix):
    """action (n_env, 4): surge, sway, heave, yaw rate in [-1, 1] of the vehicle's limits ->
    actuation.rpm_command."""
    n, lanes = ti.static(io.clock.active.shape[0], n_column())
    n_packet = ti.static(-(-n // lanes))
    for packet in range(loop_end(n_packet, io.clock)):
        if n_active(packet * lanes, lanes, io.clock) > 0:
            for env in range(packet * lanes, (packet + 1) * lanes):
                if is_active(env, io.clock):
                    raw = ti.Vector([action[env, 0], action[env, 1], action[env, 2], action[env, 3]])
                    io.actuation.command[env] = scaled_command(raw, io)
            _drive(packet * lanes, lanes, io)


@quick_launch
@ti.kernel
def take_action(io: Bundle[ActuationIO], asked: FloatMatrix, action: FloatMatrix):
    """``action`` becomes ``asked``, both (n_env, 4), if every number of it is finite; actuation.n_not_finite
    says how many are not."""
    io.actuation.n_not_finite[None] = 0
    for env in range(asked.shape[0]):
        for axis in ti.static(range(4)):
            if not ti.abs(asked[env, axis]) <= _LARGEST:
                ti.atomic_add(io.actuation.n_not_finite[None], 1)
    for env in range(asked.shape[0]):
        if io.actuation.n_not_finite[None] == 0:
            for axis in ti.static(range(4)):
                action[env, axis] = asked[env, axis]


@quick_launch
@ti.kernel
def reset_actuation(io: Bundle[ActuationIO]):
    """Nothing commanded, nothing under way."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            io.actuation.command[env] = 0.0
            io.actuation.integral[env] = 0.0
            for i in ti.static(range(io.actuation.response.shape[1])):
                io.actuation.response[env, i] = 0.0
            io.actuation.hold_moment_b[env] = 0.0
            io.actuation.external_wrench_b[env] = 0.0
            for i in range(ti.static(io.actuation.rpm_command.shape[1])):
                io.actuation.rpm_command[env, i] = 0.0
                io.actuation.thrust_n[env, i] = 0.0
                for slot in range(ti.static(io.actuation.rpm_queue.shape[1])):
                    io.actuation.rpm_queue[env, slot, i] = 0.0


class AxisLoop(NamedTuple):
    """PI loop of one commanded axis."""

    gain: float
    integral_gain: float
    band: float
    """[m/s or rad/s] errors beyond it do not build up the integral"""
    bound: float
    """[N or N m] of the integral"""
    limit: float
    """[N or N m] of the whole"""


def axis_loops(cfg):
    """Loops of surge, sway, heave and yaw rate; plain Python, constants of the kernel."""
    linear = zip(cfg.velocity_gain, cfg.velocity_integral, cfg.max_force_n, strict=True)
    yaw = AxisLoop(
        cfg.yaw_rate_gain, cfg.yaw_rate_integral, BAND_RAD_S, cfg.max_integral_n_m, cfg.max_moment_n_m
    )
    return (*(AxisLoop(p, i, BAND_M_S, cfg.max_integral_n, limit) for p, i, limit in linear), yaw)


@ti.func
def scaled_command(action, io: Bundle[ActuationIO]):
    """[m/s, m/s, m/s, rad/s] of an action, clamped to [-1, 1]; NaN asks for nothing."""
    limits = ti.Vector(
        [
            io.vehicle_cfg.max_surge_m_s,
            io.vehicle_cfg.max_sway_m_s,
            io.vehicle_cfg.max_heave_m_s,
            io.vehicle_cfg.max_yaw_rate_rad_s,
        ]
    )
    out = ti.Vector([0.0] * 4)
    for axis in ti.static(range(4)):
        if action[axis] >= 1.0:
            out[axis] = limits[axis]
        elif action[axis] <= -1.0:
            out[axis] = -limits[axis]
        elif action[axis] > -1.0 and action[axis] < 1.0:  # false for NaN
            out[axis] = action[axis] * limits[axis]
    return out


@ti.func
def _drive(first, lanes: Const[int], io: Bundle[ActuationIO]):
    """Rotor speeds of the velocity loop for the packet of vehicles that begins with ``first``, into this
    step's slot of the queue."""
    n, n_thruster = ti.static(io.actuation.rpm_command.shape[0], io.actuation.rpm_command.shape[1])
    fleet = ti.Struct(
        command=ti.Matrix([[0.0] * lanes for _ in range(4)]),
        vel=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        rate=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        up=ti.Matrix([[0.0] * lanes for _ in range(3)]),
        integral=ti.Matrix([[0.0] * lanes for _ in range(4)]),
        seen=ti.Matrix([[0.0] * lanes for _ in range(4)]),
        rpm=ti.Matrix([[0.0] * lanes for _ in range(n_thruster)]),
    )
    for lane in range(lanes):
        _load_vehicle(lane, ti.min(first + lane, n - 1), fleet, io)
    inverse = ti.Matrix(
        [[io.allocation.thrust_of_wrench[i, axis] for axis in range(6)] for i in range(n_thruster)]
    )
    for lane in range(lanes):
        _control(lane, fleet, inverse, io)
    for lane in range(lanes):
        if is_active(first + lane, io.clock):
            _store_vehicle(lane, first + lane, fleet, io)


@ti.func
def _load_vehicle(lane, env, fleet: Out[Any], io: Bundle[ActuationIO]):
    """Copy what one vehicle wants and senses into its column."""
    command, vel = io.actuation.command[env], io.ego.vel_b[env]
    # a lost DVL holds an old velocity: feeding that back would run away, so the feed-forward drives alone
    # until it is back, but in heave where that is known (2)
    seen = io.ego.vel_valid[env]
    for axis in ti.static(range(3)):
        known = seen == 1 or (axis == 2 and seen == 2)
        fleet.vel[axis, lane] = ti.select(known, vel[axis], command[axis])
        fleet.seen[axis, lane] = ti.select(known, 1.0, 0.0)
    fleet.seen[3, lane] = 1.0
    put_column(fleet.command, lane, command)
    put_column(fleet.rate, lane, io.ego.rate_b[env])
    put_column(fleet.up, lane, _up_b(io.ego.rpy[env]))
    put_column(fleet.integral, lane, io.actuation.integral[env])


@ti.func
def _store_vehicle(lane, env, fleet: In[Any], io: Bundle[ActuationIO]):
    """Copy one vehicle's column back. What left the queue's tail reaches the rotors: the command of
    delay_steps control steps ago."""
    io.actuation.integral[env] = column(fleet.integral, lane)
    n_slot = ti.static(io.actuation.rpm_queue.shape[1])
    slot = io.clock.step[env] % n_slot
    due = (io.clock.step[env] - io.params.delay_steps[env]) % n_slot
    for i in ti.static(range(io.actuation.rpm_command.shape[1])):
        io.actuation.rpm_queue[env, slot, i] = fleet.rpm[i, lane]
    if ti.static(io.actuation_cfg.watch_s > 0 and len(vertical_pair(io.vehicle_cfg)) == 2):
        _spare_given_up(env, slot, io)
    for i in ti.static(range(io.actuation.rpm_command.shape[1])):
        io.actuation.rpm_command[env, i] = io.actuation.rpm_queue[env, due, i]


@ti.func
def _spare_given_up(env, slot, io: Bundle[ActuationIO]):
    """Tell a thruster that is given up nothing, and its mate the thrust of both: the heave stays, the roll
    moment is left to the hold."""
    pair = ti.static(vertical_pair(io.vehicle_cfg))
    if io.ego.given_up[env] > 0:
        both = thrust_of_rpm(io.actuation.rpm_queue[env, slot, pair[0]], io.vehicle_cfg) + thrust_of_rpm(
            io.actuation.rpm_queue[env, slot, pair[1]], io.vehicle_cfg
        )
        alone = rpm_of_thrust(both, io.vehicle_cfg)
        dead_first = io.ego.given_up[env] == ti.static(1 + pair[0])
        io.actuation.rpm_queue[env, slot, pair[0]] = ti.select(dead_first, 0.0, alone)
        io.actuation.rpm_queue[env, slot, pair[1]] = ti.select(dead_first, alone, 0.0)


@ti.func
def _control(lane, fleet: Out[Any], inverse: In[Any], io: Bundle[ActuationIO]):
    """Velocity loop of one column. It touches local variables only, so that the loop over columns becomes
    vector code."""
    command, vel, rate = column(fleet.command, lane), column(fleet.vel, lane), column(fleet.rate, lane)
    integral, up = column(fleet.integral, lane), column(fleet.up, lane)
    error = ti.Vector([command[0] - vel[0], command[1] - vel[1], command[2] - vel[2], command[3] - rate[2]])
    force, moment = feed_forward(command, vel, rate, up, io)
    ahead = ti.Vector([force[0], force[1], force[2], moment[2]])
    loops = ti.static(axis_loops(io.actuation_cfg))
    asked = ti.Vector([ahead[axis] + integral[axis] for axis in range(4)])
    given = ti.Vector([0.0] * 4)
    for axis in ti.static(range(4)):
        asked[axis] += loops[axis].gain * error[axis]
        given[axis] = ti.math.clamp(asked[axis], -loops[axis].limit, loops[axis].limit)
    roll_moment, pitch_moment = 0.0, 0.0
    if ti.static(io.vehicle_cfg.attitude_hold == "thrusters"):
        roll_moment, pitch_moment = stabilising_moment(up, rate, moment, io)
    wrench = ti.Vector([given[0], given[1], given[2], roll_moment, pitch_moment, given[3]])
    share = _allocate(lane, wrench, fleet, inverse, io)
    for axis in ti.static(range(4)):
        saturated = share < 1.0 or given[axis] != asked[axis]
        per_step = loops[axis].integral_gain * io.episode_cfg.control_dt_s
        after = integrated(
            integral[axis], error[axis], saturated, per_step, loops[axis].band, loops[axis].bound
        )
        fleet.integral[axis, lane] = ti.select(fleet.seen[axis, lane] == 1.0, after, integral[axis])


@ti.func
def integrated(integral, error, saturated, gain, band, bound):
    """Integral part [N or N m] after one control step; ``gain`` is per step. It never winds up:

    it shrinks freely, but grows only on errors smaller than ``band`` that the actuators can serve
    (``saturated``: they give less than asked).
    """
    share = 0.0 if saturated else ti.max(0.0, 1.0 - abs(error) / band)
    if error * integral < 0.0:
        share = 1.0
    return ti.math.clamp(integral + gain * share * error, -bound, bound)


@ti.func
def feed_forward(command, vel, rate, up, io: Bundle[ActuationIO]):
    """Force and moment that hold the commanded velocity in still water: drag of the command, Coriolis of the
    motion, net buoyancy."""
    mass, added, linear, quadratic = ti.static(
        io.vehicle_cfg.mass_kg,
        io.vehicle_cfg.added_mass,
        io.vehicle_cfg.linear_damping,
        io.vehicle_cfg.quadratic_damping,
    )
    momentum = ti.Vector([(mass + added[0]) * vel[0], (mass + added[1]) * vel[1], (mass + added[2]) * vel[2]])
    spin = ti.Vector(
        [(io.vehicle_cfg.inertia_kg_m2[i] + added[3 + i]) * rate[i] for i in ti.static(range(3))]
    )
    force = rate.cross(momentum)
    moment = rate.cross(spin) + vel.cross(momentum)
    for axis in ti.static(range(3)):
        force[axis] += (linear[axis] + quadratic[axis] * abs(command[axis])) * command[axis]
    moment[2] += (linear[5] + quadratic[5] * abs(command[3])) * command[3]
    net = ti.static(
        io.vehicle_cfg.gravity_m_s2
        * (io.vehicle_cfg.water_density_kg_m3 * io.vehicle_cfg.volume_m3 - io.vehicle_cfg.mass_kg)
    )
    return force - net * up, moment


@ti.func
def stabilising_moment(up, rate, coriolis, io: Bundle[ActuationIO]):
    """[N m] roll and pitch moment of the hold by thrusters: upright, damped, Munk moment fed forward,
    bounded."""
    k, d = io.actuation_cfg.thruster_hold_gain_n_m, io.actuation_cfg.thruster_hold_damping
    roll, pitch = coriolis[0] - k * up[1] - d * rate[0], coriolis[1] + k * up[0] - d * rate[1]
    share = ti.min(1.0, io.actuation_cfg.hold_limit_n_m / ti.max(ti.sqrt(roll * roll + pitch * pitch), 1e-6))
    return share * roll, share * pitch


@ti.func
def _up_b(rpy):
    """World z axis seen in body axes."""
    return ti.Vector([-ti.sin(rpy[1]), ti.sin(rpy[0]) * ti.cos(rpy[1]), ti.cos(rpy[0]) * ti.cos(rpy[1])])


@ti.func
def _allocate(lane, wrench, fleet: Out[Any], inverse: In[Any], io: Bundle[ActuationIO]):
    """Least-squares thrusts to rotor speeds; returns the share <= 1 by which all thrusts are scaled so that
    none exceeds its limit.

    One factor for all keeps the wrench's direction: a vehicle that clips single thrusters turns and drifts
    where it should only be slower.
    """
    forward, reverse = ti.static(thrust_limits(io.vehicle_cfg))
    thrust = ti.Vector([0.0] * ti.static(len(io.vehicle_cfg.thrusters)))
    share = 1.0
    for i in ti.static(range(len(io.vehicle_cfg.thrusters))):
        for axis in ti.static(range(6)):
            thrust[i] += inverse[i, axis] * wrench[axis]
        if thrust[i] > 0.0:
            share = ti.min(share, forward / thrust[i])
        elif thrust[i] < 0.0:
            share = ti.min(share, reverse / thrust[i])
    for i in ti.static(range(len(io.vehicle_cfg.thrusters))):
        fleet.rpm[i, lane] = rpm_of_thrust(share * thrust[i], io.vehicle_cfg)
    return share
