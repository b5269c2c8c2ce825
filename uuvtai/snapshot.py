"""One env at one control step as plain NumPy arrays: what the simulator hands to whoever records it.

Nothing here knows Taichi, torch or files. Arrays are copies of one env's rows, SI units, frames as in
``state`` (``_w`` world, ``_b`` body). A value that does not exist (no policy, no depth image in this step) is
None.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uuvtai.version import __version__

RUNNING = "running"
"""outcome of an episode that has not ended"""

KINDS = {1: "sphere", 2: "cylinder", 3: "box"}
"""names of ``EpisodeSnapshot.obstacle_kind``, the codes of ``kernels.geometry``; other codes are empty
slots"""


@dataclass(frozen=True, eq=False)
class EpisodeHeader:
    """What is known before the first step; it comes first in the log."""

    controller: str
    """name of the method that drives: 'bt', 'planner', 'straight' or a policy's name"""
    config_yaml: str
    """the resolved config"""
    scenario: dict[str, Any]
    """``uuvtai.logs.closed_form.scenario_document``: everything true about the world, in closed form"""
    control_dt_s: float
    sonar_max_range_m: float
    camera_offset_b_m: tuple[float, float, float] = (0.2, 0.0, 0.0)
    reward_terms: tuple[str, ...] = ()
    """names of ``EpisodeSnapshot.reward``'s entries"""
    tree_nodes: tuple[str, ...] = ()
    """names of ``EpisodeSnapshot.tree_status``'s entries; numbered by the log where two are equal"""
    tree_statuses: tuple[str, ...] = ("IDLE", "RUNNING", "SUCCESS", "FAILURE")
    """name of every status code"""
    version: str = __version__
    git_sha: str = "unknown"
    checkpoint_sha256: str = ""
    """of the policy's checkpoint; empty = no policy"""


@dataclass(frozen=True, eq=False)
class MapLayers:
    """The vehicle's map: arrays (n_row, n_col) float32, row along y, column along x."""

    origin_m: tuple[float, float]
    """world x, y of the outer corner of cell [0, 0]"""
    cell_m: float
    static: np.ndarray
    """occupancy [0, 1]"""
    dynamic: np.ndarray
    """occupancy [0, 1]"""
    clearance_m: np.ndarray
    """[m]"""
    risk: np.ndarray | None = None
    clearance_step: int | None = None
    """step whose map clearance and risk were computed from; None = this one"""


@dataclass(frozen=True, eq=False)
class DepthLine:
    """What the map takes from a depth image: of every column that has one, the nearest pixel at the vehicle's
    own depth."""

    column: np.ndarray
    """(n,)"""
    row: np.ndarray
    """(n,)"""
    depth_m: np.ndarray
    """(n,) z-depth"""


@dataclass(frozen=True, eq=False)
class EpisodeSnapshot:
    """One env at one control step, the reset (step 0) included."""

    step: int
    """control steps since the start; time = step * control_dt_s"""
    outcome: str
    """'running', or how the episode ended: then this snapshot is the last"""

    # truth
    pos_w: np.ndarray
    """(3,) [m]"""
    quat_wb: np.ndarray
    """(4,) w, x, y, z"""
    vel_b: np.ndarray
    """(3,) [m/s] over ground"""
    rate_b: np.ndarray
    """(3,) [rad/s]"""
    current_w: np.ndarray
    """(3,) [m/s]"""
    rpm: np.ndarray
    """(n_thruster,)"""
    thrust_n: np.ndarray
    """(n_thruster,) [N]"""
    clearance_m: float
    """hull to the nearest obstacle or wall"""
    ttc_s: float | None
    """smallest time to collision; None (or anything above 1e5) = nothing closes in"""
    obstacle_kind: np.ndarray
    """(n_body,) keys of KINDS, or 0 = empty slot"""
    obstacle_pos_w: np.ndarray
    """(n_body, 3) [m]"""
    obstacle_vel_w: np.ndarray
    """(n_body, 3) [m/s]"""
    obstacle_size: np.ndarray
    """(n_body, 3) as in WorldState"""
    obstacle_yaw: np.ndarray
    """(n_body,) [rad]"""

    # sensed
    estimate_pos_w: np.ndarray
    """(3,) [m] own position estimate"""
    estimate_rpy: np.ndarray
    """(3,) [rad] own attitude estimate"""
    measured_vel_b: np.ndarray
    """(3,) [m/s] DVL"""
    measured_vel_valid: bool
    measured_rate_b: np.ndarray
    """(3,) [rad/s] gyro"""
    depth_m: float
    """[m] pressure depth, positive down"""
    sonar_fresh: bool
    """a scan was delivered in this step; otherwise the sonar arrays are not looked at"""
    sonar_ping_step: int
    """step at which that scan was taken"""
    sonar_range_m: np.ndarray
    """(n_ray,)"""
    sonar_doppler_m_s: np.ndarray
    """(n_ray,)"""
    sonar_intensity: np.ndarray
    """(n_ray,) [0, 1]"""
    sonar_hit: np.ndarray
    """(n_ray,) 1 = return"""
    sonar_ping_vel_b: np.ndarray
    """(3,) [m/s] own measured velocity when the scan was taken"""

    # action
    action_applied: np.ndarray
    """(4,) surge, sway, heave, yaw rate in [-1, 1] that led here"""
    action_teacher: np.ndarray | None
    """(4,) what the tree chooses now"""
    action_policy: np.ndarray | None = None
    """(4,) what the policy chooses now"""

    # planning
    route_w: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    """(n, 2) or (n, 3) [m] waypoints of the route, looked at when route_fresh"""
    route_fresh: bool = False
    """the route was planned in this step"""
    route_planner: str = "none"
    """'voronoi', 'rrt' or 'none'"""
    route_fallback: str = ""
    """why the Voronoi planner failed in this step, empty = it did not"""
    replan_trigger: str = "none"
    """'initial', 'stuck', 'safety', 'intersection' or 'none'"""
    lookahead_w: np.ndarray | None = None
    """(3,) [m] point being steered at"""
    path_risk: float = 0.0
    tracks: np.ndarray | None = None
    """(n, 6) x, y, z [m], vx, vy [m/s], radius [m] of the moving bodies being tracked; looked at when
    sonar_fresh"""
    track_beams: np.ndarray | None = None
    """indices of the beams that a moving body explains"""

    # tree, reward, policy
    tree_status: np.ndarray | None = None
    """(n_node,) status codes of the newest tick"""
    tree_leaf: int | None = None
    """node that set the action"""
    reward: np.ndarray | None = None
    """(n_term,) weighted terms"""
    policy_value: float | None = None
    policy_std: np.ndarray | None = None
    """(4,)"""
    distill_lambda: float | None = None
    wm_residual: float | None = None
    wm_uncertainty: float | None = None

    depth_line: DepthLine | None = None
    """of a depth image taken in this step; None = none was"""

    # big ones: only where ``McapEpisodeLog.due`` asked for them
    depth_image_m: np.ndarray | None = None
    """(rows, cols) [m]"""
    maps: MapLayers | None = None


@dataclass(frozen=True)
class EpisodeEnd:
    """How the episode ended: the last thing in the log."""

    outcome: str
    episode_return: float
    time_s: float
    min_clearance_m: float
    replans: dict[str, int] = field(default_factory=dict)
    """by trigger"""
    planned_by: dict[str, int] = field(default_factory=dict)
    """routes by planner"""
