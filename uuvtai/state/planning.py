"""Clearance, Voronoi planner, route and features."""

from __future__ import annotations

from dataclasses import dataclass

import taichi as ti

from uuvtai.state.arrays import array


@dataclass(frozen=True, eq=False)
class ClearanceState:
    """The nearest occupied or outside cell, from which follows how far it is, centre to centre."""

    site: ti.Field = array("n_env", "n_row", "n_col", lanes=True, dtype=ti.i16)
    """the nearest site: how many rows away (upper 8 bits), how many columns (the next 7), 1 = an obstacle's,
    which clearance.inflate_m brings nearer; common.enums.NO_SITE = none within clearance.max_m"""
    fresh: ti.Field = array("n_env", dtype=ti.i32)
    """1 = computed in this very step"""


@dataclass(frozen=True, eq=False)
class ClearanceMemory:
    """What the newest clearance was computed from: the next one redoes only what changed. And scratch, its
    slots shared by all envs."""

    sites: ti.Field = array("n_env", "n_row", "n_col", bits=True)
    """occupied cells and cells outside"""
    farthest: ti.Field = array("n_env", "n_row", "n_packet", dtype=ti.i32)
    """[cells^2] largest squared distance among sixteen neighbours in a row"""
    limit: ti.Field = array("n_env", dtype=ti.i32)
    """[cells^2] limit of the distances, 0 = nothing computed yet"""
    row_key: ti.Field = array("n_slot", "n_row", "n_col", dtype=ti.i32, packed=True, scratch=True)
    """scratch: key of the nearest site in the same row (clearance.py)"""
    near_up: ti.Field = array("n_slot", "n_packet", "n_row", bits=True, scratch=True)
    """scratch: rows of a packet's columns that have a site in reach, lowest row first"""
    near_down: ti.Field = array("n_slot", "n_packet", "n_row", bits=True, scratch=True)
    """scratch: the same, highest row first"""
    stale: ti.Field = array("n_slot", "n_packet", "n_row", bits=True, scratch=True)
    """scratch: rows of a packet's columns that must be redone"""


@dataclass(frozen=True, eq=False)
class VoronoiState:
    """Scratch of the global planner. Slots are shared by the queue (slot s plans its items s, s + n_plan,
    ...): few serve many envs."""

    weight: ti.Field = array("n_plan", "n_row", "n_col", dtype=ti.f32, scratch=True)
    """[1/m] 1 / max(clearance, eps_r) of a traversable cell, 0 = not traversable"""
    cost: ti.Field = array("n_plan", "n_row", "n_col", dtype=ti.f32, scratch=True)
    """cost-to-go of the cells reached by the search"""
    cell: ti.Field = array("n_plan", "n_row", "n_col", dtype=ti.u8, scratch=True)
    """bits of voronoi.py: on the skeleton or not (filled on demand), reached, direction of the next cell
    towards the goal"""
    heap: ti.Field = array("n_plan", "n_heap", dtype=ti.u64, scratch=True)
    """binary heap of open cells: bits of the estimated total cost, then the cell (row * n_col + col)"""
    path_cell: ti.Field = array("n_plan", "n_path", dtype=ti.i32, scratch=True)
    """cells of the path found, from start to goal"""
    node_cost: ti.Field = array("n_plan", "n_path", dtype=ti.f32, scratch=True)
    """shortcutting: cost-to-go of every few path cells"""
    node_next: ti.Field = array("n_plan", "n_path", dtype=ti.i32, scratch=True)
    """shortcutting: how many nodes the best chord from here spans, 0 = along the cells to the next node"""
    pops: ti.Field = array("n_env", dtype=ti.i32, scratch=True)
    """cells expanded by the newest plan of this env"""


@dataclass(frozen=True, eq=False)
class RouteState:
    """Remembered: the route, how it came about, and where the vehicle is along it."""

    n_way: ti.Field = array("n_env", dtype=ti.i32)
    """waypoints in use; 0 = no route yet"""
    way_w: ti.Field = array("n_env", "n_way", vec=2)
    """[m] waypoints at most route.spacing_m apart, first = where it was planned, last = goal"""
    way_left_m: ti.Field = array("n_env", "n_way")
    """[m] route length from this waypoint to the last"""
    cost: ti.Field = array("n_env")
    """sum |dp| / max(clearance, eps) of the route when it was planned"""
    planner: ti.Field = array("n_env", dtype=ti.i32)
    """who planned it: plan_codes.PLANNER_NONE, PLANNER_VORONOI, PLANNER_RRT, PLANNER_OWN"""
    trigger: ti.Field = array("n_env", dtype=ti.i32)
    """trigger of this step's replan, plan_codes.TRIGGER_NONE if none (a bit set of the triggers that fired in
    `fired`)"""
    fired: ti.Field = array("n_env", dtype=ti.i32)
    """bit set of every trigger that holds in this step"""
    want_plan: ti.Field = array("n_env", dtype=ti.i32, scratch=True)
    """1 = plan in this step"""
    fallback_reason: ti.Field = array("n_env", dtype=ti.i32)
    """why Voronoi failed in this step (voronoi.* code), 0 = it did not"""
    queue: ti.Field = array("n_env", dtype=ti.i32, scratch=True)
    """env ids that plan in this step, in any order"""
    n_queue: ti.Field = array(dtype=ti.i32, scratch=True)
    """length of the queue"""
    failed: ti.Field = array("n_env", dtype=ti.i32, scratch=True)
    """env ids whose Voronoi plan failed in this step, in any order: the host's RRT takes them"""
    n_failed: ti.Field = array(dtype=ti.i32, scratch=True)
    """length of that list"""
    plan_step: ti.Field = array("n_env", dtype=ti.i32)
    """episode step of the newest route"""
    replans: ti.Field = array("n_env", "n_trigger", dtype=ti.i32)
    """replans of the episode by trigger: initial, stuck, safety, intersection"""
    planned_by: ti.Field = array("n_env", "n_planner", dtype=ti.i32)
    """routes of the episode by planner: voronoi, rrt, own"""
    fallbacks: ti.Field = array("n_env", "n_reason", dtype=ti.i32)
    """fallbacks of the episode by reason: voronoi.* code - 1"""
    kept: ti.Field = array("n_env", dtype=ti.i32)
    """replans of the episode in which both planners failed and the old route (if any) stayed"""
    second_passes: ti.Field = array("n_env", dtype=ti.i32)
    """plans of the episode that left the skeleton and searched all traversable cells"""
    served_step: ti.Field = array("n_env", "n_trigger", dtype=ti.i32)
    """episode step at which this trigger was last answered by a replan"""
    ahead_w: ti.Field = array("n_env", "n_ahead", vec=2)
    """[m] points of the look-ahead segment, one cell apart, from the foot on"""
    n_ahead: ti.Field = array("n_env", dtype=ti.i32)
    """points in use"""
    arc: ti.Field = array("n_env")
    """[waypoint index, fractional] foot of the vehicle on the route"""
    lookahead_w: ti.Field = array("n_env", vec=3)
    """[m] point to steer at"""
    heading_error: ti.Field = array("n_env")
    """[rad] bearing of the look-ahead point minus own yaw"""
    cross_track_m: ti.Field = array("n_env")
    """[m] signed distance from the route, positive = left of it"""
    remaining_m: ti.Field = array("n_env")
    """[m] route length still ahead"""
    path_risk: ti.Field = array("n_env")
    """mean of the risk map over the look-ahead segment"""
    stuck_steps: ti.Field = array("n_env", dtype=ti.i32)
    """control steps in a row at low speed away from the goal"""


@dataclass(frozen=True, eq=False)
class ObservationState:
    """What the policy and the tree see of the surroundings, by sector (sector 0 centred ahead,
    counter-clockwise)."""

    sector_range_m: ti.Field = array("n_env", "n_sector")
    """[m] smallest range in the sector"""
    sector_ttc_s: ti.Field = array("n_env", "n_sector")
    """[s] smallest range / closing speed of a beam in the sector, capped"""
    sector_closing_m_s: ti.Field = array("n_env", "n_sector")
    """[m/s] largest closing speed in the sector, ego motion included; 0 where nothing returned"""
    sector_valid: ti.Field = array("n_env", "n_sector", dtype=ti.i32)
    """1 = at least one beam of the sector returned"""
    closest_m: ti.Field = array("n_env", "n_track", scratch=True)
    """[m] closest approach of each moving track within its forecast, FAR_M = does not move; written where the
    observation shows obstacles"""
    closest_s: ti.Field = array("n_env", "n_track", scratch=True)
    """[s] time until then"""


@dataclass(frozen=True, eq=False)
class PlanningStructs:
    """Structs of this room, by the noun of their stage."""

    clearance: ClearanceState
    clearance_memory: ClearanceMemory
    voronoi: VoronoiState
    route: RouteState
    observation: ObservationState
