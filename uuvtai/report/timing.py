"""Blocks of a profile (the document of ``uuv profile --json``): rates, time per stage, the paper's two timing
tables beside ours."""

from __future__ import annotations

from typing import Any

from uuvtai.report.blocks import Block, Data, Figure, Panel, Prose, Table
from uuvtai.report.figures import Line, curves, stages
from uuvtai.report.wording import number


def timing(document: dict[str, Any], command: str = "") -> list[Block]:
    """Everything that a profile has to show."""
    machine, rows = document.get("machine", {}), document.get("rows", [])
    said = (
        f"Measured on {machine.get('cpu', 'an unnamed processor')}, {machine.get('cores', '-')} cores, "
        f"{machine.get('device', 'cpu')}."
    )
    blocks: list[Block] = [Prose(said)]
    if rows:
        blocks += [_rates_table(rows), _stages_figure(rows, command)]
    blocks += _latency(document.get("paper_latency", []))
    return blocks + _density(document.get("paper_density", []), command)


def _rates_table(rows: list[dict[str, Any]]) -> Table:
    columns = [
        "envs",
        "controller",
        "S",
        "D",
        "env-steps/s",
        "+ inference",
        "+ training",
        "memory MB",
        "compile s",
    ]
    shown = []
    for row in rows:
        rates = row["env_steps_per_s"]
        speeds = [number(rates.get(name), 0) for name in ("step", "step_inference", "train")]
        scene = [str(row.get(name, "-")) for name in ("controller", "S", "D")]
        shown.append(
            [
                number(row["num_envs"], 0),
                *scene,
                *speeds,
                number(row.get("memory_mb")),
                number(row.get("compile_s")),
            ]
        )
    return Table(columns, shown, "Env-steps per second, resets included")


def _stages_figure(rows: list[dict[str, Any]], command: str) -> Figure:
    bars = [(f"{row['num_envs']:,} env", row["stages_us_per_env_step"]) for row in rows]
    data = Data(
        ["num_envs", "stage", "us_per_env_step"],
        [[row["num_envs"], *item] for row in rows for item in row["stages_us_per_env_step"].items()],
    )
    panels = [_alone(bar, i, len(bars)) for i, bar in enumerate(bars)]
    return Figure(
        "stages",
        panels,
        "Time per stage, the longest first; names of short stages on hover and in the data",
        data,
        command,
    )


def _alone(bar: tuple[str, dict[str, float]], i: int, n_bars: int) -> Panel:
    """Batch sizes differ by orders of magnitude: each bar has its own scale."""
    return stages([bar], "" if i or n_bars < 2 else "Each batch size on its own scale")


def _latency(rows: list[dict[str, Any]]) -> list[Block]:
    timed = [row for row in rows if "mean_ms" in row]
    if not timed:
        return []
    keys = ("mean_ms", "max_ms", "paper_mean_ms", "paper_max_ms")
    shown = [[str(row["component"]), *(number(row.get(key), 3) for key in keys)] for row in timed]
    data = Data(["component", *keys], [[row["component"], *(row.get(key) for key in keys)] for row in timed])
    columns = ["component", "mean ms", "max ms", "paper: mean ms", "paper: max ms"]
    caption = "Beside the paper's table 'Workstation deployability timing' (its machine has an RTX 5090)"
    return [Table(columns, shown, caption, data=data)]


def _density(rows: list[dict[str, Any]], command: str) -> list[Block]:
    if not rows:
        return []
    keys = ("D", "loop_ms", "replans_per_episode", "paper_loop_ms", "paper_replans")
    data = Data(keys, [[row.get(key) for key in keys] for row in rows])
    lines = [
        Line(name, [row["D"] for row in rows], [row[key] for row in rows])
        for name, key in (("here", "loop_ms"), ("paper", "paper_loop_ms"))
    ]
    panel = curves(lines, "Loop time over moving obstacles", "D", zero=True)
    shown = [[number(row.get(key), 0 if key == "D" else 2) for key in keys] for row in rows]
    columns = ["D", "loop ms", "replans an episode", "paper: loop ms", "paper: replans"]
    return [
        Figure("density", [panel], "Loop time [ms] over D, beside the paper's", data, command),
        Table(columns, shown, "Runtime versus obstacle density"),
    ]
