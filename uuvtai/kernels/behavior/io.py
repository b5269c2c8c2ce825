"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    ElevationConfig,
    EpisodeConfig,
    FastConfig,
    MappingConfig,
    SonarConfig,
    TankConfig,
    TeacherConfig,
    TrackingConfig,
    TrafficConfig,
    VehicleConfig,
)
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    BaselineState,
    ClearanceState,
    ClockState,
    ForecastState,
    FutureState,
    MissionState,
    Proprioception,
    RouteState,
    SonarScan,
    TeacherState,
    TrackState,
    TreeTable,
)


@dataclass(frozen=True, eq=False)
class EvasionIO:
    """The evasive velocity of least cost."""

    teacher: Out[TeacherState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    futures: In[FutureState]
    mapping_cfg: Const[MappingConfig]
    tank_cfg: Const[TankConfig]
    teacher_cfg: Const[TeacherConfig]
    tracking_cfg: Const[TrackingConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class TeacherIO:
    """The behaviour tree and its action."""

    teacher: Out[TeacherState]
    baselines: In[BaselineState]
    clock: In[ClockState]
    ego: In[Proprioception]
    mission: In[MissionState]
    route: In[RouteState]
    table: In[TreeTable]
    episode_cfg: Const[EpisodeConfig]
    sonar_cfg: Const[SonarConfig]
    teacher_cfg: Const[TeacherConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class ThreatsIO:
    """What is dangerous now."""

    teacher: Out[TeacherState]
    clearance: In[ClearanceState]
    clock: In[ClockState]
    ego: In[Proprioception]
    forecast: In[ForecastState]
    futures: In[FutureState]
    mission: In[MissionState]
    route: In[RouteState]
    scan: In[SonarScan]
    tracks: In[TrackState]
    elevation_cfg: Const[ElevationConfig]
    episode_cfg: Const[EpisodeConfig]
    fast_cfg: Const[FastConfig]
    mapping_cfg: Const[MappingConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]
    teacher_cfg: Const[TeacherConfig]
    tracking_cfg: Const[TrackingConfig]
    traffic_cfg: Const[TrafficConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class TeacherStages:
    """Bundles of this room, by the noun of their stage."""

    threats: ThreatsIO
    evasion: EvasionIO
    teacher: TeacherIO
