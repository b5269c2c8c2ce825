"""What the behavior tree, its threats and its evasion read and write."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    BehaviorConfig,
    ClearanceConfig,
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
class BehaviorIO:
    """What is dangerous now, the evasive velocity of least cost, the behaviour tree and its action."""

    behavior: Out[BehaviorState]
    baselines: In[BaselineState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    futures: In[FutureState]
    mission: In[MissionState]
    route: In[RouteState]
    scan: In[SonarScan]
    table: In[TreeTable]
    tracks: In[TrackState]
    behavior_cfg: Const[BehaviorConfig]
    clearance_cfg: Const[ClearanceConfig]
    episode_cfg: Const[EpisodeConfig]
    fast_cfg: Const[FastConfig]
    height_cfg: Const[HeightConfig]
    mapping_cfg: Const[MappingConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]
    tracking_cfg: Const[TrackingConfig]
    traffic_cfg: Const[TrafficConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class BehaviorStages:
    """The bundle of this room, by the noun of its stages."""

    behavior: BehaviorIO
