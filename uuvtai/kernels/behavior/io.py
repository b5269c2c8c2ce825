"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    BehaviorConfig,
    EpisodeConfig,
    FastConfig,
    HeightConfig,
    MappingConfig,
    SonarConfig,
    TankConfig,
    TrackingConfig,
    TrafficConfig,
    VehicleConfig,
)
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    BaselineState,
    BehaviorState,
    ClearanceState,
    ClockState,
    ForecastState,
    FutureState,
    MissionState,
    Proprioception,
    RouteState,
    SonarScan,
    TrackState,
    TreeTable,
)


@dataclass(frozen=True, eq=False)
class EvasionIO:
    """The evasive velocity of least cost."""

    behavior: Out[BehaviorState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    futures: In[FutureState]
    mapping_cfg: Const[MappingConfig]
    tank_cfg: Const[TankConfig]
    behavior_cfg: Const[BehaviorConfig]
    tracking_cfg: Const[TrackingConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class BehaviorIO:
    """The behaviour tree and its action."""

    behavior: Out[BehaviorState]
    baselines: In[BaselineState]
    clock: In[ClockState]
    ego: In[Proprioception]
    mission: In[MissionState]
    route: In[RouteState]
    table: In[TreeTable]
    episode_cfg: Const[EpisodeConfig]
    sonar_cfg: Const[SonarConfig]
    behavior_cfg: Const[BehaviorConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class ThreatsIO:
    """What is dangerous now."""

    behavior: Out[BehaviorState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    futures: In[FutureState]
    mission: In[MissionState]
    route: In[RouteState]
    scan: In[SonarScan]
    tracks: In[TrackState]
    height_cfg: Const[HeightConfig]
    episode_cfg: Const[EpisodeConfig]
    fast_cfg: Const[FastConfig]
    mapping_cfg: Const[MappingConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]
    behavior_cfg: Const[BehaviorConfig]
    tracking_cfg: Const[TrackingConfig]
    traffic_cfg: Const[TrafficConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class BehaviorStages:
    """Bundles of this room, by the noun of their stage."""

    threats: ThreatsIO
    evasion: EvasionIO
    behavior: BehaviorIO
