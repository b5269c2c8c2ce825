"""Columns of the twin's tensors, and how many there are: one row per env, all float32."""

from __future__ import annotations

MOVERS = 9
"""moving bodies of an env at most"""
STATICS = 8
"""obstacles at rest of an env at most"""
RAYS = 24
"""directions in which free space is looked up"""

CRUISE_M_S, CLIMB_M_S = 0.85, 0.4
"""what an action of 1 asks for: horizontally (a hull diagonal at its limits), vertically"""
AXIS_M_S = 0.6
"""limit of surge and of sway"""
MARGIN_M = 0.26
"""from the hull's centre to floor and surface at least: the heave loop overshoots"""
DECISION_S = 0.1

STATIC = ("kind", "x", "y", "size_x", "size_y", "yaw")
MOVER = ("kind", "z", "radius", "half_height", "n_way", "turn_radius", "length", "phase", "speed", "way")
WAY = MOVER.index("way")
"""from here on 5 corners (x, y) [m]; of a circle, corner 0 is the centre"""
N_STATIC, N_MOVER = len(STATIC), WAY + 10

EGO = (
    *("x", "y", "z", "vx", "vy", "vz", "yaw", "rate", "time", "goal_x", "goal_y", "goal_z"),
    *("flip_x", "flip_y", "last_x", "last_y", "last_z"),
)
N_EGO = len(EGO)
TRACK = ("x", "y", "vx", "vy", "seen_s", "age_s", "watched_m", "height_known")
N_TRACK = len(TRACK)

BODY_COLUMNS = 22
"""what the actor sees of a tracked body; column 0 is 1 where there is one"""
EGO_COLUMNS = 17 + RAYS
"""what the actor sees beside the bodies"""
TRUE_COLUMNS = 10
"""what the critic alone sees of a body in training: where it is and will be 1, 2 and 3 s ahead"""

SEEN_COLUMNS = 14
"""what is known of a tracked body, in the world frame (``sensed.gather_tracks``)"""
