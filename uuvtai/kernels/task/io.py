"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import EpisodeConfig, RewardConfig, TankConfig, VehicleConfig
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    ActuationState,
    ClockState,
    EpisodeState,
    MissionState,
    RewardState,
    RouteState,
    TerminationState,
    VehicleState,
    WorldState,
)


@dataclass(frozen=True, eq=False)
class EpisodeIO:
    """The clock of each env, and the termination."""

    clock: Out[ClockState]
    episode: Out[EpisodeState]
    termination: Out[TerminationState]
    mission: In[MissionState]
    vehicle: In[VehicleState]
    world: In[WorldState]
    episode_cfg: Const[EpisodeConfig]
    tank_cfg: Const[TankConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class RewardIO:
    """What a step was worth, and how it went."""

    reward: Out[RewardState]
    actuation: In[ActuationState]
    clock: In[ClockState]
    termination: In[TerminationState]
    route: In[RouteState]
    vehicle: In[VehicleState]
    episode_cfg: Const[EpisodeConfig]
    reward_cfg: Const[RewardConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class TaskStages:
    """Bundles of this room, by the noun of their stage."""

    episode: EpisodeIO
    reward: RewardIO
