"""A CFAR detector in NumPy, cell by cell: the nearest above its surroundings, side lobes, least level."""

import math

import numpy as np

from uuvtai.config import multibeam


def side_lobe_level(heard, sonar_cfg):
    """(n_ray, n_bin) heard by side lobes: power of other bearings times the pattern's mean over them."""
    off = sonar_cfg.beam_step_rad * np.abs(np.arange(len(heard))[:, None] - np.arange(len(heard))[None])
    half = math.sin(math.radians(0.5 * multibeam.BEAM_DEG))
    nulls = multibeam.HALF_POWER * np.abs(np.sin(off)) / half
    share = np.where((nulls > 1) & (np.cos(off) > 0), 0.5 / (np.pi * np.maximum(nulls, 1)) ** 2, 0.0)
    main = np.where(nulls[0] < 1, multibeam.beam_pattern(off[0]) ** 2, 0.0)
    return share @ heard / (2 * main.sum() - main[0])


def first_cells(heard, sonar_cfg, factor):
    """(n_ray,) number of the first cell that passes; -1 = none."""
    lobes, n_bin = side_lobe_level(heard, sonar_cfg), heard.shape[1]
    half = sonar_cfg.cfar_beams // 2
    heard = np.array([heard[max(0, k - half) : k + half + 1].mean(0) for k in range(len(heard))])
    middle = sonar_cfg.max_range_m * (np.arange(n_bin) + 0.5) / n_bin
    level = heard * multibeam.gain(middle, sonar_cfg)
    passing = level > 10 ** (0.1 * sonar_cfg.least_level_db)
    passing &= heard > -math.log(sonar_cfg.cfar_false_alarm) * lobes
    guard, cells = sonar_cfg.cfar_guard, sonar_cfg.cfar_cells
    found = np.full(len(heard), -1)
    for beam, cell in np.argwhere(passing)[::-1]:
        sides = [
            heard[beam, max(0, cell - guard - cells) : max(0, cell - guard)],
            heard[beam, cell + guard + 1 : cell + guard + 1 + cells],
        ]
        means = [side.mean() for side in sides if len(side)]
        around = min(means) if sonar_cfg.detector == "so" else np.concatenate(sides).mean()
        if heard[beam, cell] > factor * around:
            found[beam] = cell
    return found
