"""All that one simulator owns: its structs, and the bundles by which its stages see them."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar, get_type_hints

import taichi as ti

from uuvtai.config import Section
from uuvtai.kernels.baselines.io import BaselineStages
from uuvtai.kernels.behavior.io import BehaviorStages
from uuvtai.kernels.oracle.io import OracleStages
from uuvtai.kernels.perception.io import PerceptionStages
from uuvtai.kernels.planning.io import PlanningStages
from uuvtai.kernels.sensors.io import SensorStages
from uuvtai.kernels.task.io import TaskStages
from uuvtai.kernels.vehicle.io import VehicleStages
from uuvtai.kernels.world.io import WorldStages
from uuvtai.state.behavior import BaselineStructs, BehaviorStructs
from uuvtai.state.perception import PerceptionStructs
from uuvtai.state.planning import PlanningStructs
from uuvtai.state.sensors import SensorStructs
from uuvtai.state.vehicle import VehicleStructs
from uuvtai.state.world import TaskStructs, WorldStructs

STAGES = (
    "dynamics", "world", "proprioception", "sonar", "localization", "depth", "tracking",
    "mapping", "clearance", "planning", "observation", "behavior", "reward",
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
    BehaviorStructs,
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
    BehaviorStages,
    BaselineStages,
    OracleStages,
):
    """What every stage reads and writes, by the noun of the stage."""


# ------------------------------------------------------------------------------------------------------------
# Fills the bundles of the stages, once, by type: a kernel's ``io`` says what it reads and writes, and here
# it gets it.


_T = TypeVar("_T")

_MARKED = re.compile(r"(?:In|Out|Const)\[(\w+)\]")


def bind(bundle: type[_T], *sources: object, partial: bool = False) -> _T:
    """A bundle whose members are those parts of the sources that have their types.

    ``sources`` are structs, config sections (searched with all their parts), bundles, and dataclasses of
    structs. Raises TypeError for a member that two sources have, and for one that none has; where ``partial``
    is set that one stays None, and what uses it cannot compile.
    """
    parts = _parts_of(sources)
    if partial:
        return bundle(**{name: parts.get(kind) for name, kind in members_of(bundle).items()})
    return _filled(bundle, parts)


def bind_all(stages: type[_T], *sources: object) -> _T:
    """A dataclass of bundles, each of them bound."""
    parts = _parts_of(sources)
    return stages(**{name: _filled(bundle, parts) for name, bundle in _bundles_of(stages).items()})


def members_of(bundle: type) -> dict[str, str]:
    """Name of the type of each member, as its annotation says."""
    found = {}
    for member in dataclasses.fields(bundle):  # type: ignore[arg-type]
        marked = _MARKED.fullmatch(str(member.type))
        if marked is None:
            raise TypeError(
                f"{bundle.__name__}.{member.name}: {member.type} is none of In[..], Out[..] and Const[..]"
            )
        found[member.name] = marked.group(1)
    return found


@cache
def _bundles_of(stages: type) -> dict[str, type]:
    return get_type_hints(stages)


def _parts_of(sources: tuple[object, ...]) -> dict[str, Any]:
    """All structs and sections of the sources by the names of their types."""
    parts: dict[str, Any] = {}
    for source in sources:
        _gather(source, parts)
    return parts


def _filled(bundle: type[_T], parts: dict[str, Any]) -> _T:
    wanted = members_of(bundle)
    if missing := sorted(kind for kind in wanted.values() if kind not in parts):
        raise TypeError(f"{bundle.__name__} needs {', '.join(missing)}: pass them too")
    return bundle(**{name: parts[kind] for name, kind in wanted.items()})


def _gather(source: object, parts: dict[str, Any]) -> None:
    """Note ``source`` and all of its parts by the names of their types."""
    if isinstance(source, Section):
        for name in type(source).model_fields:
            value = getattr(source, name)
            if isinstance(value, Section):
                _note(value, parts)
                _gather(value, parts)
        _note(source, parts)
    elif dataclasses.is_dataclass(source) and not isinstance(source, type):
        inner = [getattr(source, member.name) for member in dataclasses.fields(source)]
        if inner and all(dataclasses.is_dataclass(value) or isinstance(value, Section) for value in inner):
            for value in inner:
                _gather(value, parts)
        else:
            _note(source, parts)


def _note(value: object, parts: dict[str, Any]) -> None:
    kind = type(value).__name__
    if parts.setdefault(kind, value) is not value:
        raise TypeError(f"two different {kind} to bind")
