"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    BaselinesConfig,
    BehaviorConfig,
    DynamicWindowConfig,
    EpisodeConfig,
    MappingConfig,
    PathIntegralConfig,
    PotentialFieldConfig,
    TankConfig,
    TrackingConfig,
    VehicleConfig,
    VelocityObstacleConfig,
)
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    BaselineState,
    BehaviorState,
    ClearanceState,
    ClockState,
    ForecastState,
    MissionState,
    Proprioception,
    TrackState,
)


@dataclass(frozen=True, eq=False)
class DynamicWindowIO:
    """The velocity of best score in the dynamic window."""

    baselines: Out[BaselineState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    mission: In[MissionState]
    behavior: In[BehaviorState]
    baselines_cfg: Const[BaselinesConfig]
    dwa_cfg: Const[DynamicWindowConfig]
    mapping_cfg: Const[MappingConfig]
    tank_cfg: Const[TankConfig]
    behavior_cfg: Const[BehaviorConfig]
    tracking_cfg: Const[TrackingConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class PotentialFieldIO:
    """The velocity along the force of the potential field."""

    baselines: Out[BaselineState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    mission: In[MissionState]
    behavior: In[BehaviorState]
    baselines_cfg: Const[BaselinesConfig]
    field_cfg: Const[PotentialFieldConfig]
    mapping_cfg: Const[MappingConfig]
    tank_cfg: Const[TankConfig]
    behavior_cfg: Const[BehaviorConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class VelocityObstacleIO:
    """The reachable velocity outside all cones that is nearest to the wanted one."""

    baselines: Out[BaselineState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    mission: In[MissionState]
    behavior: In[BehaviorState]
    tracks: In[TrackState]
    baselines_cfg: Const[BaselinesConfig]
    mapping_cfg: Const[MappingConfig]
    obstacle_cfg: Const[VelocityObstacleConfig]
    tank_cfg: Const[TankConfig]
    behavior_cfg: Const[BehaviorConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class PathIntegralIO:
    """The first velocity of MPPI's plan."""

    baselines: Out[BaselineState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    mission: In[MissionState]
    behavior: In[BehaviorState]
    baselines_cfg: Const[BaselinesConfig]
    episode_cfg: Const[EpisodeConfig]
    mapping_cfg: Const[MappingConfig]
    mppi_cfg: Const[PathIntegralConfig]
    tank_cfg: Const[TankConfig]
    behavior_cfg: Const[BehaviorConfig]
    tracking_cfg: Const[TrackingConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class BaselineStages:
    """Bundles of this room, by the noun of their stage."""

    dynamic_window: DynamicWindowIO
    potential_field: PotentialFieldIO
    velocity_obstacle: VelocityObstacleIO
    path_integral: PathIntegralIO
