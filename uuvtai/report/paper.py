"""What a paper takes from a run folder: figures and tables with captions that say n and which intervals."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from uuvtai.common.files import refusing
from uuvtai.common.statistics import holm_adjusted
from uuvtai.config.loader import ConfigError
from uuvtai.logs.run_folder import RunFolderError, write_atomic
from uuvtai.report import paper_style
from uuvtai.report.blocks import Block, Figure
from uuvtai.report.build import NOTHING, command_of, damage_named, refuse_run, training_of
from uuvtai.report.evaluation import causes_table, conditions, evaluation_data, paired_data
from uuvtai.report.html import all_shown, read_json, shown
from uuvtai.report.sweep import ON_HOVER, agent_of, axis_column, by_agent, cells_data, grid_table, sweep
from uuvtai.report.tables import (
    PAGE,
    Column,
    Data,
    Table,
    change_name,
    probability,
    varies_alone,
    varying,
    with_interval,
)
from uuvtai.report.timing import timing
from uuvtai.report.training import Training, training

_MOST_EPISODES = 6  # whose ways are drawn
_LOG = re.compile(r"(?P<agent>.+)_seed(?P<seed>-?\d+)_episode(?P<episode>\d+)")
_WORDS = 3  # of a table's title that name it
_WILSON = "95 % Wilson intervals"


@dataclass(frozen=True)
class PaperItem:
    """A figure or a table, with the run that it comes from."""

    name: str
    caption: str
    origin: str  # the command and the commit, a line each
    data: Data | None
    panels: Sequence[paper_style.PaperPanel] = ()
    table: Table | None = None
    both_widths: bool = True  # a figure for one column too


def origin_of(run: Path) -> str:
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
    for i, block in enumerate(blocks):
        if isinstance(block, Figure):
            is_stages, is_cells = block.name == "stages", block.name.startswith("heat_map")
            panels = [paper_style.of_panel(panel, is_cells, is_stages) for panel in block.panels]
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


_RATES = (
    Column("n", of=lambda m: str(m["episodes"])),
    Column("success % [95 %]", of=lambda m: _interval(m, "success")),
    Column("collision % [95 %]", of=lambda m: _interval(m, "collision")),
)
"""of an agent or a cell"""

_AGENTS = (
    Column("agent", left=True, of=lambda m: m["name"]),
    *_RATES,
    Column("timeout", of=lambda m: str(m["outcomes"]["timeout"])),
    Column(
        "time to goal s [95 %]",
        of=lambda m: with_interval(m.get("time_to_success_mean_s"), m.get("time_to_success_ci95"), 1),
    ),
)


def _of_evaluation(result: dict[str, Any], origin: str) -> list[PaperItem]:
    agents = result["agents"]
    if not agents:
        return []
    scene = conditions(result)
    privileged = [m["name"] for m in agents if m.get("privileged")]
    note = f" Told the truth, so no competitors: {', '.join(privileged)}." if privileged else ""
    data = evaluation_data(agents)
    n = f"n = {agents[0]['episodes']} episodes of each agent"
    found = [
        PaperItem(
            "agents",
            f"Success and collision of every agent. {scene} {n}; whiskers: {_WILSON}.{note}",
            origin,
            data,
            panels=[paper_style.bars(agents, key) for key in ("success", "collision")],
        ),
        PaperItem(
            "agents",
            f"Agents on the same episodes. {scene} {n}; rates with {_WILSON}, collision counts contacts, "
            "stops for the time to collision and leaving the tank; times over successes, with 95 % bootstrap "
            f"intervals.{note}",
            origin,
            data,
            table=Table(_AGENTS, agents),
        ),
    ]
    found += _paired(result.get("paired", []), scene, origin)
    return [*found, *(_causes(m, scene, origin) for m in agents if m.get("causes"))]


def _causes(agent: dict[str, Any], scene: str, origin: str) -> PaperItem:
    caption = (
        f"Why episodes of {agent['name']} failed, judged from the truth. {scene} n = "
        f"{len(agent['explain'])} failures of {agent['episodes']} episodes; shares of the failures, "
        "without intervals; times are medians before the end."
    )
    return PaperItem(f"causes_{agent['name']}", caption, origin, None, table=causes_table(agent, ""))


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
    """[] without two agents."""
    if not pairs:
        return []
    adjusted = holm_adjusted([pair["mcnemar_p"] for pair in pairs])
    rows = [{**pair, "holm_p": p} for pair, p in zip(pairs, adjusted, strict=True)]
    caption = (
        f"Pairs of agents. {scene} n = {pairs[0]['episodes']} pairs of episodes; who alone arrives, p of "
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
        panel, said = paper_style.ways(logs)
        caption = (
            f"Ways of {len(logs)} agent{'s' if len(logs) > 1 else ''} through one episode, chosen by its "
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
    for agent, own in by_agent(cells).items():
        table, note = grid_table(own, document)
        caption = (
            f"{agent}: success / collision [%]. World {document.get('world', '-')}; {n}{_widest(own)}.{note}"
        )
        found.append(PaperItem(f"grid_{agent}", caption, origin, cells_data(own), table=table))
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


def _cells(cells: list[dict[str, Any]], document: dict[str, Any]) -> Table:
    """One row a cell: what varies, agent, rates with intervals."""
    if varies_alone(document):
        where = [Column("changed", left=True, of=lambda cell: change_name(cell, document))]
    else:
        where = [axis_column(name) for name in varying(document["axes"])]
    return Table([*where, Column("agent", left=True, of=agent_of), *_RATES], cells)


# ---- LaTeX of tables and floats. Whatever a user can name is text in it, never a command.

_COMMANDS = {
    "\\": "backslash", "^": "asciicircum", "~": "asciitilde", "<": "less", ">": "greater", "|": "bar",
    '"': "quotedbl", "'": "quotesingle", "`": "asciigrave", "·": "periodcentered", "°": "degree",
    "†": "dagger", "–": "endash", "—": "emdash",
}  # fmt: skip
_SPECIAL = {
    **{c: rf"\{c}" for c in "{}$&#%_"},
    **{c: rf"\text{name}{{}}" for c, name in _COMMANDS.items()},
    **{"±": r"$\pm$", "µ": r"$\mu$", "−": "$-$"},
}
_LETTERS = range(0xC0, 0x100)  # letters with accents that every LaTeX knows in UTF-8
_NO_LETTERS = (0xD7, 0xF7)
_COLUMN_CHARACTERS, _GAP = 52, 2  # what fits one column of a page, and a table's column beside its words
_MINUS = re.compile(r"(?<![\w.-])-(?=\d)")  # before a number of a table
_PROSE = "p{0.3\\linewidth}"


def escaped(text: str) -> str:
    """The text as LaTeX shows it, on one line. A letter that a plain LaTeX cannot set becomes '?'."""
    found = "".join(_character(c) for c in " ".join(text.split()))
    for pair in ("--", ",,"):  # two are an option and a list here, not a dash and a quotation mark
        found = found.replace(pair, f"{pair[0]}{{}}{pair[0]}").replace(pair, f"{pair[0]}{{}}{pair[0]}")
    return found


def _character(c: str) -> str:
    if c in _SPECIAL:
        return _SPECIAL[c]
    is_known = (c.isascii() and c.isprintable()) or (ord(c) in _LETTERS and ord(c) not in _NO_LETTERS)
    return c if is_known else "?"


def comment(text: str) -> str:
    """A line that LaTeX does not read, whatever stands in it."""
    return f"% {shown(text)}"


def _cell(text: str) -> str:
    found = escaped(_MINUS.sub("\N{MINUS SIGN}", text))
    # behind \\ LaTeX takes a bracket or a star for a part of it
    return f"{{{found[0]}}}{found[1:]}" if found[:1] in ("[", "*") else found


def tabular(table: Table, remark: str) -> str:
    """The table with the rules of booktabs, below a comment."""
    columns, cells = table.on(PAGE)
    lines = [[_cell(column.head) for column in columns], *([_cell(str(c)) for c in row] for row in cells)]
    spec = "".join(_PROSE if column.prose else "l" if column.left else "r" for column in columns)
    head, *rows = (" & ".join(line) + r" \\" for line in lines)
    return "\n".join(
        [
            *map(comment, remark.splitlines()),
            rf"\begin{{tabular}}{{{spec}}}",
            r"\toprule",
            head,
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def is_wide(table: Table) -> bool:
    columns, cells = table.on(PAGE)
    widths = [
        max(len(str(row[i])) for row in [[c.head for c in columns], *cells]) for i in range(len(columns))
    ]
    return sum(widths) + _GAP * len(widths) > _COLUMN_CHARACTERS


def float_of(kind: str, name: str, caption: str, body: Sequence[str], wide: bool = False) -> str:
    """A figure or a table with its caption and the label ``fig:NAME`` or ``tab:NAME``."""
    star, label = "*" if wide else "", {"figure": "fig", "table": "tab"}[kind]
    said = rf"  \caption{{{escaped(caption)}}}"
    inner = [f"  {line}" for line in body]
    parts = [said, *inner] if kind == "table" else [*inner, said]
    begin, end = rf"\begin{{{kind}{star}}}[tbp]", rf"\end{{{kind}{star}}}"
    return "\n".join([begin, r"  \centering", *parts, rf"  \label{{{label}:{name}}}", end, ""])


DOCUMENT = r"""% All figures and tables, to look at: pdflatex paper.tex
\documentclass[twocolumn]{article}
\usepackage[T1]{fontenc}
\usepackage[utf8]{inputenc}
\usepackage{textcomp,booktabs,graphicx}
\usepackage[margin=0.67in,columnsep=0.16in,letterpaper]{geometry}
\begin{document}
\input{captions}
\end{document}
"""


# ---- ``uuv report --paper DIR``: figures, tables and captions of finished runs, whole or not at all.

_WIDTHS = {"1col": paper_style.ONE_COLUMN_IN, "2col": paper_style.TWO_COLUMNS_IN}
_NAME = re.compile(r"[^A-Za-z0-9]+")
_LONGEST = 60
_FORMULA = ("=", "+", "-", "@", "\t", "\r")  # what a spreadsheet takes a text that begins so for
_MARKDOWN = re.compile(r"([\\`*_{}\[\]<>#|&!])")
_MOST_ITEMS = 400
_TALL_IN = 6.5  # a figure that is higher in one column stands in two


@dataclass(frozen=True)
class PaperKit:
    folder: Path
    figures: list[Path]
    tables: list[Path]

    def document(self) -> dict[str, object]:
        return {
            "schema": 1,
            "paper": str(self.folder),
            "figures": list(map(str, self.figures)),
            "tables": list(map(str, self.tables)),
        }


def paper(runs: list[Path], folder: Path) -> PaperKit:
    """Write into ``folder``, new or empty: ``figures/`` (PDF and SVG for one and two columns), ``tables/``
    (LaTeX and CSV), ``data/`` (the numbers of figures), captions.tex, captions.md and paper.tex.

    Trainings are compared in one figure. Everything is read and drawn before anything is written. Raises
    ConfigError for a run without anything to show or with a damaged file, RunFolderError where the folder is
    not empty or cannot be written, FileError for links, LogError.
    """
    for run in runs:
        refuse_run(run)
    _refuse_folder(folder)
    found = _named(_all(runs), len(runs) > 1)
    files: dict[str, bytes] = {}
    for run, item in found:
        with damage_named(run):
            files |= _files_of(item)
    items = [item for _run, item in found]
    files["captions.tex"] = _tex(items).encode()
    files["captions.md"] = _markdown(items).encode()
    files["paper.tex"] = DOCUMENT.encode()
    written = _write(folder, files)
    return PaperKit(
        folder,
        [path for path in written if path.parent.name == "figures"],
        [path for path in written if path.parent.name == "tables"],
    )


def _refuse_folder(folder: Path) -> None:
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise RunFolderError(f"{folder}: is no folder; give --paper the name of a new one")
    if folder.exists() and any(folder.iterdir()):
        raise RunFolderError(f"{folder}: is not empty; give --paper a new folder, or empty it")


def _all(runs: list[Path]) -> Iterator[tuple[Path, PaperItem]]:
    """Every run's items; trainings stand first, as one."""
    trainings = [run for run in runs if (run / "metrics.jsonl").exists()]
    if trainings:
        with damage_named(trainings[0]):
            origin = "\n".join(map(origin_of, trainings))
            found = items_of_trainings([training_of(run) for run in trainings], origin)
        yield from ((trainings[0], item) for item in found)
    for run in runs:
        with damage_named(run):
            if read_json(run, "reproduce.json"):
                raise ConfigError(
                    f"{run}: is a reproduction; give the run folders in it one by one ({run}/...)"
                )
            own = items_of(run)
        if not own and run not in trainings:
            raise ConfigError(f"{run}: {NOTHING}")
        yield from ((run, item) for item in own)


def _named(found: Iterator[tuple[Path, PaperItem]], several: bool) -> list[tuple[Path, PaperItem]]:
    """The items under names that files may have, each kind's once; with their run where there are several."""
    items: list[tuple[Path, PaperItem]] = []
    taken: set[tuple[bool, str]] = set()
    for run, item in found:
        if len(items) >= _MOST_ITEMS:
            raise ConfigError(f"{run}: has more than {_MOST_ITEMS} figures and tables; give fewer runs")
        wanted = f"{run.resolve().name}_{item.name}" if several else item.name
        base = name = _NAME.sub("_", wanted).strip("_")[:_LONGEST] or "item"
        number = 1
        while (item.table is None, name.lower()) in taken:
            number += 1
            name = f"{base}_{number}"
        taken.add((item.table is None, name.lower()))
        items.append((run, replace(item, name=name)))
    return items


# ---------------------------------------------------------------------------------------------------- content


def _files_of(item: PaperItem) -> dict[str, bytes]:
    """Content by path in the folder."""
    if item.table is not None:
        remark = f"{item.caption}\n{item.origin}\nneeds \\usepackage{{booktabs,textcomp}}"
        made = {f"tables/{item.name}.tex": tabular(item.table, remark).encode()}
        data = item.data or _texts(item.table)
        return made | {f"tables/{item.name}.csv": _csv(data).encode()}
    made = {} if item.data is None else {f"data/{item.name}.csv": _csv(item.data).encode()}
    for width, inches in _WIDTHS.items():
        if width == "2col" or item.both_widths:
            for kind, content in paper_style.sheets(item.panels, inches).items():
                made[f"figures/{item.name}_{width}.{kind}"] = content
    return made


def _texts(table: Table) -> Data:
    """A table without numbers of its own as its cells."""
    columns, cells = table.on("page")
    return Data([column.head for column in columns], [[str(cell) for cell in row] for row in cells])


def _csv(data: Data) -> str:
    """CSV in which no text is a formula."""
    rows = [[_harmless(value) for value in row] for row in data.rows]
    return Data([str(_harmless(column)) for column in data.columns], rows).csv()


def _harmless(value: object) -> object:
    """A text that a spreadsheet would compute, behind an apostrophe; numbers stay."""
    if not isinstance(value, str) or not value.startswith(_FORMULA):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}" if value != "-" else value
    return value


def _tex(items: Sequence[PaperItem]) -> str:
    """A float for each item, ready to be copied."""
    parts = ["% Floats of uuv report --paper. Needs \\usepackage{booktabs,graphicx,textcomp} and T1 fonts."]
    for item in items:
        remarks = [comment(line) for line in item.origin.splitlines()]
        if item.table is not None:
            body, kind = [rf"\input{{tables/{item.name}}}"], "table"
            wide = is_wide(item.table)
        else:
            is_tall = paper_style.height_in(item.panels, paper_style.ONE_COLUMN_IN) > _TALL_IN
            wide, kind = is_tall or not item.both_widths, "figure"
            width = r"\textwidth" if wide else r"\columnwidth"
            file = f"figures/{item.name}_{'2col' if wide else '1col'}.pdf"
            body = [rf"\includegraphics[width={width}]{{{file}}}"]
        parts.append("\n".join([*remarks, float_of(kind, item.name, item.caption, body, wide)]))
    return "\n\n".join(parts)


def _markdown(items: Sequence[PaperItem]) -> str:
    parts = ["# Captions"]
    for item in items:
        kind = "Figure" if item.table is None else "Table"
        origin = "\n".join(f"    {shown(line)}" for line in item.origin.splitlines())
        said = _MARKDOWN.sub(r"\\\1", shown(item.caption))
        parts += [f"## {kind} {item.name}", said, origin]
    return "\n\n".join(parts) + "\n"


def _write(folder: Path, files: dict[str, bytes]) -> list[Path]:
    where = "give a place that can be: --paper DIR"
    with refusing(RunFolderError, f"{folder}: cannot be written", where):
        for name, content in files.items():
            write_atomic(folder / name, content)
    return [folder / name for name in files]
