"""What each oracle reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import EpisodeConfig, HeightConfig, MappingConfig, SonarConfig, TankConfig
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    ClockState,
    ClusterState,
    MapState,
    PathState,
    Proprioception,
    SonarScan,
    TrackState,
    WorldState,
)


@dataclass(frozen=True, eq=False)
class TrueMapIO:
    """An oracle: the map as it truly is."""

    grid_map: Out[MapState]
    clock: In[ClockState]
    world: In[WorldState]
    mapping_cfg: Const[MappingConfig]
    tank_cfg: Const[TankConfig]


@dataclass(frozen=True, eq=False)
class TrueTracksIO:
    """An oracle: the tracks as they truly are."""

    clusters: Out[ClusterState]
    tracks: Out[TrackState]
    clock: In[ClockState]
    ego: In[Proprioception]
    path: In[PathState]
    scan: In[SonarScan]
    world: In[WorldState]
    height_cfg: Const[HeightConfig]
    episode_cfg: Const[EpisodeConfig]
    sonar_cfg: Const[SonarConfig]
    tank_cfg: Const[TankConfig]


@dataclass(frozen=True, eq=False)
class OracleStages:
    """Bundles of this room, by the noun of their stage."""

    true_tracks: TrueTracksIO
    true_map: TrueMapIO
