"""Proprioception: DVL, IMU, pressure, and the pose estimate that mapping and planning use.

Every error is a config number, compiled away at zero. Heading error = constant drift rate of the episode plus the integrated noise of the
yaw gyro. Position is the truth (as in the paper), or dead reckoning: DVL velocity turned by the IMU's attitude, summed up from the known
start, z from pressure; while the DVL has lost the bottom it goes on with the last velocity. Where depth is found by pressure the sensor is
zeroed at the known start: its first reading is taken for the start's depth, so that the bias drops out and one reading's noise stays.
"""

import taichi as ti

from uuvtai.config import EpisodeConfig, SensorsConfig, VehicleConfig
from uuvtai.kernels.core.geometry import quaternion_wb, roll_pitch_yaw, rotation_wb, wrapped_angle
from uuvtai.kernels.core.noise import STREAM_DVL, STREAM_IMU, STREAM_PRESSURE, normal, stream_key, uniform, uniform_in
from uuvtai.kernels.core.signature import Const, In, Out, quick_launch, spread
from uuvtai.state import ClockState, EpisodeState, Proprioception, ProprioceptionMemory, VehicleState

_EPISODE_DRAW = 1000
"""Index of draws made once per episode, apart from those of step 0."""


@quick_launch
@ti.kernel
def reset_proprioception(
    ego: Out[Proprioception],
    memory: Out[ProprioceptionMemory],
    vehicle: In[VehicleState],
    episode: In[EpisodeState],
    clock: In[ClockState],
    sensors: Const[SensorsConfig],
):
    """Draw the errors that stay constant over an episode; the estimate starts at the true position. Awake rows only."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            draw_constants(env, memory, episode, sensors)
            clear_readings(env, ego, vehicle)


@ti.func
def draw_constants(env, memory: Out[ProprioceptionMemory], episode: In[EpisodeState], sensors: Const[SensorsConfig]):
    key = episode.key[env]
    dvl, imu = stream_key(key, 0, STREAM_DVL), stream_key(key, 0, STREAM_IMU)
    memory.dvl_scale[env] = 1.0 + sensors.dvl.scale_error * normal(dvl, _EPISODE_DRAW)
    memory.heading_rate[env] = sensors.imu.heading_drift_rad_s * normal(imu, _EPISODE_DRAW)
    memory.heading_error[env] = 0.0
    memory.dropout_until[env] = 0
    memory.pressure_zero_m[env] = 0.0
    bias = sensors.pressure.bias_m
    memory.pressure_bias_m[env] = uniform_in(stream_key(key, 0, STREAM_PRESSURE), _EPISODE_DRAW, -bias, bias)


@ti.func
def clear_readings(env, ego: Out[Proprioception], vehicle: In[VehicleState]):
    zero = ti.zero(ego.vel_b[env])
    ego.vel_b[env], ego.rpy[env], ego.rate_b[env], ego.specific_force_b[env] = zero, zero, zero, zero
    ego.vel_valid[env] = 0
    ego.depth_m[env] = 0.0
    ego.pos_w[env] = vehicle.pos_w[env]


@quick_launch
@ti.kernel
def sense_proprioception(
    ego: Out[Proprioception],
    memory: Out[ProprioceptionMemory],
    vehicle: In[VehicleState],
    episode: In[EpisodeState],
    clock: In[ClockState],
    sensors: Const[SensorsConfig],
    body: Const[VehicleConfig],
    rules: Const[EpisodeConfig],
):
    """One reading of every sensor whose turn it is, then the pose estimate. Awake rows only."""
    n = ti.static(clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and clock.awake[env] == 1:
            key, step = episode.key[env], clock.step[env]
            read_imu(env, key, step, ego, memory, vehicle, sensors, body, rules)
            if step % sensors.dvl.period_steps == 0:
                read_dvl(env, key, step, ego, memory, vehicle, sensors, rules)
            read_pressure(env, key, step, ego, memory, vehicle, sensors)
            estimate_position(env, step, ego, vehicle, sensors, rules)


@ti.func
def normal_vector(key, first):
    """Three standard normals, draws first to first + 2."""
    return ti.Vector([normal(key, first), normal(key, first + 1), normal(key, first + 2)])


@ti.func
def read_imu(
    env,
    key,
    step,
    ego: Out[Proprioception],
    memory: Out[ProprioceptionMemory],
    vehicle: In[VehicleState],
    sensors: Const[SensorsConfig],
    body: Const[VehicleConfig],
    rules: Const[EpisodeConfig],
):
    """Attitude with heading error, angular rate, and specific force = acceleration minus gravity, in body axes."""
    stream = stream_key(key, step, STREAM_IMU)
    rate, heading_rate = vehicle.rate_b[env], memory.heading_rate[env]
    if ti.static(sensors.imu.gyro_noise_rad_s_rthz > 0):
        error = ti.static(sensors.imu.gyro_noise_rad_s_rthz / rules.control_dt_s**0.5) * normal_vector(stream, 0)
        rate += error
        heading_rate += error[2]
    if step > 0:
        memory.heading_error[env] += heading_rate * rules.control_dt_s
    rpy = roll_pitch_yaw(vehicle.quat_wb[env])
    if ti.static(sensors.imu.attitude_sigma_rad > 0):
        rpy += sensors.imu.attitude_sigma_rad * normal_vector(stream, 3)
    force = vehicle.acc_b[env] + rotation_wb(vehicle.quat_wb[env]).transpose() @ ti.Vector([0.0, 0.0, body.gravity_m_s2])
    if ti.static(sensors.imu.accel_sigma_m_s2 > 0):
        force += sensors.imu.accel_sigma_m_s2 * normal_vector(stream, 6)
    ego.rpy[env] = ti.Vector([rpy[0], rpy[1], wrapped_angle(rpy[2] + memory.heading_error[env])])
    ego.rate_b[env] = rate
    ego.specific_force_b[env] = force


@ti.func
def read_dvl(
    env,
    key,
    step,
    ego: Out[Proprioception],
    memory: Out[ProprioceptionMemory],
    vehicle: In[VehicleState],
    sensors: Const[SensorsConfig],
    rules: Const[EpisodeConfig],
):
    """Velocity over ground; no reading while the bottom is lost. An episode starts with it in sight, so there always is a last reading."""
    stream = stream_key(key, step, STREAM_DVL)
    lost = step < memory.dropout_until[env]
    if ti.static(sensors.dvl.dropout > 0):
        if not lost and step > 0 and uniform(stream, 20) < sensors.dvl.dropout:
            lasts = uniform_in(stream, 21, sensors.dvl.dropout_s[0], sensors.dvl.dropout_s[1])
            memory.dropout_until[env] = step + ti.cast(ti.ceil(lasts / rules.control_dt_s), ti.i32)
            lost = True
    ego.vel_valid[env] = ti.select(lost, 0, 1)
    if not lost:
        reading = memory.dvl_scale[env] * vehicle.vel_b[env]
        if ti.static(sensors.dvl.sigma_m_s > 0):
            reading += sensors.dvl.sigma_m_s * normal_vector(stream, 0)
        ego.vel_b[env] = reading


@ti.func
def read_pressure(
    env,
    key,
    step,
    ego: Out[Proprioception],
    memory: Out[ProprioceptionMemory],
    vehicle: In[VehicleState],
    sensors: Const[SensorsConfig],
):
    """Depth, positive down; in dead reckoning less what the first reading was off the known start, where ``ego.pos_w`` is at step 0."""
    reading = memory.pressure_bias_m[env] - vehicle.pos_w[env][2]
    if ti.static(sensors.pressure.sigma_m > 0):
        reading += sensors.pressure.sigma_m * normal(stream_key(key, step, STREAM_PRESSURE), 0)
    if ti.static(sensors.localization == "dead_reckoning"):
        if step == 0:
            memory.pressure_zero_m[env] = reading + ego.pos_w[env][2]
        reading -= memory.pressure_zero_m[env]
    ego.depth_m[env] = reading


@ti.func
def estimate_position(
    env,
    step,
    ego: Out[Proprioception],
    vehicle: In[VehicleState],
    sensors: Const[SensorsConfig],
    rules: Const[EpisodeConfig],
):
    """Position estimate: truth, or one step of dead reckoning from what was just measured."""
    if ti.static(sensors.localization == "truth"):
        ego.pos_w[env] = vehicle.pos_w[env]
    else:
        pos, rpy = ego.pos_w[env], ego.rpy[env]
        if step > 0:
            pos += rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2])) @ ego.vel_b[env] * rules.control_dt_s
        pos[2] = -ego.depth_m[env]
        ego.pos_w[env] = pos
