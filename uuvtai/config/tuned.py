"""Factors on the behaviour tree's numbers: among slow bodies and among fast ones."""

from __future__ import annotations

from uuvtai.config.section import NonNegative, Positive, Section


class TunedConfig(Section):
    """Factors on numbers of ``teacher``. ``uuv train best`` learns them (``docs/learning.md``)."""

    caution: Positive = 1.0
    margin_growth_m_s: Positive = 1.0
    closing_s: Positive = 1.0
    horizon_s: Positive = 1.0
    lag_s: Positive = 1.0
    weight_deviation: Positive = 1.0
    emergency_ttc_s: Positive = 1.0
    emergency_range_m: Positive = 1.0
    calm_s: Positive = 1.0
    gaze_m: Positive = 1.0
    vertical_weight: Positive = 1.0
    weight_peak: Positive = 1.0
    weight_mean: Positive = 1.0
    weight_contact: Positive = 1.0
    weight_change: Positive = 1.0
    softness: Positive = 1.0
    static_margin_m: Positive = 1.0
    weight_static: Positive = 1.0
    heave_m_s: Positive = 1.0
    burst_s: Positive = 1.0
    conflict_within_s: Positive = 1.0
    return_slope: Positive = 1.0
    weight_goal_depth: Positive = 1.0
    weight_depth_change: Positive = 1.0
    body_doubt: Positive = 1.0
    arrival_depth_share: Positive = 1.0


class SlowConfig(TunedConfig):
    """Factors on numbers of ``teacher`` that hold where no fast body was lately tracked."""


class FastConfig(TunedConfig):
    """Factors on numbers of ``teacher`` that hold, instead of those of ``slow``, where fast bodies were
    lately tracked, and by a share of their logarithms where these are a little fast."""

    from_m_s: NonNegative = 0.8
    """speed of the fastest tracked body, less its standard deviation, up to which ``slow`` holds alone"""
    full_m_s: NonNegative = 1.2
    """speed from which on these factors hold alone"""
    settle_s: Positive = 1.0
    """time constant of the mean of that speed"""
