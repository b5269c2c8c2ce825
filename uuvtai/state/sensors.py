"""What the sensors deliver, and their hidden state."""

from __future__ import annotations

from dataclasses import dataclass

import taichi as ti

from uuvtai.common.enums import Truth
from uuvtai.state.arrays import array


@dataclass(frozen=True, eq=False)
class Proprioception:
    """Sensed: DVL, IMU, pressure and the pose estimate. Values hold their last reading where the flag says
    invalid."""

    vel_b: ti.Field = array("n_env", vec=3)
    """[m/s] DVL; in steps without a reading how the given position changes, with dead reckoning the last
    reading, once that is lost with the heave by pressure; where the pose is estimated the filter's"""
    vel_valid: ti.Field = array("n_env", dtype=ti.i32)
    """1 = known: by the DVL, no longer ago than its period, or by the given position; where the pose is
    estimated the filter is sure of it (``localization.sure_speed_m_s``); 2 = heave alone is; 0 = the last
    reading"""
    fix_vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] how the given position changes,"""
    fix_valid: ti.Field = array("n_env", dtype=ti.i32)
    """1 = which is the velocity in this step: the DVL has said nothing"""
    rise_m_s: ti.Field = array("n_env")
    """[m/s] how z changes: by the DVL, while it is silent by pressure (dead reckoning)"""
    rise_z_m: ti.Field = array("n_env")
    """[m] z by pressure, smoothed (dead reckoning)"""
    rpy: ti.Field = array("n_env", vec=3)
    """[rad] roll, pitch, yaw of the IMU; yaw corrected where the pose is estimated"""
    rate_b: ti.Field = array("n_env", vec=3)
    """[rad/s] gyro"""
    specific_force_b: ti.Field = array("n_env", vec=3)
    """[m/s^2] accelerometer: acceleration minus gravity, in body axes"""
    depth_m: ti.Field = array("n_env")
    """[m] pressure depth, positive down; zeroed at the known start unless the position is given"""
    pos_w: ti.Field = array("n_env", vec=3)
    """[m] position: the truth, dead reckoning (z from pressure) or the pose filter's estimate"""
    pose_cov: ti.Field = array("n_env", vec=6)
    """[m^2, m^2, m rad, m^2, m rad, rad^2] covariance of x, y and heading, its upper triangle row by row; 0
    where the pose is not estimated"""
    z_var: ti.Field = array("n_env")
    """[m^2] variance of z; 0 where the position is given"""
    imu_rpy: ti.Field = array("n_env", vec=3)
    """[rad] roll, pitch, yaw as the IMU itself says, without the filter's correction: for logs"""
    dvl_b: ti.Field = array("n_env", vec=3)
    """[m/s] newest reading of the DVL itself, which the filter does not overwrite: for logs"""
    given_up: ti.Field = array("n_env", dtype=ti.i32)
    """number, counted from 1, of the vertical thruster that is taken for dead by what the vehicle does
    (``lost_thruster``); -1 = one of them is suspected to be, 0 = none"""
    dvl_fresh: ti.Field = array("n_env", dtype=ti.i32)
    """1 = ``dvl_b`` was read in this very step"""


@dataclass(frozen=True, eq=False)
class ProprioceptionMemory(Truth):
    """Hidden state of the proprioceptive sensors (simulator side)."""

    pressure_bias_m: ti.Field = array("n_env", beside="errors")
    """[m] constant over an episode"""
    pressure_zero_m: ti.Field = array("n_env", beside="errors")
    """[m] what the sensor is zeroed by: its first reading less the known start's depth; 0 where the position
    is given"""
    dvl_scale: ti.Field = array("n_env", beside="errors")
    """1 + scale error, constant over an episode"""
    heading_error: ti.Field = array("n_env", beside="errors")
    """[rad] integrated heading drift"""
    heading_rate: ti.Field = array("n_env", beside="errors")
    """[rad/s] drift rate of the episode"""
    accel_bias_b: ti.Field = array("n_env", vec=3)
    """[m/s^2] error of the accelerometer, constant over an episode"""
    dropout_until: ti.Field = array("n_env", dtype=ti.i32, beside="errors")
    """step until which the DVL has lost the bottom"""


@dataclass(frozen=True, eq=False)
class SonarScan:
    """Sensed: the newest delivered sonar scan. Beam 0 ahead, counter-clockwise, horizontal.

    Of a mechanical beam: the returns of this step, and in the other beams what was remembered of the last
    sweep, as it would be seen from here (``EchoState``)."""

    range_m: ti.Field = array("n_env", "n_ray", lanes=True)
    """[m] no return = maximum range"""
    doppler_m_s: ti.Field = array("n_env", "n_ray", lanes=True)
    """[m/s] rate of change of the distance to what the beam hit, positive = receding, ego motion included;
    without meaning (0) where the sonar measures none (``sonar.doppler``)"""
    intensity: ti.Field = array("n_env", "n_ray", lanes=True)
    """[0, 1]"""
    hit: ti.Field = array("n_env", "n_ray", lanes=True, dtype=ti.i32)
    """1 = return"""
    fresh: ti.Field = array("n_env", dtype=ti.i32, beside="ping")
    """1 = delivered in this very step"""
    ping_step: ti.Field = array("n_env", dtype=ti.i32, beside="ping")
    """episode step at which it was taken"""
    ping_pos_w: ti.Field = array("n_env", vec=3)
    """[m] own position estimate when it was taken"""
    ping_yaw: ti.Field = array("n_env")
    """[rad] own yaw estimate when it was taken"""
    ping_vel_b: ti.Field = array("n_env", vec=3)
    """[m/s] own measured velocity when it was taken"""
    ping_vel_valid: ti.Field = array("n_env", dtype=ti.i32, beside="ping")
    """1 = that was a reading; 0 = the last one, held since"""
    new_from: ti.Field = array("n_env", dtype=ti.i32, beside="ping")
    """of a mechanical beam: first of the beams that were taken in this step,"""
    new_count: ti.Field = array("n_env", dtype=ti.i32, beside="ping")
    """and how many, counter-clockwise"""


@dataclass(frozen=True, eq=False)
class SonarMemory(Truth):
    """Hidden state of the sonar (simulator side): scans under way and bubble clouds."""

    range_m: ti.Field = array("n_env", "n_latency", "n_ray", lanes=True)
    """[m] ring of scans taken and not yet delivered"""
    doppler_m_s: ti.Field = array("n_env", "n_latency", "n_ray", lanes=True)
    """[m/s]"""
    intensity: ti.Field = array("n_env", "n_latency", "n_ray", lanes=True)
    """[0, 1]"""
    hit: ti.Field = array("n_env", "n_latency", "n_ray", lanes=True, dtype=ti.i32)
    """1 = return"""
    step: ti.Field = array("n_env", "n_latency", dtype=ti.i32)
    """step at which it was taken, -1 = empty"""
    pos_w: ti.Field = array("n_env", "n_latency", vec=3)
    """[m] own position estimate then"""
    yaw: ti.Field = array("n_env", "n_latency")
    """[rad]"""
    vel_b: ti.Field = array("n_env", "n_latency", vec=3)
    """[m/s]"""
    vel_valid: ti.Field = array("n_env", "n_latency", dtype=ti.i32)
    """1 = a reading"""
    mount_w: ti.Field = array("n_env", vec=3, scratch=True)
    """[m] scratch of one ping: true position of the sonar"""
    mount_vel_w: ti.Field = array("n_env", vec=2, scratch=True)
    """[m/s] its true horizontal velocity"""
    heading_w: ti.Field = array("n_env", vec=2, scratch=True)
    """unit vector along beam 0"""
    obstacle_x_m: ti.Field = array("n_env", "n_obstacle", lanes=True, scratch=True)
    """[m] scratch of one ping: centre of an obstacle's outline from the sensor, along x of the world"""
    obstacle_y_m: ti.Field = array("n_env", "n_obstacle", lanes=True, scratch=True)
    """[m] along y"""
    obstacle_reach_m: ti.Field = array("n_env", "n_obstacle", lanes=True, scratch=True)
    """[m] radius around it that holds the outline, far below 0 = empty slot"""
    cloud_beam: ti.Field = array("n_env", "n_cloud", dtype=ti.i32, beside="cloud")
    """first beam of a bubble cloud, counted from the world's x axis"""
    cloud_width: ti.Field = array("n_env", "n_cloud", dtype=ti.i32, beside="cloud")
    """beams it covers"""
    cloud_range_m: ti.Field = array("n_env", "n_cloud", beside="cloud")
    """[m]"""
    cloud_until: ti.Field = array("n_env", "n_cloud", dtype=ti.i32, beside="cloud")
    """step at which it is gone"""


@dataclass(frozen=True, eq=False)
class SonarImage(Truth):
    """What the beams of a multibeam with a detector hear in a ping (simulator side)."""

    echo: ti.Field = array("n_env", "n_heard", "n_bin", lanes=True, scratch=True)
    """power that comes back from each bearing and range, then its field's real part"""
    echo_imag: ti.Field = array("n_env", "n_heard", "n_bin", lanes=True, scratch=True)
    """imaginary part"""
    heard: ti.Field = array("n_env", "n_heard", "n_bin", lanes=True, scratch=True)
    """power that each beam hears in each range bin"""
    farthest: ti.Field = array("n_env", "n_heard", dtype=ti.i32, scratch=True)
    """range bin of the farthest that a bearing meets"""
    across: ti.Field = array("n_heard", vec=2, scratch=True)
    """a beam's pattern so many beams off, and its side lobes' share (``multibeam.main_lobe``)"""
    upright: ti.Field = array("n_elevation", vec=3, scratch=True)
    """sine and cosine of an elevation, and the power of its ray: pattern squared times solid angle [sr]"""


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Sensed: forward depth camera, row 0 at the top, column 0 at the left."""

    depth_m: ti.Field = array("n_env", "n_pixel_row", "n_pixel_col", lanes=True, dtype=ti.f32, scratch=True)
    """[m] z-depth along the optical axis; no return = maximum range"""
    fresh: ti.Field = array("n_env", dtype=ti.i32)
    """1 = taken in this very step"""
    shot_pos_w: ti.Field = array("n_env", vec=3)
    """[m] own position estimate when it was taken"""
    shot_rpy: ti.Field = array("n_env", vec=3)
    """[rad] own attitude estimate when it was taken"""


@dataclass(frozen=True, eq=False)
class SensorStructs:
    """Structs of this room, by the noun of their stage."""

    ego: Proprioception
    ego_memory: ProprioceptionMemory
    scan: SonarScan
    sonar_memory: SonarMemory
    sonar_image: SonarImage
    image: DepthImage
