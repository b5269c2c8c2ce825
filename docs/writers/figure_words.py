"""Which numbers in the text are figures, and which of them do not say where they come from.

A figure is a number with the unit of a result, a count (490/500), an interval ([96.3, 98.9]), success /
collision, or a number alone in the cell of a table. It is marked by a source (``figures.py``), or it says
what else it is: ``60 s<!-- parameter -->`` for the figures before it on the line, ``<!-- figures: parameter
-->`` on a line of its own for all figures down to the next heading or the next such line. Code, addresses and
generated tables are not looked at.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

KINDS = {
    "parameter": "what somebody chose: a setting, a limit, a size, the scene",
    "definition": "part of what a word means",
    "theirs": "another project's or the paper's own figure, with its source beside it",
    "log": "measured once; the page says when, and that the raw file was not kept",
    "marked": "back to the rule: every figure has a source",
}
LOGS = {
    "docs/history.md": "a log of optimisations: before and after, at the commit of each",
    "docs/tuning.md": "a log of experiments on tuning seeds",
}
"""pages that are logs as a whole, and say so under their title"""
GENERATED = {"docs/results.md": "python -m docs.writers.reproduction"}
"""pages that are written as a whole; a test compares them with their data"""
PARAMETER_PAGES = (
    "docs/deployment.md",
    "docs/determinism.md",
    "docs/gallery.md",
    "docs/live.md",
    "docs/paper.md",
    "docs/python.md",
    "docs/security.md",
    "docs/simulator.md",
    "docs/viewers.md",
)
"""pages without results: their seconds, sizes and cells are parameters; a rate there must be marked as
anywhere"""
NOT_KEPT = re.compile(r"raw files? (?:was|were) not kept")
"""what a page with figures of kind ``log`` says"""

_N = r"(?<![\w.,])-?\d+(?:,\d{3})*(?:\.\d+)?"
RATES = re.compile(
    rf"{_N}\s?%|(?<![\w./])\d+/\d+(?![\w/])|\[(?!-){_N}\s?%?, {_N}\s?%?\]|{_N} \.\. {_N}|{_N} / {_N}(?![ "
    r"]?/|\w)"
    rf"|{_N} (?!m/s|rad/s)(?:[\w-]+/s\b|times\b|points?\b|x\b(?! \(?\d))|\bp = {_N}|\bAUROC {_N}|{_N} "
    rf"(?:of|against) {_N}"
)
"""numbers that are results wherever they stand"""
SIZES = re.compile(
    rf"{_N}\s?(?:s|ms|us|ns|min|h|hours?|minutes?|seconds?|kB|MB|GB|MiB|GiB|TiB|core-hours)\b(?!/)"
)
"""times and amounts of memory; speeds, lengths and angles are the scene's and the vehicle's"""
CELL = re.compile(rf"^[*†\s]*{_N}(?:[\s/,]+{_N}|\s*\[[^\]]*\])*[*†\s]*$")
"""a cell of a table that holds nothing but numbers"""

_FENCE = re.compile(r"^```.*?^```", re.M | re.S)
_TABLE = re.compile(r"<!-- table: \w+ -->\n.*?^<!-- end -->", re.M | re.S)
_CODE = re.compile(r"`[^`\n]*`")
_ADDRESS = re.compile(r"https?://[^\s<>)]+|\]\([^)\n]*\)")
_SCENE = re.compile(r"\(\d+(?:, \d+(?:\.\d+)?)*\)|\b[SDv] (?:=|<=|>=) [\d.]+(?: m/s)?|\{[^}\n]*\}")
"""a scene such as (8, 6, 0.6), or one of its numbers"""
_LEVEL = re.compile(r"(?<!\d)95 % (?=Wilson|intervals?|bootstrap)|\[95 %\]|(?<=, )95 %(?= \|)")
"""the level of an interval"""
_COMMENT = re.compile(r"<!-- (?P<text>.*?) -->")


def _blank(found: re.Match[str]) -> str:
    """Spaces in place of letters, so that lines keep their numbers and columns."""
    return re.sub(r"[^\n]", " ", found[0])


def unmarked(name: str, text: str) -> Iterator[tuple[int, str]]:
    """(number of the line, what is wrong) for each figure that says nothing of itself; ``name`` is the page's
    path."""
    if name in GENERATED:
        return
    if name in LOGS:
        if "log of past measurements" not in " ".join(text.split())[:800]:
            yield 1, "is a log (figure_words.LOGS), but does not say so under its title"
        return
    noted = ""
    for pattern in (_FENCE, _TABLE, _CODE, _ADDRESS):
        text = pattern.sub(_blank, text)
    logged = False
    for number, line in enumerate(text.split("\n"), start=1):
        if alone := re.fullmatch(r"<!-- figures: (?P<kind>\w+).* -->", line.strip()):
            noted = alone["kind"]
            logged |= noted == "log"
            if noted not in KINDS:
                yield number, f"no kind {noted!r}; there are {', '.join(KINDS)}"
            continue
        if line.startswith("#"):
            noted = ""
        if noted in ("", "marked"):
            yield from (
                (number, f"{figure!r} does not say where it comes from")
                for figure in _figures(line, name in PARAMETER_PAGES)
            )
        logged |= "<!-- log" in line
    if logged and not NOT_KEPT.search(" ".join(text.split())):
        yield 1, "has figures of kind 'log', but nowhere says that the raw files were not kept"


def _figures(line: str, rates_alone: bool) -> list[str]:
    """Figures of a line that no comment covers."""
    comments = [
        found
        for found in _COMMENT.finditer(line)
        if found["text"].startswith("= ") or found["text"].split()[0] in KINDS
    ]
    plain = _LEVEL.sub(_blank, _SCENE.sub(_blank, _COMMENT.sub(_blank, line)))
    covered = _covered(plain, comments)
    found = [
        match
        for pattern in ((RATES,) if rates_alone else (RATES, SIZES))
        for match in pattern.finditer(plain)
    ]
    loose = [match[0].strip() for match in found if not all(_inside(span, covered) for span in _spans(match))]
    return loose + ([] if rates_alone else _cells(plain, covered))


def _covered(plain: str, comments: list[re.Match[str]]) -> list[tuple[int, int]]:
    """Where the numbers stand that comments speak for: as many as it has expressions, or all since the
    comment before it."""
    covered, begin = [], 0
    for comment in comments:
        numbers = [
            (n.start(), n.end())
            for n in re.finditer(r"(?<![\w.])-?\d+(?:,\d{3})*(?:\.\d+)?(?:/\d+)?", plain[: comment.start()])
        ]
        numbers = [span for span in numbers if span[0] >= begin]
        covered += (
            numbers[-len(comment["text"].split(" ; ")) :] if comment["text"].startswith("= ") else numbers
        )
        begin = comment.end()
    return covered


def _spans(match: re.Match[str]) -> list[tuple[int, int]]:
    """Where the numbers of a figure stand."""
    return [
        (match.start() + n.start(), match.start() + n.end())
        for n in re.finditer(r"\d+(?:,\d{3})*(?:\.\d+)?", match[0])
    ]


def _inside(span: tuple[int, int], covered: list[tuple[int, int]]) -> bool:
    return any(low <= span[0] and span[1] <= high for low, high in covered)


def _cells(plain: str, covered: list[tuple[int, int]]) -> list[str]:
    """Cells of a line of a table that are nothing but numbers and not covered."""
    if not plain.startswith("|"):
        return []
    found, begin = [], 0
    for cell in plain.split("|"):
        spans = [(begin + n.start(), begin + n.end()) for n in re.finditer(r"\d+(?:,\d{3})*(?:\.\d+)?", cell)]
        if CELL.match(cell) and not all(_inside(span, covered) for span in spans):
            found.append(cell.strip())
        begin += len(cell) + 1
    return found
