"""Which depth to cruise at: where the fewest moving bodies are to be met, as far as the goal's depth can
still be reached in time; with a dead vertical thruster at the goal's."""

import taichi as ti

from uuvtai.config import ElevationConfig, TeacherConfig, TrafficConfig, VehicleConfig
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.signature import Bundle, Const
from uuvtai.kernels.teacher.bundles import ThreatsIO
from uuvtai.kernels.teacher.trajectories import depth_band, edge_gap, tuned
from uuvtai.tuned_numbers import ARRIVAL, DEPTH_CHANGE, GOAL_DEPTH, SLOPE

_BLUR_M = 0.1
"""A body's edge is known to this, vertically."""


@ti.func
def choose_depth(env, io: Bundle[ThreatsIO]):
    """Set ``cruise_z_m``: the cheapest of ``depth_choices`` depths from edge to edge."""
    low, high = depth_band(edge_gap(env, io.ego, io.teacher_cfg), io.tank_cfg)
    goal, pos = io.mission.goal_w[env], io.ego.pos_w[env]
    wanted = ti.math.clamp(goal[2], low, high)
    if ti.static(io.teacher_cfg.free_depth):
        best_cost, best = FAR_M, wanted
        of_goal = io.teacher_cfg.weight_goal_depth * tuned(env, GOAL_DEPTH, io.teacher)
        of_change = io.teacher_cfg.weight_depth_change * tuned(env, DEPTH_CHANGE, io.teacher)
        n = ti.static(io.teacher_cfg.depth_choices)
        before = ti.math.clamp(io.teacher.cruise_z_m[env], low, high)
        for choice in range(n):
            z = low + (high - low) * (choice / ti.max(n - 1, 1))
            cost = ti.static(io.teacher_cfg.weight_traffic) * level_share(
                z, io.traffic_cfg, io.elevation_cfg, io.teacher_cfg, io.vehicle_cfg
            )
            cost += of_goal * ti.abs(z - goal[2])
            cost += of_change * ti.abs(z - before)
            if cost < best_cost:
                best_cost, best = cost, z
        away = ti.Vector([goal[0] - pos[0], goal[1] - pos[1]]).norm()
        radius = ti.static(io.episode_cfg.goal_radius_m)
        slope = io.teacher_cfg.return_slope * tuned(env, SLOPE, io.teacher)
        share = io.teacher_cfg.arrival_depth_share * tuned(env, ARRIVAL, io.teacher)
        off = share * radius + slope * ti.max(away - radius, 0.0)
        io.teacher.cruise_z_m[env] = best
        if io.ego.given_up[env] == 0:
            wanted = ti.math.clamp(ti.math.clamp(best, goal[2] - off, goal[2] + off), low, high)
    return wanted


@ti.func
def level_share(
    z,
    traffic_cfg: Const[TrafficConfig],
    elevation_cfg: Const[ElevationConfig],
    teacher_cfg: Const[TeacherConfig],
    vehicle_cfg: Const[VehicleConfig],
):
    """Share of the expected bodies that a vehicle at ``z`` [m] would touch, were it at the same place."""
    low, high = ti.static(traffic_cfg.z_m)
    reach = ti.static(_reach_m(traffic_cfg, teacher_cfg, vehicle_cfg))
    blur = ti.static(0.5 * _BLUR_M)
    above = ti.min(high + blur, z + reach)
    below = ti.max(low - blur, z - reach)
    share = ti.math.clamp((above - below) * ti.static(1.0 / (high - low + 2 * blur)), 0.0, 1.0)
    return elevation_cfg.column_share + (1.0 - elevation_cfg.column_share) * share


def _reach_m(traffic_cfg, teacher_cfg, vehicle_cfg):
    """[m] a body's centre nearer than this in height touches the hull."""
    return 0.25 * sum(traffic_cfg.height_m) + vehicle_cfg.hull_radius_m + teacher_cfg.contact_m
