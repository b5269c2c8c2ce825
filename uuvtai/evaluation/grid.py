"""From a request to tasks: its cells, which of them one simulator can serve, cut into tasks."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from uuvtai.common.errors import SettingError
from uuvtai.common.presets import preset_names
from uuvtai.config import Config
from uuvtai.config.base import LARGEST
from uuvtai.config.loader import ConfigError, load_config, parsed_yaml, read_preset

if TYPE_CHECKING:
    from uuvtai.evaluation.episodes import EpisodeResult
    from uuvtai.sim.scene import SceneOptions
    from uuvtai.sim.setup import Scene
    from uuvtai.sim.sim import Sim


# ---- The grid of a sweep: named axes and their values, and the cells they make.

SCENE_AXES = {"S": "world.n_static", "D": "world.n_dynamic", "v": "world.dynamic_speed_m_s"}
"""axes that vary as data within one simulator, and their config keys"""
PRESET_AXES = ("sensors", "vehicle", "world")  # axes whose values are names of presets
MAX_CELLS = 10_000
DEFAULT = "paper"  # grid preset of a sweep that names no axes
_KEY = re.compile(r"[a-z_][a-z0-9_]*(\.[a-z_][a-z0-9_]*)+")

Value = Any
Cell = dict[str, Value]  # value of every axis that the cell sets, by the axis's name


@dataclass(frozen=True)
class Grid:
    """Axes by name; ``one_at_a_time``: each axis alone around the unchanged condition."""

    axes: dict[str, tuple[Value, ...]]
    one_at_a_time: bool = False

    def cells(self) -> list[Cell]:
        """Every cell once; where nothing moves (D = 0) one speed of obstacles stands for all."""
        if self.one_at_a_time:
            found = [{}, *({name: value} for name, values in self.axes.items() for value in values)]
        else:
            found = [
                dict(zip(self.axes, each, strict=True)) for each in itertools.product(*self.axes.values())
            ]
        cells = ({name: v for name, v in cell.items() if name != "v" or cell.get("D") != 0} for cell in found)
        return list({repr(sorted(cell.items())): cell for cell in cells}.values())

    def document(self) -> dict[str, Any]:
        """As ``uuv sweep --json`` tells it."""
        return {name: list(values) for name, values in self.axes.items()}


def grid_of(texts: Sequence[str]) -> Grid:
    """Grid of ``--grid`` texts: ``AXIS=value,value,..`` (repeatable), or the name or path of one grid preset,
    whose axes they then replace.

    Raises ConfigError.
    """
    named = [text for text in texts if "=" not in text]
    if len(named) > 1:
        raise ConfigError(f"--grid {', '.join(named)}: one preset at most; add axes as --grid D=0,6")
    typed = dict(_axis(text) for text in texts if "=" in text)
    if len(typed) < len(texts) - len(named):
        raise ConfigError("--grid: an axis is given twice; write all its values in one: --grid D=0,3,6")
    start = read_grid(named[0] if named else DEFAULT) if named or not typed else Grid({})
    return checked(Grid(start.axes | typed, start.one_at_a_time))


def read_grid(name: str) -> Grid:
    """Grid of a preset's name or a YAML file's path. Raises ConfigError."""
    tree = read_preset("grid", name)
    unknown = tree.keys() - {"axes", "one_at_a_time"}
    axes = tree.get("axes")
    if unknown or not isinstance(axes, dict) or not all(isinstance(values, list) for values in axes.values()):
        raise ConfigError(
            f"grid {name}: needs 'axes:', each a list of values, and may have 'one_at_a_time: true'"
            + (f"; {', '.join(sorted(unknown))} is not known" if unknown else "")
        )
    return Grid(
        {str(axis): tuple(values) for axis, values in axes.items()}, bool(tree.get("one_at_a_time", False))
    )


def _axis(text: str) -> tuple[str, tuple[Value, ...]]:
    name, _equals, values = text.partition("=")
    parsed = parsed_yaml(f"[{values}]", f"--grid {name}")
    if not isinstance(parsed, list):
        raise ConfigError(
            f"--grid {text!r}: write AXIS=value,value,.. for example --grid S=4,8 --grid "
            "behavior.caution=0.5,1,2"
        )
    return name.strip(), tuple(parsed)


def checked(grid: Grid) -> Grid:
    """The grid. Raises ConfigError: an axis unknown, empty, with a value twice, or too many cells."""
    if not grid.axes:
        raise ConfigError("the grid has no axes; for example --grid S=4,8,12 --grid D=0,6")
    for name, values in grid.axes.items():
        if name not in SCENE_AXES and name not in PRESET_AXES and not _KEY.fullmatch(name):
            raise ConfigError(
                f"--grid {name}: no such axis; it is S, D, v, {', '.join(PRESET_AXES)} or a dotted config "
                "key such as behavior.caution"
            )
        if not values:
            raise ConfigError(f"--grid {name}: has no values; for example --grid {name}=1,2")
        if len({repr(value) for value in values}) < len(values):
            raise ConfigError(f"--grid {name}: a value is given twice: {', '.join(map(str, values))}")
        _check_values(name, values)
    count = 1
    for values in grid.axes.values():
        count *= len(values)
    if not grid.one_at_a_time and count > MAX_CELLS:
        raise ConfigError(
            f"the grid has {count:,} cells, more than {MAX_CELLS:,}: split it into several sweeps"
        )
    return grid


def _check_values(name: str, values: Sequence[Value]) -> None:
    for value in values:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if name in ("S", "D") and (not isinstance(value, int) or isinstance(value, bool) or value < 0):
            raise ConfigError(
                f"--grid {name}: {value!r} is no number of obstacles; give whole numbers from 0"
            )
        if name == "v" and (not number or not 0 <= value <= LARGEST):
            raise ConfigError(
                f"--grid v: {value!r} is no speed; give numbers in m/s, for example --grid v=0.2,0.6"
            )
        if name in PRESET_AXES and not (
            isinstance(value, str) and (value in preset_names(name) or Path(value).suffix)
        ):
            raise ConfigError(
                f"--grid {name}: {value!r} is no {name} preset; there are {', '.join(preset_names(name))}"
            )


# ---- What a worker of a sweep is given and what it gives back: plain data, for any process on any machine.

Row = dict[str, Any]  # one agent in one cell, an entry of ``cells`` in ``uuv sweep --json``


@dataclass(frozen=True)
class Task:
    """Cells of one config, which one simulator serves, and one agent that runs them."""

    config: Config
    """with room for the largest scene"""
    agent: str
    """as ``agents.load_agents`` takes it"""
    scenes: tuple[Scene, ...]
    """of the cells, in order"""
    labels: tuple[dict[str, Any], ...]
    """of the cells: values of the axes, which go into the rows"""
    seeds: tuple[int, ...]
    episodes: int  # per seed
    num_envs: int
    device: str = "auto"


_kept: dict[tuple[str, int, str], Sim] = {}
"""the simulator of this process's last task: the next one of the same config does not compile again"""


def run_task(task: Task) -> list[Row]:
    """Run all episodes of the task's cells; one row per cell, in their order."""
    from uuvtai.evaluation.agents import load_agents
    from uuvtai.evaluation.episodes import Job, run_episodes

    (agent,) = load_agents([task.agent])
    sim = _sim_of(task, agent.config_of(task.config))
    sim.use_tree(agent.tree)
    sim.planner = agent.planner_for(sim)
    runs = itertools.product(task.scenes, task.seeds, range(task.episodes))
    jobs = [Job(seed, episode, scene) for scene, seed, episode in runs]
    note = agent.agent_for(sim)
    results, _env_steps = run_episodes(sim, jobs, agent=note.agent if note else None)
    if agent.own:
        agent.own.close()
    each = len(task.seeds) * task.episodes
    return [
        row_of(agent.name, label, results[i * each : (i + 1) * each]) for i, label in enumerate(task.labels)
    ]


def _sim_of(task: Task, config: Config) -> Sim:
    from uuvtai.common.presets import TRAINING_TREE
    from uuvtai.sim.behavior_tree import read_tree
    from uuvtai.sim.sim import Sim

    key = (config.model_dump_json(), task.num_envs, task.device)
    if key not in _kept:
        _kept.clear()
        _kept[key] = Sim(config, task.num_envs, read_tree(TRAINING_TREE), task.device)
    return _kept[key]


def row_of(agent: str, label: dict[str, Any], results: list[EpisodeResult]) -> Row:
    """One agent in one cell: as in ``uuv eval``, without what a clock measured, and how episodes end."""
    from uuvtai.evaluation.results import summary

    found = summary(agent, results, 0, 0.0)
    for name in (
        "name",
        "env_steps",
        "wall_s",
        "env_steps_per_s",
        "replans_by_trigger",
        "planned_by",
        "fallbacks_by_reason",
    ):
        found.pop(name)
    details = found.pop("episodes_detail")
    return {
        **label,
        "agent": agent,
        **found,
        "episode_outcomes": [entry["outcome"] for entry in details],
        "episode_times_s": [entry["time_s"] for entry in details],
    }


BATCH = 256  # episodes side by side in one simulator
TASK_EPISODES = 1024  # about: what a kill costs at most, and enough to make stragglers cheap


@dataclass(frozen=True)
class SweepRequest:
    """What ``uuv sweep`` was asked for; all of it plain data that a run folder can keep."""

    grid: Grid
    world: str
    sensors: str | None
    vehicle: str | None
    overrides: tuple[str | tuple[str, Any], ...]
    """of the config, for every cell: ``key=value`` texts and (key, value) pairs"""
    agents: tuple[str, ...]
    seeds: tuple[int, ...]
    episodes: int  # per seed, cell and agent
    num_envs: int | None = None
    device: str = "auto"

    @classmethod
    def typed(cls, scene: SceneOptions, agents: list[str], **rest: Any) -> SweepRequest:
        """What a command line asks for, with the scene as it was typed."""
        return cls(
            world=scene.world_name,
            sensors=scene.sensors,
            vehicle=scene.vehicle,
            overrides=tuple(scene.settings),
            agents=tuple(agents),
            **rest,
        )

    def document(self) -> dict[str, Any]:
        """As JSON, for the run folder; ``request_of`` reads it."""
        return json.loads(json.dumps({**vars(self), "grid": vars(self.grid)}))


def request_of(document: dict[str, Any]) -> SweepRequest:
    """The request of ``document``. SettingError for no such document, ConfigError for a grid."""
    try:
        request = TypeAdapter(SweepRequest).validate_json(json.dumps(document), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        raise SettingError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    checked(request.grid)
    return request


def base_config(request: SweepRequest, cell: Cell | None = None) -> Config:
    """Config of a cell, or none, the scene as data, room for the grid's largest. Raises ConfigError."""
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
    """What a row says of its cell: S, D, v_m_s (None = nothing moves) and every other axis by name."""
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


def row_key(label: dict[str, Any], agent: str) -> str:
    """What tells a row from every other one of the same sweep."""
    return hashlib.sha256(json.dumps([sorted(label.items(), key=str), agent]).encode()).hexdigest()


def tasks_of(request: SweepRequest, agents: Sequence[tuple[str, str]], done: set[str]) -> list[Task]:
    """Tasks for the rows that are not ``done`` (keys). ``agents``: (name, agent). ConfigError."""
    each = len(request.seeds) * request.episodes
    per_task = max(1, TASK_EPISODES // each)
    found = []
    for config, cells in _by_config(request):
        num_envs = request.num_envs or min(BATCH, each * len(cells))
        run = request.seeds, request.episodes, num_envs, request.device
        for name, agent in agents:
            labels = [label for cell in cells if row_key(label := label_of(cell, config), name) not in done]
            for first in range(0, len(labels), per_task):
                part = labels[first : first + per_task]
                scenes = tuple((label["S"], label["D"], label["v_m_s"] or 0.0) for label in part)
                found.append(Task(config, agent, scenes, tuple(part), *run))
    return found


def _by_config(request: SweepRequest) -> list[tuple[Config, list[Cell]]]:
    """Cells by what must be compiled for them; every config is checked here, before anything runs."""
    groups: dict[str, tuple[Config, list[Cell]]] = {}
    for cell in request.grid.cells():
        config = base_config(request, cell)
        groups.setdefault(config.model_dump_json(), (config, []))[1].append(cell)
    return list(groups.values())


def check_rows(request: SweepRequest, agents: Sequence[str]) -> list[str]:
    """Keys of all rows in the document's order. Raises ConfigError for cells that cannot be told apart."""
    keys = [
        row_key(label_of(cell, config), name)
        for config, cells in _by_config(request)
        for cell in cells
        for name in agents
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
