"""Clearance, Voronoi planner, route and features."""

from __future__ import annotations

from typing import Literal

from uuvtai.config.base import Count, NonNegative, Positive, PositiveCount, Section


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
