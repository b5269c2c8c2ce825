"""Where things lie in the surrogate's arrays, and the config sections its kernels are compiled for."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    ActuationConfig,
    ClearanceConfig,
    EpisodeConfig,
    MappingConfig,
    RouteConfig,
    TankConfig,
    TrackingConfig,
    VehicleConfig,
)
from uuvtai.config.learning import SurrogateConfig
from uuvtai.kernels.core.stage import Const, In
from uuvtai.state import (
    ClearanceState,
    ClockState,
    ForecastState,
    MissionState,
    Proprioception,
    RouteState,
    TrackState,
)


class At:
    """Columns of an env's row: position in the world, velocity in the body frame, heading, yaw rate, time,
    goal, signs of the way to it, last action, integrals of the velocity loops; of the route: look-ahead
    point, length left, place left of it, foot as a fractional waypoint."""

    POS, VEL, YAW, RATE, TIME, GOAL, FLIP, LAST, INTEGRAL = 0, 3, 6, 7, 8, 9, 12, 14, 17
    AHEAD, LEFT, ASIDE, ARC = 21, 23, 24, 25


EGO_WIDTH = 26
TRACK_WIDTH = 9  # of what the surrogate's tracker remembers of a body (``sensing_model.sense_surrogate``)
RAW_WIDTH = 14
"""of an obstacle as a tracker delivers it: x, y, vx, vy, turn rate, radius, free water above, below, time
unseen, displacement in 1 s (2), in 2 s (2), 1 = there"""
TRUTH_WIDTH = 10  # of an obstacle as only the critic sees it, in training


@dataclass(frozen=True, eq=False)
class Rules:
    """What the kernels are compiled for; the safety filter reads the first and ``episode_cfg`` alone."""

    vehicle_cfg: Const[VehicleConfig]
    actuation_cfg: Const[ActuationConfig]
    tank_cfg: Const[TankConfig]
    episode_cfg: Const[EpisodeConfig]
    route_cfg: Const[RouteConfig]
    surrogate_cfg: Const[SurrogateConfig]


@dataclass(frozen=True, eq=False)
class ObserverIO:
    """What a policy over a set of obstacles is told by the simulator: no truth."""

    clock: In[ClockState]
    mission: In[MissionState]
    ego: In[Proprioception]
    route: In[RouteState]
    tracks: In[TrackState]
    forecast: In[ForecastState]
    clearance: In[ClearanceState]
    clearance_cfg: Const[ClearanceConfig]
    vehicle_cfg: Const[VehicleConfig]
    tank_cfg: Const[TankConfig]
    mapping_cfg: Const[MappingConfig]
    tracking_cfg: Const[TrackingConfig]
