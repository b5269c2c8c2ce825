"""Every array of the simulator, one struct per stage: shape, dtype, unit and frame are written here and
nowhere else.

Frames: ``_w`` world (z up, origin at the tank's corner, z = 0 at the surface), ``_b`` body (x forward, y
left, z up). SI units, radians. Structs hold arrays only: a Python number in a struct would go stale silently.
``n_env`` is always the first index. Truth (what the simulator knows) and sensed or remembered data (what the
vehicle knows) never share a struct. The files group the stages as ``config/`` does; everybody imports the
structs from here.
"""

from __future__ import annotations

from uuvtai.state.arrays import PACKET, REAL, WORD, allocate, array, bytes_of
from uuvtai.state.behavior import BaselineState, TeacherState, TreeTable
from uuvtai.state.perception import (
    ClusterState,
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
    SpotState,
    TrackState,
)
from uuvtai.state.planning import (
    ClearanceMemory,
    ClearanceState,
    FeatureState,
    RouteState,
    VoronoiState,
)
from uuvtai.state.sensors import (
    DepthImage,
    Proprioception,
    ProprioceptionMemory,
    SonarImage,
    SonarMemory,
    SonarScan,
)
from uuvtai.state.task import ClockState, EpisodeState, MissionState, RefereeState, RewardState
from uuvtai.state.vehicle import ActuationState, Allocation, CurrentState, VehicleParams, VehicleState
from uuvtai.state.world import FixedTable, PathState, ScenarioScratch, SceneState, WorldState

__all__ = [
    "PACKET",
    "REAL",
    "WORD",
    "ActuationState",
    "Allocation",
    "BaselineState",
    "ClearanceMemory",
    "ClearanceState",
    "ClockState",
    "ClusterState",
    "CurrentState",
    "DepthImage",
    "EchoState",
    "EpisodeState",
    "FeatureState",
    "FixedTable",
    "ForecastState",
    "FutureState",
    "GridMask",
    "HabitState",
    "MapScratch",
    "MapState",
    "MissionState",
    "MixtureState",
    "PastState",
    "PathState",
    "PoseState",
    "Proprioception",
    "ProprioceptionMemory",
    "RefereeState",
    "RewardState",
    "RouteState",
    "ScenarioScratch",
    "SceneState",
    "SonarImage",
    "SonarMemory",
    "SonarScan",
    "SpotState",
    "TeacherState",
    "TrackState",
    "TreeTable",
    "VehicleParams",
    "VehicleState",
    "VoronoiState",
    "WorldState",
    "allocate",
    "array",
    "bytes_of",
]
