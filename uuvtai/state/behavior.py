"""The behaviour tree: blackboard, statuses and action, and the tree itself as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import taichi as ti

from uuvtai.state.arrays import array


@dataclass(frozen=True, eq=False)
class BehaviorState:
    """The behaviour tree: blackboard, statuses and action."""

    status: ti.Field = array("n_env", "n_node", dtype=ti.i8)
    """status of every node after the newest tick (``tree_codes``)"""
    running_child: ti.Field = array("n_env", "n_node", dtype=ti.i16)
    """child (preorder index) that a node with memory goes on with"""
    result: ti.Field = array("n_env", "n_node", dtype=ti.i8, scratch=True)
    """scratch of one tick: what each leaf answers when it is ticked"""
    since_step: ti.Field = array("n_env", "n_node", dtype=ti.i32)
    """episode step at which a leaf that is running began"""
    ticks: ti.Field = array("n_env", "n_node", dtype=ti.i32)
    """ticks of every node in the episode"""
    acted: ti.Field = array("n_env", "n_node", dtype=ti.i32)
    """control steps of the episode in which this leaf set the action"""
    action: ti.Field = array("n_env", vec=4)
    """[-1, 1] surge, sway, heave, yaw rate of the tree"""
    tuned: ti.Field = array("n_env", "n_tuned", vec=2)
    """natural logarithms of factors on the config's numbers (``tuned_numbers``), where obstacles are slow and
    where they are fast: a training changes them row by row, a reset sets them to those of the config's
    sections ``slow`` and ``fast``"""
    alert: ti.Field = array("n_env")
    """[0, 1] share of the second ones in what holds, by how fast the fastest tracked obstacles have lately
    been; -1 = none was tracked in this episode yet: the first ones hold"""
    leaf: ti.Field = array("n_env", dtype=ti.i32)
    """node that set the action, -1 = none (then the vehicle is told to stop)"""
    follow_vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] velocity that following the route asks for"""
    speed_share: ti.Field = array("n_env")
    """share of the cruising speed that narrow places leave"""
    cruise_z_m: ti.Field = array("n_env")
    """[m] world z to cruise at"""
    evade_vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] best evasive velocity found"""
    evade_cost: ti.Field = array("n_env")
    """cost of that velocity"""
    evade_candidate: ti.Field = array("n_env", dtype=ti.i32)
    """its number among the candidates; -1 = the mean of the best ones"""
    candidate_cost: ti.Field = array("n_env", "n_candidate", scratch=True)
    """cost of every candidate of the newest decision"""
    want_evade: ti.Field = array("n_env", dtype=ti.i32)
    """1 = plan an evasion in this step"""
    ttc_s: ti.Field = array("n_env", beside="danger")
    """[s] smallest sensed time to contact, geometry.FAR_M = none"""
    threat_bearing: ti.Field = array("n_env", beside="danger")
    """[rad] its bearing in the body frame"""
    nearest_m: ti.Field = array("n_env", beside="danger")
    """[m] smallest sensed distance from the hull"""
    nearest_bearing: ti.Field = array("n_env", beside="danger")
    """[rad] its bearing in the body frame"""
    clearance_m: ti.Field = array("n_env", beside="danger")
    """[m] mapped static clearance of the own position"""
    away_w: ti.Field = array("n_env", vec=2)
    """unit vector away from the nearest mapped obstacle, zero = none near"""
    path_clearance_m: ti.Field = array("n_env", beside="danger")
    """[m] smallest mapped clearance on the straight way to the look-ahead point"""
    conflict_s: ti.Field = array("n_env", beside="danger")
    """[s] time of the first predicted conflict of following the route, geometry.FAR_M = none"""
    hold_conflict_s: ti.Field = array("n_env", beside="danger")
    """[s] time of the first predicted conflict of stopping here, geometry.FAR_M = none"""
    obstacle_near_m: ti.Field = array("n_env", beside="danger")
    """[m] distance to the nearest forecast obstacle now, hull to surface"""
    waited_s: ti.Field = array("n_env")
    """[s] for how long it has hardly come on along its way,"""
    patience: ti.Field = array("n_env")
    """and the share of its caution that this leaves"""
    steer_w: ti.Field = array("n_env", vec=2)
    """[m] horizontal way to the point that is steered for: the look-ahead point, or a nearer one where the
    straight way there is narrow"""
    heading_w: ti.Field = array("n_env", vec=2)
    """[m] horizontal way to the body that the camera should look at, zero = none near"""
    hysteresis_steps: ti.Field = array("n_env", dtype=ti.i32)
    """control steps since a conflict was last predicted"""
    evading_steps: ti.Field = array("n_env", dtype=ti.i32)
    """control steps since the tree began to evade, 0 = not evading"""
    last_vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] velocity asked for in the last step"""


@dataclass(frozen=True, eq=False)
class TreeTable:
    """A behaviour tree flattened to preorder arrays, the same for all envs: trees are data, no tree needs a
    recompilation."""

    n_node: ti.Field = array(dtype=ti.i32)
    """nodes in use"""
    kind: ti.Field = array("n_node", dtype=ti.i32)
    """kind of node (``tree_codes``)"""
    end: ti.Field = array("n_node", dtype=ti.i32)
    """one past the last descendant in preorder"""
    parent: ti.Field = array("n_node", dtype=ti.i32)
    """preorder index of the parent, -1 = root"""
    leaf: ti.Field = array("n_node", dtype=ti.i32)
    """which condition or action a leaf is"""
    param: ti.Field = array("n_node", vec=4)
    """numbers from the leaf's ports"""
    factor: ti.Field = array("n_tuned", vec=2)
    """constant: natural logarithms of the factors in the config's sections ``slow`` and ``fast``"""


@dataclass(frozen=True, eq=False)
class BehaviorStructs:
    """Structs of this room, by the noun of their stage."""

    behavior: BehaviorState
    table: TreeTable


# ------------------------------------------------------------------------------------------------------------
# Local planners of the literature: what they drive, and MPPI's plan.


@dataclass(frozen=True, eq=False)
class BaselineState:
    """What the local planner whose leaf is in the tree wants; nobody writes it where the tree has none."""

    vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] velocity of the newest decision, world"""
    score: ti.Field = array("n_env", "n_trial", scratch=True)
    """how good (dynamic window) or how costly (MPPI) each trial of the newest decision is"""
    plan_w: ti.Field = array("n_env", "n_control", vec=3)
    """[m/s] velocities that MPPI means to command from now on, one per decision, world"""
    change_w: ti.Field = array("n_env", "n_control", vec=3, scratch=True)
    """[m/s] weighted mean of the samples' noise"""


@dataclass(frozen=True, eq=False)
class BaselineStructs:
    """Structs of this room, by the noun of their stage."""

    baselines: BaselineState
