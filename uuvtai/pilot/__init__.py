"""The stack on a vehicle: sensor messages in, commands out (docs/replay.md)."""

from __future__ import annotations

from uuvtai.pilot.fed_pilot import PilotCommand, StaleLimits
from uuvtai.pilot.inbox import Tally
from uuvtai.pilot.mission import Mission
from uuvtai.pilot.onboard import OnboardPilot
from uuvtai.pilot.sensor_messages import (
    KINDS,
    DepthShot,
    DvlReading,
    ImuReading,
    PositionFix,
    PressureReading,
    SensorMessage,
    SonarPing,
    ThrusterLoss,
)

__all__ = [
    "KINDS",
    "DepthShot",
    "DvlReading",
    "ImuReading",
    "Mission",
    "OnboardPilot",
    "PilotCommand",
    "PositionFix",
    "PressureReading",
    "SensorMessage",
    "SonarPing",
    "StaleLimits",
    "Tally",
    "ThrusterLoss",
]
