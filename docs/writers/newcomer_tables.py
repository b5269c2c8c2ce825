"""The tables of ``docs/newcomer.md``, from the newest results of the benchmark ``newcomer``."""

from __future__ import annotations

from typing import Any

from docs.writers.figure_sources import Sources
from uuvtai.tables.table import text_table

_ZERO = (
    ("environment", "python3 -m venv"),
    ("torch", 'pip install "torch'),
    ("uuvtai and what it needs", "pip install uuvtai"),
    ("examples", "uuv examples"),
    ("table, logs, pictures, report", "uuv eval --planner examples/own_astar.py"),
)
"""(what, how the line begins)"""


def newcomer_zero(sources: Sources) -> str:
    """From nothing to the first paired table."""
    rows = sources.benchmark("newcomer")["rows"]
    took = [
        next(row["ours"] for row in rows if row["details"]["line"].startswith(begin)) for _, begin in _ZERO
    ]
    cells = [[what, f"{seconds:.0f} s"] for (what, _), seconds in zip(_ZERO, took, strict=True)]
    return text_table(["from nothing", "took"], [*cells, ["in all", f"{sum(took) / 60:.1f} min"]])


def newcomer(sources: Sources) -> str:
    """Every line that was pasted, what it took and what it left."""
    rows = sources.benchmark("newcomer")["rows"]
    return text_table(["page", "line", "took", "threads", "left"], [_cells(row) for row in rows])


def _cells(row: dict[str, Any]) -> list[str]:
    told = row["details"]
    page = told["page"] if told["page"] in ("begin", "examples") else f"[{told['page']}]({told['page']}.md)"
    left = told["left"] if told["code"] == 0 else f"exit code {told['code']}"
    return [page, f"`{told['line']}`".replace("|", "\\|"), f"{row['ours']:.0f} s", told["threads"], left]
