"""Where figures in the text come from: committed results, read by a path such as
``evaluations.pool_6.bt.success_rate``.

=========================================
===========================================================================================
``evaluations.ROW.METHOD.FIELD``           ``docs/data/evaluations_SEED.json`` (the one that
``docs/data/shown.json`` names)
``evaluations.seed``                       the seed of those
``sweep.NAME[METHOD;AXIS<=VALUE].FIELD``   ``docs/data/sweep_NAME.csv``, the cells that fit, pooled;
``sweep.NAME.about.KEY``: its entry
                                           in ``docs/data/sweeps.json``
``bench.WHAT[TEXT].FIELD``                 newest ``benchmarks/results/*_WHAT.json``: the one row whose
``what`` holds TEXT (commas part
                                           several texts); without brackets a list, for ``min(...)`` and
                                           ``max(...)``; FIELD may be ``note/PATTERN/``, a number within the
                                           note
``own_pieces.ROW.FIELD``                   ``docs/data/own_pieces.json``
``paper.NAME``                             what the paper prints: a constant of
``uuvtai/measure/reproduce/paper.py``
=========================================
===========================================================================================

FIELD of counts is ``success``, ``episodes``, ``success_rate``, ``success_low``, ``success_high``, the same of
``collision`` and of each ending, ``success_of`` ("490/500"), ``time_s`` (mean of the successes); of a sweep
also ``cells``, ``spotless`` (cells without a collision) and ``weighted_success_rate`` (as the paper's 40
conditions). The condition ``moderate`` stands for those over which the paper gives means.
"""

from __future__ import annotations

import csv
import json
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uuvtai.measure.reproduce import paper
from uuvtai.outcomes import COLLIDED
from uuvtai.statistics import wilson_interval

ROOT = Path(__file__).resolve().parents[2]
COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {"<=": operator.le, ">=": operator.ge, "=": operator.eq}
_CELL_COUNTS = {
    "success": "success",
    "contact": "collision",
    "ttc_stop": "ttc",
    "out_of_tank": "out_of_tank",
    "timeout": "timeout",
}
"""columns of a sweep's CSV and the endings that they count"""


class SourceError(LookupError):
    """A path names nothing; says what there is."""


@dataclass(frozen=True)
class Counts:
    """How often each ending occurred; None = it was not kept."""

    episodes: int
    outcomes: dict[str, int | None]
    time_s: float | None = None

    def count(self, name: str) -> int:
        """Episodes of one ending, or of all collisions; raises SourceError where they are not known."""
        found = [self.outcomes.get(part) for part in (COLLIDED if name == "collided" else (name,))]
        if any(k is None for k in found):
            raise SourceError(f"the counts of {name!r} were not kept")
        return sum(k for k in found if k is not None)

    def field(self, name: str) -> Any:
        """One FIELD (see above)."""
        if name == "episodes":
            return self.episodes
        if name == "time_s":
            if self.time_s is None:
                raise SourceError("the times were not kept")
            return self.time_s
        ending, _, kind = (
            name.partition("_") if not name.startswith("out_of_tank") else ("out_of_tank", "", name[12:])
        )
        ending = {"collision": "collided", "contact": "collision"}.get(ending, ending)
        k = self.count(ending)
        interval = wilson_interval(k, self.episodes) or (0.0, 1.0)
        values = {
            "": k,
            "rate": k / self.episodes,
            "low": interval[0],
            "high": interval[1],
            "of": f"{k}/{self.episodes}",
        }
        if kind not in values:
            raise SourceError(f"no field {name!r}")
        return values[kind]


# ------------------------------------------------------------------------------------------------------ files


class Sources:
    """All committed results of a checkout; each file is read once."""

    def __init__(self, root: Path = ROOT) -> None:
        self.root = root
        self._read: dict[Path, Any] = {}

    def json(self, place: str) -> Any:
        """A JSON file of the checkout."""
        path = self.root / place
        if path not in self._read:
            self._read[path] = json.loads(path.read_text(encoding="utf-8"))
        return self._read[path]

    def evaluations(self) -> dict[str, Any]:
        """The evaluations that README shows."""
        return self.json(f"docs/data/{self.json('docs/data/shown.json')['evaluations']}")

    def pieces(self) -> dict[str, Any]:
        """The pilot with each piece off, as ``docs/tuning.md`` shows it."""
        return self.json(f"docs/data/{self.json('docs/data/shown.json')['pieces']}")

    def own_pieces(self) -> dict[str, Any]:
        """Pieces of a user's beside the tree, as ``docs/own_pieces.md`` shows them."""
        return self.json("docs/data/own_pieces.json")

    def evaluation(self, row: str, method: str) -> Counts:
        """One method in one row of the evaluations."""
        rows = {entry["name"]: entry for entry in self.evaluations()["rows"]}
        entry = _pick(_pick(rows, row, "row")["methods"], method, "method")
        return Counts(entry["episodes"], entry["outcomes"], entry.get("time_to_success_mean_s"))

    def cells(self, name: str) -> list[dict[str, str]]:
        """Rows of a sweep's CSV."""
        path = self.root / f"docs/data/sweep_{name}.csv"
        if path not in self._read:
            if not path.exists():
                raise SourceError(f"no sweep {name!r}")
            with path.open(encoding="utf-8", newline="") as file:
                self._read[path] = list(csv.DictReader(file))
        return self._read[path]

    def benchmark(self, what: str) -> dict[str, Any]:
        """The newest results of a benchmark."""
        found = sorted((self.root / "benchmarks/results").glob(f"????-??-??_*_{what}.json"))
        if not found:
            raise SourceError(f"no results of benchmark {what!r}")
        return self.json(str(found[-1].relative_to(self.root)))

    # -------------------------------------------------------------------------------------------------- paths

    def value(self, expression: str) -> Any:
        """What an expression stands for: a path, or ``min(path)``, ``max(path)`` of a list. Raises
        SourceError."""
        if call := re.fullmatch(r"(min|max)\((.+)\)", expression):
            return {"min": min, "max": max}[call[1]](self.value(call[2]))
        kind, _, rest = expression.partition(".")
        readers = {
            "evaluations": self._of_evaluations,
            "own_pieces": self._of_own_pieces,
            "sweep": self._of_sweep,
            "bench": self._of_benchmark,
            "paper": _of_paper,
        }
        if kind not in readers:
            raise SourceError(f"{expression!r}: begins with none of {', '.join(readers)}")
        try:
            return readers[kind](rest)
        except SourceError as error:
            raise SourceError(f"{expression!r}: {error}") from None

    def _of_evaluations(self, path: str) -> Any:
        parts = path.split(".")
        if len(parts) == 1:
            return _pick(self.evaluations(), parts[0], "entry")
        row, method, field = parts
        if "/" in method:  # a paired comparison: pool_0.bt/straight.time_ratio
            a, _, b = method.partition("/")
            return self._paired(row, a, b, field)
        return self.evaluation(row, method).field(field)

    def _paired(self, row: str, a: str, b: str, field: str) -> Any:
        rows = {entry["name"]: entry for entry in self.evaluations()["rows"]}
        for pair in _pick(rows, row, "row").get("paired", []):
            if (pair["a"], pair["b"]) == (a, b):
                return _pick(pair, field, "field")
        raise SourceError(f"no pair {a}/{b} in row {row!r}")

    def _of_sweep(self, path: str) -> Any:
        if about := re.fullmatch(r"(\w+)\.about\.(\w+)", path):
            return _pick(_pick(self.json("docs/data/sweeps.json"), about[1], "sweep"), about[2], "entry")
        parts = re.fullmatch(r"(\w+)\[([^\]]*)\]\.(\w+)", path)
        if not parts:
            raise SourceError("wanted: sweep.NAME[METHOD;AXIS<=VALUE;...].FIELD")
        cells = fitting(self.cells(parts[1]), parts[2].split(";"))
        if parts[3] == "cells":
            return len(cells)
        if parts[3] == "spotless":
            return sum(pooled([cell]).count("collided") == 0 for cell in cells)
        if parts[3].startswith("weighted_"):
            return weighted(cells).field(parts[3].removeprefix("weighted_"))
        return pooled(cells).field(parts[3])

    def _of_own_pieces(self, path: str) -> Any:
        name, _, field = path.partition(".")
        rows = {entry["name"]: entry for entry in self.own_pieces()["methods"]}
        entry = _pick(rows, name, "row")
        return Counts(entry["episodes"], entry["outcomes"], entry["time_to_success_mean_s"]).field(field)

    def _of_benchmark(self, path: str) -> Any:
        parts = re.fullmatch(r"(\w+)(?:\[([^\]]*)\])?\.(\w+)(?:/(.+)/)?", path)
        if not parts:
            raise SourceError("wanted: bench.WHAT[TEXT].FIELD")
        rows = self.benchmark(parts[1])["rows"]
        if parts[2] is None:
            return [row[parts[3]] for row in rows if row[parts[3]] is not None]
        texts = [text.strip() for text in parts[2].split(",")]
        found = [row for row in rows if all(text in f"{row['what']} | {row['peer_name']}" for text in texts)]
        if len(found) != 1:
            raise SourceError(
                f"{len(found)} rows hold {parts[2]!r}; there are {[row['what'] for row in rows]}"
            )
        value = _pick({**found[0], **found[0]["details"]}, parts[3], "field")
        return value if parts[4] is None else _searched(parts[4], str(value))


def _pick(entries: dict[str, Any], name: str, noun: str) -> Any:
    if name not in entries:
        raise SourceError(f"no {noun} {name!r}; there are {', '.join(map(str, entries))}")
    return entries[name]


def _searched(pattern: str, text: str) -> float:
    """The number that the pattern's group finds."""
    found = re.search(pattern, text)
    if not found:
        raise SourceError(f"{pattern!r} is not in {text!r}")
    return float(found[1])


def _of_paper(name: str) -> Any:
    if not hasattr(paper, name):
        raise SourceError(f"uuvtai/measure/reproduce/paper.py has no {name}")
    return getattr(paper, name)


# ------------------------------------------------------------------------------------------------------ cells


MODERATE = ("S<=8", "D<=9", "v_m_s<=1.5")
"""the conditions over which the paper gives means; ``moderate`` in a path"""


def fitting(cells: Sequence[dict[str, str]], conditions: Sequence[str]) -> list[dict[str, str]]:
    """Cells that meet every condition: a method's name, or ``AXIS<=VALUE``, ``AXIS>=VALUE``, ``AXIS=VALUE``.

    An empty cell (nothing moves, nothing is changed) is small: it meets every ``<=``. ``AXIS=`` asks for an
    empty one.
    """
    wanted = [
        part
        for condition in conditions
        for part in (MODERATE if condition == "moderate" else (condition,))
        if part
    ]
    found = [cell for cell in cells if all(_meets(cell, condition) for condition in wanted)]
    if not found:
        raise SourceError(f"no cell meets {'; '.join(conditions)}")
    return found


def _meets(cell: dict[str, str], condition: str) -> bool:
    parts = re.fullmatch(r"([\w.]+)(<=|>=|=)(.*)", condition)
    if not parts:
        return cell["method"] == condition
    axis, sign, wanted = parts[1], parts[2], parts[3]
    held = _pick(cell, axis, "axis")
    if sign == "=":
        return held == wanted
    return sign == "<=" if held == "" else COMPARISONS[sign](float(held), float(wanted))


def pooled(cells: Sequence[dict[str, str]]) -> Counts:
    """All episodes of these cells together; the time is the mean over their successes."""
    outcomes: dict[str, int | None] = {
        ending: sum(int(cell[column]) for cell in cells) for column, ending in _CELL_COUNTS.items()
    }
    arrived = [
        (int(cell["success"]), float(cell["time_to_success_mean_s"]))
        for cell in cells
        if cell["time_to_success_mean_s"]
    ]
    n = sum(k for k, _ in arrived)
    return Counts(
        sum(int(cell["episodes"]) for cell in cells),
        outcomes,
        sum(k * t for k, t in arrived) / n if n else None,
    )


def weighted(cells: Sequence[dict[str, str]]) -> Counts:
    """Pooled with a cell in which nothing moves counted once per speed, which makes the paper's 40 conditions
    of our 32."""
    speeds = len({cell["v_m_s"] for cell in cells if cell["v_m_s"]})
    return pooled([cell for cell in cells for _ in range(1 if cell["v_m_s"] else speeds)])


def share(counts: Counts, ending: str) -> str:
    """'490/500 = 98.0 % [96.3, 98.9]'."""
    return f"{counts.field(ending + '_of')} = {rated(counts, ending)}"


def rated(counts: Counts, ending: str) -> str:
    """'98.0 % [96.3, 98.9]': rate and 95 % Wilson interval."""
    low, high = (100 * counts.field(f"{ending}_{end}") for end in ("low", "high"))
    return f"{100 * counts.field(ending + '_rate'):.1f} % [{low:.1f}, {high:.1f}]"
