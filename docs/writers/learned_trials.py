"""Play the stack ``best`` beside the tree that it grew from: ``python -m docs.writers.learned_trials``.

Each cell is one ``uuv eval`` in a process of its own. ``docs/data/learned_90008.json`` holds the outcome and
the time of every episode, by both; a second start plays what is missing. ``docs/learning.md`` shows the
table.
"""

from __future__ import annotations

import argparse
import itertools
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from docs.writers.evaluations import commit_of_package
from docs.writers.figure_sources import ROOT, Sources
from docs.writers.pieces import LETTERS
from docs.writers.sonar_trials import document_at, play
from uuvtai.run_folder import hardware, write_atomic
from uuvtai.statistics import bootstrap_interval, mcnemar_p
from uuvtai.tables.table import text_table

FILE = "docs/data/learned_90008.json"
BEFORE_FILES = {
    "until 25 November": "docs/data/learned_90008_first.json",
    "depth on arrival as in `bt`": "docs/data/learned_90008_second.json",
    "on arrival deep among fast bodies, too": "docs/data/learned_90008_third.json",
}
"""the stacks that were ``best`` before, on these episodes; the third was not played in all of them"""
TRIALS_FILE = "docs/data/stack_trials.json"
SEED, EPISODES = 90008, 1000
FRESH_FILE, FRESH_SEED = "docs/data/learned_77909.json", 77909
"""episodes that no stack had met,"""
FRESH_CELLS = 6
"""in the first of the cells"""
CONDITION_EPISODES = 64
"""of each of the paper's conditions"""
PAPER = "the paper's conditions"


@dataclass(frozen=True)
class LearnedCell:
    """One ``uuv eval``; cells of the same title are one row of the table."""

    title: str
    """Markdown"""
    options: str
    """of ``uuv eval``"""
    episodes: int = EPISODES


_SLOW, _FAST = "-S 8 -D 6 -v 0.6", "-S 8 -D 9 -v 1.5"
_NOMINAL = "nominal sensing, position estimated"
CELLS = (
    LearnedCell("gauntlet (8, 9, 1.5)", f"--world gauntlet {_FAST}"),
    LearnedCell("pool (8, 9, 1.5)", f"--world pool {_FAST}"),
    LearnedCell("pool (8, 6, 0.6)", f"--world pool {_SLOW}"),
    LearnedCell("maze (8, 6, 0.6)", f"--world maze {_SLOW}"),
    LearnedCell("netpen", "--world netpen"),
    LearnedCell("transfer", "--world transfer"),
    LearnedCell(f"pool (8, 6, 0.6), {_NOMINAL}", f"--world pool {_SLOW} --sensors nominal"),
    LearnedCell(f"pool (8, 9, 1.5), {_NOMINAL}", f"--world pool {_FAST} --sensors nominal"),
    LearnedCell(f"gauntlet (8, 9, 1.5), {_NOMINAL}", f"--world gauntlet {_FAST} --sensors nominal"),
    *(
        LearnedCell(PAPER, f"--world pool -S {s} -D {d} -v {v}", CONDITION_EPISODES)
        for s, (d, v) in itertools.product(
            (4, 8), [(0, 0.2), *itertools.product((3, 6, 9), (0.2, 0.4, 0.6, 0.8, 1.5))]
        )
    ),
)
"""without bodies their speed makes no difference: these conditions are played once"""


def command_of(cell: LearnedCell, seed: int = SEED) -> list[str]:
    """Arguments of ``uuv`` for a cell."""
    who = ["eval", "--controller", "bt", "--controller", "best", *cell.options.split()]
    return [*who, "--seeds", str(seed), "--episodes", str(cell.episodes)]


def entry_of(cell: LearnedCell, seed: int, result: dict[str, Any], commit: str) -> dict[str, Any]:
    """What is kept of a ``uuv eval --json`` document."""
    found = {method["name"]: method["episodes_detail"] for method in result["methods"]}
    return {
        "cell": cell.title,
        "command": "uuv " + " ".join(command_of(cell, seed)),
        "commit": commit,
        "machine": hardware(),
        **{
            name: {
                "outcomes": "".join(LETTERS[e["outcome"]] for e in episodes),
                "times_s": [e["time_s"] for e in episodes],
            }
            for name, episodes in found.items()
        },
    }


def learned_trials(sources: Sources) -> str:
    """``best`` beside ``bt`` on the same episodes."""
    return _beside_the_tree(sources.json(FILE)["rows"])


def learned_fresh(sources: Sources) -> str:
    """The same on episodes that no stack had met."""
    return _beside_the_tree(sources.json(FRESH_FILE)["rows"])


def _beside_the_tree(entries: list[dict[str, Any]]) -> str:
    rows = []
    for title in dict.fromkeys(cell.title for cell in CELLS):
        here = [entry for entry in entries if entry["cell"] == title]
        if not here:
            continue
        pair = Paired.of([(entry["bt"], entry["best"]) for entry in here])
        rows.append([title, str(len(pair.ends)), *pair.cells(), pair.points(), pair.times()])
    head = ["world (S, D, v in m/s)", "episodes", "`bt`", "`best`", "gains, losses, McNemar's p", "points"]
    return text_table([*head, "time where both arrive"], rows)


def learned_before(sources: Sources) -> str:
    """``best`` beside the stacks that were ``best`` before, on the same episodes."""
    entries, rows = sources.json(FILE)["rows"], []
    for stack, file in BEFORE_FILES.items():
        before = {row["command"]: row["best"] for row in sources.json(file)["rows"]}
        for title in dict.fromkeys(cell.title for cell in CELLS):
            here = [entry for entry in entries if entry["cell"] == title]
            if not before.keys() >= {entry["command"] for entry in here}:
                continue
            pair = Paired.of([(before[entry["command"]], entry["best"]) for entry in here])
            rows.append([stack, title, *pair.cells(), pair.points(), pair.times()])
    head = ["`best` before", "world (S, D, v in m/s)", "it", "`best`", "gains, losses, McNemar's p", "points"]
    return text_table([*head, "time where both arrive"], rows)


def stack_trials(sources: Sources) -> str:
    """Stacks that were tried on the way to ``best``, each beside ``bt`` on the same episodes."""
    document = sources.json(TRIALS_FILE)
    kept = {(row["pilot"], row["cell"], row["seed"]): row for row in document["rows"]}
    rows = []
    for pilot, cell in dict.fromkeys((pilot, cell) for pilot, cell, _seed in kept if pilot != "bt"):
        seeds = [seed for name, where, seed in kept if (name, where) == (pilot, cell)]
        pair = Paired.of([(kept["bt", cell, seed], kept[pilot, cell, seed]) for seed in seeds])
        title = document["cells"][cell]
        rows.append([pilot, title, ", ".join(map(str, seeds)), *pair.cells(), pair.times()])
    head = ["stack", "world (S, D, v in m/s)", "seeds", "`bt`", "stack", "gains, losses, McNemar's p"]
    return text_table([*head, "time where both arrive"], rows)


@dataclass(frozen=True)
class Paired:
    """Episodes of two pilots, the tree first."""

    ends: list[tuple[str, str]]
    """letters"""
    times_s: list[tuple[float, float]]

    @classmethod
    def of(cls, rows: list[tuple[dict[str, Any], dict[str, Any]]]) -> Paired:
        """Of entries with outcomes and times."""
        ends = [end for a, b in rows for end in zip(a["outcomes"], b["outcomes"], strict=True)]
        return cls(ends, [time for a, b in rows for time in zip(a["times_s"], b["times_s"], strict=True)])

    def cells(self) -> list[str]:
        """Success / collision of both, gains and losses of the second with McNemar's p."""
        won = sum(b == "s" != a for a, b in self.ends)
        lost = sum(a == "s" != b for a, b in self.ends)
        rates = [_rates([end[who] for end in self.ends]) for who in (0, 1)]
        return [*rates, f"+{won} -{lost}, p = {mcnemar_p(won, lost):.2g}"]

    def points(self) -> str:
        """Difference of success [points] with its 95 % interval."""
        gain = [float(b == "s") - float(a == "s") for a, b in self.ends]
        low, high = bootstrap_interval(gain) or (0.0, 0.0)
        return f"{100 * sum(gain) / len(gain):+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"

    def times(self) -> str:
        """Mean times where both arrive."""
        both = [pair for pair, end in zip(self.times_s, self.ends, strict=True) if end == ("s", "s")]
        tree_s, own_s = (sum(column) / len(both) for column in zip(*both, strict=True))
        return f"{tree_s:.1f}, {own_s:.1f} s ({100 * (own_s / tree_s - 1):+.0f} %)"


def _rates(ends: list[str]) -> str:
    """Success / collision in %."""
    share = 100 / len(ends)
    return f"{share * ends.count('s'):.1f} / {share * sum(end in 'cxo' for end in ends):.1f}"


def main() -> None:
    """Play all cells that are not in the file yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--jobs", type=int, default=2, help="cells played at a time, one thread each")
    parser.add_argument("--fresh", action="store_true", help=f"the episodes of seed {FRESH_SEED}")
    chosen = parser.parse_args()
    seed, file, wanted = (
        (FRESH_SEED, FRESH_FILE, CELLS[:FRESH_CELLS]) if chosen.fresh else (SEED, FILE, CELLS)
    )
    path: Path = ROOT / file
    document = document_at(path, seed)
    done = {row["command"] for row in document["rows"]}
    cells = [cell for cell in wanted if "uuv " + " ".join(command_of(cell, seed)) not in done]
    commit = commit_of_package()
    with ThreadPoolExecutor(chosen.jobs) as pool:
        for cell, result in zip(
            cells, pool.map(lambda cell: play(command_of(cell, seed)), cells), strict=True
        ):
            document["rows"].append(entry_of(cell, seed, result, commit))
            write_atomic(path, (json.dumps(document, indent=1) + "\n").encode())
            print(cell.title, cell.options, flush=True)


if __name__ == "__main__":
    main()
