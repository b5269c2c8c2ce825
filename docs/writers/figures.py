"""Figures in README and docs, from committed results: ``python -m docs.writers.figures`` renews them,
``--check`` says what is wrong.

A number ends with an invisible comment that says where it comes from: ``98.0 %<!-- =
evaluations.pool_6.bt.success_rate:.1% -->``. A comment with N expressions (parted by ``;``) stands for the
last N numbers before it. What follows ``:`` is Python's format. Paths are told in ``figure_sources.py``.
Tables between ``<!-- table: NAME -->`` and ``<!-- end -->`` are written by ``figure_tables.py``. Numbers that
are no results of ours say what they are, see ``figure_words.py``.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path

from docs.writers.figure_sources import ROOT, SourceError, Sources
from docs.writers.figure_tables import TABLES
from docs.writers.figure_words import unmarked

MARK = re.compile(r"<!-- = (?P<what>.*?) -->")
TABLE = re.compile(
    r"(?P<head><!-- table: (?P<name>\w+) -->\n)(?P<body>.*?)(?P<foot>^<!-- end -->)", re.M | re.S
)
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:,\d{3})*(?:\.\d+)?(?:/\d+)?")


def pages(root: Path = ROOT) -> list[Path]:
    """What is watched: README and the pages of docs."""
    return [root / "README.md", *sorted((root / "docs").glob("*.md"))]


def renewed(text: str, sources: Sources) -> str:
    """The text with every table and every marked number as the results have them. Raises SourceError."""
    text = TABLE.sub(lambda found: found["head"] + _table(found["name"], sources) + found["foot"], text)
    return "\n".join(_line(line, sources) for line in text.split("\n"))


def _table(name: str, sources: Sources) -> str:
    if name not in TABLES:
        raise SourceError(f"no table {name!r}; there are {', '.join(TABLES)}")
    return TABLES[name](sources) + "\n"


def _line(line: str, sources: Sources) -> str:
    """One line: each mark renews the numbers between it and the mark before it."""
    done, begin = "", 0
    for mark in MARK.finditer(line):
        done += _before(line[begin : mark.start()], mark["what"], sources) + mark[0]
        begin = mark.end()
    return done + line[begin:]


def _before(text: str, what: str, sources: Sources) -> str:
    """The text before a mark with its last numbers renewed."""
    values = [shown(part.strip(), sources) for part in what.split(" ; ")]
    numbers = list(NUMBER.finditer(text))[-len(values) :]
    if len(numbers) < len(values):
        raise SourceError(
            f"{len(values)} figures are marked by {what!r}, but only {len(numbers)} numbers stand before it"
        )
    for number, value in reversed(list(zip(numbers, values, strict=True))):
        text = text[: number.start()] + value + text[number.end() :]
    return text


def shown(part: str, sources: Sources) -> str:
    """``path:format`` as it stands in the text; ``%`` formats lose their sign, which the text has with its
    space."""
    path, _, form = part.partition(":")
    value = sources.value(path)
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return format(value, form).removesuffix("%")


# ---------------------------------------------------------------------------------------------------- command


def faults(path: Path, sources: Sources) -> list[str]:
    """What is wrong with a page: stale figures and tables, marks that lead nowhere, figures without a
    mark."""
    text, name = path.read_text(encoding="utf-8"), str(path.relative_to(sources.root))
    try:
        wanted = renewed(text, sources)
    except SourceError as error:
        return [f"{name}: {error}"]
    stale = [
        f"{name}:{number}: is {is_!r}, the results say {should!r}"
        for number, (is_, should) in enumerate(
            zip(text.split("\n"), wanted.split("\n"), strict=False), start=1
        )
        if is_ != should
    ]
    if not stale and text != wanted:
        stale = [f"{name}: a table has other rows than the results"]
    return stale + [f"{name}:{number}: {fault}" for number, fault in unmarked(name, text)]


def main(arguments: list[str] | None = None) -> int:
    """Renew or check; 1 where ``--check`` finds something."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.writers.figures", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--check", action="store_true", help="change nothing, list what is wrong")
    parser.add_argument(
        "--evaluations", metavar="FILE", help="show these evaluations from now on (a file in docs/data)"
    )
    parser.add_argument("--pieces", metavar="FILE", help="show these pieces of the pilot from now on")
    chosen = parser.parse_args(arguments)
    given = {"evaluations": chosen.evaluations, "pieces": chosen.pieces}
    if named := {what: Path(file).name for what, file in given.items() if file}:
        place = ROOT / "docs/data/shown.json"
        named = json.loads(place.read_text(encoding="utf-8")) | named
        place.write_text(json.dumps(named) + "\n", encoding="utf-8")
    sources, wrong = Sources(), 0
    for path in pages():
        if not chosen.check:
            try:
                path.write_text(renewed(path.read_text(encoding="utf-8"), sources), encoding="utf-8")
            except SourceError as error:
                print(f"{path.relative_to(ROOT)}: not renewed: {error}", file=sys.stderr)
        for fault in faults(path, sources):
            wrong += 1
            print(fault, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
