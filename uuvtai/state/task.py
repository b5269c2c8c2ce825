"""Clock and episode, what the vehicle is told, reward, and how the termination check sees the episode."""

from __future__ import annotations

from dataclasses import dataclass

import taichi as ti

from uuvtai.common.enums import Truth
from uuvtai.state.arrays import array


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
