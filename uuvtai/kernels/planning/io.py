"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    ClearanceConfig,
    EpisodeConfig,
    ForecastConfig,
    MappingConfig,
    ObservationConfig,
    QuietConfig,
    RouteConfig,
    SonarConfig,
    TankConfig,
    TrackingConfig,
    VoronoiConfig,
)
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    BehaviorState,
    ClearanceMemory,
    ClearanceState,
    ClockState,
    ForecastState,
    GridMask,
    MapState,
    MissionState,
    ObservationState,
    Proprioception,
    RouteState,
    SonarScan,
    TrackState,
    TreeTable,
    VoronoiState,
)


@dataclass(frozen=True, eq=False)
class ClearanceIO:
    """Distance to the nearest occupied cell, and which one it is."""

    clearance: Out[ClearanceState]
    clearance_memory: Out[ClearanceMemory]
    clock: In[ClockState]
    grid_map: In[MapState]
    mask: In[GridMask]
    clearance_cfg: Const[ClearanceConfig]
    mapping_cfg: Const[MappingConfig]
    voronoi_cfg: Const[VoronoiConfig]


@dataclass(frozen=True, eq=False)
class ObservationIO:
    """The observation: what the policy reads."""

    observation: Out[ObservationState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    mission: In[MissionState]
    route: In[RouteState]
    scan: In[SonarScan]
    table: In[TreeTable]
    behavior: In[BehaviorState]
    tracks: In[TrackState]
    episode_cfg: Const[EpisodeConfig]
    observation_cfg: Const[ObservationConfig]
    forecast_cfg: Const[ForecastConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]
    tracking_cfg: Const[TrackingConfig]


@dataclass(frozen=True, eq=False)
class RouteIO:
    """When to plan again, the planner, and the route ahead: where to aim, what is left, what it risks."""

    route: Out[RouteState]
    voronoi: Out[VoronoiState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    grid_map: In[MapState]
    mask: In[GridMask]
    mission: In[MissionState]
    scan: In[SonarScan]
    tracks: In[TrackState]
    clearance_cfg: Const[ClearanceConfig]
    episode_cfg: Const[EpisodeConfig]
    mapping_cfg: Const[MappingConfig]
    quiet_cfg: Const[QuietConfig]
    route_cfg: Const[RouteConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]
    tracking_cfg: Const[TrackingConfig]
    voronoi_cfg: Const[VoronoiConfig]


@dataclass(frozen=True, eq=False)
class PlanningStages:
    """Bundles of this room, by the noun of their stage."""

    clearance: ClearanceIO
    observation: ObservationIO
    route: RouteIO
