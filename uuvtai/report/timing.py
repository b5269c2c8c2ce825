"""Tables of a profile (the document of ``uuv profile --json``): rates, and the paper's two timing tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from uuvtai.report.blocks import Block, Figure, Paragraph
from uuvtai.report.figures import Line, curves, stages
from uuvtai.report.tables import Column, Data, Table, number

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


# ---- Blocks of ``uuv profile --json``: rates, time per stage, the paper's two timing tables beside ours.


def timing(document: dict[str, Any], command: str = "") -> list[Block]:
    machine, rows = document.get("machine", {}), document.get("rows", [])
    said = (
        f"Measured on {machine.get('cpu', 'an unnamed processor')}, {machine.get('cores', '-')} cores, "
        f"{machine.get('device', 'cpu')}."
    )
    blocks: list[Block] = [Paragraph(said)]
    if rows:
        table = Table(_RATES, rows, "Env-steps per second, resets included")
        blocks += [table, _stages_figure(rows, command)]
    if timed := [row for row in document.get("paper_latency", []) if "mean_ms" in row]:
        caption = "Beside the paper's table 'Workstation deployability timing' (its machine has an RTX 5090)"
        blocks.append(latency_table(timed, caption))
    return blocks + _density(document.get("paper_density", []), command)


_RATES = (
    ENVS,
    Column("agent", of=lambda row: str(row.get("agent", "-"))),
    Column("S", of=lambda row: str(row.get("S", "-"))),
    Column("D", of=lambda row: str(row.get("D", "-"))),
    *SPEEDS,
    Column("memory MB", of=lambda row: number(row.get("memory_mb"))),
    Column("compile s", of=lambda row: number(row.get("compile_s"))),
)


def _stages_figure(rows: list[dict[str, Any]], command: str) -> Figure:
    bars = [(f"{row['num_envs']:,} env", row["stages_us_per_env_step"]) for row in rows]
    data = Data(
        ["num_envs", "stage", "us_per_env_step"],
        [[row["num_envs"], *item] for row in rows for item in row["stages_us_per_env_step"].items()],
    )
    title = "Each batch size on its own scale" if len(bars) > 1 else ""  # they differ by orders of magnitude
    panels = [stages([bar], "" if i else title) for i, bar in enumerate(bars)]
    return Figure(
        "stages",
        panels,
        "Time per stage, the longest first; names of short stages on hover and in the data",
        data,
        command,
    )


def _density(rows: list[dict[str, Any]], command: str) -> list[Block]:
    if not rows:
        return []
    lines = [
        Line(name, [row["D"] for row in rows], [row[key] for row in rows])
        for name, key in (("here", "loop_ms"), ("paper", "paper_loop_ms"))
    ]
    panel = curves(lines, "Loop time over moving obstacles", "D", zero=True)
    caption = "Loop time [ms] over D, beside the paper's"
    return [
        Figure(
            "density",
            [panel],
            caption,
            Data(_DENSITY, [list(map(row.get, _DENSITY)) for row in rows]),
            command,
        ),
        density_table(rows, "Runtime versus obstacle density"),
    ]
