"""What a paper takes from a run folder: figures and tables with captions that say n and which intervals."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from uuvtai.report.blocks import Block, Figure
from uuvtai.report.learning_curves import Training, training
from uuvtai.report.methods_table import conditions, evaluation_data, paired_data
from uuvtai.report.paper_panels import bars, ways
from uuvtai.report.paper_style import PaperPanel, of_panel
from uuvtai.report.plain_text import all_shown, shown
from uuvtai.report.provenance import command_of
from uuvtai.report.run_files import read_json
from uuvtai.report.sweep import ON_HOVER, by_method, cells_data, sweep
from uuvtai.report.timing import timing
from uuvtai.statistics import holm_adjusted
from uuvtai.tables.cell_table import method_of
from uuvtai.tables.heatmap import pivot, varying
from uuvtai.tables.method_tables import causes_table
from uuvtai.tables.one_at_a_time import change_name, varies_alone
from uuvtai.tables.table import Column, Data, Table, heads
from uuvtai.tables.wording import axis_name, number, probability, value_name, with_interval

_MOST_EPISODES = 6
"""whose ways are drawn"""
_LOG = re.compile(r"(?P<method>.+)_seed(?P<seed>-?\d+)_episode(?P<episode>\d+)")
_WORDS = 3
"""of a table's title that name it"""
_WILSON = "95 % Wilson intervals"


@dataclass(frozen=True)
class PaperItem:
    """A figure or a table, with the run that it comes from."""

    name: str
    caption: str
    origin: str
    """the command and the commit, a line each"""
    data: Data | None
    panels: Sequence[PaperPanel] = ()
    table: Table | None = None
    both_widths: bool = True
    """a figure for one column too"""


def origin_of(run: Path) -> str:
    """The command and the commit of a run."""
    record = read_json(run, "run.json") or {}
    version = (record.get("versions") or {}).get("uuvtai", "unknown")
    commit = record.get("git_sha") or "not known"
    command = shown(command_of(record)) or "not known"
    return f"command: {command}\ncommit: {shown(str(commit))} (uuvtai {shown(str(version))})"


def items_of(run: Path) -> list[PaperItem]:
    """All that a run folder other than a training has to show."""
    origin = origin_of(run)
    found: list[PaperItem] = []
    if result := _read(run, "eval/result.json"):
        found += _of_evaluation(result, origin)
    found += _of_logs(run, origin)
    if (document := _read(run, "sweep.json")) and document["cells"]:
        found += _of_sweep(document, origin)
    if document := _read(run, "profile.json"):
        found += list(
            _of_blocks(timing(document), origin, "One measurement on the machine that the run names")
        )
    return found


def _read(run: Path, name: str) -> dict[str, Any] | None:
    """A document of a run without what cannot be shown."""
    return all_shown(read_json(run, name))


def items_of_trainings(trainings: Sequence[Training], origin: str) -> list[PaperItem]:
    """Curves of trainings, those that differ in their seed only as one line with its band."""
    plain = [replace(one, name=shown(one.name), preset=shown(one.preset)) for one in trainings]
    runs = f"n = {len(trainings)} training{'s' if len(trainings) != 1 else ''}"
    return list(_of_blocks(training(plain), origin, f"{runs}; no intervals"))


def _of_blocks(blocks: Iterable[Block], origin: str, n: str) -> Iterable[PaperItem]:
    """Figures and tables of the report's page."""
    for i, block in enumerate(blocks):
        if isinstance(block, Figure):
            is_stages, is_cells = block.name == "stages", block.name.startswith("heat_map")
            panels = [of_panel(panel, is_cells, is_stages) for panel in block.panels]
            caption = _sentences(block.caption, n)
            yield PaperItem(block.name, caption, origin, block.data, panels=panels, both_widths=not is_stages)
        elif isinstance(block, Table):
            name = " ".join(re.findall(r"\w+", block.title)[:_WORDS]) or f"table_{i}"
            yield PaperItem(name, _sentences(block.title, n), origin, block.data, table=block)


def _sentences(*parts: str) -> str:
    return " ".join(f"{part.rstrip('.')}." for part in parts if part)


# ------------------------------------------------------------------------------------------------- evaluation


def _interval(m: dict[str, Any], key: str) -> str:
    """'98.0 [96.4, 98.9]' of a rate in %."""
    bounds = m.get(f"{key}_ci95")
    share = m.get(f"{key}_rate")
    return with_interval(
        None if share is None else 100 * share, bounds and [100 * bound for bound in bounds], 1
    )


_METHODS = (
    Column("method", left=True, of=lambda m: m["name"]),
    Column("n", of=lambda m: str(m["episodes"])),
    Column("success % [95 %]", of=lambda m: _interval(m, "success")),
    Column("collision % [95 %]", of=lambda m: _interval(m, "collision")),
    Column("timeout", of=lambda m: str(m["outcomes"]["timeout"])),
    Column(
        "time to goal s [95 %]",
        of=lambda m: with_interval(m.get("time_to_success_mean_s"), m.get("time_to_success_ci95"), 1),
    ),
)


def _of_evaluation(result: dict[str, Any], origin: str) -> list[PaperItem]:
    methods = result["methods"]
    if not methods:
        return []
    scene = conditions(result)
    privileged = [m["name"] for m in methods if m.get("privileged")]
    note = f" Told the truth, so no competitors: {', '.join(privileged)}." if privileged else ""
    data = evaluation_data(methods)
    n = f"n = {methods[0]['episodes']} episodes of each method"
    found = [
        PaperItem(
            "methods",
            f"Success and collision of every method. {scene} {n}; whiskers: {_WILSON}.{note}",
            origin,
            data,
            panels=[bars(methods, key) for key in ("success", "collision")],
        ),
        PaperItem(
            "methods",
            f"Methods on the same episodes. {scene} {n}; rates with {_WILSON}, collision counts contacts, "
            "stops for the time to collision and leaving the tank; times over successes, with 95 % bootstrap "
            f"intervals.{note}",
            origin,
            data,
            table=Table(_METHODS, methods),
        ),
    ]
    found += _paired(result.get("paired", []), scene, origin)
    return [*found, *(_causes(m, scene, origin) for m in methods if m.get("causes"))]


def _causes(method: dict[str, Any], scene: str, origin: str) -> PaperItem:
    """Why episodes of a method failed."""
    caption = (
        f"Why episodes of {method['name']} failed, judged from the truth. {scene} n = "
        f"{len(method['explain'])} failures of {method['episodes']} episodes; shares of the failures, "
        "without intervals; times are medians before the end."
    )
    return PaperItem(f"causes_{method['name']}", caption, origin, None, table=causes_table(method, ""))


_PAIRS = (
    Column("a", left=True, of=lambda p: p["a"]),
    Column("b", left=True, of=lambda p: p["b"]),
    Column("both", of=lambda p: str(p["both"])),
    Column("only a", of=lambda p: str(p["only_a"])),
    Column("only b", of=lambda p: str(p["only_b"])),
    Column("p", of=lambda p: probability(p["mcnemar_p"])),
    Column("p (Holm)", of=lambda p: probability(p["holm_p"])),
    Column(
        "a - b s [95 %]",
        of=lambda p: with_interval(p.get("time_difference_mean_s"), p.get("time_difference_ci95")),
    ),
)


def _paired(pairs: list[dict[str, Any]], scene: str, origin: str) -> list[PaperItem]:
    """[] without two methods."""
    if not pairs:
        return []
    adjusted = holm_adjusted([pair["mcnemar_p"] for pair in pairs])
    rows = [{**pair, "holm_p": p} for pair, p in zip(pairs, adjusted, strict=True)]
    caption = (
        f"Pairs of methods. {scene} n = {pairs[0]['episodes']} pairs of episodes; who alone arrives, p of "
        f"McNemar's exact test, the same adjusted by Holm (tests: {len(pairs)}); difference in time where "
        "both arrive, with its 95 % bootstrap interval."
    )
    given = paired_data(pairs)
    data = Data([*given.columns, "holm_p"], [[*row, p] for row, p in zip(given.rows, adjusted, strict=True)])
    return [PaperItem("paired", caption, origin, data, table=Table(_PAIRS, rows))]


# ------------------------------------------------------------------------------------------------------- logs


def _of_logs(run: Path, origin: str) -> list[PaperItem]:
    """A figure for each recorded episode, as many as there is room for."""
    episodes: dict[tuple[int, int], list[Path]] = {}
    for path in sorted((run / "logs").glob("*.mcap")):
        if named := _LOG.fullmatch(path.stem):
            episodes.setdefault((int(named["seed"]), int(named["episode"])), []).append(path)
    found = []
    for (seed, episode), logs in sorted(episodes.items())[:_MOST_EPISODES]:
        panel, said = ways(logs)
        caption = (
            f"Ways of {len(logs)} method{'s' if len(logs) > 1 else ''} through one episode, chosen by its "
            f"number: {said}; dashed: their ways. Grey: what rests; cross: an end that is no success. "
            "n = 1 episode; no intervals."
        )
        name = f"ways_seed{seed}_episode{episode}"
        found.append(PaperItem(name, caption, origin, None, panels=[panel]))
    return found


# ------------------------------------------------------------------------------------------------------ sweep


def _of_sweep(document: dict[str, Any], origin: str) -> list[PaperItem]:
    cells = document["cells"]
    counts = sorted({cell["episodes"] for cell in cells})
    most = f" to {counts[-1]}" if len(counts) > 1 else ""
    n = f"n = {counts[0]}{most} episodes a cell"
    drawn = [block for block in sweep(document) if isinstance(block, Figure)]
    kept = f"{n}; counts and {_WILSON} of every cell: the data beside it"
    found = [replace(item, caption=_of_print(item.caption)) for item in _of_blocks(drawn, origin, kept)]
    if len(varying(document["axes"])) < 2 or varies_alone(document):
        caption = f"Every cell of the sweep. World {document.get('world', '-')}; {n}, {_WILSON}."
        return [*found, PaperItem("cells", caption, origin, cells_data(cells), table=_cells(cells, document))]
    for method, own in by_method(cells).items():
        table, note = _grid(own, document)
        caption = (
            f"{method}: success / collision [%]. World {document.get('world', '-')}; {n}{_widest(own)}.{note}"
        )
        found.append(PaperItem(f"grid_{method}", caption, origin, cells_data(own), table=table))
    return found


def _of_print(caption: str) -> str:
    """A caption of the page where nothing can be pointed at, and panels may stand one below the other."""
    said = caption.replace(f" {ON_HOVER}.", "")
    return said.replace("(left)", "(first)").replace("(right)", "(second)")


def _widest(cells: list[dict[str, Any]]) -> str:
    """How far the intervals of a grid reach at most; nothing where none is known."""
    bounds = [
        cell[f"{key}_ci95"] for cell in cells for key in ("success", "collision") if cell.get(f"{key}_ci95")
    ]
    if not bounds:
        return ""
    most = max(100 * (high - low) for low, high in bounds)
    return f", {_WILSON} at most {most:.0f} points wide, each in the CSV beside it"


def _both(cell: dict[str, Any]) -> str:
    """'98.4 / 1.6'."""
    rates = [cell.get(f"{key}_rate") for key in ("success", "collision")]
    return " / ".join(number(None if share is None else 100 * share) for share in rates)


def _grid(own: list[dict[str, Any]], document: dict[str, Any]) -> tuple[Table, str]:
    """Rows and columns as in the heat map, and what has to be said of cells that span a row."""
    chosen = pivot(own, document["axes"])
    rows = [[name, *[""] * len(chosen.column_values)] for name in chosen.row_names]
    for place in chosen.places:
        rows[place.row][1 + place.first] = _both(place.cell)
    spans = any(place.n_columns > 1 for place in chosen.places)
    across = axis_name(chosen.column_axis)
    note = f" A row with one entry does not depend on {across}." if spans else ""
    return Table(heads(f"{chosen.row_title} / {across}", *chosen.column_names), rows), note


def _cells(cells: list[dict[str, Any]], document: dict[str, Any]) -> Table:
    """One row a cell: what varies, method, rates with intervals."""
    if varies_alone(document):
        where = [Column("changed", left=True, of=lambda cell: change_name(cell, document))]
    else:
        where = [_axis(name) for name in varying(document["axes"])]
    columns = [
        *where,
        Column("method", left=True, of=method_of),
        Column("n", of=lambda cell: str(cell["episodes"])),
        Column("success % [95 %]", of=lambda cell: _interval(cell, "success")),
        Column("collision % [95 %]", of=lambda cell: _interval(cell, "collision")),
    ]
    return Table(columns, cells)


def _axis(name: str) -> Column:
    return Column(
        axis_name(name), left=True, of=lambda cell: "-" if cell.get(name) is None else value_name(cell[name])
    )
