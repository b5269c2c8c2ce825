"""Who fills what the stack senses: the simulator's kernels, or somebody outside (``uuvtai.pilot``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from uuvtai.stages import Stages


@dataclass(frozen=True)
class Mission:
    """What a vehicle is told before it begins."""

    start: tuple[float, float, float]
    """[m] world, where it begins"""
    goal: tuple[float, float, float]
    """[m] world"""
    seed: int = 0
    """with ``episode``: of the fallback planner's random numbers"""
    episode: int = 0


class SensorSource(Protocol):
    """Fills readings of the awake rows, in this order in every control step."""

    def sense_motion(self, stages: Stages) -> None:
        """Readings of ``ego``: DVL, IMU, pressure, a position where it is given. The pose filter, if any,
        predicts between this and the sonar."""
        ...

    def sense_sonar(self, stages: Stages) -> None:
        """``scan``; the own pose at a ping is the one that ``ego`` holds now."""
        ...

    def sense_depth(self, stages: Stages) -> None:
        """``image``; by now the pose filter has used the scan."""
        ...
