"""Table of what each of the tree's numbers does, from many episodes in which all were changed at once."""

from __future__ import annotations

from docs.writers.figure_sources import Sources
from uuvtai.tables.table import text_table

FILE = "docs/data/tuner_slopes.json"
SHOWN = 2.0
"""standard errors from which a number is in the table, in either world"""


def tuner_slopes(sources: Sources) -> str:
    """Numbers whose effect is larger than chance, the strongest first."""
    found = [
        row
        for row in sources.json(FILE)["rows"]
        if max(abs(row[world]["points"]) / row[world]["se"] for world in ("gauntlet", "pool")) >= SHOWN
    ]
    found.sort(key=lambda row: -abs(row["gauntlet"]["points"]) / row["gauntlet"]["se"])
    rows = [
        [
            f"`{row['number']}`",
            f"{row['least']:g} .. {row['most']:g}",
            *(f"{row[world]['points']:+.1f} ± {row[world]['se']:.1f}" for world in ("gauntlet", "pool")),
            *(f"{row[world]['seconds']:+.1f} s" for world in ("gauntlet", "pool")),
        ]
        for row in found
    ]
    head = [
        "number of `teacher`",
        "tried",
        "gauntlet: points",
        "pool: points",
        "gauntlet: time",
        "pool: time",
    ]
    return text_table(head, rows)


SLOPES_FILE = "docs/data/fast_slopes.json"


def fast_slopes(sources: Sources) -> str:
    """Numbers of the search among fast bodies whose effect is larger than chance, the strongest first."""
    found = [
        row
        for row in sources.json(SLOPES_FILE)["rows"]
        if max(abs(row[world]["points"]) / row[world]["se"] for world in ("gauntlet", "pool")) >= SHOWN
    ]
    found.sort(key=lambda row: -abs(row["both"]["points"]) / row["both"]["se"])
    rows = [
        [f"`{row['number']}`", f"{row['usual']:g}", f"x {row['factor']:.2f}"]
        + [f"{row[world]['points']:+.1f} ± {row[world]['se']:.1f}" for world in ("gauntlet", "pool")]
        for row in found
    ]
    return text_table(["number of `teacher`", "usual", "a step up", "gauntlet: points", "pool: points"], rows)
