"""From a request to tasks: which cells there are, which of them one simulator can serve, and how they are cut
into tasks."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from uuvtai.config import Config
from uuvtai.loader import ConfigError, load_config
from uuvtai.measure.sweep.cells import PRESET_AXES, SCENE_AXES, Cell, Grid, checked
from uuvtai.measure.sweep.tasks import Row, Task

if TYPE_CHECKING:
    from uuvtai.scene_options import SceneOptions

BATCH = 256
"""episodes side by side in one simulator"""
TASK_EPISODES = 1024
"""episodes of a task, about: what a kill costs at most, and enough that the last stragglers of a batch cost
little"""

Overrides = list[Any]


@dataclass(frozen=True)
class SweepRequest:
    """What ``uuv sweep`` was asked for; all of it plain data that a run folder can keep."""

    grid: Grid
    world: str
    sensors: str | None
    vehicle: str | None
    overrides: tuple[Any, ...]
    """of the config, for every cell: ``key=value`` texts and (key, value) pairs"""
    controllers: tuple[str, ...]
    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    episodes: int
    """per seed, cell and method"""
    num_envs: int | None = None
    device: str = "auto"

    @classmethod
    def typed(cls, scene: SceneOptions, policies: list[str], **rest: Any) -> SweepRequest:
        """What a command line asks for, with the scene as it was typed."""
        return cls(
            world=scene.world_name,
            sensors=scene.sensors,
            vehicle=scene.vehicle,
            overrides=tuple(scene.settings),
            policies=tuple(policies),
            **rest,
        )

    def document(self) -> dict[str, Any]:
        """As JSON, for the run folder; ``request_of`` reads it."""
        return json.loads(json.dumps({**vars(self), "grid": vars(self.grid)}))


def request_of(document: dict[str, Any]) -> SweepRequest:
    """The request that ``document`` came from. Raises KeyError or TypeError for another document, ConfigError
    for another grid."""
    one_at_a_time, axes = document["grid"]["one_at_a_time"], document["grid"]["axes"]
    grid = checked(Grid({name: tuple(values) for name, values in axes.items()}, _typed(one_at_a_time, bool)))
    lists = {name: tuple(document[name]) for name in ("controllers", "policies", "seeds")}
    overrides = tuple(item if isinstance(item, str) else tuple(item) for item in document["overrides"])
    rest = {name: _typed(document[name], of) for name, of in _TYPES.items()}
    for name, values in lists.items():
        for value in values:
            _typed(value, int if name == "seeds" else str)
    return SweepRequest(grid=grid, overrides=overrides, **lists, **rest)


_TYPES: dict[str, Any] = {
    "world": str,
    "sensors": str | None,
    "vehicle": str | None,
    "episodes": int,
    "num_envs": int | None,
    "device": str,
}


def _typed(value: Any, of: Any) -> Any:
    if not isinstance(value, of) or (isinstance(value, bool) and of is not bool):
        raise TypeError(f"{value!r:.80} is no {of}")
    return value


def base_config(request: SweepRequest, cell: Cell | None = None) -> Config:
    """Config of a cell, or of none, with the scene as data and room for the grid's largest. Raises
    ConfigError."""
    cell = cell or {}
    presets = {kind: cell.get(kind, getattr(request, kind)) for kind in PRESET_AXES}
    keys = [
        (name, value) for name, value in cell.items() if name not in PRESET_AXES and name not in SCENE_AXES
    ]
    overrides = [*request.overrides, *keys]
    config = load_config(presets["world"], presets["sensors"], presets["vehicle"], overrides)
    axes = request.grid.axes
    room = {
        "world.static_capacity": max([config.world.static_slots, *axes.get("S", ())]),
        "world.dynamic_capacity": max([config.world.dynamic_slots, *axes.get("D", ())]),
    }
    return load_config(presets["world"], presets["sensors"], presets["vehicle"], [*overrides, *room.items()])


def label_of(cell: Cell, config: Config) -> dict[str, Any]:
    """What a row says of its cell: S, D, v_m_s (None where nothing moves) and every other axis by its
    name."""
    world = config.world
    n_dynamic = cell.get("D", world.n_dynamic)
    scene = {
        "S": cell.get("S", world.n_static),
        "D": n_dynamic,
        "v_m_s": cell.get("v", world.dynamic_speed_m_s) if n_dynamic else None,
    }
    return {**scene, **{name: value for name, value in cell.items() if name not in SCENE_AXES}}


def unchanged(request: SweepRequest) -> dict[str, Any]:
    """What every axis is where the grid does not set it; None for a preset that the world names itself."""
    config = base_config(request)
    world = config.world
    known: dict[str, Any] = {"S": world.n_static, "D": world.n_dynamic, "v": world.dynamic_speed_m_s}
    known |= {kind: getattr(request, kind) for kind in PRESET_AXES}
    own = {
        name: known[name] if name in known else functools.reduce(getattr, name.split("."), config)
        for name in request.grid.axes
    }
    return json.loads(json.dumps(own))


def row_key(label: dict[str, Any], method: str) -> str:
    """What tells a row from every other one of the same sweep."""
    return hashlib.sha256(json.dumps([sorted(label.items(), key=str), method]).encode()).hexdigest()


def tasks_of(
    request: SweepRequest, methods: Sequence[tuple[str, str | None, str | None]], done: set[str]
) -> list[Task]:
    """Tasks for the rows that are not ``done`` (keys). ``methods``: (name, controller, policy), exactly one
    of the two. ConfigError."""
    each = len(request.seeds) * request.episodes
    per_task = max(1, TASK_EPISODES // each)
    found = []
    for config, cells in _by_config(request):
        for name, controller, policy in methods:
            labels = [label for cell in cells if row_key(label := label_of(cell, config), name) not in done]
            for first in range(0, len(labels), per_task):
                part = labels[first : first + per_task]
                scenes = tuple((label["S"], label["D"], label["v_m_s"] or 0.0) for label in part)
                num_envs = request.num_envs or min(BATCH, each * len(cells))
                found.append(
                    Task(
                        config,
                        controller,
                        policy,
                        scenes,
                        tuple(part),
                        request.seeds,
                        request.episodes,
                        num_envs,
                        request.device,
                    )
                )
    return found


def _by_config(request: SweepRequest) -> list[tuple[Config, list[Cell]]]:
    """Cells by what must be compiled for them; every config is checked here, before anything runs."""
    groups: dict[str, tuple[Config, list[Cell]]] = {}
    for cell in request.grid.cells():
        config = base_config(request, cell)
        groups.setdefault(config.model_dump_json(), (config, []))[1].append(cell)
    return list(groups.values())


def check_rows(request: SweepRequest, methods: Sequence[str]) -> list[str]:
    """Keys of all rows in the order of the document. Raises ConfigError where two cells could not be told
    apart."""
    keys = [
        row_key(label_of(cell, config), name)
        for config, cells in _by_config(request)
        for cell in cells
        for name in methods
    ]
    if len(set(keys)) != len(keys):
        raise ConfigError(
            "the grid has the same cell twice: an axis repeats what the condition has already; leave that "
            "value out"
        )
    return keys


def ordered(rows: dict[str, Row], keys: Sequence[str]) -> list[Row]:
    """Rows in the order of the grid."""
    return [rows[key] for key in keys if key in rows]
