"""What stands and moves in the water: truth. Clock and episode, what the vehicle is told, reward, and how the
termination check sees the episode."""

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
    easing_m: ti.Field = array("n_env", "n_dynamic")
    """[m] speed squared over acceleration; 0 = turns at once"""


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

    open: ti.Field = array("n_env", "n_coarse_row", "n_coarse_word", dtype=ti.u64, scratch=True)
    """bits of the cells that are free"""
    reach: ti.Field = array("n_env", "n_coarse_row", "n_coarse_word", dtype=ti.u64, scratch=True)
    """bits of those that are reached from the start"""
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


@dataclass(frozen=True, eq=False)
class ClockState:
    """Which envs run, and their time. Every kernel sees it; it holds no truth about the world."""

    running: ti.Field = array("n_env", dtype=ti.i32)
    """1 = running; 0 = ended, waiting for a reset"""
    active: ti.Field = array("n_env", dtype=ti.i32)
    """1 = processed by the kernels of this pass: the running rows in a step, the rows being reset in a
    reset"""
    step: ti.Field = array("n_env", dtype=ti.i32)
    """control steps done since the episode's start; time = step * control_dt_s"""
    zero: ti.Field = array(dtype=ti.i32)
    """always 0; see ``kernels.core.stage.loop_end``"""


@dataclass(frozen=True, eq=False)
class EpisodeState(Truth):
    """Which episode each env runs. Its key opens every random stream, so only the simulator's side (world,
    vehicle, sensors) gets it."""

    seed: ti.Field = array("n_env", dtype=ti.i32)
    """seed of the scenario"""
    number: ti.Field = array("n_env", dtype=ti.i32)
    """episode index under that seed"""
    key: ti.Field = array("n_env", dtype=ti.u32)
    """random key of (seed, number)"""


@dataclass(frozen=True, eq=False)
class MissionState:
    """What the vehicle is told: its goal. (The tank's bounds are known from the config.)"""

    goal_w: ti.Field = array("n_env", vec=3)
    """[m]"""
    start_w: ti.Field = array("n_env", vec=3)
    """[m]"""
    start_yaw: ti.Field = array("n_env")
    """[rad]"""


@dataclass(frozen=True, eq=False)
class RewardState:
    """Reward of the step, term by term."""

    term: ti.Field = array("n_env", "n_term")
    """weighted terms, in the order of TERMS"""
    episode_sum: ti.Field = array("n_env", "n_term")
    """their sums over the episode"""
    total: ti.Field = array("n_env")
    """reward of the step"""
    episode_return: ti.Field = array("n_env")
    """sum of rewards over the episode"""
    last_remaining_m: ti.Field = array("n_env")
    """[m] route length that was still ahead in the last step, negative = unknown"""
    n_ended: ti.Field = array(dtype=ti.i32, scratch=True)
    """envs whose episode had ended at the last ``write_ends``"""


@dataclass(frozen=True, eq=False)
class TerminationState(Truth):
    """How each episode stands, judged from the truth. Never an input of mapping, planning, behaviour tree or
    policy."""

    outcome: ti.Field = array("n_env", dtype=ti.i32)
    """episode.RUNNING, SUCCESS, COLLISION, TTC, OUT_OF_TANK or TIMEOUT"""
    clearance_m: ti.Field = array("n_env")
    """[m] hull to nearest obstacle or side wall, now"""
    ttc_s: ti.Field = array("n_env")
    """[s] smallest clearance / closing speed over the obstacles, geometry.FAR_M = none"""
    min_clearance_m: ti.Field = array("n_env")
    """[m] smallest of the episode"""
    path_length_m: ti.Field = array("n_env")
    """[m] driven"""
    last_pos_w: ti.Field = array("n_env", vec=3)
    """[m] position at the last step"""


@dataclass(frozen=True, eq=False)
class TaskStructs:
    """Structs of this room, by the noun of their stage."""

    clock: ClockState
    episode: EpisodeState
    mission: MissionState
    termination: TerminationState
    reward: RewardState
