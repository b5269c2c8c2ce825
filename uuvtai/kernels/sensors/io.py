"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import DepthConfig, EpisodeConfig, SensorsConfig, SonarConfig, TankConfig, VehicleConfig
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    ClockState,
    DepthImage,
    EpisodeState,
    Proprioception,
    ProprioceptionMemory,
    SonarImage,
    SonarMemory,
    SonarScan,
    VehicleState,
    WorldState,
)


@dataclass(frozen=True, eq=False)
class DepthIO:
    """The depth camera."""

    image: Out[DepthImage]
    clock: In[ClockState]
    ego: In[Proprioception]
    episode: In[EpisodeState]
    vehicle: In[VehicleState]
    world: In[WorldState]
    depth_cfg: Const[DepthConfig]
    tank_cfg: Const[TankConfig]


@dataclass(frozen=True, eq=False)
class ProprioceptionIO:
    """DVL, IMU, pressure, and the estimate of the pose."""

    ego: Out[Proprioception]
    ego_memory: Out[ProprioceptionMemory]
    clock: In[ClockState]
    episode: In[EpisodeState]
    vehicle: In[VehicleState]
    episode_cfg: Const[EpisodeConfig]
    sensors_cfg: Const[SensorsConfig]
    vehicle_cfg: Const[VehicleConfig]


@dataclass(frozen=True, eq=False)
class VelocityIO:
    """The own velocity while the DVL is silent."""

    ego: Out[Proprioception]
    clock: In[ClockState]
    episode_cfg: Const[EpisodeConfig]
    sensors_cfg: Const[SensorsConfig]


@dataclass(frozen=True, eq=False)
class SonarIO:
    """The imaging sonar."""

    scan: Out[SonarScan]
    sonar_memory: Out[SonarMemory]
    sonar_image: Out[SonarImage]
    clock: In[ClockState]
    ego: In[Proprioception]
    episode: In[EpisodeState]
    vehicle: In[VehicleState]
    world: In[WorldState]
    episode_cfg: Const[EpisodeConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]


@dataclass(frozen=True, eq=False)
class ExactProprioceptionIO:
    """Measurements without errors, for experiments on the vehicle alone."""

    ego: Out[Proprioception]
    clock: In[ClockState]
    vehicle: In[VehicleState]


@dataclass(frozen=True, eq=False)
class SensorStages:
    """Bundles of this room, by the noun of their stage."""

    proprioception: ProprioceptionIO
    velocity: VelocityIO
    sonar: SonarIO
    depth: DepthIO
