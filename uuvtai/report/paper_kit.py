"""``uuv report --paper DIR``: figures, tables and captions of finished runs, whole or not at all."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from uuvtai.loader import ConfigError
from uuvtai.report import latex
from uuvtai.report.build import NOTHING, damage_named, refuse_run, training_of
from uuvtai.report.paper_items import PaperItem, items_of, items_of_trainings, origin_of
from uuvtai.report.paper_style import ONE_COLUMN_IN, TWO_COLUMNS_IN, height_in, sheets
from uuvtai.report.plain_text import shown
from uuvtai.report.run_files import read_json
from uuvtai.run_folder import RunFolderError, write_atomic
from uuvtai.tables.table import Data, Table

_WIDTHS = {"1col": ONE_COLUMN_IN, "2col": TWO_COLUMNS_IN}
_NAME = re.compile(r"[^A-Za-z0-9]+")
_LONGEST = 60
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""what a spreadsheet takes a text that begins so for"""
_MARKDOWN = re.compile(r"([\\`*_{}\[\]<>#|&!])")
_MOST_ITEMS = 400
_TALL_IN = 6.5
"""a figure that is higher in one column stands in two"""


@dataclass(frozen=True)
class PaperKit:
    """What was written."""

    folder: Path
    figures: list[Path]
    tables: list[Path]

    def document(self) -> dict[str, object]:
        """``uuv report --paper --json``."""
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
    files["paper.tex"] = latex.DOCUMENT.encode()
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
            _refuse_reproduction(run)
            own = items_of(run)
        if not own and run not in trainings:
            raise ConfigError(f"{run}: {NOTHING}")
        yield from ((run, item) for item in own)


def _refuse_reproduction(run: Path) -> None:
    if read_json(run, "reproduce.json"):
        raise ConfigError(f"{run}: is a reproduction; give the run folders in it one by one ({run}/...)")


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
        made = {f"tables/{item.name}.tex": latex.tabular(item.table, _remark(item)).encode()}
        data = item.data or _texts(item.table)
        return made | {f"tables/{item.name}.csv": _csv(data).encode()}
    made = {} if item.data is None else {f"data/{item.name}.csv": _csv(item.data).encode()}
    for width, inches in _WIDTHS.items():
        if width == "2col" or item.both_widths:
            for kind, content in sheets(item.panels, inches).items():
                made[f"figures/{item.name}_{width}.{kind}"] = content
    return made


def _remark(item: PaperItem) -> str:
    return f"{item.caption}\n{item.origin}\nneeds \\usepackage{{booktabs,textcomp}}"


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
        remarks = [latex.comment(line) for line in item.origin.splitlines()]
        if item.table is not None:
            body, kind = [rf"\input{{tables/{item.name}}}"], "table"
            is_wide = latex.is_wide(item.table)
        else:
            is_tall = height_in(item.panels, ONE_COLUMN_IN) > _TALL_IN
            is_wide, kind = is_tall or not item.both_widths, "figure"
            width = r"\textwidth" if is_wide else r"\columnwidth"
            file = f"figures/{item.name}_{'2col' if is_wide else '1col'}.pdf"
            body = [rf"\includegraphics[width={width}]{{{file}}}"]
        parts.append("\n".join([*remarks, latex.float_of(kind, item.name, item.caption, body, is_wide)]))
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
    try:
        for name, content in files.items():
            write_atomic(folder / name, content)
    except OSError as error:
        raise RunFolderError(
            f"{folder}: cannot be written ({error.strerror}); give a place that can be: --paper DIR"
        ) from None
    return [folder / name for name in files]
