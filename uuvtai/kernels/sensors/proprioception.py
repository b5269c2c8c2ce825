"""Proprioception: DVL, IMU, pressure, and a position.

Every error is a config number, compiled away at zero. Heading error = constant drift rate of the episode plus
the integrated noise of the yaw gyro. Position is the truth (as in the paper), dead reckoning (DVL velocity
turned by the IMU's attitude, summed up from the known start, z from pressure; while the DVL has lost the
bottom it goes on with the last velocity), or left to the pose filter (perception/pose.py). Where depth is
found by pressure the sensor is zeroed at the known start: its first reading is taken for the start's depth,
so that the bias drops out and one reading's noise stays.

In a step without a reading of the DVL the velocity is how the given position changes; with dead reckoning,
while the DVL has lost the bottom, the heave is how the pressure's depth changes, and the horizontal part is
unknown (``find_velocity``).
"""

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.geometry import quaternion_wb, roll_pitch_yaw, rotation_wb, wrapped_angle
from uuvtai.kernels.core.noise import (
    STREAM_DVL,
    STREAM_IMU,
    STREAM_PRESSURE,
    normal,
    stream_key,
    uniform,
    uniform_in,
)
from uuvtai.kernels.core.stage import Bundle, n_envs
from uuvtai.kernels.sensors.io import ExactProprioceptionIO, ProprioceptionIO, VelocityIO

_EPISODE_DRAW = 1000  # Index of draws made once per episode, apart from those of step 0.
_RISE_RATE = 4.0
"""[rad/s] of the critically damped filter that finds the heave by pressure: it lags by half a second, and
2 cm of noise in each reading become 1.6 cm/s (EC)"""


@quick_launch
@ti.kernel
def reset_proprioception(io: Bundle[ProprioceptionIO]):
    """Draw the errors that stay constant over an episode; the estimate starts where the vehicle is told that
    it is. Active rows only."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            draw_constants(env, io)
            clear_readings(env, io)


@quick_launch
@ti.kernel
def sense_exactly(io: Bundle[ExactProprioceptionIO]):
    """Perfect velocity, attitude and rates for the inner loop: experiments on the plant alone have no
    sensors."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            io.ego.vel_b[env] = io.vehicle.vel_b[env]
            io.ego.vel_valid[env] = 1
            io.ego.rate_b[env] = io.vehicle.rate_b[env]
            io.ego.rpy[env] = roll_pitch_yaw(io.vehicle.quat_wb[env])
            io.ego.pos_w[env] = io.vehicle.pos_w[env]


@ti.func
def draw_constants(env, io: Bundle[ProprioceptionIO]):
    key = io.episode.key[env]
    dvl, imu = stream_key(key, 0, STREAM_DVL), stream_key(key, 0, STREAM_IMU)
    io.ego_memory.dvl_scale[env] = 1.0 + io.sensors_cfg.dvl.scale_error * normal(dvl, _EPISODE_DRAW)
    io.ego_memory.heading_rate[env] = io.sensors_cfg.imu.heading_drift_rad_s * normal(imu, _EPISODE_DRAW)
    io.ego_memory.accel_bias_b[env] = 0.0
    if ti.static(io.sensors_cfg.imu.accel_bias_m_s2 > 0):
        io.ego_memory.accel_bias_b[env] = io.sensors_cfg.imu.accel_bias_m_s2 * normal_vector(
            imu, _EPISODE_DRAW + 1
        )
    io.ego_memory.heading_error[env] = 0.0
    if ti.static(io.sensors_cfg.imu.heading_sigma_rad > 0):
        io.ego_memory.heading_error[env] = io.sensors_cfg.imu.heading_sigma_rad * normal(
            imu, _EPISODE_DRAW + 4
        )
    io.ego_memory.dropout_until[env] = 0
    io.ego_memory.pressure_zero_m[env] = 0.0
    bias = io.sensors_cfg.pressure.bias_m
    io.ego_memory.pressure_bias_m[env] = uniform_in(
        stream_key(key, 0, STREAM_PRESSURE), _EPISODE_DRAW, -bias, bias
    )


@ti.func
def clear_readings(env, io: Bundle[ProprioceptionIO]):
    zero = ti.zero(io.ego.vel_b[env])
    io.ego.vel_b[env], io.ego.rpy[env], io.ego.rate_b[env], io.ego.specific_force_b[env] = (
        zero,
        zero,
        zero,
        zero,
    )
    io.ego.imu_rpy[env], io.ego.dvl_b[env] = zero, zero
    io.ego.vel_valid[env], io.ego.dvl_fresh[env], io.ego.fix_valid[env] = 0, 0, 0
    io.ego.given_up[env] = 0
    io.ego.fix_vel_w[env], io.ego.rise_m_s[env], io.ego.rise_z_m[env] = zero, 0.0, 0.0
    io.ego.depth_m[env] = 0.0
    io.ego.pos_w[env] = io.vehicle.pos_w[env]
    if ti.static(io.sensors_cfg.localization != "truth" and io.sensors_cfg.start_sigma_m > 0):
        imu = stream_key(io.episode.key[env], 0, STREAM_IMU)
        for axis in ti.static(range(2)):
            io.ego.pos_w[env][axis] += io.sensors_cfg.start_sigma_m * normal(imu, _EPISODE_DRAW + 5 + axis)
    io.ego.pose_cov[env] = 0.0
    io.ego.z_var[env] = 0.0
    if ti.static(io.sensors_cfg.localization == "dead_reckoning"):  # a reading's noise, and that of the zero
        io.ego.z_var[env] = 2.0 * io.sensors_cfg.pressure.sigma_m * io.sensors_cfg.pressure.sigma_m


@quick_launch
@ti.kernel
def sense_proprioception(io: Bundle[ProprioceptionIO]):
    """One reading of every sensor whose turn it is, then the pose estimate. Active rows only."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            key, step = io.episode.key[env], io.clock.step[env]
            read_imu(env, key, step, io)
            io.ego.dvl_fresh[env], io.ego.fix_valid[env] = 0, 1
            if step % io.sensors_cfg.dvl.period_steps == 0:
                read_dvl(env, key, step, io)
            read_pressure(env, key, step, io)
            estimate_position(env, step, io)


@ti.func
def normal_vector(key, first):
    """Three standard normals, draws first to first + 2."""
    return ti.Vector([normal(key, first), normal(key, first + 1), normal(key, first + 2)])


@ti.func
def read_imu(env, key, step, io: Bundle[ProprioceptionIO]):
    """Attitude with heading error, angular rate, and specific force = acceleration minus gravity, in body
    axes."""
    stream = stream_key(key, step, STREAM_IMU)
    rate, heading_rate = io.vehicle.rate_b[env], io.ego_memory.heading_rate[env]
    if ti.static(io.sensors_cfg.imu.gyro_noise_rad_s_rthz > 0):
        error = ti.static(
            io.sensors_cfg.imu.gyro_noise_rad_s_rthz / io.episode_cfg.control_dt_s**0.5
        ) * normal_vector(stream, 0)
        rate += error
        heading_rate += error[2]
    if step > 0:
        io.ego_memory.heading_error[env] += heading_rate * io.episode_cfg.control_dt_s
    rpy = roll_pitch_yaw(io.vehicle.quat_wb[env])
    if ti.static(io.sensors_cfg.imu.attitude_sigma_rad > 0):
        rpy += io.sensors_cfg.imu.attitude_sigma_rad * normal_vector(stream, 3)
    force = io.vehicle.acc_b[env] + rotation_wb(io.vehicle.quat_wb[env]).transpose() @ ti.Vector(
        [0.0, 0.0, io.vehicle_cfg.gravity_m_s2]
    )
    if ti.static(io.sensors_cfg.imu.accel_sigma_m_s2 > 0):
        force += io.sensors_cfg.imu.accel_sigma_m_s2 * normal_vector(stream, 6)
    if ti.static(io.sensors_cfg.imu.accel_bias_m_s2 > 0):
        force += io.ego_memory.accel_bias_b[env]
    io.ego.rpy[env] = ti.Vector([rpy[0], rpy[1], wrapped_angle(rpy[2] + io.ego_memory.heading_error[env])])
    io.ego.imu_rpy[env] = io.ego.rpy[env]
    io.ego.rate_b[env] = rate
    io.ego.specific_force_b[env] = force


@ti.func
def read_dvl(env, key, step, io: Bundle[ProprioceptionIO]):
    """Velocity over ground; no reading while the bottom is lost. An episode starts with it in sight, so there
    always is a last reading."""
    stream = stream_key(key, step, STREAM_DVL)
    lost = step < io.ego_memory.dropout_until[env]
    if ti.static(io.sensors_cfg.dvl.dropout > 0):
        if not lost and step > 0 and uniform(stream, 20) < io.sensors_cfg.dvl.dropout:
            lasts = uniform_in(stream, 21, io.sensors_cfg.dvl.dropout_s[0], io.sensors_cfg.dvl.dropout_s[1])
            io.ego_memory.dropout_until[env] = step + ti.cast(
                ti.ceil(lasts / io.episode_cfg.control_dt_s), ti.i32
            )
            lost = True
    io.ego.vel_valid[env] = ti.select(lost, 0, 1)
    if not lost:
        reading = io.ego_memory.dvl_scale[env] * io.vehicle.vel_b[env]
        if ti.static(io.sensors_cfg.dvl.sigma_m_s > 0):
            reading += io.sensors_cfg.dvl.sigma_m_s * normal_vector(stream, 0)
        io.ego.vel_b[env] = reading
        io.ego.dvl_b[env] = reading
        io.ego.dvl_fresh[env], io.ego.fix_valid[env] = 1, 0


@ti.func
def read_pressure(env, key, step, io: Bundle[ProprioceptionIO]):
    """Depth, positive down; unless the position is given less what the first reading was off the known
    start, where ``ego.pos_w`` is at step 0."""
    reading = io.ego_memory.pressure_bias_m[env] - io.vehicle.pos_w[env][2]
    if ti.static(io.sensors_cfg.pressure.sigma_m > 0):
        reading += io.sensors_cfg.pressure.sigma_m * normal(stream_key(key, step, STREAM_PRESSURE), 0)
    if ti.static(io.sensors_cfg.localization != "truth"):
        if step == 0:
            io.ego_memory.pressure_zero_m[env] = reading + io.ego.pos_w[env][2]
        reading -= io.ego_memory.pressure_zero_m[env]
    io.ego.depth_m[env] = reading


@ti.func
def estimate_position(env, step, io: Bundle[ProprioceptionIO]):
    """Position: truth, or one step of dead reckoning from what was just measured; the pose filter writes its
    own."""
    if ti.static(io.sensors_cfg.localization == "truth"):
        gone = io.vehicle.pos_w[env] - io.ego.pos_w[env]
        io.ego.fix_vel_w[env] = gone * ti.static(1.0 / io.episode_cfg.control_dt_s)
        io.ego.pos_w[env] = io.vehicle.pos_w[env]
    elif ti.static(io.sensors_cfg.localization == "dead_reckoning"):
        pos, rpy = io.ego.pos_w[env], io.ego.rpy[env]
        if step > 0:
            pos += (
                rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2]))
                @ io.ego.vel_b[env]
                * io.episode_cfg.control_dt_s
            )
        pos[2] = -io.ego.depth_m[env]
        io.ego.pos_w[env] = pos


def loses_velocity(sensors_cfg):
    """Whether there are steps without a reading of the DVL where no filter estimates the velocity; plain
    Python."""
    missing = sensors_cfg.dvl.dropout > 0 or sensors_cfg.dvl.period_steps > 1
    return missing and sensors_cfg.localization != "estimated"


@quick_launch
@ti.kernel
def find_velocity(io: Bundle[VelocityIO]):
    """Find what is known of the velocity where the DVL says nothing, whoever filled the readings. Active rows
    only."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            rpy = io.ego.rpy[env]
            rotation = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2]))
            if ti.static(io.sensors_cfg.localization == "truth"):
                if io.ego.fix_valid[env] == 1:
                    io.ego.vel_b[env] = rotation.transpose() @ io.ego.fix_vel_w[env]
                    io.ego.vel_valid[env] = 1
            else:
                find_heave(env, rotation, io)


@ti.func
def find_heave(env, rotation, io: Bundle[VelocityIO]):
    """Heave by the pressure's depth, which a filter follows from the last reading of the DVL on."""
    dt = ti.static(io.episode_cfg.control_dt_s)
    vel = io.ego.vel_b[env]
    if io.clock.step[env] == 0:
        io.ego.rise_z_m[env] = -io.ego.depth_m[env]
    off = -io.ego.depth_m[env] - (io.ego.rise_z_m[env] + dt * io.ego.rise_m_s[env])
    io.ego.rise_z_m[env] = -io.ego.depth_m[env] - (1.0 - ti.static(2.0 * _RISE_RATE * dt)) * off
    if io.ego.vel_valid[env] == 1:
        io.ego.rise_m_s[env] = rotation[2, 0] * vel[0] + rotation[2, 1] * vel[1] + rotation[2, 2] * vel[2]
    else:
        io.ego.rise_m_s[env] += ti.static(_RISE_RATE * _RISE_RATE * dt) * off
        level = rotation[2, 0] * vel[0] + rotation[2, 1] * vel[1]
        io.ego.vel_b[env][2] = (io.ego.rise_m_s[env] - level) / ti.max(rotation[2, 2], 0.5)
        io.ego.vel_valid[env] = 2
