"""Sector features of the newest sonar scan: nearest range, fastest approach, smallest time to collision."""

import taichi as ti

from uuvtai.config import FeaturesConfig, SonarConfig
from uuvtai.kernels.geometry import TWO_PI
from uuvtai.kernels.signature import Const, In, Out
from uuvtai.state import ClockState, FeatureState, Proprioception, SonarScan


@ti.kernel
def sense_sectors(
    features: Out[FeatureState],
    scan: In[SonarScan],
    ego: In[Proprioception],
    clock: In[ClockState],
    features_cfg: Const[FeaturesConfig],
    sonar_cfg: Const[SonarConfig],
):
    """Sector s is centred at s * 360 / n_sector degrees from ahead, counter-clockwise. One work item per sector."""
    n, n_sector = ti.static(features.sector_range_m.shape[0], features.sector_range_m.shape[1])
    for env, sector in ti.ndrange(n, n_sector):
        if clock.awake[env] == 1:
            first, last = sector_beams(sector, ego.rpy[env][2] - scan.ping_yaw[env], n_sector, ti.static(scan.range_m.shape[1]))
            _summarise(env, sector, first, last, features, scan, features_cfg, sonar_cfg)


@ti.func
def _summarise(
    env,
    sector,
    first,
    last,
    features: Out[FeatureState],
    scan: In[SonarScan],
    features_cfg: Const[FeaturesConfig],
    sonar_cfg: Const[SonarConfig],
):
    """Doppler already holds the own motion, so a beam's time to collision is its range over its closing speed."""
    n_ray = ti.static(scan.range_m.shape[1])
    nearest, ttc, closing, hits = 0.0 + sonar_cfg.max_range_m, 0.0 + features_cfg.ttc_cap_s, 0.0, 0
    for i in range(first, last):
        beam = i % n_ray
        if scan.hit[env, beam] == 1:
            rate = -scan.doppler_m_s[env, beam]
            closing = ti.select(hits == 0, rate, ti.max(closing, rate))
            hits += 1
            nearest = ti.min(nearest, scan.range_m[env, beam])
            if rate > 0:
                ttc = ti.min(ttc, scan.range_m[env, beam] / rate)
    features.sector_range_m[env, sector] = nearest
    features.sector_ttc_s[env, sector] = ttc
    features.sector_closing_m_s[env, sector] = closing
    features.sector_valid[env, sector] = ti.cast(hits > 0, ti.i32)


@ti.func
def sector_beams(sector, turned, n_sector, n_ray):
    """Half-open range of beams in a sector now, after the vehicle has turned by ``turned`` [rad] since the ping; take it modulo n_ray."""
    shift = turned * n_sector / TWO_PI
    per_sector = n_ray / n_sector
    first = ti.ceil((sector - 0.5 + shift) * per_sector)
    last = ti.ceil((sector + 0.5 + shift) * per_sector)
    return ti.cast(first, ti.i32), ti.cast(last, ti.i32)
