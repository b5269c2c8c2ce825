"""The table of ``docs/sonars.md``: the tree with each kind of sonar, from ``docs/data/sonars_77001.json``."""

from __future__ import annotations

from typing import Any

from docs.writers.figure_sources import Counts, Sources, rated, share
from docs.writers.pieces import LETTERS
from docs.writers.sonar_trials import CELLS, FILE, KINDS
from uuvtai.statistics import mcnemar_p
from uuvtai.tables.table import text_table

_SHOWN_CAUSES = 3


def sonars(sources: Sources) -> str:
    """A row for each sonar and scene: rates with intervals, time, against the first sonar on the same
    episodes, and the most frequent causes; of those that were played."""
    played = {(row["sonar"], row["cell"]): row for row in sources.json(FILE)["rows"]}
    rows = [
        _row(played[kind.title, cell], played[KINDS[0].title, cell])
        for cell, _options in CELLS
        for kind in KINDS
        if (kind.title, cell) in played
    ]
    head = ["sonar", "world (S, D, v in m/s)", "success", "collision", "time to goal"]
    head += ["only the first, only this arrives; exact McNemar p", "most frequent causes of failure"]
    return text_table(head, rows)


def _row(own: dict[str, Any], first: dict[str, Any]) -> list[str]:
    outcomes = own["outcomes"]
    counts = Counts(len(outcomes), {name: outcomes.count(letter) for name, letter in LETTERS.items()})
    arrived = [t for t, outcome in zip(own["times_s"], outcomes, strict=True) if outcome == "s"]
    causes = sorted(own["causes"].items(), key=lambda cause: -cause[1])[:_SHOWN_CAUSES]
    return [
        own["sonar"],
        f"`{own['cell']}`",
        share(counts, "success"),
        rated(counts, "collision"),
        f"{sum(arrived) / max(1, len(arrived)):.1f} s",
        "" if own is first else _beside(first["outcomes"], outcomes),
        ", ".join(f"{label} {count}" for label, count in causes),
    ]


def _beside(first: str, own: str) -> str:
    pairs = list(zip(first, own, strict=False))  # a row of fewer episodes has the first of them
    only = [sum(a == "s" != b for a, b in pairs), sum(b == "s" != a for a, b in pairs)]
    return f"{only[0]}, {only[1]}; {mcnemar_p(*only):.2g}"
