"""The window of velocities that can be reached within a short time: a grid along surge and sway, held in
depth, climbing and diving.

The window of Fox, Burgard and Thrun (1997) is in speed and turn rate, because their robot cannot move
sideways; this vehicle can, so that its window is in surge and sway (as that of Brock and Khatib 1999), and
its paths are straight. It is also the set of reachable velocities of Fiorini and Shiller (1998).
"""

import taichi as ti

from uuvtai.config import BaselinesConfig, TankConfig, TeacherConfig, VehicleConfig
from uuvtai.kernels.baselines.surroundings import edge_stopped, speed_limited
from uuvtai.kernels.core.geometry import turned_z
from uuvtai.kernels.core.signature import Const, In
from uuvtai.state import Proprioception


@ti.func
def reachable_velocity(
    env,
    trial,
    wanted,
    ego: In[Proprioception],
    window_s: Const[float],
    baselines_cfg: Const[BaselinesConfig],
    tank_cfg: Const[TankConfig],
    teacher_cfg: Const[TeacherConfig],
    vehicle_cfg: Const[VehicleConfig],
):
    """World velocity [m/s] of one trial: the grid at each heave, then ``wanted`` (x, y, z [m/s]) and a stop,
    both as near as the window allows."""
    n, first_extra = ti.static(baselines_cfg.n_axis, baselines_cfg.n_reachable - 2)
    yaw, own = ego.rpy[env][2], ti.Vector([ego.vel_b[env][0], ego.vel_b[env][1]])
    low = window_edge(own, -1.0, window_s, baselines_cfg, vehicle_cfg)
    high = window_edge(own, 1.0, window_s, baselines_cfg, vehicle_cfg)
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
    return speed_limited(ti.Vector([held[0], held[1], heave]), yaw, teacher_cfg, vehicle_cfg)


@ti.func
def window_edge(
    own,
    side,
    window_s: Const[float],
    baselines_cfg: Const[BaselinesConfig],
    vehicle_cfg: Const[VehicleConfig],
):
    """Surge and sway [m/s] of the window's lower (``side`` -1) or upper (1) corner around one's own."""
    reach = ti.static(baselines_cfg.acceleration_m_s2 * window_s)
    surge, sway = ti.static(vehicle_cfg.max_surge_m_s), ti.static(vehicle_cfg.max_sway_m_s)
    return ti.Vector(
        [
            ti.math.clamp(own[0] + side * reach, -surge, surge),
            ti.math.clamp(own[1] + side * reach, -sway, sway),
        ]
    )
