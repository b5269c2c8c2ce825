"""A sweep's run folder: finished rows are on disk at once, so a killed sweep goes on from there."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from uuvtai.common import signals
from uuvtai.common.files import FileError, json_object, open_to_append, read_json, read_lines, truncate
from uuvtai.common.presets import built_in_agents
from uuvtai.common.processes import ATTEMPTS, EngineError, Item, LocalEngine, Work
from uuvtai.evaluation.grid import (
    SCENE_AXES,
    Grid,
    Row,
    SweepRequest,
    base_config,
    check_rows,
    ordered,
    request_of,
    row_key,
    run_task,
    tasks_of,
    unchanged,
)
from uuvtai.logs.run_folder import RunFolder, RunFolderError, default_run_dir, refuse_place
from uuvtai.plugins.api import is_plugin, plugin_spec, refuse_code, to_resume

if TYPE_CHECKING:
    from uuvtai.evaluation.agents import AgentSpec
    from uuvtai.evaluation.evaluate import EvaluationWatch


# ---- Who does the work: processes on this machine, or a Ray cluster. A lost worker's task is done once more.


class Engine(Protocol):
    """Runs tasks somewhere."""

    def run(self, work: Work, items: Sequence[Item]) -> Iterator[tuple[int, Any]]:
        """(item's number, result) as they come. Raises errors of the work; EngineError where workers die."""
        ...


class RayEngine:
    """Tasks on a Ray cluster that runs already, or one in this process; Ray runs lost tasks again."""

    def __init__(self, address: str = "auto", cpus_per_task: float = 2.0) -> None:
        """``address``: of the cluster, ``auto`` = this machine's, ``local`` = one in this process."""
        try:
            import ray  # type: ignore[import-not-found]  # an extra
        except ImportError:
            raise EngineError(
                "--engine ray: the package ray is missing; install it: pip install 'uuvtai[cluster]'"
            ) from None
        self._ray = ray
        try:
            ray.init(
                address=None if address == "local" else address,
                ignore_reinit_error=True,
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise EngineError(
                f"--engine ray: no cluster at {address!r} ({error}); start one: ray start --head"
            ) from None
        signals.reinstall()  # Ray has put its own handler of SIGTERM in their place
        self._cpus = min(cpus_per_task, ray.cluster_resources().get("CPU", 1.0))

    def run(self, work: Work, items: Sequence[Item]) -> Iterator[tuple[int, Any]]:
        remote = self._ray.remote(num_cpus=self._cpus, max_retries=ATTEMPTS - 1)(work)
        running = {remote.remote(item): number for number, item in enumerate(items)}
        try:
            yield from self._results(running, len(items))
        finally:
            for left in running:  # of a cluster that outlives us
                self._ray.cancel(left, force=True)

    def _results(self, running: dict[Any, int], total: int) -> Iterator[tuple[int, Any]]:
        while running:
            (done, *_), _rest = self._ray.wait(list(running))
            number = running.pop(done)
            try:
                yield number, self._ray.get(done)
            except (self._ray.exceptions.WorkerCrashedError, self._ray.exceptions.NodeDiedError) as error:
                raise EngineError(
                    f"task {number + 1} of {total} lost its worker {ATTEMPTS} times: {error}"
                ) from None
            except self._ray.exceptions.RayTaskError as error:
                raise error.as_instanceof_cause() from None


def engine_of(name: str, workers: int, address: str) -> Engine:
    """The engine of ``uuv sweep --engine``: 'local' with so many ``workers``, or 'ray' at ``address``."""
    return LocalEngine(workers) if name == "local" else RayEngine(address)


ROWS, REQUEST, RESULT = "cells.jsonl", "sweep_request.json", "sweep.json"

AgentKey = tuple[str, str]
"""(name in the table, agent)"""


def sweep(
    request: SweepRequest, engine: Engine, run_dir: Path | None, watch: EvaluationWatch
) -> tuple[dict[str, Any], Path]:
    """Begin a sweep: the ``uuv sweep --json`` document and the run folder. Whatever can be refused is refused
    before anything is written.

    Raises ConfigError, CheckpointError, RunFolderError, EngineError.
    """
    refuse_place(run_dir)
    request, named, checkpoints = resolved(request, watch)
    keys = check_rows(request, [name for name, _agent in named])
    place = run_dir or default_run_dir(f"sweep-{Path(request.world).stem}")
    folder = RunFolder(place, base_config(request), list(request.seeds))
    folder.write_json(
        REQUEST, {"schema": 1, **request.document(), "named_agents": named, "checkpoints": checkpoints}
    )
    return _run_cells(request, named, keys, engine, folder, watch), folder.path


def resume(
    place: Path, engine: Engine, watch: EvaluationWatch, allow_code: bool = False
) -> tuple[dict[str, Any], Path]:
    """Go on with a sweep that was killed or interrupted: rows that are finished stay as they are.
    ``allow_code``: Python files that the folder names may be run. Raises RunFolderError."""
    from uuvtai.evaluation.agents import load_agents
    from uuvtai.evaluation.results import refuse_others

    folder = RunFolder.held(place, "uuv sweep", REQUEST)
    try:
        try:
            document = read_json(place / REQUEST, folder=place)
            if "named_agents" not in document:
                raise TypeError("an older version of uuv wrote it; begin the sweep again")
            request, named = request_of(document), [_agent_key(pair) for pair in document["named_agents"]]
            checkpoints = dict(document["checkpoints"])
        except (FileError, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise RunFolderError(
                f"{place / REQUEST}: cannot be read ({error}); give the folder that 'uuv sweep' printed"
            ) from None
        agents = [agent for _name, agent in named]
        refuse_code(place, [*request.agents, *agents], allow_code)
        refuse_others(place, checkpoints, _sha256_of(load_agents(agents, watch.note)), "sweep")
        keys = check_rows(request, [name for name, _agent in named])
        folder.go_on({"rows": len(read_rows(place))})
        return _run_cells(request, named, keys, engine, folder, watch), place
    finally:
        folder.release()


def _agent_key(given: Any) -> AgentKey:
    """Of a request on disk. Raises TypeError, ValueError."""
    name, agent = given
    if not (isinstance(name, str) and isinstance(agent, str)):
        raise TypeError(f"{given!r:.80} is no agent")
    return name, agent


def resolved(
    request: SweepRequest, watch: EvaluationWatch
) -> tuple[SweepRequest, list[AgentKey], dict[str, str]]:
    """The request with the columns that its policies see, its agents by their names in the table, and the
    sha256 of every policy.

    Paths are made absolute. Raises ConfigError, CheckpointError.
    """
    from uuvtai.evaluation.agents import differences, load_agents, observation_of

    agents = tuple(map(_located, request.agents))
    loaded = load_agents(agents, watch.note)
    named = [(agent.name, name) for agent, name in zip(loaded, agents, strict=True)]
    request = replace(request, overrides=(*observation_of(agents), *request.overrides), agents=agents)
    cells = request.grid.cells() if request.grid.axes.keys() - SCENE_AXES else [None]
    for agent in loaded:
        changes = (differences(agent, base_config(request, cell)) for cell in cells)
        if first := next(filter(None, changes), ""):
            watch.note(f"note: {first}")
    return request, named, _sha256_of(loaded)


def _located(name: str) -> str:
    """An agent's name as a worker in any folder finds it."""
    if is_plugin(name):
        return plugin_spec(name).absolute().text
    is_folder = name not in built_in_agents() and Path(name).is_dir()
    return str(Path(name).resolve()) if is_folder or name.endswith((".xml", ".yaml", ".yml")) else name


def _sha256_of(agents: Sequence[AgentSpec]) -> dict[str, str]:
    """Of the checkpoints and of the user's own plugins, by the agent's name."""
    found = {agent.name: agent.own or agent.checkpoint for agent in agents}
    return {name: source.sha256 for name, source in found.items() if source}


def _run_cells(
    request: SweepRequest,
    named: Sequence[AgentKey],
    keys: list[str],
    engine: Engine,
    folder: RunFolder,
    watch: EvaluationWatch,
) -> dict[str, Any]:
    rows = _by_key(folder.path, request.grid)
    tasks = tasks_of(request, named, set(rows))
    watch.start(f"{len(keys)} cells", len(keys), len(rows))
    try:
        with folder.recorded():
            for number, done in engine.run(run_task, tasks):
                for row in done:
                    append_row(folder.path, row)
                    rows[row_key(_label(row, request.grid), row["agent"])] = row
                watch.note(f"{_words(tasks[number].labels[0])} .. {_words(tasks[number].labels[-1])}: done")
                watch.update(len(rows), len(keys), 0)
            document = _document(request, ordered(rows, keys))
            folder.write_json(RESULT, document)
            return document
    except KeyboardInterrupt:
        again = to_resume(folder.path, request.agents)
        watch.note(f"finished rows are kept; go on with: uuv sweep {again}")
        raise
    finally:
        watch.stop()


def _by_key(place: Path, grid: Grid) -> dict[str, Row]:
    """Rows that are finished. Raises RunFolderError for rows of another grid."""
    try:
        return {row_key(_label(row, grid), row["agent"]): row for row in read_rows(place)}
    except (KeyError, TypeError) as error:
        raise RunFolderError(
            f"{place / ROWS}: holds a row that is not of this sweep ({error!r}); take it out to go on"
        ) from None


def _label(row: Row, grid: Grid) -> dict[str, Any]:
    """Of a row that was written: what ``label_of`` gave for its cell."""
    names = ("S", "D", "v_m_s", *(name for name in grid.axes if name in row and name not in ("S", "D", "v")))
    return {name: row[name] for name in names}


def _words(label: dict[str, Any]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in label.items() if value is not None)


def _document(request: SweepRequest, rows: list[Row]) -> dict[str, Any]:
    return {
        "schema": 1,
        "world": request.world,
        "sensors": request.sensors,
        "axes": request.grid.document(),
        **({"one_at_a_time": True, "unchanged": unchanged(request)} if request.grid.one_at_a_time else {}),
        "seeds": list(request.seeds),
        "episodes_per_seed": request.episodes,
        "cells": rows,
    }


# ------------------------------------------------------------------------------------------------------- file


def append_row(place: Path, row: Row) -> None:
    """Add a row to a run folder that is held, and see it on the disk."""
    with open_to_append(place / ROWS, place) as stream:
        stream.write(json.dumps(row, allow_nan=False).encode() + b"\n")
        stream.flush()
        os.fsync(stream.fileno())


def read_rows(place: Path) -> list[Row]:
    """Rows written so far in a run folder that is held.

    A last line that a kill cut off is removed from the file, so that the next row begins a line of its own.
    """
    path = place / ROWS
    if not path.exists():
        return []
    rows: list[Row] = []
    whole, last, row = 0, 0, None
    for line in read_lines(path, folder=place):
        row = json_object(line) if line.endswith(b"\n") else None
        rows += [] if row is None else [row]
        whole, last = whole + len(line), len(line)
    if row is None and whole:
        truncate(path, whole - last, place)
    return rows
