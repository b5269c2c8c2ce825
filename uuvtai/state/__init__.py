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
from uuvtai.state.behavior import BaselineState, BehaviorState, TreeTable
from uuvtai.state.perception import (
    ClusterState,
    EchoState,
    ForecastState,
    FutureState,
    GridMask,
    LocalizationState,
    MapScratch,
    MapState,
    MixtureState,
    PastState,
    SpotState,
    TrackState,
    TurnHistory,
)
from uuvtai.state.planning import ClearanceMemory, ClearanceState, ObservationState, RouteState, VoronoiState
from uuvtai.state.sensors import (
    DepthImage,
    Proprioception,
    ProprioceptionMemory,
    SonarImage,
    SonarMemory,
    SonarScan,
)
from uuvtai.state.vehicle import ActuationState, Allocation, CurrentState, VehicleParams, VehicleState
from uuvtai.state.world import (
    ClockState,
    EpisodeState,
    FixedTable,
    MissionState,
    PathState,
    RewardState,
    ScenarioScratch,
    SceneState,
    TerminationState,
    WorldState,
)

__all__ = [
    "PACKET", "REAL", "WORD", "ActuationState", "Allocation", "BaselineState", "BehaviorState",
    "ClearanceMemory", "ClearanceState", "ClockState", "ClusterState", "CurrentState", "DepthImage",
    "EchoState", "EpisodeState", "FixedTable", "ForecastState", "FutureState", "GridMask",
    "LocalizationState", "MapScratch", "MapState", "MissionState", "MixtureState", "ObservationState",
    "PastState", "PathState", "Proprioception", "ProprioceptionMemory", "RewardState", "RouteState",
    "ScenarioScratch", "SceneState", "SonarImage", "SonarMemory", "SonarScan", "SpotState",
    "TerminationState", "TrackState", "TreeTable", "TurnHistory", "VehicleParams", "VehicleState",
    "VoronoiState", "WorldState", "allocate", "array", "bytes_of",
]  # fmt: skip
