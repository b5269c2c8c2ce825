"""Local planners of the literature: what they drive, and MPPI's plan."""

from __future__ import annotations

from dataclasses import dataclass

import taichi as ti

from uuvtai.state.arrays import array


@dataclass(frozen=True, eq=False)
class BaselineState:
    """What the local planner whose leaf is in the tree wants; nobody writes it where the tree has none."""

    vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] velocity of the newest decision, world"""
    score: ti.Field = array("n_env", "n_trial", scratch=True)
    """how good (dynamic window) or how costly (the others) each trial of the newest decision is"""
    plan_w: ti.Field = array("n_env", "n_control", vec=3)
    """[m/s] velocities that MPPI means to command from now on, one per decision, world"""
    change_w: ti.Field = array("n_env", "n_control", vec=3, scratch=True)
    """[m/s] weighted mean of the samples' noise"""


@dataclass(frozen=True, eq=False)
class BaselineStructs:
    """Structs of this room, by the noun of their stage."""

    baselines: BaselineState
