"""The table of ``docs/cuda.md``: CUDA without a GPU, as ``benchmarks/rehearsal.py`` left it."""

from __future__ import annotations

from docs.writers.figure_sources import Sources
from uuvtai.tables.table import text_table


def rehearsal(sources: Sources) -> str:
    """What was assembled, counted and compared, and the MODEL of its speed."""
    rows = [
        [
            row["what"],
            "not done" if row["ours"] is None else f"{row['ours']:,.0f} {row['unit']}".strip(),
            row["note"],
        ]
        for row in sources.benchmark("rehearsal")["rows"]
    ]
    return text_table(["what", "result", "more"], rows)
