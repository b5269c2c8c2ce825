"""One vehicle under way without a world: what it is told."""

from __future__ import annotations

from dataclasses import dataclass


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
    spread: tuple[float, ...] = ()
    """covariance of start and heading (x, y [m], yaw [rad]), upper triangle of six; none = exactly known"""

    def places(self) -> dict[str, tuple[float, float, float]]:
        """By the array that holds it."""
        return {"mission.start_w": self.start, "mission.goal_w": self.goal, "vehicle.pos_w": self.start}
