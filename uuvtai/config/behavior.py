"""The behaviour tree's leaves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from uuvtai.config.base import Fraction, NonNegative, Positive, PositiveCount, Section

if TYPE_CHECKING:
    import numpy as np


class BehaviorConfig(Section):
    """Behaviour tree's leaves: assessment of threats, evasion and driving. Ports of a tree override the
    numbers that are a leaf's own."""

    cruise_m_s: Positive = 0.85
    """where there is room for a body diagonal along the way; in narrow places no more than ``max_surge_m_s``,
    and 0.6 drives nose first everywhere, as in the paper"""
    decide_period_steps: PositiveCount = 5
    """control steps between decisions of the evasion (10 Hz: more made no difference in a trial)"""
    lag_s: Positive = 0.3
    """time constant from commanded to driven velocity, for roll-outs"""
    horizon_s: Positive = 2.0
    """of roll-outs (``research/LOG.md``)"""

    n_heading: PositiveCount = 24
    n_speed: PositiveCount = 4
    evade_m_s: Positive = 0.85
    """fastest candidate; the limits of surge and sway are separate, so diagonals of the body are faster than
    its axes"""

    heave_m_s: NonNegative = 0.4
    """vertical speed of the candidates that dive or climb; 0 = evade level only"""
    n_heave_heading: PositiveCount = 13
    """headings of the candidates that dive or climb"""
    burst_s: NonNegative = 0.8
    """the candidates that are a short dash last so long, then they stop; 0 = none"""

    hull_reach_m: NonNegative = 0.22
    """hull centre to surface: between 0.17 abeam and 0.27 ahead"""
    contact_m: NonNegative = 0.1
    """clearance that the termination check calls a collision"""
    margin_m: NonNegative = 0.275
    """wanted clearance beyond contact from a forecast obstacle"""
    margin_growth_m_s: NonNegative = 0.085
    """the margin grows with prediction time"""
    closing_s: NonNegative = 0.2
    """effective clearance is reduced by this times the closing speed (the termination check stops at 0.18
    s)"""
    vertical_weight: Positive = 2.0
    """free water above or below an obstacle counts this many times: the hull is slimmer upwards (0.17 m) and
    heights carry their own margin"""
    least_share: Fraction = 0.02
    """futures that are less probable are left out,"""
    evade_probability: Fraction = 0.2
    """and those that are less probable than this cost, but are no reason to evade"""
    future_margin: Fraction = 1.0
    """margin kept from an obstacle that does something else than is forecast, as a share of the usual one"""
    caution: Positive = 1.0
    """factor of both margins from moving obstacles: more trades time and success for fewer collisions"""
    patience_s: NonNegative = 3.0
    """a vehicle that has waited longer, before crossing traffic say, is less cautious: by this over the time
    that it has waited; 0 = it waits for ever"""
    obstacle_growth: Positive = 1.0
    """factor of what an obstacle's radius grows by in its forecast, as that is less and less sure"""
    static_margin_m: NonNegative = 0.1
    """wanted clearance beyond contact from mapped obstacles and walls"""
    place_sigmas: NonNegative = 3.0
    """walls and mapped obstacles are taken to be nearer by so many standard deviations of the own place,
    surface and floor by as many of the own depth"""
    static_horizon_s: Positive = 1.5
    static_dt_s: Positive = 0.25

    weight_peak: NonNegative = 6.0
    """[1/m] largest depth of violation of the wanted clearance"""
    weight_mean: NonNegative = 5.0
    """[1/m] depth of violation averaged over the horizon, summed over obstacles"""
    weight_contact: NonNegative = 12.0
    """[1/m] largest depth below contact"""
    weight_static: NonNegative = 12.0
    """[1/m] mean depth of violation of the static clearance"""
    weight_static_contact: NonNegative = 30.0
    """[1/m] largest depth below static contact"""
    weight_deviation: NonNegative = 1.0
    """per cruise speed of difference from the follow velocity"""
    weight_change: NonNegative = 0.3
    """per cruise speed of difference from the last command"""
    temperature: Positive = 0.05
    """temperature of the cost-softmax mean over candidates"""

    hysteresis_s: NonNegative = 0.3
    """evasion goes on for this long after the last predicted conflict"""
    conflict_within_s: NonNegative = 2.5
    emergency_ttc_s: NonNegative = 0.15
    emergency_range_m: NonNegative = 0.07
    back_off_m_s: Positive = 0.85
    slow_clearance_m: Positive = 0.6
    """speed falls below cruise where the static clearance is smaller than this"""
    slow_fraction: Fraction = 0.75
    """share of cruise speed left at contact"""
    edge_gap_m: NonNegative = 0.2
    """hull centre to surface or floor, at least: the hull's radius of 0.17 m and 0.03 m"""
    lost_edge_gap_m: NonNegative = 0.35
    """the same, if it is more, once a vertical thruster is suspected to be dead; the vehicle then cruises at
    the goal's depth"""
    free_depth: bool = True
    """cruise at the depth where the fewest obstacles are to be met, as far as the goal's depth can still be
    reached in time; false = at the goal's depth"""
    depth_choices: PositiveCount = 8
    """depths to choose among, from edge to edge"""
    weight_goal_depth: NonNegative = 0.05
    """[1/m] of the way to the goal's depth; obstacles that are expected but not seen (``traffic``) cost the
    share of them that is level"""
    weight_depth_change: NonNegative = 0.1
    """[1/m] of leaving the depth chosen before"""
    return_slope: NonNegative = 0.3
    """[m/m] how much farther from the goal's depth the vehicle may be per metre from the goal"""
    arrival_depth_share: Fraction = 0.7
    """share of the goal's radius that the depth may be off on arrival: what is left of the radius ends the
    level way"""
    depth_gain: Positive = 1.0
    """[1/s] heave per metre of depth error"""
    heading_range_m: NonNegative = 3.0
    """the nose, and with it the camera, turns to the nearest moving obstacle this close: near ones leave the
    sonar's fan; 0 = along the way"""
    heading_level_m: NonNegative = 3.0
    """obstacles level with the vehicle count as so much farther: the sonar sees them; as much as
    ``heading_range_m`` or more: the nose is not turned to them at all"""
    heading_clearance_m: NonNegative = 0.6
    """mapped clearance below which the nose stays along the way: the hull is longer than wide"""
    sideslip_clearance_m: NonNegative = 0.5
    """where the way is narrower the vehicle slows down until its nose lies along it"""
    travel_diagonal: bool = False
    """on a route with room, a diagonal of the body goes along the way, wherever the camera then looks, for
    diagonals are faster; not with a sonar that looks ahead"""
    heading_off_deg: NonNegative = 25.0
    """the nose may be so far off the body that is looked at, towards a diagonal of the body along the way"""
    sight_margin_deg: NonNegative = 20.0
    """where the sonar is a fan ahead, the way is kept so far within its edge: the nose turns, and beyond that
    the vehicle slows down, to a stop at the edge"""
    sweep_way_m: Positive = 1.0
    """with a mechanical sonar the vehicle drives no farther along its route while the beam comes round once,
    and waits for the first sweep"""
    yaw_gain: Positive = 2.5
    """[1/s]"""

    @property
    def n_held(self) -> int:
        """Evasive velocities to be held: level headings times speeds; stop, last command, follow; diving and
        climbing ones."""
        return self.n_heading * self.n_speed + 3 + (2 * self.n_heave_heading + 2 if self.heave_m_s > 0 else 0)

    @property
    def first_burst(self) -> int:
        """Index of the first dash: ``n_held`` padded to whole packets of 16."""
        return 16 * -(-self.n_held // 16)

    @property
    def n_candidate(self) -> int:
        """Evasive velocities in all, padding included: the dashes go in two packets of 16 headings."""
        return self.first_burst + (32 if self.burst_s > 0 else 0)


# ------------------------------------------------------------------------------------------------------------
# Factors on the behaviour tree's numbers: among slow obstacles and among fast ones.


class TunedConfig(Section):
    """Factors on numbers of ``behavior``. ``uuv train best`` learns them (``docs/learning.md``)."""

    caution: Positive = 1.0
    margin_growth_m_s: Positive = 1.0
    closing_s: Positive = 1.0
    horizon_s: Positive = 1.0
    lag_s: Positive = 1.0
    weight_deviation: Positive = 1.0
    emergency_ttc_s: Positive = 1.0
    emergency_range_m: Positive = 1.0
    hysteresis_s: Positive = 1.0
    heading_range_m: Positive = 1.0
    vertical_weight: Positive = 1.0
    weight_peak: Positive = 1.0
    weight_mean: Positive = 1.0
    weight_contact: Positive = 1.0
    weight_change: Positive = 1.0
    temperature: Positive = 1.0
    static_margin_m: Positive = 1.0
    weight_static: Positive = 1.0
    heave_m_s: Positive = 1.0
    burst_s: Positive = 1.0
    conflict_within_s: Positive = 1.0
    return_slope: Positive = 1.0
    weight_goal_depth: Positive = 1.0
    weight_depth_change: Positive = 1.0
    obstacle_growth: Positive = 1.0
    arrival_depth_share: Positive = 1.0


class SlowConfig(TunedConfig):
    """Factors on numbers of ``behavior`` that hold where no fast obstacle was lately tracked."""


class FastConfig(TunedConfig):
    """Factors on numbers of ``behavior`` that hold, instead of those of ``slow``, where fast obstacles were
    lately tracked, and by a share of their logarithms where these are a little fast."""

    from_m_s: NonNegative = 0.8
    """speed of the fastest tracked obstacle, less its standard deviation, up to which ``slow`` holds alone"""
    full_m_s: NonNegative = 1.2
    """speed from which on these factors hold alone"""


# ------------------------------------------------------------------------------------------------------------
# Numbers of the behaviour tree that ``uuv train best`` changes, row by row: the order of
# ``BehaviorState.tuned``.


SLOW, FAST = 0, 1
"""last axis of ``BehaviorState.tuned``: which obstacles the factors are for"""

CAUTION, GROWTH, CLOSING, HORIZON, LAG, DEVIATION, TTC, RANGE, HYSTERESIS, HEADING_RANGE = range(10)
VERTICAL, PEAK, MEAN, CONTACT, CHANGE, TEMPERATURE, STATIC_MARGIN, STATIC, HEAVE, BURST = range(10, 20)
WITHIN, SLOPE, GOAL_DEPTH, DEPTH_CHANGE, DOUBT, ARRIVAL = range(20, 26)


class TunedNumber(NamedTuple):
    """A number of the config's section ``behavior``; the sections ``slow`` and ``fast`` have a factor of the
    same name."""

    name: str
    least: float
    """smallest factor that is tried"""
    most: float
    """largest one"""


TUNED = (
    TunedNumber("caution", 0.4, 1.6),
    TunedNumber("margin_growth_m_s", 0.4, 2.0),
    TunedNumber("closing_s", 0.4, 2.5),
    TunedNumber("horizon_s", 0.5, 1.0),
    TunedNumber("lag_s", 0.5, 1.6),
    TunedNumber("weight_deviation", 0.4, 2.5),
    TunedNumber("emergency_ttc_s", 0.15, 2.0),
    TunedNumber("emergency_range_m", 0.15, 2.5),
    TunedNumber("hysteresis_s", 0.3, 4.0),
    TunedNumber("heading_range_m", 0.1, 1.6),
    TunedNumber("vertical_weight", 0.5, 1.6),
    TunedNumber("weight_peak", 0.4, 5.0),
    TunedNumber("weight_mean", 0.4, 5.0),
    TunedNumber("weight_contact", 0.4, 4.0),
    TunedNumber("weight_change", 0.3, 2.5),
    TunedNumber("temperature", 0.2, 3.0),
    TunedNumber("static_margin_m", 0.25, 2.5),
    TunedNumber("weight_static", 0.4, 4.0),
    TunedNumber("heave_m_s", 0.5, 1.1),
    TunedNumber("burst_s", 0.4, 2.0),
    TunedNumber("conflict_within_s", 0.3, 1.0),
    TunedNumber("return_slope", 0.4, 4.0),
    TunedNumber("weight_goal_depth", 0.3, 3.0),
    TunedNumber("weight_depth_change", 0.3, 3.0),
    TunedNumber("obstacle_growth", 0.1, 2.0),
    TunedNumber("arrival_depth_share", 0.1, 1.4),
)
"""by their numbers above, new ones last: a checkpoint without them drives by factors of one; roll-outs are no
longer than the config's horizon, for forecasts end there"""


def log_bounds() -> tuple[list[float], list[float]]:
    """(smallest, largest) natural logarithms of the factors."""
    return [math.log(number.least) for number in TUNED], [math.log(number.most) for number in TUNED]


def configured_factors(slow: SlowConfig, fast: FastConfig) -> np.ndarray:
    """(n_tuned, 2) natural logarithms of their factors, float32."""
    import numpy as np  # not for the commands that read presets

    factors = [[getattr(part, number.name) for part in (slow, fast)] for number in TUNED]
    return np.log(np.array(factors)).astype(np.float32)
