"""What every local planner is given: the wanted velocity, obstacles as upright cylinders, the mapped
clearance.

The papers' robots move in a plane. Here the wanted depth is the goal's, obstacles that are known to be above
or below leave free water, and those planners that try velocities may try to climb and dive.
"""

import taichi as ti

from uuvtai.config.planning import ACCELERATION_M_S2, N_AXIS
from uuvtai.kernels.baselines.io import LocalPlannerIO
from uuvtai.kernels.core.geometry import turned_z
from uuvtai.kernels.core.grid import cell_of, clearance_of
from uuvtai.kernels.core.stage import Bundle, Const


@ti.func
def decides(env, io: Bundle[LocalPlannerIO]):
    """Whether a row makes up its mind in this step."""
    return io.clock.active[env] == 1 and io.clock.step[env] % ti.static(io.baselines_cfg.period_steps) == 0


@ti.func
def wanted_velocity(env, io: Bundle[LocalPlannerIO]):
    """World velocity [m/s] towards the local goal, as following the route asks for it, and to the goal's
    depth."""
    low, high = ti.static(depth_limits(io.tank_cfg, io.baselines_cfg))
    top = ti.static(io.vehicle_cfg.max_heave_m_s)
    off = ti.math.clamp(io.mission.goal_w[env][2], low, high) - io.ego.pos_w[env][2]
    follow = io.behavior.follow_vel_w[env]
    return ti.Vector(
        [follow[0], follow[1], ti.math.clamp(off * ti.static(io.behavior_cfg.depth_gain), -top, top)]
    )


@ti.func
def edge_stopped(heave, own_z, io: Bundle[LocalPlannerIO]):
    """Heave [m/s] that comes to rest before floor and surface."""
    low, high = ti.static(depth_limits(io.tank_cfg, io.baselines_cfg))
    return ti.math.clamp(heave, ti.min(low - own_z, 0.0), ti.max(high - own_z, 0.0))


@ti.func
def speed_limited(velocity, yaw, io: Bundle[LocalPlannerIO]):
    """World velocity that surge, sway and heave can give at this heading, its level direction kept."""
    body = turned_z(ti.Vector([velocity[0], velocity[1]]), -yaw)
    excess = ti.max(
        ti.abs(body[0]) / ti.static(io.vehicle_cfg.max_surge_m_s),
        ti.abs(body[1]) / ti.static(io.vehicle_cfg.max_sway_m_s),
    )
    share = 1.0 / ti.max(1.0, ti.max(excess, body.norm() / ti.static(io.behavior_cfg.evade_m_s)))
    top = ti.static(io.vehicle_cfg.max_heave_m_s)
    return ti.Vector([velocity[0] * share, velocity[1] * share, ti.math.clamp(velocity[2], -top, top)])


@ti.func
def free_water_m(env, track, own_z, io: Bundle[LocalPlannerIO]):
    """Weighted free water [m] between one's own height and an obstacle's; 0 = may be level with it."""
    gap = ti.min(io.forecast.above_w[env, track] - own_z, own_z - io.forecast.below_w[env, track])
    return ti.max(gap, 0.0) * ti.static(io.baselines_cfg.vertical_weight)


@ti.func
def apart_m(beyond, gap):
    """Distance [m] to an obstacle that is ``beyond`` away on the level (negative = inside its outline) and
    ``gap`` above or below."""
    level = ti.max(beyond, 0.0)
    return ti.select(gap > 0.0, ti.sqrt(level * level + gap * gap), beyond)


@ti.func
def nearest_obstacle_m(env, sample, at, io: Bundle[LocalPlannerIO]):
    """Distance [m] from a hull whose centre is ``at`` (x, y, z) to the nearest obstacle at a sample of the
    forecast, beyond contact; 1e3 = none."""
    nearest = 1.0e3
    for track in range(ti.static(io.forecast.radius_m.shape[1])):
        radius = io.forecast.radius_m[env, track, sample]
        if radius >= 0:
            beyond = (ti.Vector([at[0], at[1]]) - io.forecast.pos_w[env, track, sample]).norm() - radius
            gap = free_water_m(env, track, at[2], io)
            nearest = ti.min(nearest, apart_m(beyond, gap))
    return nearest - ti.static(io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m)


@ti.func
def mapped_m(env, at, io: Bundle[LocalPlannerIO]):
    """Mapped clearance [m] of a place (x, y, ...) beyond contact; off the grid its border's, which is 0."""
    n_row, n_col = ti.static(io.clearance.site.shape[1:])
    cell = cell_of(at, io.tank_cfg, ti.static(io.mapping_cfg.cell_m))
    row, col = ti.math.clamp(cell[0], 0, n_row - 1), ti.math.clamp(cell[1], 0, n_col - 1)
    room = clearance_of(io.clearance.site[env, row, col], io.clearance_cfg, io.mapping_cfg.cell_m)
    return room - ti.static(io.behavior_cfg.hull_reach_m + io.behavior_cfg.contact_m)


def depth_limits(tank_cfg, baselines_cfg):
    """(lowest, highest) own z [m] that a local planner steers for."""
    return tank_cfg.z_m[0] + baselines_cfg.edge_gap_m, tank_cfg.z_m[1] - baselines_cfg.edge_gap_m


# ------------------------------------------------------------------------------------------------------------
# The window of velocities that can be reached within a short time: a grid along surge and sway, held in
# depth, climbing and diving.
#
# The window of Fox, Burgard and Thrun (1997) is in speed and turn rate, because their robot cannot move
# sideways; this vehicle can, so that its window is in surge and sway (as that of Brock and Khatib 1999), and
# its paths are straight.


@ti.func
def reachable_velocity(env, trial, window_s: Const[float], io: Bundle[LocalPlannerIO]):
    """World velocity [m/s] of one trial: the grid at each heave, then the wanted one and a stop, both as near
    as the window allows."""
    wanted = wanted_velocity(env, io)
    n, first_extra = ti.static(N_AXIS, io.baselines_cfg.n_reachable - 2)
    yaw, own = io.ego.rpy[env][2], ti.Vector([io.ego.vel_b[env][0], io.ego.vel_b[env][1]])
    low = window_edge(own, -1.0, window_s, io)
    high = window_edge(own, 1.0, window_s, io)
    cell, layer = trial % (n * n), trial // (n * n)
    share = ti.Vector([ti.cast(cell % n, ti.f32), ti.cast(cell // n, ti.f32)]) / ti.static(max(n - 1, 1))
    level, heave = low + share * (high - low), wanted[2]
    if trial >= first_extra:
        towards = turned_z(ti.Vector([wanted[0], wanted[1]]), -yaw)
        level = ti.math.clamp(towards * ti.cast(trial == first_extra, ti.f32), low, high)
    elif layer > 0:
        climb = ti.static(io.baselines_cfg.heave_m_s) * ti.select(layer == 1, 1.0, -1.0)
        heave = edge_stopped(climb, io.ego.pos_w[env][2], io)
    held = turned_z(level, yaw)
    return speed_limited(ti.Vector([held[0], held[1], heave]), yaw, io)


@ti.func
def window_edge(own, side, window_s: Const[float], io: Bundle[LocalPlannerIO]):
    """Surge and sway [m/s] of the window's lower (``side`` -1) or upper (1) corner around one's own."""
    reach = ti.static(ACCELERATION_M_S2 * window_s)
    surge, sway = ti.static(io.vehicle_cfg.max_surge_m_s), ti.static(io.vehicle_cfg.max_sway_m_s)
    return ti.Vector(
        [
            ti.math.clamp(own[0] + side * reach, -surge, surge),
            ti.math.clamp(own[1] + side * reach, -sway, sway),
        ]
    )
