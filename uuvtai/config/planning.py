"""Clearance, Voronoi planner, route, columns of the observation, local planners of the literature."""

from __future__ import annotations

from typing import Literal

from uuvtai.config.base import Count, Fraction, NonNegative, Positive, PositiveCount, Section


class ClearanceConfig(Section):
    """Distance transform and risk."""

    max_m: Positive = 2.0
    """distances are exact up to here"""
    period_steps: PositiveCount = 5
    inflate_m: NonNegative = 0.0
    """obstacles, not the tank's bounds, count as so much larger: 0.08 in the paper's planner map; margins do
    the same here"""
    risk_static: NonNegative = 1.0
    """alpha_m"""
    risk_dynamic: NonNegative = 1.0
    """alpha_d"""
    risk_clearance: NonNegative = 0.1
    """alpha_delta [m]"""
    risk_epsilon_m: Positive = 0.1


class VoronoiConfig(Section):
    """Global planner on the medial axis."""

    site_gap_cells: Positive = 3.0
    min_clearance_m: NonNegative = 0.35
    """d_min"""
    cost_epsilon_m: Positive = 0.1
    """eps_r"""
    max_pops: PositiveCount = 20000
    """budget of each pass of the search"""
    use: Literal["static", "fused"] = "static"
    """which occupancy the route must avoid"""


class QuietConfig(Section):
    """Quiet water: how much room a route takes."""

    room_m: Positive = 2.0
    """clearance beyond this is worth nothing more, and water so wide belongs to the planner's graph; at most
    ``clearance.max_m``"""


class RouteConfig(Section):
    """Route, triggers, look-ahead and the RRT fallback."""

    n_way: PositiveCount = 512
    """waypoints kept; a longer route is spaced wider"""
    spacing_m: Positive = 0.2
    lookahead_m: Positive = 1.0
    risk_horizon_m: Positive = 3.0
    """length of the look-ahead segment for path risk and for the intersection trigger"""
    stuck_s: Positive = 3.0
    safety_range_m: NonNegative = 0.5
    safety_ttc_s: NonNegative = 1.0
    reach_speed_m_s: NonNegative = 0.6
    """the vehicle can be anywhere up to this times t along the path when a forecast obstacle is there"""
    min_replan_s: NonNegative = 0.4
    """the same trigger does not fire again within this"""
    rrt_clearance_m: NonNegative = 0.1
    """overlay clearance floor of the paper: what the fallback may still cross"""
    rrt_iterations: PositiveCount = 4000
    """budget of the fallback; never wall time, so that results do not depend on the machine"""


class ObservationConfig(Section):
    """What the observation holds: the sonar by sectors, and what may be added to the paper's phi."""

    n_sector: PositiveCount = 12
    ttc_cap_s: Positive = 10.0
    """times to collision or conflict are cut off here"""
    n_track: Count = 0
    """moving obstacles with columns of their own, those that come closest; 0 = none (the paper's phi)"""
    behavior: bool = False
    """the behaviour tree's action, and why it takes it, as columns; false = the paper's phi"""


# ------------------------------------------------------------------------------------------------------------
# Local planners of the literature: dynamic window, path integral.


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
    """vertical speed of climbs and dives; 0 = depth is not used to evade"""
    vertical_weight: Positive = 1.5
    """free water above or below an obstacle counts this many times: the hull is slimmer upwards"""
    edge_gap_m: NonNegative = 0.26
    """hull centre to surface or floor, at least"""
    static_margin_m: NonNegative = 0.1
    """wanted clearance beyond contact from mapped obstacles and walls"""
    dwa: DynamicWindowConfig = DynamicWindowConfig()
    mppi: PathIntegralConfig = PathIntegralConfig()

    @property
    def n_reachable(self) -> int:
        """Velocities tried in the reachable window: the grid at each heave, the wanted velocity, a stop."""
        return N_AXIS * N_AXIS * (3 if self.heave_m_s > 0 else 1) + 2

    @property
    def n_trial(self) -> int:
        """Velocities or sequences of them that a decision tries, at most."""
        return max(self.n_reachable, self.mppi.n_sample)
