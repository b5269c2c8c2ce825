"""What the commands do, as functions: ``uuvtai.evaluate``, ``sweep``, ``train``, ``load_log`` and ``show``.

Results print as the command's tables, in a terminal and in a notebook, and hold the document that ``--json``
prints. What a command refuses raises the same error here, a ValueError.
"""

from __future__ import annotations

import inspect
import os
import shutil
import tempfile
import webbrowser
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uuvtai.common.errors import SettingError
from uuvtai.common.files import read_bytes
from uuvtai.sim.scene import SceneOptions

if TYPE_CHECKING:
    from uuvtai.console.screen import Screen
    from uuvtai.logs.reader import LogMessage
    from uuvtai.report.tables import Table

Agent = str | os.PathLike[str] | Callable[..., Any]
"""what ``--agent`` takes, a result of ``train``, or a function or class of a Python file"""
Overrides = Mapping[str, Any]
"""dotted config keys to values"""
MOST_PICTURE = 64 << 20
"""[bytes] of a picture that is read back"""


@dataclass(frozen=True)
class Shown(ABC):
    """Something that prints as tables."""

    document: dict[str, Any]
    """what ``--json`` prints"""
    folder: Path
    """the run's; of a log its file"""

    def tables(self) -> list[Table]:
        """As the command prints them."""
        return _printed(self)[1]

    def __str__(self) -> str:
        return _printed(self)[0]

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.folder}>\n{self}"

    def __fspath__(self) -> str:
        return str(self.folder)

    def _repr_html_(self) -> str:
        return "".join(map(_html, self.tables()))

    @abstractmethod
    def _show(self, screen: Screen) -> None:
        """Print it."""


class Evaluation(Shown):
    """Agents on the same episodes."""

    @property
    def logs(self) -> list[Path]:
        """Of its recorded episodes."""
        return sorted((self.folder / "logs").glob("*.mcap"))

    def to_pandas(self, episodes: bool = False) -> Any:
        """DataFrame, a row an agent, or with ``episodes`` a row an episode and agent. Raises ImportError
        without pandas."""
        agents = self.document["agents"]
        if not episodes:
            rows = [_flat({k: v for k, v in agent.items() if k != "episodes_detail"}) for agent in agents]
        else:
            rows = [{"agent": a["name"], **episode} for a in agents for episode in a["episodes_detail"]]
        return _frame(rows)

    def _show(self, screen: Screen) -> None:
        from uuvtai.console.views import show_evaluation

        show_evaluation(screen, self.document, self.folder)


class Sweep(Shown):
    """Agents in every cell of a grid of conditions."""

    def to_pandas(self) -> Any:
        """DataFrame, a row a cell and agent. Raises ImportError without pandas."""
        return _frame([_flat(cell) for cell in self.document["cells"]])

    def _show(self, screen: Screen) -> None:
        from uuvtai.console.views import show_sweep

        show_sweep(screen, self.document)


class Training(Shown):
    """A trained agent: ``evaluate`` takes it among its agents."""

    def to_pandas(self) -> Any:
        """DataFrame, a row an iteration. Raises ImportError without pandas."""
        from uuvtai.learning.runner import read_metrics

        return _frame(read_metrics(self.folder))

    def _show(self, screen: Screen) -> None:
        from uuvtai.console.views import show_training

        show_training(screen, self.document)


class Log(Shown):
    """A recorded episode."""

    def messages(self, *topics: str) -> Iterator[LogMessage]:
        """Its messages in their order, of all topics or of these: ``topic``, ``time_s``, ``data``."""
        from uuvtai.logs.reader import read_messages

        return read_messages(self.folder, topics or None)

    def to_pandas(self, topic: str) -> Any:
        """DataFrame, a row a message of a topic, with ``time_s``. Raises ImportError without pandas,
        KeyError."""
        there = [row["topic"] for row in self.document["topics"]]
        if topic not in there:
            raise KeyError(f"{self.folder}: has no topic {topic!r}; there are {', '.join(there)}")
        return _frame([{"time_s": one.time_s, **_flat(one.data)} for one in self.messages(topic)])

    def _repr_png_(self) -> bytes:
        from uuvtai.logs.picture import picture

        with tempfile.TemporaryDirectory() as folder:
            picture([self.folder], target := Path(folder) / "episode.png")
            return read_bytes(target, MOST_PICTURE)

    def _show(self, screen: Screen) -> None:
        from uuvtai.console.views import show_log

        show_log(screen, self.document, self.folder)


# ------------------------------------------------------------------------------------------------------------


def evaluate(
    agents: Agent | Sequence[Agent] = "bt",
    world: str = "pool",
    *,
    episodes: int = 64,
    seeds: int | Sequence[int] = 0,
    planners: Callable[..., Any] | Sequence[Callable[..., Any]] = (),
    sensors: str | None = None,
    vehicle: str | None = None,
    overrides: Overrides | None = None,
    record: int = 0,
    explain: bool = False,
    num_envs: int | None = None,
    device: str = "auto",
    run_dir: str | os.PathLike[str] | None = None,
) -> Evaluation:
    """Run agents on the same ``episodes`` of each seed, as ``uuv eval``; a function or class of yours drives
    as ``mine.py:act`` would, one of ``planners`` plans the tree's routes.

    Logs of the first ``record`` episodes are kept; ``explain`` names the cause of each failure. Raises
    ValueError for what cannot be run, RunFolderError for a ``run_dir`` that is in use.
    """
    from uuvtai.console.screen import Progress
    from uuvtai.evaluation.evaluate import compare
    from uuvtai.evaluation.results import Request

    named = [*_named(agents), *_named(planners, "planner")]
    _check(1, episodes=episodes, num_envs=num_envs, agents=len(named))
    _check(0, record=record)
    request = Request.typed(
        _scene(world, sensors, vehicle, overrides), named,
        seeds=_seeds(seeds), episodes=int(episodes), record=int(record), explain=explain,
        num_envs=num_envs, device=device, run_dir=_path(run_dir),
    )  # fmt: skip
    return Evaluation(*compare(request, Progress()))


def sweep(
    agents: Agent | Sequence[Agent] = "bt",
    grid: str | Mapping[str, Sequence[Any]] = "paper",
    world: str = "pool",
    *,
    episodes: int = 64,
    seeds: int | Sequence[int] = 0,
    sensors: str | None = None,
    vehicle: str | None = None,
    overrides: Overrides | None = None,
    workers: int = 1,
    num_envs: int | None = None,
    device: str = "auto",
    run_dir: str | os.PathLike[str] | None = None,
) -> Sweep:
    """Run agents in every cell of a grid, as ``uuv sweep``: a preset's name, or values by axis
    (``{"D": [0, 6], "v": [0.4, 1.5]}``), in ``workers`` processes. Raises as ``evaluate``."""
    from uuvtai.console.screen import Progress
    from uuvtai.evaluation import sweep as sweeps
    from uuvtai.evaluation.grid import Grid, SweepRequest, checked, grid_of

    _check(1, episodes=episodes, workers=workers, num_envs=num_envs, agents=len(_several(agents)))
    engine = sweeps.engine_of("local", workers, "")
    own = {} if isinstance(grid, str) else {axis: tuple(_several(values)) for axis, values in grid.items()}
    axes = grid_of([grid]) if isinstance(grid, str) else checked(Grid(own))
    request = SweepRequest.typed(
        _scene(world, sensors, vehicle, overrides), _named(agents), grid=axes, episodes=episodes,
        seeds=tuple(_seeds(seeds)), num_envs=num_envs, device=device,
    )  # fmt: skip
    return Sweep(*sweeps.sweep(request, engine, _path(run_dir), Progress("cells")))


def train(
    preset: str = "policy",
    *,
    seed: int | None = None,
    iterations: int | None = None,
    world: str | None = None,
    sensors: str | None = None,
    vehicle: str | None = None,
    overrides: Overrides | None = None,
    reward: Agent | None = None,
    start: str | os.PathLike[str] | None = None,
    resume: str | os.PathLike[str] | None = None,
    device: str = "auto",
    run_dir: str | os.PathLike[str] | None = None,
) -> Training:
    """Train an agent, as ``uuv train``: a preset's recipe, or go on with the run folder ``resume``;
    ``reward``: function of yours whose terms are added, or its ``FILE.py:NAME``; ``start``: run with whose
    policy a new one begins. Raises ValueError for what cannot be trained, RunFolderError, CheckpointError,
    TrainingError, PluginError."""
    from uuvtai.console.parsing import reward as own_reward
    from uuvtai.console.screen import TrainingProgress
    from uuvtai.evaluation.evaluate import evaluate_now
    from uuvtai.learning import runner

    _check(1, iterations=iterations)
    own = None if reward is None else own_reward(_name(reward, ""))
    options: dict[str, Any] = {"iterations": iterations, "device": device, "reward": own}
    if resume is not None:
        changes: Any = list((overrides or {}).items())
        request = runner.TrainRequest(resume=_path(resume), overrides=changes, **options)
    else:
        first = [] if seed is None else [("train.seed", seed)]
        config = _scene(world, sensors, vehicle, overrides).training(preset, first)
        options |= {"start": _path(start), "run_dir": _path(run_dir)}
        request = runner.TrainRequest(config, preset, **options)
    return Training(*runner.train(request, TrainingProgress(), evaluate_now))


def load_log(file: str | os.PathLike[str]) -> Log:
    """A log (MCAP) of ``record``, ``uuv pilot`` or another recorder. Raises LogError."""
    from uuvtai.logs.reader import info

    return Log(info(Path(file)), Path(file))


def show(what: str | os.PathLike[str]) -> Path:
    """Open in the browser: the report of a result or run folder, or the picture of a log. Its file.

    Raises ConfigError for a folder that is no run, LogError."""
    place = Path(what)
    if place.suffix == ".mcap":
        from uuvtai.logs.picture import picture

        picture([place], target := place.with_suffix(".png"))
    else:
        from uuvtai.report.build import report

        target = report([place]).page
    webbrowser.open_new_tab(target.resolve().as_uri())
    return target


# ------------------------------------------------------------------------------------------------------------


def _scene(
    world: str | None, sensors: str | None, vehicle: str | None, overrides: Overrides | None
) -> SceneOptions:
    changes: Any = list((overrides or {}).items())
    given: Any = [None if one is None else os.fspath(one) for one in (world, sensors, vehicle)]
    return SceneOptions(*given, overrides=changes)


def _check(least: int, **counts: int | None) -> None:
    """SettingError for what is no count."""
    for name, value in counts.items():
        if value is not None and (
            isinstance(value, bool) or not hasattr(value, "__index__") or value < least
        ):
            raise SettingError(f"{name}={value!r}: must be a whole number, at least {least}")


def _several(given: Any) -> list[Any]:
    """What was given, alone or in a row."""
    return [*given] if isinstance(given, Iterable) and not isinstance(given, str) else [given]


def _seeds(seeds: int | Sequence[int]) -> list[int]:
    from uuvtai.envs.vector_env import checked_seed

    _check(1, seeds=len(found := _several(seeds)))
    return [checked_seed(seed) for seed in found]


def _path(place: str | os.PathLike[str] | None) -> Path | None:
    return None if place is None else Path(place)


def _named(given: Agent | Sequence[Agent], kind: str = "") -> list[str]:
    """As ``--agent`` takes them. SettingError for a function that lies in no file."""
    return [_name(one, f"{kind}:" if kind else "") for one in _several(given)]


def _name(agent: Agent, kind: str) -> str:
    if isinstance(agent, str | os.PathLike):
        return kind + os.fspath(agent)
    name = getattr(agent, "__qualname__", type(agent).__name__)
    try:
        file = inspect.getsourcefile(agent)
    except TypeError:
        file = None
    if file is None or not file.endswith(".py") or not Path(file).exists() or not name.isidentifier():
        raise SettingError(
            f"{name}: is no function or class at the top of a Python file; write it to one (in a notebook: "
            "%%writefile mine.py) and give 'mine.py:NAME'"
        )
    return f"{kind}{file}:{name}"


def _printed(shown: Shown) -> tuple[str, list[Table]]:
    """What a view prints, as text and as tables."""
    from io import StringIO

    from rich.console import Console

    from uuvtai.console.screen import Screen

    class Keeping(Screen):
        def table(self, table: Table) -> None:
            found.append(table)
            super().table(table)

    found: list[Table] = []
    width = shutil.get_terminal_size((100, 24)).columns
    console = Console(file=(text := StringIO()), width=width, force_terminal=False, force_jupyter=False)
    shown._show(Keeping(console=console, more="to_pandas()"))
    return text.getvalue().rstrip(), found


def _html(table: Table) -> str:
    """A table as HTML, escaped."""
    from uuvtai.report.tables import PAGE

    columns, rows = table.on(PAGE)
    head = "".join(f"<th>{escape(column.head)}</th>" for column in columns)
    body = "".join(f"<tr>{''.join(f'<td>{escape(str(c))}</td>' for c in row)}</tr>" for row in rows)
    return f"<table><caption>{escape(table.title)}</caption><tr>{head}</tr>{body}</table>"


def _flat(row: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Keys of what is inside joined by dots: a cell a number."""
    found: dict[str, Any] = {}
    for key, value in row.items():
        name = f"{before}{key}"
        found |= _flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return found


def _frame(rows: list[dict[str, Any]]) -> Any:
    try:
        import pandas  # type: ignore[import-not-found]
    except ImportError:
        raise ImportError("to_pandas() needs pandas: pip install pandas") from None
    return pandas.DataFrame(rows)
