"""From blocks to one self-contained page: no address, no script but the player's; what comes from files is
escaped, or packed in base64."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from uuvtai.common import files
from uuvtai.common.colours import on_page
from uuvtai.common.files import json_object
from uuvtai.common.version import __version__
from uuvtai.config.loader import MAX_BYTES as MAX_YAML_BYTES
from uuvtai.config.loader import ConfigError
from uuvtai.report import figures
from uuvtai.report.blocks import Block, Figure, PageSection, Player

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup


_MAX_SHOWN_ROWS = 200  # A longer table of numbers is for download only.


@dataclass(frozen=True)
class Page:
    title: str
    subtitle: str
    notices: Sequence[Block]
    sections: Sequence[PageSection]


@dataclass
class _Drawing:
    """Figures are drawn as the page meets them; the PNGs are kept by name."""

    pngs: dict[str, bytes] = field(default_factory=dict)

    def svgs(self, figure: Figure) -> list[Markup]:
        """The figure's panels as markup; also draws the PNG."""
        from markupsafe import Markup

        plain = re.sub(r"[^a-z0-9]+", "_", figure.name.lower()).strip("_") or "figure"
        names = [plain, *(f"{plain}_{i}" for i in range(2, len(self.pngs) + 3))]
        name = next(name for name in names if name not in self.pngs)
        self.pngs[name] = figures.png(figure.panels)
        # safe: ElementTree wrote it from matplotlib's own drawing and escaped every text in it
        return [
            Markup(figures.svg(panel, f"{name}-{i}-", figure.caption))
            for i, panel in enumerate(figure.panels)
        ]


def render(page: Page) -> tuple[str, dict[str, bytes]]:
    """(the page's HTML, name -> PNG of every figure)."""
    drawing = _Drawing()
    has_player = any(
        isinstance(block, Player) and block.episodes for s in page.sections for block in s.blocks
    )
    return _rendered(page, _script(_RECORDED, "start") if has_player else "", drawing), drawing.pngs


def live_page(title: str, subtitle: str) -> str:
    """HTML of a page whose player asks the server that it comes from for running episodes."""
    return _rendered(Page(title, subtitle, [], []), _script((*_RECORDED, *_LIVE), "live"), _Drawing(), True)


def _rendered(page: Page, script: str, drawing: _Drawing, is_live: bool = False) -> str:
    return _template().render(
        page=page, version=__version__, svgs=drawing.svgs, kind=lambda block: type(block).__name__,
        max_rows=_MAX_SHOWN_ROWS, text=_text,
        csv_uri=lambda data: "data:text/csv;charset=utf-8," + quote(data.csv()),
        on_page=on_page, file_name=_file_name, data_uri=_data_uri, script=script, is_live=is_live,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )  # fmt: skip


_RECORDED = ("decode", "view", "paint", "strip", "source", "touch", "player")
_LIVE = ("running", "steer", "live")
_IMPORT = re.compile(r"^import [^\n]*\n|^export (?=[a-z])", re.MULTILINE)


@cache
def _script(names: tuple[str, ...], begin: str) -> Markup:
    """The player's modules as one script, each after those that it imports; ``begin`` is called at the
    end."""
    from markupsafe import Markup

    folder = resources.files("uuvtai") / "report" / "player"
    modules = [(folder / f"{name}.mjs").read_text(encoding="utf-8") for name in names]
    # safe: the package's own text, in which a test looks for what would end the element
    return Markup("\n".join([*(_IMPORT.sub("", module) for module in modules), f"{begin}();"]))


@cache
def _template() -> Template:
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(
        (resources.files("uuvtai") / "report" / "page.html.j2").read_text(encoding="utf-8")
    )


def _data_uri(content: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(content).decode()}"


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.-]+", "_", text).strip("_")[:80] or "data"


def _text(value: Any) -> str:
    """A number of a data table as it is, but not longer than anybody reads."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# ---- Reading a run folder: what is wrong with a file is said, and nothing that stands in one is executed.

_MAX_LINES = 1_000_000
_MOST = {
    "agents": 200,
    "cells": 20_000,
    "rows": 200,
    "paper_latency": 1000,
    "paper_density": 1000,
    "sections": 200,
}
"""entries of a result's lists that a page has room for: each is drawn, and drawing takes time"""
_MOST_VALUES = 10_000  # of an axis of a sweep


def read_json(run: Path, name: str) -> dict[str, Any] | None:
    """The document ``name`` of a run, None = no such file. Raises ConfigError for no JSON object."""
    path = run / name
    again = "write it again with the command in run.json"
    with files.refusing(ConfigError, f"{path}: cannot be read", refused=again):
        try:
            document = files.read_json(path, folder=run)
        except (FileNotFoundError, NotADirectoryError):
            return None
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: is no JSON object; {again}")
    _refuse_many(document, path)
    return document


def _refuse_many(document: dict[str, Any], path: Path) -> None:
    """Raise ConfigError for a document that would be drawn for hours."""
    axes = document.get("axes")
    lists = [(name, document.get(name), most) for name, most in _MOST.items()]
    if isinstance(axes, dict):
        lists += [(f"axes.{name:.40}", values, _MOST_VALUES) for name, values in axes.items()]
    for name, entries, most in [*lists, ("axes", axes, _MOST["agents"])]:
        if isinstance(entries, list | dict) and len(entries) > most:
            raise ConfigError(
                f"{path}: {name} has {len(entries):,} entries, more than the {most:,} that a page has room "
                "for"
            )


def read_lines(run: Path, name: str) -> list[dict[str, Any]]:
    """Objects of a JSONL file, [] = no file; a last line that a kill cut is left out. Raises ConfigError."""
    path, found, damaged = run / name, [], 0
    with files.refusing(ConfigError, f"{path}: cannot be read", refused=""), suppress(FileNotFoundError):
        for i, line in enumerate(files.read_lines(path, files.MAX_JSON_BYTES, run), start=1):
            if damaged or i > _MAX_LINES:
                why = "is no JSON object; take that line out to go on without it"
                why = why if damaged else f"is one of more than {_MAX_LINES:,}"
                raise ConfigError(f"{path}, line {damaged or i}: {why}")
            row = _object(line)
            if row is None:
                damaged = i
            else:
                found.append(row)
    return found


def _object(line: bytes) -> dict[str, Any] | None:
    """A record of figures."""
    row = json_object(line)
    return row and {key: value for key, value in row.items() if not isinstance(value, list | dict)}


def read_config(run: Path) -> str | None:
    """Text of config.yaml, or None where there is none. Raises ConfigError for what is no small text."""
    path = run / "config.yaml"
    with files.refusing(ConfigError, f"{path}: cannot be read", refused=""):
        try:
            return files.read_text(path, MAX_YAML_BYTES, run)
        except FileNotFoundError:
            return None


# ---- Texts of files without what no figure and no table can show.

_LONGEST = 300  # characters of a text in a document: names, not novels


def shown(text: str) -> str:
    """The text on one line, without control characters."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def all_shown(document: Any) -> Any:
    """A JSON document with such texts alone, none of them long."""
    if isinstance(document, str):
        return shown(document[:_LONGEST])
    if isinstance(document, dict):
        return {shown(key[:_LONGEST]): all_shown(value) for key, value in document.items()}
    return [all_shown(value) for value in document] if isinstance(document, list) else document
