"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    BehaviorConfig,
    CameraTrackingConfig,
    DepthConfig,
    EpisodeConfig,
    ForecastConfig,
    HeightConfig,
    LocalizationConfig,
    MappingConfig,
    SensorsConfig,
    SonarConfig,
    TankConfig,
    TrackingConfig,
    TrafficConfig,
    VehicleConfig,
)
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    ClockState,
    ClusterState,
    DepthImage,
    EchoState,
    ForecastState,
    FutureState,
    GridMask,
    LocalizationState,
    MapScratch,
    MapState,
    MixtureState,
    PastState,
    Proprioception,
    SonarScan,
    SpotState,
    TrackState,
    TurnHistory,
)


@dataclass(frozen=True, eq=False)
class EchoesIO:
    """What a mechanical beam heard, seen from where the vehicle is now."""

    echoes: Out[EchoState]
    scan: Out[SonarScan]
    clock: In[ClockState]
    sonar_cfg: Const[SonarConfig]


@dataclass(frozen=True, eq=False)
class MappingIO:
    """Both layers of the occupancy map, from the fan and the depth image."""

    grid_map: Out[MapState]
    map_scratch: Out[MapScratch]
    clock: In[ClockState]
    clusters: In[ClusterState]
    image: In[DepthImage]
    mask: In[GridMask]
    scan: In[SonarScan]
    tracks: In[TrackState]
    depth_cfg: Const[DepthConfig]
    episode_cfg: Const[EpisodeConfig]
    mapping_cfg: Const[MappingConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]


@dataclass(frozen=True, eq=False)
class LocalizationIO:
    """Where the vehicle is."""

    ego: Out[Proprioception]
    localization: Out[LocalizationState]
    clock: In[ClockState]
    scan: In[SonarScan]
    episode_cfg: Const[EpisodeConfig]
    localization_cfg: Const[LocalizationConfig]
    sensors_cfg: Const[SensorsConfig]
    tank_cfg: Const[TankConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class TrackingIO:
    """Obstacles: followed from ping to ping and by the camera, how high they reach, where they will be."""

    clusters: Out[ClusterState]
    echoes: Out[EchoState]
    forecast: Out[ForecastState]
    futures: Out[FutureState]
    mixture: Out[MixtureState]
    past: Out[PastState]
    spots: Out[SpotState]
    tracks: Out[TrackState]
    turn_history: Out[TurnHistory]
    clock: In[ClockState]
    ego: In[Proprioception]
    image: In[DepthImage]
    scan: In[SonarScan]
    behavior_cfg: Const[BehaviorConfig]
    camera_tracking_cfg: Const[CameraTrackingConfig]
    depth_cfg: Const[DepthConfig]
    episode_cfg: Const[EpisodeConfig]
    forecast_cfg: Const[ForecastConfig]
    height_cfg: Const[HeightConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]
    tracking_cfg: Const[TrackingConfig]
    traffic_cfg: Const[TrafficConfig]


@dataclass(frozen=True, eq=False)
class PerceptionStages:
    """Bundles of this room, by the noun of their stage."""

    echoes: EchoesIO
    localization: LocalizationIO
    tracking: TrackingIO
    mapping: MappingIO
