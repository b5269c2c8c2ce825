"""LaTeX of tables and floats. Whatever a user can name is text in it, never a command."""

from __future__ import annotations

import re
from collections.abc import Sequence

from uuvtai.report.plain_text import shown
from uuvtai.tables.table import PAGE, Column, Table

_SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "'": r"\textquotesingle{}",
    "`": r"\textasciigrave{}",
    "·": r"\textperiodcentered{}",
    "±": r"$\pm$",
    "µ": r"$\mu$",
    "°": r"\textdegree{}",
    "†": r"\textdagger{}",
    "–": r"\textendash{}",
    "—": r"\textemdash{}",
    "−": "$-$",
}
_LETTERS = range(0xC0, 0x100)
"""letters with accents that every LaTeX knows in UTF-8"""
_NO_LETTERS = (0xD7, 0xF7)
_COLUMN_CHARACTERS, _GAP = 52, 2
"""what fits one column of a page, and what a column of the table takes beside its words"""
_MINUS = re.compile(r"(?<![\w.-])-(?=\d)")
"""before a number of a table"""
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


def _spec(column: Column) -> str:
    return _PROSE if column.prose else "l" if column.left else "r"


def tabular(table: Table, remark: str) -> str:
    """The table with the rules of booktabs, below a comment."""
    columns, cells = table.on(PAGE)
    lines = [[_cell(column.head) for column in columns], *([_cell(str(c)) for c in row] for row in cells)]
    head, *rows = (" & ".join(line) + r" \\" for line in lines)
    return "\n".join(
        [
            *map(comment, remark.splitlines()),
            rf"\begin{{tabular}}{{{''.join(map(_spec, columns))}}}",
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
    """Whether a table wants both columns of a page."""
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
