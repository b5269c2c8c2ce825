"""Play the pilot with each of its pieces switched off, on the same episodes: ``python -m docs.writers.pieces
--seeds 77001``.

Each row is one ``uuv eval`` on one thread, two of them at a time; ``--before COMMIT`` adds the pilot of
another commit, played by that commit's own code. A row is in ``docs/data/pieces_SEED.json``, with the outcome
of every episode, as soon as it is played; a second start plays what is missing. ``docs/tuning.md`` shows the
table.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.before import checked_out
from docs.writers.evaluations import ONE_THREAD, commit_of_package
from docs.writers.figure_sources import ROOT
from uuvtai.outcomes import COLLIDED
from uuvtai.run_folder import hardware, write_atomic
from uuvtai.statistics import mcnemar_p

EPISODES = 400
LETTERS = {"success": "s", "collision": "c", "ttc": "x", "out_of_tank": "o", "timeout": "t"}
"""one letter an episode"""
COLUMN = """\
# the scene of the world preset `column` for code that does not have that preset
world:
  dynamic:
    cylinder_fraction: 1.0
    full_column_fraction: 1.0
elevation:
  column_share: 0.95
"""


@dataclass(frozen=True)
class Cell:
    """A scene of the table."""

    name: str
    title: str
    """as the table has it, Markdown"""
    options: str
    """of ``uuv eval``"""


@dataclass(frozen=True)
class Piece:
    """What is switched off; a new row of the table is a new entry of ``PIECES``."""

    name: str
    title: str
    settings: str = ""
    """keys of the config, as ``--set`` takes them"""
    cells: tuple[str, ...] = ("pool_6", "pool_9_fast", "gauntlet_9_fast")


CELLS = (
    Cell("pool_6", "pool (8, 6, 0.6)", "--world pool -S 8 -D 6 -v 0.6"),
    Cell("pool_9_fast", "pool (8, 9, 1.5)", "--world pool -S 8 -D 9 -v 1.5"),
    Cell("gauntlet_9_fast", "gauntlet (8, 9, 1.5)", "--world gauntlet -S 8 -D 9 -v 1.5"),
    Cell("column_9_fast", "column (8, 9, 1.5)", "--world column -S 8 -D 9 -v 1.5"),
    Cell("pool_6_harsh", "pool (8, 6, 0.6), harsh", "--world pool -S 8 -D 6 -v 0.6 --sensors harsh"),
)
_LEVEL = "teacher.free_depth=false teacher.vertical_weight=1.5 teacher.edge_gap_m=0.26"
_LEARNED, _FAST = "forecast.learned=shipped", ("pool_9_fast", "gauntlet_9_fast")
PIECES = (
    Piece("all", "nothing", cells=tuple(cell.name for cell in CELLS)),
    Piece("depth", "depth as a free dimension", _LEVEL),
    Piece(
        "diagonal",
        "diagonal cruise: at most 0.6 m/s",
        "teacher.cruise_m_s=0.6",
        cells=("pool_6", "pool_9_fast", "gauntlet_9_fast", "column_9_fast"),
    ),
    Piece("first_sight", "motion at first sight", "tracking.sight_doppler_m_s=100"),
    Piece("turning_back", "bodies above or below may turn back", "forecast.use_turning_back=false"),
    Piece("margins", "margins as before", "teacher.margin_m=0.25 teacher.margin_growth_m_s=0.1"),
    Piece("quiet", "nothing; quiet water on", "quiet.weight_seen=20"),
    Piece("futures", "nothing; futures on", "forecast.turn_back_s=[0.4,0.8]"),
    Piece(
        "learned_one",
        "nothing; learned forecast, likeliest alone",
        _LEARNED + " teacher.least_share=0.99",
        _FAST,
    ),
    Piece("learned", "nothing; learned forecast, all futures", _LEARNED, _FAST),
    Piece(
        "pose", "corrections of the position", "sensors.localization=dead_reckoning", cells=("pool_6_harsh",)
    ),
    Piece("pose_known", "nothing; position known", "sensors.localization=truth", cells=("pool_6_harsh",)),
)
DASH = "-"
BEFORE = Piece("before", "all: the pilot before")


# ---------------------------------------------------------------------------------------------------- results


def file_of(seed: int, root: Path = ROOT) -> Path:
    """Where the rows of a seed are kept."""
    return root / f"docs/data/pieces_{seed}.json"


def read(path: Path, seed: int) -> dict[str, Any]:
    """What was played so far; an empty document where nothing was."""
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    return {
        "schema": 1,
        "seed": seed,
        "letters": {letter: name for name, letter in LETTERS.items()},
        "rows": [],
    }


def command_of(piece: Piece, cell: Cell, seed: int, episodes: int) -> list[str]:
    """Arguments of ``uuv`` for one place of the table."""
    settings = [part for setting in piece.settings.split() for part in ("--set", setting)]
    return [
        "eval",
        "--controller",
        "bt",
        *cell.options.split(),
        *settings,
        "--seeds",
        str(seed),
        "--episodes",
        str(episodes),
    ]


def entry_of(
    piece: str, cell: str, command: list[str], result: dict[str, Any], commit: str
) -> dict[str, Any]:
    """What is kept of a ``uuv eval --json`` document: the outcome of every episode and the mean time."""
    method = result["methods"][0]
    return {
        "piece": piece,
        "cell": cell,
        "command": "uuv " + " ".join(command),
        "commit": commit,
        "machine": hardware(),
        "outcomes": "".join(LETTERS[episode["outcome"]] for episode in method["episodes_detail"]),
        "time_to_success_mean_s": method["time_to_success_mean_s"],
    }


def add(path: Path, document: dict[str, Any], entry: dict[str, Any]) -> None:
    """Put an entry at the end instead of an older one of the same piece and cell; write the file whole."""
    place = (entry["piece"], entry["cell"])
    document["rows"] = [row for row in document["rows"] if (row["piece"], row["cell"]) != place] + [entry]
    write_atomic(path, (json.dumps(document, indent=1) + "\n").encode())


def beside(played: dict[tuple[str, str], str], piece: str, other: str, cell: str) -> str:
    """One place of the table; the episodes that both pilots played are compared."""
    if (piece, cell) not in played:
        return DASH
    own, whole = played[piece, cell], played.get((other, cell), "")
    collided = sum(own.count(LETTERS[ending]) for ending in COLLIDED)
    rates = f"{100 * own.count('s') / len(own):.1f} / {100 * collided / len(own):.1f}"
    if piece == other or not whole:
        return rates
    pairs = list(zip(own, whole, strict=False))
    won, lost = (sum(a == "s" != b for a, b in pairs), sum(b == "s" != a for a, b in pairs))
    return f"{rates} (+{won} -{lost}, p = {mcnemar_p(won, lost):.2g})"


# ---------------------------------------------------------------------------------------------------- playing


@dataclass(frozen=True)
class Turn:
    """One ``uuv eval`` to play: what is off, where, and with which code."""

    piece: Piece
    cell: Cell
    tree: Path
    commit: str

    def play(self, seed: int, episodes: int) -> dict[str, Any]:
        """The entry of this turn. Raises RuntimeError where the command fails."""
        command = command_of(self.piece, self.cell, seed, episodes)
        with tempfile.TemporaryDirectory() as folder:
            run, column = Path(folder) / "run", Path(folder) / "column.yaml"
            given = list(command)
            if "column" in given and not (self.tree / "uuvtai/presets/worlds/column.yaml").exists():
                column.write_text(COLUMN, encoding="utf-8")
                given[given.index("column")] = str(column)
            done = subprocess.run(
                [sys.executable, "-m", "uuvtai", *given, "--run-dir", str(run)],
                cwd=self.tree,
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(self.tree)},
                stdout=subprocess.DEVNULL,
                check=False,
            )
            if done.returncode:
                raise RuntimeError(f"'uuv {' '.join(command)}' ended with {done.returncode}; see above")
            result = json.loads((run / "eval/result.json").read_text(encoding="utf-8"))
        return entry_of(self.piece.name, self.cell.name, command, result, self.commit)


def missing(document: dict[str, Any], turns: list[Turn], episodes: int) -> list[Turn]:
    """Turns that were not played with this code, or with fewer episodes."""
    done = {
        (row["piece"], row["cell"], row["commit"])
        for row in document["rows"]
        if len(row["outcomes"]) >= episodes
    }
    return [turn for turn in turns if (turn.piece.name, turn.cell.name, turn.commit) not in done]


def play_all(turns: list[Turn], path: Path, document: dict[str, Any], episodes: int, jobs: int) -> list[str]:
    """Play turns, ``jobs`` at a time; what went wrong, in words. The others are kept all the same."""
    failed: list[str] = []
    with ThreadPoolExecutor(jobs) as pool:
        waiting = {pool.submit(turn.play, document["seed"], episodes): turn for turn in turns}
        for future in as_completed(waiting):
            turn = waiting[future]
            try:
                add(path, document, future.result())
            except (RuntimeError, OSError, ValueError, KeyError) as error:
                failed.append(f"{turn.piece.name}, {turn.cell.name}: {error}")
                continue
            print(f"{turn.piece.name}, {turn.cell.name}: done", file=sys.stderr, flush=True)
    return failed


def turns_of(names: list[str], cells: list[str], tree: Path, commit: str) -> list[Turn]:
    """Every piece in each of its cells that is wanted; no names: all."""
    scenes = {cell.name: cell for cell in CELLS}
    return [
        Turn(piece, scenes[name], tree, commit)
        for piece in PIECES
        for name in piece.cells
        if piece.name in (names or [piece.name]) and name in (cells or [name])
    ]


def main(arguments: list[str] | None = None) -> int:
    """Play what is missing; 1 where a row failed, 2 for an unknown name."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.writers.pieces", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--seeds", type=int, required=True, help="the one seed of every row")
    parser.add_argument("--episodes", type=int, default=EPISODES, help=f"a row (default {EPISODES})")
    parser.add_argument("--only", default="", help="pieces, parted by commas (default: all)")
    parser.add_argument("--cells", default="", help="scenes, parted by commas (default: each piece's own)")
    parser.add_argument("--before", default="", help="a commit: its pilot is a row, and no other is played")
    parser.add_argument("--jobs", type=int, default=2, help="rows at a time, one thread each (default 2)")
    parser.add_argument("--out", type=Path, help="results file (default docs/data/pieces_SEED.json)")
    chosen = parser.parse_args(arguments)
    names, cells = ([part for part in text.split(",") if part] for text in (chosen.only, chosen.cells))
    known = {piece.name for piece in PIECES} | {cell.name for cell in CELLS}
    if unknown := sorted({*names, *cells} - known):
        print(f"unknown: {', '.join(unknown)}; there are: {', '.join(sorted(known))}", file=sys.stderr)
        return 2
    path = chosen.out or file_of(chosen.seeds)
    document = read(path, chosen.seeds)
    with contextlib.ExitStack() as stack:
        turns = turns_of(names, cells, ROOT, commit_of_package())
        if chosen.before:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            commit, tree = stack.enter_context(checked_out(chosen.before, folder / "tree"))
            turns = [Turn(BEFORE, turn.cell, tree, commit) for turn in turns_of(["all"], cells, tree, commit)]
        turns = missing(document, turns, chosen.episodes)
        print(f"{len(turns)} rows to play, {chosen.jobs} at a time", file=sys.stderr, flush=True)
        failed = play_all(turns, path, document, chosen.episodes, chosen.jobs)
    print("\n".join(failed) or f"all played: {path}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
