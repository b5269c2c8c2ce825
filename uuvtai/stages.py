"""All that one simulator owns: its structs, and the bundles by which its stages see them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass

import taichi as ti

from uuvtai import state
from uuvtai.kernels.baselines.bundles import (
    DynamicWindowIO,
    PathIntegralIO,
    PotentialFieldIO,
    VelocityObstacleIO,
)
from uuvtai.kernels.perception.bundles import (
    ForecastIO,
    FuturesIO,
    HeightsIO,
    LookIO,
    MappingIO,
    MixtureIO,
    PastIO,
    PoseIO,
    SpottingIO,
    TrackingIO,
)
from uuvtai.kernels.planning.bundles import (
    ClearanceIO,
    ExposureIO,
    FeaturesIO,
    RouteIO,
    TriggersIO,
    VoronoiIO,
)
from uuvtai.kernels.privileged.bundles import TrueMapIO, TrueTracksIO
from uuvtai.kernels.sensors.bundles import DepthIO, ProprioceptionIO, SonarIO
from uuvtai.kernels.task.bundles import EpisodeIO, RewardIO
from uuvtai.kernels.teacher.bundles import EvasionIO, TeacherIO, ThreatsIO
from uuvtai.kernels.vehicle.bundles import ActuationIO, DynamicsIO, ThrusterWatchIO
from uuvtai.kernels.world.bundles import WorldIO

STAGES = (
    "dynamics", "world", "proprioception", "sonar", "pose", "depth", "tracking",
    "mapping", "clearance", "planning", "features", "teacher", "reward",
)  # fmt: skip
"""what is timed apart, in order"""


@contextlib.contextmanager
def timed_stage(name: str, stage_s: dict[str, float] | None) -> Iterator[None]:
    """Add the time that a stage takes [s], all its kernels done, to ``stage_s``; None costs nothing."""
    if stage_s is None:
        yield
        return
    ti.sync()
    begin = time.perf_counter()
    yield
    ti.sync()
    stage_s[name] = stage_s.get(name, 0.0) + time.perf_counter() - begin


@dataclass(frozen=True)
class SimState:
    """Every struct of the simulator, by the noun of its stage."""

    clock: state.ClockState
    episode: state.EpisodeState
    vehicle: state.VehicleState
    params: state.VehicleParams
    actuation: state.ActuationState
    allocation: state.Allocation
    current: state.CurrentState
    scene: state.SceneState
    world: state.WorldState
    path: state.PathState
    fixed: state.FixedTable
    scratch: state.ScenarioScratch
    mission: state.MissionState
    referee: state.RefereeState
    ego: state.Proprioception
    ego_memory: state.ProprioceptionMemory
    scan: state.SonarScan
    sonar_memory: state.SonarMemory
    image: state.DepthImage
    pose: state.PoseState
    tracks: state.TrackState
    clusters: state.ClusterState
    spots: state.SpotState
    habits: state.HabitState
    forecast: state.ForecastState
    futures: state.FutureState
    past: state.PastState
    mixture: state.MixtureState
    mask: state.GridMask
    grid_map: state.MapState
    map_scratch: state.MapScratch
    clearance: state.ClearanceState
    clearance_memory: state.ClearanceMemory
    exposure: state.ExposureState
    voronoi: state.VoronoiState
    route: state.RouteState
    features: state.FeatureState
    teacher: state.TeacherState
    table: state.TreeTable
    reward: state.RewardState
    baselines: state.BaselineState


@dataclass(frozen=True)
class Stages:
    """What every stage reads and writes, by the noun of the stage."""

    episode: EpisodeIO
    world: WorldIO
    thrusters: ThrusterWatchIO
    actuation: ActuationIO
    dynamics: DynamicsIO
    proprioception: ProprioceptionIO
    sonar: SonarIO
    depth: DepthIO
    pose: PoseIO
    tracking: TrackingIO
    spotting: SpottingIO
    look: LookIO
    true_tracks: TrueTracksIO
    forecast: ForecastIO
    futures: FuturesIO
    past: PastIO
    mixture: MixtureIO
    heights: HeightsIO
    mapping: MappingIO
    true_map: TrueMapIO
    clearance: ClearanceIO
    exposure: ExposureIO
    features: FeaturesIO
    triggers: TriggersIO
    voronoi: VoronoiIO
    route: RouteIO
    threats: ThreatsIO
    evasion: EvasionIO
    dynamic_window: DynamicWindowIO
    potential_field: PotentialFieldIO
    velocity_obstacle: VelocityObstacleIO
    path_integral: PathIntegralIO
    teacher: TeacherIO
    reward: RewardIO
