"""Ranges from the intensity image: constant false alarm rate (CFAR) along each beam, the first that passes
counts.

Power is averaged over a few neighbouring beams, for the speckle of floor and surface nearby would else raise
a false alarm every second. A cell is a return where that stands above three things: the mean of the cells
around it, beyond a guard, by the factor at which exponentially distributed noise passes with
``cfar_false_alarm`` (cell averaging, CA, both sides together; smallest of, SO, the quieter side: P. Gandhi,
S. Kassam, *Analysis of CFAR Processors in Nonhomogeneous Background*, IEEE Trans. AES 24(4), 1988); what the
beam's side lobes bring from other bearings of the same range, by the factor of that probability; and the
least level.
"""

import math

import taichi as ti

from uuvtai.config import SonarConfig
from uuvtai.config.multibeam import ABSORPTION_NP_M, SHOWN_DB, filled_beam
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.simd import filled
from uuvtai.kernels.core.stage import Bundle, Const
from uuvtai.kernels.sensors.io import SonarIO


@ti.func
def detected(env, first, beams: Const[int], io: Bundle[SonarIO]):
    """(range [m], FAR_M = none; intensity [0, 1]) of the beams from ``first`` on: the middle of the nearest
    range bin that passes, and its level over ``SHOWN_DB``."""
    range_m, intensity = filled(FAR_M, beams), filled(0.0, beams)
    bin_m = ti.static(io.sonar_cfg.max_range_m / io.sonar_cfg.image_bins)
    for lane in range(beams):
        cell = first_return(env, first + lane, io)
        if cell >= 0:
            range_m[lane] = bin_m * (cell + 0.5)
            share = relative_level(mean_power(env, first + lane, cell, io), cell, io)
            level_db = ti.log(ti.max(share, 1.0e-12)) * ti.static(10.0 / math.log(10.0))
            intensity[lane] = ti.min(ti.max(1.0 + level_db / SHOWN_DB, 0.01), 1.0)
    return range_m, intensity


@ti.func
def first_return(env, beam, io: Bundle[SonarIO]):
    """The nearest range bin that passes; -1 = none."""
    found, cell = -1, 0
    lobes = ti.static(-math.log(io.sonar_cfg.cfar_false_alarm))
    least = ti.static(10.0 ** (0.1 * io.sonar_cfg.least_level_db))
    factor = ti.static(cfar_factor(io.sonar_cfg))
    while found < 0 and cell < io.sonar_cfg.image_bins:
        power = mean_power(env, beam, cell, io)
        if relative_level(power, cell, io) > least and power > factor * level_around(env, beam, cell, io):
            if power > lobes * level_beside(env, beam, cell, io):
                found = cell
        cell += 1
    return found


@ti.func
def mean_power(env, beam, cell, io: Bundle[SonarIO]):
    """Mean over ``cfar_beams`` neighbours; at the edges of a fan over those that there are."""
    half, n_ray = ti.static(io.sonar_cfg.cfar_beams // 2, io.sonar_cfg.n_ray)
    total, count = 0.0, 0
    for off in ti.static(range(-half, half + 1)):
        other = beam + off
        if ti.static(io.sonar_cfg.is_ring):
            other = (beam + off + n_ray) % n_ray
        if 0 <= other < n_ray:
            total += io.sonar_image.heard[env, other, cell]
            count += 1
    return total / count


@ti.func
def relative_level(power, cell, io: Bundle[SonarIO]):
    """Power as a share of what a wall across the beam would return from there."""
    range_m = ti.static(io.sonar_cfg.max_range_m / io.sonar_cfg.image_bins) * (cell + 0.5)
    gain = range_m * range_m * ti.exp(ti.static(4.0 * ABSORPTION_NP_M) * range_m)
    return power * gain * ti.static(1.0 / filled_beam(io.sonar_cfg))


@ti.func
def level_around(env, beam, cell, io: Bundle[SonarIO]):
    """Mean power of the cells around, beyond the guard; at the ends of the beam of those that there are."""
    guard, cells = ti.static(io.sonar_cfg.cfar_guard, io.sonar_cfg.cfar_cells)
    before, n_before, behind, n_behind = 0.0, 0, 0.0, 0
    for i in range(ti.max(cell - guard - cells, 0), ti.max(cell - guard, 0)):
        before += mean_power(env, beam, i, io)
        n_before += 1
    for i in range(cell + guard + 1, ti.min(cell + guard + 1 + cells, io.sonar_cfg.image_bins)):
        behind += mean_power(env, beam, i, io)
        n_behind += 1
    level = (before + behind) / ti.max(n_before + n_behind, 1)
    if ti.static(io.sonar_cfg.detector == "so"):
        if n_before > 0 and n_behind > 0:
            level = ti.min(before / n_before, behind / n_behind)
    return level


@ti.func
def level_beside(env, beam, cell, io: Bundle[SonarIO]):
    """Mean power that side lobes bring, from what all beams hear in the same range bin."""
    level = 0.0
    for other in range(ti.static(io.sonar_cfg.n_ray)):
        share = io.sonar_image.across[ti.abs(other - beam)][1]
        level += share * io.sonar_image.heard[env, other, cell]
    return level


def cfar_factor(sonar_cfg: SonarConfig) -> float:
    """By how much a cell must stand above the mean around it. Plain Python."""
    n, wanted = sonar_cfg.cfar_cells, sonar_cfg.cfar_false_alarm
    if sonar_cfg.detector == "ca":
        return 2 * n * (wanted ** (-0.5 / n) - 1.0)
    low, high = 0.0, 1e6
    for _ in range(100):
        middle = 0.5 * (low + high)
        passing = 2.0 * sum(math.comb(n - 1 + k, k) * (2.0 + middle) ** -(n + k) for k in range(n))
        low, high = (middle, high) if passing > wanted else (low, middle)
    return n * high
