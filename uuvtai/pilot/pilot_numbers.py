"""What the stack's frame needs to know of a config, as plain numbers: without Taichi, torch and pydantic."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PilotNumbers:
    """Of one vehicle with its sensors and its tree."""

    dt_s: float
    """control step"""
    top: tuple[float, float, float, float]
    """[m/s, m/s, m/s, rad/s] full command in surge, sway, heave, yaw"""
    nodes: tuple[str, ...]
    """the tree's nodes as logs name them"""
    gravity_m_s2: float
    estimated: bool
    """the pilot estimates its own position, nobody gives it"""
    dvl_steps: int
    """control steps from one expected reading to the next"""
    beams: int
    beam_limit: int
    """beams [0, limit) may follow each other in a ping of a mechanical sonar: a ring goes round"""
    mechanical: bool
    doppler: bool
    sonar_latency_steps: int
    """control steps from a ping to its scan, always"""
    sonar_m: float
    """maximum range"""
    image: tuple[int, int]
    """rows, columns of a depth image"""
    camera_m: float
    """maximum range"""
