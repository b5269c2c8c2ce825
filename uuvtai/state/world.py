"""What stands and moves in the water: truth."""

from __future__ import annotations

from dataclasses import dataclass

import taichi as ti

from uuvtai.common.enums import Truth
from uuvtai.state.arrays import array


@dataclass(frozen=True, eq=False)
class SceneState(Truth):
    """What is asked of the scenario of each env: data, so that cells of a sweep need no recompilation."""

    n_static: ti.Field = array("n_env", dtype=ti.i32)
    """S: random static obstacles wanted"""
    n_dynamic: ti.Field = array("n_env", dtype=ti.i32)
    """D: moving obstacles wanted"""
    speed_m_s: ti.Field = array("n_env")
    """v: nominal speed of the moving obstacles [m/s]"""


@dataclass(frozen=True, eq=False)
class WorldState(Truth):
    """Truth: obstacles as a list per env, fixed and static ones first, moving ones from ``first_dynamic`` on.
    kind NONE = empty slot."""

    kind: ti.Field = array("n_env", "n_obstacle", dtype=ti.i32)
    """geometry.SPHERE, CYLINDER, BOX or NONE"""
    pos_w: ti.Field = array("n_env", "n_obstacle", vec=3)
    """[m] centre"""
    vel_w: ti.Field = array("n_env", "n_obstacle", vec=3)
    """[m/s]"""
    size: ti.Field = array("n_env", "n_obstacle", vec=3)
    """[m] sphere (r, r, r), cylinder (r, r, half height), box half extents"""
    yaw: ti.Field = array("n_env", "n_obstacle")
    """[rad]"""
    draws: ti.Field = array("n_env", dtype=ti.i32)
    """how many layouts were drawn until start and goal were joined by free space"""
    unclear_paths: ti.Field = array("n_env", dtype=ti.i32)
    """paths of moving obstacles taken as they were: no draw kept clear of static obstacles"""
    faults: ti.Field = array("n_env", dtype=ti.i32)
    """0 = the scenario is as asked; else a bit set of scenario.FAULTS: draws ran out, the world cannot be
    placed"""


@dataclass(frozen=True, eq=False)
class PathState(Truth):
    """Truth: how the moving obstacles move. A closed polyline of 2 to 5 waypoints (2 = back and forth), or a
    circle (n_way = 0)."""

    n_way: ti.Field = array("n_env", "n_dynamic", dtype=ti.i32)
    """waypoints of the closed polyline; 0 = circle"""
    way_w: ti.Field = array("n_env", "n_dynamic", "n_corner", vec=2)
    """[m] waypoints; of a circle, way 0 is the centre"""
    radius_m: ti.Field = array("n_env", "n_dynamic")
    """[m] of a circle; positive = counter-clockwise, negative = clockwise"""
    length_m: ti.Field = array("n_env", "n_dynamic")
    """[m] once around the closed path"""
    phase_m: ti.Field = array("n_env", "n_dynamic")
    """[m] arc length along the closed path at t = 0"""
    speed_m_s: ti.Field = array("n_env", "n_dynamic")
    """[m/s]"""


@dataclass(frozen=True, eq=False)
class FixedTable(Truth):
    """Obstacles given explicitly by the world's YAML, the same for all envs; moving ones fill the first slots
    of the moving list."""

    kind: ti.Field = array("n_fixed", dtype=ti.i32)
    """geometry kind"""
    pos_w: ti.Field = array("n_fixed", vec=3)
    """[m]"""
    size: ti.Field = array("n_fixed", vec=3)
    """[m] as in WorldState"""
    yaw: ti.Field = array("n_fixed")
    """[rad]"""
    n_way: ti.Field = array("n_fixed", dtype=ti.i32)
    """waypoints of its path, 0 = does not move"""
    way_w: ti.Field = array("n_fixed", "n_corner", vec=2)
    """[m]"""
    speed_m_s: ti.Field = array("n_fixed")
    """[m/s], negative = the scenario's v"""


@dataclass(frozen=True, eq=False)
class ScenarioScratch(Truth):
    """Scratch of scenario drawing: free space on a coarse grid, to see whether start and goal are joined."""

    reach: ti.Field = array("n_env", "n_coarse_row", "n_coarse_col", dtype=ti.u8, scratch=True)
    """0 = free, 1 = blocked, 2 = reached from the start"""
    footprint: ti.Field = array("n_env", "n_obstacle", vec=7, scratch=True)
    """plan view of the static obstacles (footprint.py)"""


@dataclass(frozen=True, eq=False)
class WorldStructs:
    """Structs of this room, by the noun of their stage."""

    scene: SceneState
    world: WorldState
    path: PathState
    fixed: FixedTable
    scratch: ScenarioScratch
