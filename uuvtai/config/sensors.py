"""What the vehicle senses with."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from uuvtai.config.section import (
    Count,
    Fraction,
    Interval,
    NonNegative,
    Packets,
    Positive,
    PositiveCount,
    Section,
    Vector3,
)


class SonarConfig(Section):
    """Horizontal ring of beams, fixed to the yaw, always level."""

    n_ray: Packets = 256
    max_range_m: Positive = 12.0
    vertical_half_aperture_deg: Annotated[float, Field(ge=0, lt=80)] = 10.0
    period_steps: PositiveCount = 1
    """control steps between pings"""
    latency_steps: Count = 0
    range_sigma_m: NonNegative = 0.0
    range_sigma_slope: NonNegative = 0.0
    """[m/m]"""
    range_quantum_m: NonNegative = 0.0
    range_jitter_m: NonNegative = 0.0
    """mean of a positive exponential error"""
    missed_return: Fraction = 0.0
    false_return: Fraction = 0.0
    bubble_clouds_per_s: NonNegative = 0.0
    """mean rate at which bubble clouds form; each hides a run of beams at one range and bearing"""
    bubble_beams: tuple[Count, Count] = (3, 8)
    bubble_s: Interval = (1.0, 3.0)
    ghost: Fraction = 0.0
    """probability per beam that a specular bounce replaces the direct return"""
    grazing_cosine: Fraction = 0.0
    """a return is lost below this cosine of incidence"""
    doppler_sigma_m_s: NonNegative = 0.0
    doppler_outlier: Fraction = 0.0
    """probability per beam that the Doppler is worthless"""
    doppler_outlier_m_s: NonNegative = 2.0
    """worthless = uniform within +- this (EC)"""


class DepthConfig(Section):
    """Forward camera."""

    rows: PositiveCount = 72
    cols: Packets = 128
    fov_deg: Annotated[float, Field(ge=1e-3, lt=170)] = 90.0
    """horizontal"""
    offset_b_m: Vector3 = (0.2, 0.0, 0.0)
    max_range_m: Positive = 10.0
    period_steps: PositiveCount = 5
    sigma_m: NonNegative = 0.0
    sigma_slope: NonNegative = 0.0


class DvlConfig(Section):
    sigma_m_s: NonNegative = 0.0
    scale_error: NonNegative = 0.0
    """standard deviation of the scale factor, drawn per episode"""
    period_steps: PositiveCount = 1
    dropout: Fraction = 0.0
    """probability per reading that the bottom is lost"""
    dropout_s: Interval = (0.0, 0.0)
    """how long it then stays lost"""


class ImuConfig(Section):
    gyro_noise_rad_s_rthz: NonNegative = 0.0
    heading_drift_rad_s: NonNegative = 0.0
    """standard deviation of the constant drift rate, drawn per episode"""
    accel_sigma_m_s2: NonNegative = 0.0
    accel_bias_m_s2: NonNegative = 0.0
    """standard deviation of each axis's constant error, drawn per episode"""
    attitude_sigma_rad: NonNegative = 0.0


class PressureConfig(Section):
    bias_m: NonNegative = 0.0
    """drawn uniformly from +- this, per episode"""
    sigma_m: NonNegative = 0.0


class SensorsConfig(Section):
    sonar: SonarConfig = SonarConfig()
    depth: DepthConfig = DepthConfig()
    dvl: DvlConfig = DvlConfig()
    imu: ImuConfig = ImuConfig()
    pressure: PressureConfig = PressureConfig()
    localization: Literal["truth", "dead_reckoning", "estimated"] = "truth"
    """truth: the position is given, as in the paper. dead_reckoning: DVL, IMU and pressure alone, from the
    known start. estimated: the pose filter (section pose) corrects these by the walls that the sonar sees"""
