"""Local planners of the literature: dynamic window, potential field, velocity obstacle, path integral."""

from __future__ import annotations

from uuvtai.config.base import Fraction, NonNegative, Positive, PositiveCount, Section

N_AXIS = 11
"""velocities along surge and along sway of a window of reachable ones"""
ACCELERATION_M_S2 = 1.7
"""of the vehicle: cruise speed over the time constant of its velocity"""


class DynamicWindowConfig(Section):
    """Dynamic window approach (Fox, Burgard, Thrun 1997)."""

    window_s: Positive = 0.4
    """velocities that can be reached within this are tried"""
    horizon_s: Positive = 2.5
    """of the roll-out of a velocity"""
    margin_m: NonNegative = 0.15
    """wanted clearance beyond contact from moving obstacles; closer counts as a collision"""
    weight_heading: NonNegative = 2.0
    """of the angle to the wanted velocity, as a share of 180 degrees"""
    weight_clearance: NonNegative = 5.0
    """of time and distance to what is nearest, as a share; the speed, as a share of cruise speed, weighs 1"""


class PotentialFieldConfig(Section):
    """Artificial potential field (Khatib 1986)."""

    reach_m: Positive = 1.5
    """moving obstacles farther away push nobody"""
    gain: NonNegative = 0.1
    """[m^4/s] of the push of a moving obstacle"""


class VelocityObstacleConfig(Section):
    """Velocity obstacles (Fiorini and Shiller 1998)."""

    window_s: Positive = 0.8
    """velocities that can be reached within this are tried"""
    horizon_s: Positive = 3.0
    """collisions later than this are none"""
    margin_m: NonNegative = 0.4
    """wanted clearance beyond contact from moving obstacles"""
    static_horizon_s: Positive = 1.5
    """the same for mapped obstacles and walls"""


class PathIntegralConfig(Section):
    """Sampling model-predictive control: MPPI (Williams and others 2017)."""

    n_sample: PositiveCount = 256
    """sequences of velocities that are tried in a decision"""
    horizon_s: Positive = 2.5
    sigma_m_s: Positive = 0.4
    """standard deviation of the noise on surge and sway"""
    temperature: Positive = 0.1
    """lambda: smaller trusts the best sample more"""
    exploration: Fraction = 0.98
    """alpha: how much of the control cost is left out; 1 = all of it"""
    margin_m: NonNegative = 0.25
    """wanted clearance beyond contact from moving obstacles"""
    margin_growth_m_s: NonNegative = 0.1
    """the margin grows with prediction time"""
    weight_obstacle: NonNegative = 40.0
    """[1/m] mean depth of violation of the wanted clearance from moving obstacles; a metre off the wanted way
    costs 1"""
    weight_static: NonNegative = 40.0
    """[1/m] mean depth of violation of the wanted clearance from mapped obstacles and walls"""
    weight_contact: NonNegative = 10.0
    """of every sample that touches something, once"""


class BaselinesConfig(Section):
    """What the local planners of the literature share. Limits of speed, hull and lag are the behaviour tree's
    and the vehicle's: the same for everybody."""

    period_steps: PositiveCount = 5
    """control steps between decisions"""
    heave_m_s: NonNegative = 0.4
    """vertical speed of those that climb or dive; 0 = depth is not used to evade (also in the potential
    field)"""
    vertical_weight: Positive = 1.5
    """free water above or below an obstacle counts this many times: the hull is slimmer upwards"""
    edge_gap_m: NonNegative = 0.26
    """hull centre to surface or floor, at least"""
    static_margin_m: NonNegative = 0.1
    """wanted clearance beyond contact from mapped obstacles and walls"""
    dwa: DynamicWindowConfig = DynamicWindowConfig()
    potential_field: PotentialFieldConfig = PotentialFieldConfig()
    velocity_obstacle: VelocityObstacleConfig = VelocityObstacleConfig()
    mppi: PathIntegralConfig = PathIntegralConfig()

    @property
    def n_reachable(self) -> int:
        """Velocities tried in the reachable window: the grid at each heave, the wanted velocity, a stop."""
        return N_AXIS * N_AXIS * (3 if self.heave_m_s > 0 else 1) + 2

    @property
    def n_trial(self) -> int:
        """Velocities or sequences of them that a decision tries, at most."""
        return max(self.n_reachable, self.mppi.n_sample)
