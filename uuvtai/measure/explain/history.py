"""What is kept of a failed episode to explain it: its bodies, its last seconds sample by sample, all of it
coarsely."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uuvtai.kernels.core.geometry import NONE

Array = np.ndarray


@dataclass(frozen=True)
class Bodies:
    """What stays the same over an episode: its bodies. Arrays have one entry per slot."""

    kind: Array
    size: Array
    yaw: Array
    speed_m_s: Array
    """nominal; 0 = at rest"""
    circle_m: Array
    """radius of the circle it drives on; 0 = a polyline or at rest"""
    lap_s: Array
    """time once around its closed path; inf = at rest"""

    @property
    def moving(self) -> Array:
        """Slots with a body that moves."""
        return (self.kind != NONE) & (self.speed_m_s > 0.01)


@dataclass(frozen=True)
class CoarseHistory:
    """The whole episode at a coarse rate."""

    t_s: Array
    pos_w: Array
    goal_m: Array
    """3-D distance to the goal"""
    has_route: Array
    leaf: list[str]


@dataclass(frozen=True)
class History:
    """The last seconds of an episode, oldest sample first, the end last; ``coarse`` is the account of all of
    it."""

    t_s: Array
    """(n,) since the start"""
    pos_w: Array
    believed_pos_w: Array
    """(n, 3) own position as the vehicle estimates it"""
    vel_valid: Array
    """(n,) whether it knows its velocity: 1, 2 = heave alone, 0 = not"""
    quat_wb: Array
    vel_b: Array
    rate_b: Array
    body_w: Array
    """(n, nb, 3)"""
    body_vel_w: Array
    ping_age_s: Array
    """(n,) age of the newest delivered scan"""
    range_m: Array
    """(n, n_ray) that scan; no return = maximum range"""
    track_moving: Array
    """(n, n_track) 1 = confirmed, 0 = taken to be static, -1 = empty slot"""
    track_w: Array
    """(n, n_track, 2)"""
    forecast_w: Array
    """(n, n_track, n_forecast, 2)"""
    forecast_m: Array
    """(n, n_track) present radius, negative = no forecast"""
    forecast_above_w: Array
    """(n, n_track) z of the lowest edge of what it may hold above the vehicle; the vehicle's own z where it
    may be level with it"""
    forecast_below_w: Array
    """(n, n_track) z of the highest edge of what it may hold below"""
    conflict: Array
    """(n,) bool: the pilot foresees a conflict"""
    leaf: list[str]
    """type of the leaf in charge, "" = none"""
    action: Array
    """(n, 4)"""
    map_clearance_m: Array
    """(n,) what the vehicle's own map says"""
    coarse: CoarseHistory
