"""The tables of ``docs/sitl.md``, from the newest results of the benchmarks ``closed_loop``, ``ardusub``."""

from __future__ import annotations

from typing import Any

from docs.writers.figure_sources import SourceError, Sources
from uuvtai.statistics import mcnemar_p
from uuvtai.tables.table import text_table


def real_ardusub(sources: Sources) -> str:
    """What ArduSub itself did in our water."""
    rows = sources.benchmark("ardusub")["rows"]
    cells = [[row["what"], _result(row), row["note"]] for row in rows]
    return text_table(["tried", "result", "more"], cells)


def _result(row: dict[str, Any]) -> str:
    if row["unit"] == "1 = yes":
        return "yes" if row["ours"] else "no"
    return f"{row['ours']:.3g} {row['unit']}"


def closed_loop(sources: Sources) -> str:
    """The same episodes by the interfaces and in the simulator's own loop, paired."""
    rows = sources.benchmark("closed_loop")["rows"]
    if len(rows) != 2:
        raise SourceError(f"the benchmark closed_loop has {len(rows)} rows, not two")
    arrived = [[end == "success" for end in row["details"]["endings"]] for row in rows]
    pairs = list(zip(*arrived, strict=True))
    first, second = (sum(pair == kind for pair in pairs) for kind in ((True, False), (False, True)))
    p = mcnemar_p(first, second)
    told = [f"only this arrives: {first}, only the other: {second}; exact McNemar p {p:.2g}", ""]
    cells = [
        [row["what"].removeprefix("closed loop, "), f"{row['ours']:.1f} %", row["note"], more]
        for row, more in zip(rows, told, strict=True)
    ]
    return text_table(["driven", "success", "of episodes [95 %], and the others", "paired"], cells)
