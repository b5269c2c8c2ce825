"""What each stage of this room reads and writes."""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.config import EpisodeConfig, WorldConfig
from uuvtai.kernels.core.stage import Const, In, Out
from uuvtai.state import (
    ClockState,
    EpisodeState,
    FixedTable,
    MissionState,
    PathState,
    ScenarioScratch,
    SceneState,
    WorldState,
)


@dataclass(frozen=True, eq=False)
class WorldIO:
    """Scenarios, and where moving obstacles are."""

    mission: Out[MissionState]
    path: Out[PathState]
    scratch: Out[ScenarioScratch]
    world: Out[WorldState]
    clock: In[ClockState]
    episode: In[EpisodeState]
    fixed: In[FixedTable]
    scene: In[SceneState]
    episode_cfg: Const[EpisodeConfig]
    world_cfg: Const[WorldConfig]


@dataclass(frozen=True, eq=False)
class WorldStages:
    """Bundles of this room, by the noun of their stage."""

    world: WorldIO
