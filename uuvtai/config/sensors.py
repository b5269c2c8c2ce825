"""What the vehicle senses with."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from uuvtai.config.base import (
    Count,
    Fraction,
    Interval,
    NonNegative,
    Packets,
    Positive,
    PositiveCount,
    Section,
    Vector3,
    place_among,
)

SOUND_M_S = 1500.0
"""[m/s] in water"""


class SonarConfig(Section):
    """Horizontal beams, fixed to the yaw, always level: a ring, or a fan ahead; all at once, or one beam that
    a motor turns from one to the next (``mechanical``)."""

    n_ray: Packets = 256
    horizontal_aperture_deg: Annotated[float, Field(ge=10, le=360)] = 360.0
    """360: a ring, beam 0 ahead. Less: a fan of ``n_ray`` beams whose middle is ahead, beam 0 at its right
    edge; what lies beside and behind it is not seen. Counter-clockwise both"""
    mechanical: bool = False
    """one beam, turned by a motor: it looks along beam 0, 1, .., of a ring round and round, of a fan there
    and back. A step lasts as long as sound takes to ``max_range_m`` and back, and ``step_overhead_s``"""
    step_overhead_s: NonNegative = 0.02
    """of a mechanical beam"""
    beam_width_deg: Annotated[float, Field(ge=0, le=30)] = 0.0
    """of a mechanical beam, horizontally: what is nearest within it returns"""
    image_bins: Annotated[int, Field(ge=0, le=2048)] = 0
    """of a detector: range bins of the intensity image, which logs with depth images hold twice a second
    (``/sonar/image``)"""
    detector: Literal["none", "ca", "so"] = "none"
    """none: each beam reports the nearest range within its aperture, with the errors below. ca, so: what a
    CFAR detector finds first in the beam's row of the intensity image, cell averaging or smallest of; the
    errors of single beams below do not come on top"""
    cfar_cells: PositiveCount = 12
    """of a detector: range cells before and behind that tell the level around a cell"""
    cfar_guard: Count = 4
    """cells between, on either side"""
    cfar_beams: PositiveCount = 3
    """of a detector: neighbouring beams whose power is averaged beforehand, an odd number: less speckle"""
    cfar_false_alarm: Annotated[float, Field(gt=0, lt=1)] = 1e-4
    """probability that noise alone passes, in each cell of a single beam; of an average of beams less"""
    least_level_db: float = -15.0
    """A cell must return this much of what a wall across the beam would return from there (EC)"""
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
    at: Annotated[str, place_among("ping360", "3d15", "json")] = ""
    """where ``uuv pilot`` hears it by its own protocol, for example ping360:192.168.2.2, unless --sonar says;
    empty: by MAVLink"""
    zero_gradian: Annotated[float, Field(ge=0, lt=400)] = 200.0
    """angle of a Ping360 that looks ahead; for ``uuv pilot``, as what follows"""
    min_range_m: Positive = 0.3
    """nearer echoes of a Ping360 are its own ring-down"""
    sound_m_s: Annotated[float, Field(ge=1350, le=1650)] = SOUND_M_S
    """speed of sound that its ranges are reckoned with"""
    doppler: bool = True
    """each return carries its Doppler; off: ranges and intensities alone, and nothing reads a speed from a
    beam: what moves is told from one scan to the next"""
    doppler_sigma_m_s: NonNegative = 0.0
    doppler_outlier: Fraction = 0.0
    """probability per beam that the Doppler is worthless"""
    doppler_outlier_m_s: NonNegative = 2.0
    """worthless = uniform within +- this (EC)"""

    @model_validator(mode="after")
    def _possible(self) -> SonarConfig:
        wanted = {"doppler": False, "period_steps": 1, "latency_steps": 0}
        wrong = [name for name, value in wanted.items() if getattr(self, name) != value]
        if self.mechanical and wrong:
            typed = " ".join(f"--set sensors.sonar.{name}={str(wanted[name]).lower()}" for name in wrong)
            raise ValueError(
                f"mechanical: one beam comes at a time, at once and without Doppler; add {typed}, or take "
                "--sensors ping360"
            )
        return self

    @model_validator(mode="after")
    def _detectable(self) -> SonarConfig:
        wanted = {"doppler": False, "mechanical": False}
        wrong = [name for name, value in wanted.items() if getattr(self, name) != value]
        if self.detector != "none" and self.cfar_beams % 2 == 0:
            raise ValueError("cfar_beams: as many beams on either side of a beam, so 1, 3, 5, ..")
        if self.detector != "none" and (wrong or self.image_bins < 2):
            typed = [f"--set sensors.sonar.{name}=false" for name in wrong]
            typed += ["--set sensors.sonar.image_bins=240"] * (self.image_bins < 2)
            raise ValueError(
                "detector: ranges come from the image of a multibeam without Doppler; add "
                f"{' '.join(typed)}, or take --sensors multibeam_image"
            )
        return self

    @property
    def step_us(self) -> int:
        """[us] that one step of a mechanical beam lasts."""
        return max(1, round(1e6 * (2.0 * self.max_range_m / SOUND_M_S + self.step_overhead_s)))

    @property
    def sweep_s(self) -> float:
        """[s] in which a mechanical beam looks along all bearings once; 0 where all beams come at once."""
        return self.n_ray * self.step_us / 1e6 if self.mechanical else 0.0

    @property
    def half_width_rad(self) -> float:
        """[rad] from the middle of a mechanical beam to its edge; 0 where all beams come at once."""
        return math.radians(0.5 * self.beam_width_deg) if self.mechanical else 0.0

    @property
    def is_ring(self) -> bool:
        """Whether the beams go all around."""
        return self.horizontal_aperture_deg == 360.0

    def turn_rad(self, beams: float) -> float:
        """[rad] from one beam to the one that comes so many after it."""
        if self.is_ring:
            return 2.0 * math.pi * beams / self.n_ray
        return math.radians(self.horizontal_aperture_deg) * beams / self.n_ray

    @property
    def beam_step_rad(self) -> float:
        """[rad] between neighbouring beams."""
        return self.turn_rad(1)

    @property
    def first_beam_rad(self) -> float:
        """[rad] bearing of beam 0 from ahead, counter-clockwise."""
        return 0.0 if self.is_ring else -0.5 * self.turn_rad(self.n_ray - 1)

    @property
    def circle_beams(self) -> int:
        """Beams that fill a whole circle at this spacing; ``n_ray`` of a ring."""
        return self.n_ray if self.is_ring else math.ceil(2.0 * math.pi / self.beam_step_rad)


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
    at: Annotated[str, place_among("a50", "json")] = ""
    """where ``uuv pilot`` hears it by its own protocol, for example a50:192.168.2.95, unless --dvl says;
    empty: by MAVLink"""
    sigma_m_s: NonNegative = 0.0
    scale_error: NonNegative = 0.0
    """standard deviation of the scale factor, drawn per episode"""
    period_steps: PositiveCount = 1
    dropout: Fraction = 0.0
    """probability per reading that the bottom is lost"""
    dropout_s: Interval = (0.0, 0.0)
    """how long it then stays lost"""
    position_b_m: Vector3 = (0.0, 0.0, 0.0)
    """of the device from the vehicle's centre, body axes; for ``uuv pilot``, as what follows"""
    yaw_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """of its x axis from the vehicle's, counter-clockwise seen from above"""
    fom_most_m_s: Positive = 0.1
    """figures of merit beyond are not used"""
    latency_s: Annotated[float, Field(ge=0, le=1)] = 0.1
    """of a firmware that does not tell when a velocity was measured"""


class ImuConfig(Section):
    gyro_noise_rad_s_rthz: NonNegative = 0.0
    heading_drift_rad_s: NonNegative = 0.0
    """standard deviation of the constant drift rate, drawn per episode"""
    heading_sigma_rad: NonNegative = 0.0
    """standard deviation of the heading's error at the start, drawn per episode"""
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
    start_sigma_m: NonNegative = 0.0
    """standard deviation along x and y of the place that is told at the start, drawn per episode; not where
    the position is given"""
