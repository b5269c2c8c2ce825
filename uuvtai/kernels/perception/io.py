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
class ForecastIO:
    """Where obstacles will be: arcs, and legs between the turns that they were seen to take."""

    forecast: Out[ForecastState]
    turn_history: Out[TurnHistory]
    clock: In[ClockState]
    clusters: In[ClusterState]
    image: In[DepthImage]
    tracks: In[TrackState]
    episode_cfg: Const[EpisodeConfig]
    forecast_cfg: Const[ForecastConfig]
    tank_cfg: Const[TankConfig]
    tracking_cfg: Const[TrackingConfig]


@dataclass(frozen=True, eq=False)
class PastIO:
    """Where each track was and where it turned, as columns for a network."""

    mixture: Out[MixtureState]
    past: Out[PastState]
    clock: In[ClockState]
    clusters: In[ClusterState]
    forecast: In[ForecastState]
    turn_history: In[TurnHistory]
    tracks: In[TrackState]
    episode_cfg: Const[EpisodeConfig]
    forecast_cfg: Const[ForecastConfig]
    tank_cfg: Const[TankConfig]
    behavior_cfg: Const[BehaviorConfig]


@dataclass(frozen=True, eq=False)
class MixtureIO:
    """What a network says that the obstacles may do."""

    forecast: Out[ForecastState]
    futures: Out[FutureState]
    mixture: Out[MixtureState]
    clock: In[ClockState]
    behavior_cfg: Const[BehaviorConfig]
    tracking_cfg: Const[TrackingConfig]


@dataclass(frozen=True, eq=False)
class HeightsIO:
    """How high forecast obstacles may reach."""

    forecast: Out[ForecastState]
    clock: In[ClockState]
    ego: In[Proprioception]
    tracks: In[TrackState]
    height_cfg: Const[HeightConfig]
    tank_cfg: Const[TankConfig]


@dataclass(frozen=True, eq=False)
class LookIO:
    """What the camera shows of the tracks' heights."""

    tracks: Out[TrackState]
    clock: In[ClockState]
    image: In[DepthImage]
    depth_cfg: Const[DepthConfig]
    height_cfg: Const[HeightConfig]
    episode_cfg: Const[EpisodeConfig]
    tank_cfg: Const[TankConfig]


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
class CameraTrackingIO:
    """Obstacles that only the camera sees."""

    spots: Out[SpotState]
    tracks: Out[TrackState]
    clock: In[ClockState]
    image: In[DepthImage]
    scan: In[SonarScan]
    depth_cfg: Const[DepthConfig]
    height_cfg: Const[HeightConfig]
    episode_cfg: Const[EpisodeConfig]
    sonar_cfg: Const[SonarConfig]
    camera_tracking_cfg: Const[CameraTrackingConfig]
    tank_cfg: Const[TankConfig]
    tracking_cfg: Const[TrackingConfig]


@dataclass(frozen=True, eq=False)
class TrackingIO:
    """Obstacles followed from ping to ping."""

    clusters: Out[ClusterState]
    echoes: Out[EchoState]
    tracks: Out[TrackState]
    clock: In[ClockState]
    turn_history: In[TurnHistory]
    scan: In[SonarScan]
    height_cfg: Const[HeightConfig]
    episode_cfg: Const[EpisodeConfig]
    forecast_cfg: Const[ForecastConfig]
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
    camera_tracking: CameraTrackingIO
    look: LookIO
    forecast: ForecastIO
    past: PastIO
    mixture: MixtureIO
    heights: HeightsIO
    mapping: MappingIO
