"""What every local planner is given: the wanted velocity, obstacles as upright cylinders, the mapped
clearance.

The papers' robots move in a plane. Here the wanted depth is the goal's, obstacles that are known to be above
or below leave free water, and those planners that try velocities may try to climb and dive.
"""

import taichi as ti

from uuvtai.config import BaselinesConfig, BehaviorConfig, MappingConfig, TankConfig, VehicleConfig
from uuvtai.config.baselines import ACCELERATION_M_S2, N_AXIS
from uuvtai.kernels.core.geometry import turned_z
from uuvtai.kernels.core.grid import cell_of
from uuvtai.kernels.core.stage import Const, In
from uuvtai.state import (
    BehaviorState,
    ClearanceState,
    ClockState,
    ForecastState,
    MissionState,
    Proprioception,
)


@ti.func
def decides(env, clock: In[ClockState], baselines_cfg: Const[BaselinesConfig]):
    """Whether a row makes up its mind in this step."""
    return clock.active[env] == 1 and clock.step[env] % ti.static(baselines_cfg.period_steps) == 0


@ti.func
def wanted_velocity(
    env,
    ego: In[Proprioception],
    mission: In[MissionState],
    behavior: In[BehaviorState],
    baselines_cfg: Const[BaselinesConfig],
    tank_cfg: Const[TankConfig],
    behavior_cfg: Const[BehaviorConfig],
    vehicle_cfg: Const[VehicleConfig],
):
    """World velocity [m/s] towards the local goal, as following the route asks for it, and to the goal's
    depth."""
    low, high = ti.static(depth_limits(tank_cfg, baselines_cfg))
    top = ti.static(vehicle_cfg.max_heave_m_s)
    off = ti.math.clamp(mission.goal_w[env][2], low, high) - ego.pos_w[env][2]
    follow = behavior.follow_vel_w[env]
    return ti.Vector(
        [follow[0], follow[1], ti.math.clamp(off * ti.static(behavior_cfg.depth_gain), -top, top)]
    )


@ti.func
def edge_stopped(heave, own_z, tank_cfg: Const[TankConfig], baselines_cfg: Const[BaselinesConfig]):
    """Heave [m/s] that comes to rest before floor and surface."""
    low, high = ti.static(depth_limits(tank_cfg, baselines_cfg))
    return ti.math.clamp(heave, ti.min(low - own_z, 0.0), ti.max(high - own_z, 0.0))


@ti.func
def speed_limited(velocity, yaw, behavior_cfg: Const[BehaviorConfig], vehicle_cfg: Const[VehicleConfig]):
    """World velocity that surge, sway and heave can give at this heading, its level direction kept."""
    body = turned_z(ti.Vector([velocity[0], velocity[1]]), -yaw)
    excess = ti.max(
        ti.abs(body[0]) / ti.static(vehicle_cfg.max_surge_m_s),
        ti.abs(body[1]) / ti.static(vehicle_cfg.max_sway_m_s),
    )
    share = 1.0 / ti.max(1.0, ti.max(excess, body.norm() / ti.static(behavior_cfg.evade_m_s)))
    top = ti.static(vehicle_cfg.max_heave_m_s)
    return ti.Vector([velocity[0] * share, velocity[1] * share, ti.math.clamp(velocity[2], -top, top)])


@ti.func
def free_water_m(env, track, own_z, forecast: In[ForecastState], baselines_cfg: Const[BaselinesConfig]):
    """Weighted free water [m] between one's own height and an obstacle's; 0 = may be level with it."""
    gap = ti.min(forecast.above_w[env, track] - own_z, own_z - forecast.below_w[env, track])
    return ti.max(gap, 0.0) * ti.static(baselines_cfg.vertical_weight)


@ti.func
def apart_m(beyond, gap):
    """Distance [m] to an obstacle that is ``beyond`` away on the level (negative = inside its outline) and
    ``gap`` above or below."""
    level = ti.max(beyond, 0.0)
    return ti.select(gap > 0.0, ti.sqrt(level * level + gap * gap), beyond)


@ti.func
def nearest_body_m(
    env,
    sample,
    at,
    forecast: In[ForecastState],
    baselines_cfg: Const[BaselinesConfig],
    behavior_cfg: Const[BehaviorConfig],
):
    """Distance [m] from a hull whose centre is ``at`` (x, y, z) to the nearest obstacle at a sample of the
    forecast, beyond contact; 1e3 = none."""
    nearest = 1.0e3
    for track in range(ti.static(forecast.radius_m.shape[1])):
        radius = forecast.radius_m[env, track, sample]
        if radius >= 0:
            beyond = (ti.Vector([at[0], at[1]]) - forecast.pos_w[env, track, sample]).norm() - radius
            gap = free_water_m(env, track, at[2], forecast, baselines_cfg)
            nearest = ti.min(nearest, apart_m(beyond, gap))
    return nearest - ti.static(behavior_cfg.hull_reach_m + behavior_cfg.contact_m)


@ti.func
def mapped_m(
    env,
    at,
    clearance: In[ClearanceState],
    mapping_cfg: Const[MappingConfig],
    tank_cfg: Const[TankConfig],
    behavior_cfg: Const[BehaviorConfig],
):
    """Mapped clearance [m] of a place (x, y, ...) beyond contact; off the grid its border's, which is 0."""
    n_row, n_col = ti.static(clearance.clearance_m.shape[1], clearance.clearance_m.shape[2])
    cell = cell_of(at, tank_cfg, ti.static(mapping_cfg.cell_m))
    row, col = ti.math.clamp(cell[0], 0, n_row - 1), ti.math.clamp(cell[1], 0, n_col - 1)
    return clearance.clearance_m[env, row, col] - ti.static(
        behavior_cfg.hull_reach_m + behavior_cfg.contact_m
    )


def depth_limits(tank_cfg, baselines_cfg):
    """(lowest, highest) own z [m] that a local planner steers for."""
    return tank_cfg.z_m[0] + baselines_cfg.edge_gap_m, tank_cfg.z_m[1] - baselines_cfg.edge_gap_m


# ------------------------------------------------------------------------------------------------------------
# The window of velocities that can be reached within a short time: a grid along surge and sway, held in
# depth, climbing and diving.
#
# The window of Fox, Burgard and Thrun (1997) is in speed and turn rate, because their robot cannot move
# sideways; this vehicle can, so that its window is in surge and sway (as that of Brock and Khatib 1999), and
# its paths are straight. It is also the set of reachable velocities of Fiorini and Shiller (1998).


@ti.func
def reachable_velocity(
    env,
    trial,
    wanted,
    ego: In[Proprioception],
    window_s: Const[float],
    baselines_cfg: Const[BaselinesConfig],
    tank_cfg: Const[TankConfig],
    behavior_cfg: Const[BehaviorConfig],
    vehicle_cfg: Const[VehicleConfig],
):
    """World velocity [m/s] of one trial: the grid at each heave, then ``wanted`` (x, y, z [m/s]) and a stop,
    both as near as the window allows."""
    n, first_extra = ti.static(N_AXIS, baselines_cfg.n_reachable - 2)
    yaw, own = ego.rpy[env][2], ti.Vector([ego.vel_b[env][0], ego.vel_b[env][1]])
    low = window_edge(own, -1.0, window_s, vehicle_cfg)
    high = window_edge(own, 1.0, window_s, vehicle_cfg)
    cell, layer = trial % (n * n), trial // (n * n)
    share = ti.Vector([ti.cast(cell % n, ti.f32), ti.cast(cell // n, ti.f32)]) / ti.static(max(n - 1, 1))
    level, heave = low + share * (high - low), wanted[2]
    if trial >= first_extra:
        towards = turned_z(ti.Vector([wanted[0], wanted[1]]), -yaw)
        level = ti.math.clamp(towards * ti.cast(trial == first_extra, ti.f32), low, high)
    elif layer > 0:
        climb = ti.static(baselines_cfg.heave_m_s) * ti.select(layer == 1, 1.0, -1.0)
        heave = edge_stopped(climb, ego.pos_w[env][2], tank_cfg, baselines_cfg)
    held = turned_z(level, yaw)
    return speed_limited(ti.Vector([held[0], held[1], heave]), yaw, behavior_cfg, vehicle_cfg)


@ti.func
def window_edge(own, side, window_s: Const[float], vehicle_cfg: Const[VehicleConfig]):
    """Surge and sway [m/s] of the window's lower (``side`` -1) or upper (1) corner around one's own."""
    reach = ti.static(ACCELERATION_M_S2 * window_s)
    surge, sway = ti.static(vehicle_cfg.max_surge_m_s), ti.static(vehicle_cfg.max_sway_m_s)
    return ti.Vector(
        [
            ti.math.clamp(own[0] + side * reach, -surge, surge),
            ti.math.clamp(own[1] + side * reach, -sway, sway),
        ]
    )
