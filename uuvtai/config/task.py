"""Reward, clock and the rules of the termination."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from uuvtai.config.base import NonNegative, Positive, PositiveCount, Real, Section

TERMS = (
    "alive", "progress", "path_distance", "cross_track", "clearance", "ttc", "overspeed", "upright",
    "heading", "success", "failure", "tilt", "effort",
)  # fmt: skip
"""Names of the reward's terms, in the order of ``RewardState.term``; their weights are the config keys of the
same names."""


class RewardConfig(Section):
    """Weights of the paper's r_t, one per term and named like it (the paper gives no values: EC), and the
    bounds of the soft terms.

    Scale: driving at 0.6 m/s along the route earns about 0.015 a step, 20 over a typical episode: as much as
    one success.
    """

    alive: Real = 0.01
    """r_alive; less than path_distance takes at the usual look-ahead of 1 m, so that waiting does not pay"""
    progress: Real = 1.0
    """w_p [1/m]"""
    path_distance: Real = 0.02
    """w_d [1/m]"""
    cross_track: Real = 0.02
    """w_ct [1/m]"""
    clearance: Real = 0.1
    """w_c; touching costs five times what full speed earns"""
    ttc: Real = 0.1
    """w_ttc"""
    overspeed: Real = 0.1
    """w_v [s^2/m^2]"""
    upright: Real = 0.005
    """w_u"""
    heading: Real = 0.01
    """w_h; about as much as progress at full speed, so that the vehicle looks where it goes"""
    success: Real = 20.0
    """w_s"""
    failure: Real = 20.0
    """w_f"""
    tilt: Real = 0.02
    """w_tilt [1/rad]"""
    effort: Real = 0.005
    """w_eff"""
    soft_clearance_m: Positive = 0.4
    """C_t grows linearly from 0 here to 1 at contact"""
    soft_ttc_s: Positive = 2.0
    """T_t grows linearly from 0 here to 1 at impact"""
    safe_speed_m_s: Positive = 0.6
    """beyond this speed is overspeed (Table app_repro: 0.6 m/s)"""


class EpisodeConfig(Section):
    """Clock and the termination check's rules."""

    control_dt_s: Positive = 0.02
    substeps: PositiveCount = 2
    horizon_steps: Annotated[int, Field(ge=1, le=30000)] = 3000
    goal_radius_m: Positive = 1.0
    collision_clearance_m: NonNegative = 0.1
    ttc_s: NonNegative = 0.18
    ttc_closing_m_s: NonNegative = 0.05
