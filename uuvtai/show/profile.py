"""A profile in the terminal: time per stage, rates, one bar per batch size, and the paper's timing tables
beside ours."""

from __future__ import annotations

from typing import Any

from rich.text import Text

from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table
from uuvtai.tables.timing_tables import density_table, latency_table
from uuvtai.tables.wording import number

_RATES = {
    "step": "random actions",
    "tree": "driven by the tree",
    "step_inference": "+ policy",
    "train": "+ training",
}
_FLAME_WIDTH = 100
_FLAME_COLORS = (
    "blue",
    "cyan",
    "green",
    "yellow",
    "magenta",
    "red",
    "bright_blue",
    "bright_cyan",
    "bright_green",
    "bright_yellow",
)


def show_profile(screen: Screen, result: dict[str, Any]) -> None:
    """Tables of a ``uuv profile --json`` document."""
    rows = result["rows"]
    machine = f"{result['machine']['cpu']}, {result['machine']['cores']} cores, {result['machine']['device']}"
    stages = list(rows[0]["stages_us_per_env_step"])
    screen.table(_by_batch_size(rows, stages, machine))
    screen.line("")
    for row in rows:
        _show_flame(screen, row)
    if result["paper_latency"]:
        _show_latency(screen, result)
    if result["paper_density"]:
        screen.line("")
        title = "loop time against moving obstacles (one env)"
        screen.table(density_table(result["paper_density"], title))


def _by_batch_size(rows: list[dict[str, Any]], stages: list[str], title: str) -> Table:
    # the largest batch is what most people come for, the first one what a vehicle would do; sizes between
    # them go first
    priorities = [0 if i == len(rows) - 1 else 1 if i == 0 else 2 for i in range(len(rows))]
    sizes = [
        Column(f"{row['num_envs']} env", priority) for row, priority in zip(rows, priorities, strict=True)
    ]
    lines = [[stage, *(f"{row['stages_us_per_env_step'][stage]:.2f}" for row in rows)] for stage in stages]
    lines += [
        [f"env-steps/s: {meaning}", *(number(row["env_steps_per_s"].get(name), 0) for row in rows)]
        for name, meaning in _RATES.items()
    ]
    lines.append(["memory MB", *(f"{row['memory_mb']:,.0f}" for row in rows)])
    lines.append(["compile s", *(f"{row['compile_s']:.1f}" for row in rows)])
    return Table([Column("us per env-step", left=True), *sizes], lines, title, sections=[len(stages) - 1])


def _show_flame(screen: Screen, row: dict[str, Any]) -> None:
    """Stages of a step as one bar, each as wide as its share of the time; a name stands where it has room."""
    stages = {name: us for name, us in row["stages_us_per_env_step"].items() if us > 0}
    total, bar, edge = sum(stages.values()), Text(), 0.0
    before, after = f"{row['num_envs']:>6} env ", f" {total:.1f} us"
    room = min(_FLAME_WIDTH, screen.console.width - len(before) - len(after))
    for (name, us), color in zip(stages.items(), _FLAME_COLORS * 2, strict=False):
        first, edge = round(room * edge / total), edge + us
        width = round(room * edge / total) - first
        bar.append((name if len(name) <= width else "").ljust(width), style=f"black on {color}")
    screen.line(Text(before).append(bar).append(after))


def _show_latency(screen: Screen, result: dict[str, Any]) -> None:
    rows = [row for row in result["paper_latency"] if row["component"] != "Replanning rate"]
    screen.line("")
    screen.table(
        latency_table(
            rows, "beside the paper's timing table (one env; theirs on a workstation with an RTX 5090)"
        )
    )
    for row in result["paper_latency"]:
        if row["component"] == "Replanning rate":
            ours = f"{row['replans_per_episode']:.1f} replans an episode, {row['hz']:.2f} Hz"
            screen.line(f"{ours} (paper: {row['paper_replans_per_episode']}, {row['paper_hz']} Hz)", "dim")
    loop = result["real_time"]
    times = ", ".join(f"{name} {loop[f'{name}_ms']:.2f}" for name in ("p50", "p99", "max"))
    verdict = f"{loop['budget_ms']:.0f} ms a step {'kept' if loop['within'] else 'NOT kept'}"
    screen.line(f"{verdict}: {times} ms; {loop['late']} of {loop['steps']} steps late")
