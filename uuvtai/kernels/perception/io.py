"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import (
    DepthConfig,
    ElevationConfig,
    EpisodeConfig,
    ForecastConfig,
    MappingConfig,
    PoseConfig,
    SensorsConfig,
    SonarConfig,
    SpottingConfig,
    TankConfig,
    TeacherConfig,
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
    HabitState,
    MapScratch,
    MapState,
    MixtureState,
    PastState,
    PoseState,
    Proprioception,
    SonarScan,
    SpotState,
    TrackState,
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
    """Where bodies will be: arcs, and legs between the turns that they were seen to take."""

    forecast: Out[ForecastState]
    habits: Out[HabitState]
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
    habits: In[HabitState]
    tracks: In[TrackState]
    episode_cfg: Const[EpisodeConfig]
    forecast_cfg: Const[ForecastConfig]
    tank_cfg: Const[TankConfig]
    teacher_cfg: Const[TeacherConfig]


@dataclass(frozen=True, eq=False)
class MixtureIO:
    """What a network says that the bodies may do."""

    forecast: Out[ForecastState]
    futures: Out[FutureState]
    mixture: Out[MixtureState]
    clock: In[ClockState]
    teacher_cfg: Const[TeacherConfig]
    tracking_cfg: Const[TrackingConfig]


@dataclass(frozen=True, eq=False)
class HeightsIO:
    """How high forecast bodies may reach."""

    forecast: Out[ForecastState]
    clock: In[ClockState]
    ego: In[Proprioception]
    tracks: In[TrackState]
    elevation_cfg: Const[ElevationConfig]
    tank_cfg: Const[TankConfig]


@dataclass(frozen=True, eq=False)
class LookIO:
    """What the camera shows of the tracks' heights."""

    tracks: Out[TrackState]
    clock: In[ClockState]
    image: In[DepthImage]
    depth_cfg: Const[DepthConfig]
    elevation_cfg: Const[ElevationConfig]
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
class PoseIO:
    """Where the vehicle is."""

    ego: Out[Proprioception]
    pose: Out[PoseState]
    clock: In[ClockState]
    scan: In[SonarScan]
    episode_cfg: Const[EpisodeConfig]
    pose_cfg: Const[PoseConfig]
    sensors_cfg: Const[SensorsConfig]
    tank_cfg: Const[TankConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class SpottingIO:
    """Bodies that only the camera sees."""

    spots: Out[SpotState]
    tracks: Out[TrackState]
    clock: In[ClockState]
    image: In[DepthImage]
    scan: In[SonarScan]
    depth_cfg: Const[DepthConfig]
    elevation_cfg: Const[ElevationConfig]
    episode_cfg: Const[EpisodeConfig]
    sonar_cfg: Const[SonarConfig]
    spotting_cfg: Const[SpottingConfig]
    tank_cfg: Const[TankConfig]
    tracking_cfg: Const[TrackingConfig]


@dataclass(frozen=True, eq=False)
class TrackingIO:
    """Bodies followed from ping to ping."""

    clusters: Out[ClusterState]
    echoes: Out[EchoState]
    tracks: Out[TrackState]
    clock: In[ClockState]
    habits: In[HabitState]
    scan: In[SonarScan]
    elevation_cfg: Const[ElevationConfig]
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
    pose: PoseIO
    tracking: TrackingIO
    spotting: SpottingIO
    look: LookIO
    forecast: ForecastIO
    past: PastIO
    mixture: MixtureIO
    heights: HeightsIO
    mapping: MappingIO
