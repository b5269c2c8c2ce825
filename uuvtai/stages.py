"""All that one simulator owns: its structs, and the bundles by which its stages see them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass

import taichi as ti

from uuvtai.kernels.baselines.bundles import BaselineStages
from uuvtai.kernels.perception.bundles import PerceptionStages
from uuvtai.kernels.planning.bundles import PlanningStages
from uuvtai.kernels.privileged.bundles import PrivilegedStages
from uuvtai.kernels.sensors.bundles import SensorStages
from uuvtai.kernels.task.bundles import TaskStages
from uuvtai.kernels.teacher.bundles import TeacherStages
from uuvtai.kernels.vehicle.bundles import VehicleStages
from uuvtai.kernels.world.bundles import WorldStages
from uuvtai.state.baselines import BaselineStructs
from uuvtai.state.perception import PerceptionStructs
from uuvtai.state.planning import PlanningStructs
from uuvtai.state.sensors import SensorStructs
from uuvtai.state.task import TaskStructs
from uuvtai.state.teacher import TeacherStructs
from uuvtai.state.vehicle import VehicleStructs
from uuvtai.state.world import WorldStructs

STAGES = (
    "dynamics", "world", "proprioception", "sonar", "pose", "depth", "tracking",
    "mapping", "clearance", "planning", "features", "teacher", "reward",
)  # fmt: skip
"""what is timed apart, in order"""


@contextlib.contextmanager
def timed_stage(name: str, stage_s: dict[str, float] | None) -> Iterator[None]:
    """Add the time that a stage takes [s], all its kernels done, to ``stage_s``; None costs nothing."""
    if stage_s is None:
        yield
        return
    ti.sync()
    begin = time.perf_counter()
    yield
    ti.sync()
    stage_s[name] = stage_s.get(name, 0.0) + time.perf_counter() - begin


@dataclass(frozen=True)
class SimState(
    TaskStructs,
    WorldStructs,
    VehicleStructs,
    SensorStructs,
    PerceptionStructs,
    PlanningStructs,
    TeacherStructs,
    BaselineStructs,
):
    """Every struct of the simulator, by the noun of its stage."""


@dataclass(frozen=True)
class Stages(
    TaskStages,
    WorldStages,
    VehicleStages,
    SensorStages,
    PerceptionStages,
    PlanningStages,
    TeacherStages,
    BaselineStages,
    PrivilegedStages,
):
    """What every stage reads and writes, by the noun of the stage."""
