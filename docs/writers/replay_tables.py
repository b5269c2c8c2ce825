"""The tables of ``docs/replay.md``, from the newest results of the benchmarks ``replay`` and ``lossy``."""

from __future__ import annotations

import re

from docs.writers.figure_sources import SourceError, Sources
from uuvtai.tables.table import text_table


def replayed(sources: Sources) -> str:
    """Undisturbed: how many commands and logs are equal, and what a step takes."""
    pattern = re.compile(
        r"(\d+) of (\d+) logs equal in every step, ([\d,]+) steps; "
        r"a step takes ([\d.]+) ms, 99 %: ([\d.]+) ms; "
        r"log (\d+) kB/s, of which instruments ([\d.]+); exact images (\d+) beside"
    )
    rows = []
    for row in sources.benchmark("replay")["rows"]:
        if row["what"].startswith("replayed, "):
            continue
        found = pattern.fullmatch(row["note"])
        if not found:
            raise SourceError(f"{row['what']!r}: the note says something else: {row['note']!r}")
        equal, logs, steps, median, tail, log, instruments, images = found.groups()
        cells = [f"{equal} of {logs}", steps, f"{row['ours']:.1f} %", f"{median} / {tail}"]
        rows.append([re.sub(r", \d+ logs$", "", row["what"]), *cells, f"{log} / {instruments} / {images}"])
    head = [
        "world, sensing",
        "logs equal in every step",
        "steps",
        "commands equal",
        "ms a step: median / 99 %",
    ]
    return text_table([*head, "kB/s: log / instruments in it / exact images beside"], rows)


def changed(sources: Sources) -> str:
    """Replayed under faults: the logged vehicle drives its own way."""
    rows = [
        [row["what"].removeprefix("replayed, "), f"{row['ours']:.1f} %", row["note"]]
        for row in sources.benchmark("replay")["rows"]
        if row["what"].startswith("replayed, ")
    ]
    return text_table(["fault", "commands more than 0.1 off", "beside"], rows)


def lossy(sources: Sources) -> str:
    """Driven under faults, to the end."""
    rows = [
        [row["what"].removeprefix("driven, "), f"{row['ours']:.1f} %", row["note"]]
        for row in sources.benchmark("lossy")["rows"]
    ]
    return text_table(["fault", "success", "of episodes [95 %], and beside"], rows)
