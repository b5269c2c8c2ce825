"""Table of what each of the tree's numbers does, from many episodes in which all were changed at once."""

from __future__ import annotations

from docs.writers.figure_sources import Sources
from uuvtai.statistics import mcnemar_p
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


FAST_FILE = "docs/data/fast_trials.json"


def fast_trials(sources: Sources) -> str:
    """Factors among fast bodies, each beside the tree without them on the same episodes."""
    document = sources.json(FAST_FILE)
    kept = {(row["pilot"], row["cell"], row["seed"]): row for row in document["rows"]}
    rows = []
    for pilot, cell in dict.fromkeys((pilot, cell) for pilot, cell, _seed in kept if pilot != "bt"):
        seeds = [seed for name, where, seed in kept if (name, where) == (pilot, cell)]
        pairs = [(kept["bt", cell, seed], kept[pilot, cell, seed]) for seed in seeds]
        ends = [pair for a, b in pairs for pair in zip(a["outcomes"], b["outcomes"], strict=True)]
        times = [pair for a, b in pairs for pair in zip(a["times_s"], b["times_s"], strict=True)]
        lost, won = (sum(a == "s" != b for a, b in pair) for pair in (ends, [e[::-1] for e in ends]))
        both = [pair for pair, end in zip(times, ends, strict=True) if end == ("s", "s")]
        means = [sum(column) / len(both) for column in zip(*both, strict=True)]
        rows.append(
            [
                pilot,
                document["cells"][cell],
                ", ".join(map(str, seeds)),
                *(_rates([end[who] for end in ends]) for who in (0, 1)),
                f"+{won} -{lost}, p = {mcnemar_p(won, lost):.2g}",
                f"{means[0]:.1f}, {means[1]:.1f} s",
            ]
        )
    head = ["pilot", "world (S, D, v in m/s)", "seeds", "`bt`", "pilot", "gains, losses, McNemar's p"]
    return text_table([*head, "time where both arrive"], rows)


def _rates(ends: list[str]) -> str:
    """Success / collision in %."""
    share = 100 / len(ends)
    return f"{share * ends.count('s'):.1f} / {share * sum(end in 'cxo' for end in ends):.1f}"


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


def fast_curve(sources: Sources) -> str:
    """Arrivals of the search's trials, before the numbers were moved for the first time and since."""
    curve = sources.json(SLOPES_FILE)["curve"]
    rows = []
    for first, last in ((1, 15), (16, 18), (19, curve[-1]["iteration"])):
        cells = []
        for world in ("gauntlet", "pool"):
            found = [row for row in curve if row["world"] == world and first <= row["iteration"] <= last]
            arrived = sum(row["arrived"] for row in found) / (512 * len(found))
            cells.append(f"{100 * arrived:.1f} %, {sum(row['seconds'] for row in found) / len(found):.1f} s")
        rows.append([f"{first} to {last}", *cells])
    return text_table(["iterations", "gauntlet (8, 9, 1.5)", "pool (8, 9, 1.5)"], rows)
