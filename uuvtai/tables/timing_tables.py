"""Tables of a profile (the document of ``uuv profile --json``): rates, and the paper's two timing tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from uuvtai.tables.table import Column, Data, Table
from uuvtai.tables.wording import number

_LATENCY = ("mean_ms", "max_ms", "paper_mean_ms", "paper_max_ms")
_DENSITY = ("D", "loop_ms", "replans_per_episode", "paper_loop_ms", "paper_replans")


def _of(key: str, digits: int) -> Callable[[dict[str, Any]], str]:
    return lambda row: number(row.get(key), digits)


def _speed(name: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: number(row["env_steps_per_s"].get(name), 0)


ENVS = Column("envs", left=True, of=_of("num_envs", 0))
SPEEDS = (
    Column("env-steps/s", of=_speed("step")),
    Column("+ inference", of=_speed("step_inference")),
    Column("+ training", of=_speed("train")),
)


def latency_table(rows: list[dict[str, Any]], title: str) -> Table:
    """Mean and longest time of each component [ms], beside the paper's."""
    columns = (
        Column("component", left=True, of=lambda row: str(row["component"])),
        Column("mean ms", of=_of("mean_ms", 3)),
        Column("max ms", 1, of=_of("max_ms", 3)),
        Column("paper: mean ms", short="paper\nmean ms", of=_of("paper_mean_ms", 3)),
        Column("paper: max ms", 1, short="paper\nmax ms", of=_of("paper_max_ms", 3)),
    )
    data = Data(("component", *_LATENCY), [[row["component"], *map(row.get, _LATENCY)] for row in rows])
    return Table(columns, rows, title, data=data)


def density_table(rows: list[dict[str, Any]], title: str) -> Table:
    """Time of a loop [ms] and replans against the number of moving obstacles, beside the paper's."""
    columns = (
        Column("D", of=_of("D", 0)),
        Column("loop ms", of=_of("loop_ms", 2)),
        Column("paper: loop ms", short="paper ms", of=_of("paper_loop_ms", 1)),
        Column("replans an episode", 1, short="replans an\nepisode", of=_of("replans_per_episode", 1)),
        Column("paper: replans", 1, short="paper\nreplans", of=_of("paper_replans", 1)),
    )
    return Table(columns, rows, title)


def density_data(rows: list[dict[str, Any]]) -> Data:
    """The numbers of a density table."""
    return Data(_DENSITY, [list(map(row.get, _DENSITY)) for row in rows])
