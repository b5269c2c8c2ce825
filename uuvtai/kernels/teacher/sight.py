"""Where a vehicle may drive whose sonar is a fan ahead: not where it has not looked. A ring looks everywhere,
and none of this is compiled for it."""

import math

import taichi as ti

from uuvtai.config import SonarConfig, TeacherConfig
from uuvtai.kernels.core.geometry import wrapped_angle
from uuvtai.kernels.core.signature import Const


def edge_of_sight(sonar_cfg):
    """[rad] from ahead to the fan's edge; plain Python."""
    return math.radians(0.5 * sonar_cfg.horizontal_aperture_deg)


def widest_way(sonar_cfg, teacher_cfg):
    """[rad] from ahead within which the way is well in sight; plain Python."""
    return max(edge_of_sight(sonar_cfg) - math.radians(teacher_cfg.sight_margin_deg), 0.0)


@ti.func
def sight_share(off, sonar_cfg: Const[SonarConfig], teacher_cfg: Const[TeacherConfig]):
    """Share of the speed at which a way may be driven that lies ``off`` [rad] from ahead."""
    share = 1.0
    if ti.static(not sonar_cfg.is_ring):
        edge, wide = ti.static(edge_of_sight(sonar_cfg), widest_way(sonar_cfg, teacher_cfg))
        inside = edge - ti.abs(wrapped_angle(off))
        share = ti.math.clamp(inside / ti.static(max(edge - wide, 1.0e-3)), 0.0, 1.0)
    return share


@ti.func
def sweep_share(age_s, sonar_cfg: Const[SonarConfig], teacher_cfg: Const[TeacherConfig]):
    """Share of the cruising speed that a mechanical beam allows, ``age_s`` after the start: what it has not
    looked at for long may have changed. None in the first sweep."""
    share = 1.0
    if ti.static(sonar_cfg.mechanical):
        allowed = ti.static(min(teacher_cfg.sweep_way_m / sonar_cfg.sweep_s / teacher_cfg.cruise_m_s, 1.0))
        share = ti.select(age_s < ti.static(sonar_cfg.sweep_s), 0.0, allowed)
    return share


@ti.func
def kept_in_sight(turn, way, sonar_cfg: Const[SonarConfig], teacher_cfg: Const[TeacherConfig]):
    """Angle to turn by, next to ``turn``, after which a way that lies ``way`` [rad] from ahead is well in
    sight."""
    wide = ti.static(widest_way(sonar_cfg, teacher_cfg))
    return wrapped_angle(way + ti.math.clamp(wrapped_angle(turn - way), -wide, wide))
