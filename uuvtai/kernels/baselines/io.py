"""What the local planners read and write."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    BaselinesConfig,
    BehaviorConfig,
    ClearanceConfig,
    DynamicWindowConfig,
    EpisodeConfig,
    MappingConfig,
    PathIntegralConfig,
    TankConfig,
    TrackingConfig,
    VehicleConfig,
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
)


@dataclass(frozen=True, eq=False)
class LocalPlannerIO:
    """The velocity that one of the planners of the literature chooses."""

    baselines: Out[BaselineState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    mission: In[MissionState]
    behavior: In[BehaviorState]
    baselines_cfg: Const[BaselinesConfig]
    behavior_cfg: Const[BehaviorConfig]
    clearance_cfg: Const[ClearanceConfig]
    dwa_cfg: Const[DynamicWindowConfig]
    episode_cfg: Const[EpisodeConfig]
    mapping_cfg: Const[MappingConfig]
    mppi_cfg: Const[PathIntegralConfig]
    tank_cfg: Const[TankConfig]
    tracking_cfg: Const[TrackingConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class BaselineStages:
    """Bundles of this room, by the noun of their stage."""

    local_planner: LocalPlannerIO
