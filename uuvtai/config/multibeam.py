"""What a multibeam sonar's beams hear, in plain NumPy: patterns, losses and noise, for the image in logs and
for the kernels that drive by it."""

from __future__ import annotations

import math

import numpy as np

from uuvtai.config import SonarConfig

BEAM_DEG = 1.0
"""half-power width of a beam across (Oculus M750d at 750 kHz)"""
FREQUENCY_HZ = 750e3
ABSORPTION_NP_M = 25e-15 * FREQUENCY_HZ**2
"""of the amplitude; classical absorption of pure water"""
NOISE_DB = -40.0
"""noise below the return of a wall that fills the beam at maximum range (EC)"""
SHOWN_DB = 50.0
"""of the picture, from black to white"""
_PAD_DEG = 15.0  # A fan hears so far beyond its edge by its side lobes.
STEEPEST_RAD, STEP_RAD = math.radians(45.0), math.radians(0.75)
"""elevations of rays: up to the first, up and down, the second apart"""
HALF_POWER = 0.4429
"""sinc(x)^2 = 1/2"""


def pad_beams(sonar_cfg: SonarConfig) -> int:
    """Bearings beyond either edge of a fan that its beams hear, a beam's spacing apart."""
    if sonar_cfg.is_ring:
        return 0
    wanted = math.ceil(math.radians(_PAD_DEG) / sonar_cfg.beam_step_rad)
    return min(wanted, (sonar_cfg.circle_beams - sonar_cfg.n_ray) // 2)


def heard_bearings(sonar_cfg: SonarConfig) -> np.ndarray:
    """(m,) [rad] from ahead: those of the beams, and ``pad_beams`` on either side."""
    pad = pad_beams(sonar_cfg)
    return sonar_cfg.first_beam_rad + sonar_cfg.beam_step_rad * np.arange(-pad, sonar_cfg.n_ray + pad)


def elevations() -> np.ndarray:
    """(k,) [rad] of the rays of one bearing, from below to above."""
    return np.arange(-STEEPEST_RAD, STEEPEST_RAD + 1e-9, STEP_RAD)


def ray_sr(elevation_rad: np.ndarray, sonar_cfg: SonarConfig) -> np.ndarray:
    """[sr] that each ray stands for."""
    return sonar_cfg.beam_step_rad * STEP_RAD * np.cos(elevation_rad)


def elevation_pattern(elevation_rad: np.ndarray, sonar_cfg: SonarConfig) -> np.ndarray:
    """Amplitude of a beam above and below its plane."""
    half = math.radians(max(sonar_cfg.vertical_half_aperture_deg, 0.1))
    return np.sinc(HALF_POWER * np.sin(elevation_rad) / math.sin(half))


def beam_pattern(off_rad: np.ndarray) -> np.ndarray:
    """Amplitude of a beam across, ``off_rad`` from its middle."""
    front = np.abs(np.angle(np.exp(1j * off_rad))) < 0.5 * math.pi
    return np.where(front, np.sinc(_lobes_off(off_rad)), 0.0)


def main_lobe(sonar_cfg: SonarConfig) -> float:
    """By how much all beams together hear the power of one bearing in their main lobes."""
    off = sonar_cfg.beam_step_rad * np.arange(sonar_cfg.n_ray)
    main = beam_pattern(off[np.abs(_lobes_off(off)) < 1.0]) ** 2
    return float(2.0 * main.sum() - main[0])


def _lobes_off(off_rad: np.ndarray) -> np.ndarray:
    """Nulls of the pattern passed on the way from its middle, about."""
    return HALF_POWER * np.sin(off_rad) / math.sin(math.radians(0.5 * BEAM_DEG))


def noise_power(sonar_cfg: SonarConfig) -> float:
    """Mean power of the noise in a cell."""
    far = math.exp(-4.0 * ABSORPTION_NP_M * sonar_cfg.max_range_m) / sonar_cfg.max_range_m**2
    return filled_beam(sonar_cfg) * far * 10.0 ** (0.1 * NOISE_DB)


def filled_beam(sonar_cfg: SonarConfig) -> float:
    """[sr] of a beam: what a wall across it returns from 1 m, unabsorbed."""
    elevation, bearing = elevations(), heard_bearings(sonar_cfg)
    upright = (elevation_pattern(elevation, sonar_cfg) ** 2 * ray_sr(elevation, sonar_cfg)).sum()
    return float(upright * (beam_pattern(bearing - bearing[len(bearing) // 2]) ** 2).sum())


def gain(range_m: np.ndarray, sonar_cfg: SonarConfig) -> np.ndarray:
    """By which power becomes a share of what a wall across the beam would return from there."""
    return range_m**2 * np.exp(4.0 * ABSORPTION_NP_M * range_m) / filled_beam(sonar_cfg)
