"""The tables of ``docs/simulator.md`` on the estimated pose, from ``docs/data/pose_77002.json``."""

from __future__ import annotations

from scipy.stats import chi2

from docs.writers.figure_sources import Sources
from docs.writers.pieces import LETTERS
from uuvtai.outcomes import COLLIDED
from uuvtai.statistics import mcnemar_p
from uuvtai.tables.table import text_table

_KEPT = "docs/data/pose_77002.json"


def pose_endings(sources: Sources) -> str:
    """Success and collision with the estimated pose, now and by the code of the commit before, paired."""
    kept = sources.json(_KEPT)
    earlier = kept.get("before", {"outcomes": {}})["outcomes"]
    rows = []
    for row in kept["rows"]:
        own, then = row["outcomes"], earlier.get(row["sensors"], "")
        pairs = list(zip(own, then, strict=False))
        won, lost = sum(a == "s" != b for a, b in pairs), sum(b == "s" != a for a, b in pairs)
        against = f"{_rates(then)} (+{won} -{lost}, p = {mcnemar_p(won, lost):.2g})" if then else "-"
        rows.append([f"`{row['sensors']}`", _rates(own), against])
    return text_table(["sensing", "success / collision, %", "the filter before"], rows)


def _rates(outcomes: str) -> str:
    collided = sum(outcomes.count(LETTERS[ending]) for ending in COLLIDED)
    return f"{100 * outcomes.count('s') / len(outcomes):.1f} / {100 * collided / len(outcomes):.1f}"


def pose_errors(sources: Sources) -> str:
    """Normalised squared errors with the 95 % bounds of their mean, and root mean squares, by age of the
    episode."""
    head = [
        "sensing, age",
        "NEES of x, y, heading [95 %]",
        "NEES of depth [95 %]",
        "place",
        "depth",
        "heading",
        "velocity",
    ]
    rows = []
    for row in sources.json(_KEPT)["rows"]:
        for age, found in row["moments"].items():
            rows.append(
                [
                    f"`{row['sensors']}`, {age}",
                    f"{found['nees']:.2f} {_bounds(3, found['episodes'])}",
                    f"{found['nees_z']:.2f} {_bounds(1, found['episodes'])}",
                    f"{found['place_mm']:.1f} mm",
                    f"{found['depth_mm']:.1f} mm",
                    f"{found['heading_mrad']:.2f} mrad",
                    f"{found['speed_mm_s']:.0f} mm/s",
                ]
            )
    return text_table(head, rows)


def _bounds(dof: int, n: int) -> str:
    low, high = chi2.ppf([0.025, 0.975], dof * n) / n
    return f"[{low:.2f}, {high:.2f}]"
