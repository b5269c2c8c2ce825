"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import ActuationConfig, DisturbanceConfig, EpisodeConfig, SensorsConfig, VehicleConfig
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    ActuationState,
    Allocation,
    ClockState,
    CurrentState,
    EpisodeState,
    MissionState,
    Proprioception,
    VehicleParams,
    VehicleState,
)


@dataclass(frozen=True, eq=False)
class ActuationIO:
    """From an action to the thrusters' speeds."""

    actuation: Out[ActuationState]
    allocation: In[Allocation]
    clock: In[ClockState]
    ego: In[Proprioception]
    params: In[VehicleParams]
    actuation_cfg: Const[ActuationConfig]
    episode_cfg: Const[EpisodeConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class ThrusterWatchIO:
    """What the vertical thrusters were told, and what the vehicle did."""

    actuation: Out[ActuationState]
    ego: Out[Proprioception]
    clock: In[ClockState]
    actuation_cfg: Const[ActuationConfig]
    episode_cfg: Const[EpisodeConfig]
    sensors_cfg: Const[SensorsConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class DynamicsIO:
    """Rigid body, thrusters and current (Fossen)."""

    actuation: Out[ActuationState]
    current: Out[CurrentState]
    params: Out[VehicleParams]
    vehicle: Out[VehicleState]
    allocation: In[Allocation]
    clock: In[ClockState]
    episode: In[EpisodeState]
    mission: In[MissionState]
    actuation_cfg: Const[ActuationConfig]
    disturbance_cfg: Const[DisturbanceConfig]
    episode_cfg: Const[EpisodeConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class VehicleStages:
    """Bundles of this room, by the noun of their stage."""

    thrusters: ThrusterWatchIO
    actuation: ActuationIO
    dynamics: DynamicsIO
