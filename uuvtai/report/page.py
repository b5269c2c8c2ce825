"""From blocks to one self-contained HTML page: no script, no address, nothing but what stands in it;
everything from files is escaped."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from uuvtai.report import ink
from uuvtai.report.blocks import Block, Figure, PageSection
from uuvtai.report.colours import on_page
from uuvtai.tables.table import Data
from uuvtai.version import __version__

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup

_MAX_SHOWN_ROWS = 200
"""A longer table of numbers is for download only."""


@dataclass(frozen=True)
class Page:
    """A titled page."""

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

        name = self._free_name(figure.name)
        self.pngs[name] = ink.png(figure.panels)
        # safe: ElementTree wrote it from matplotlib's own drawing and escaped every text in it
        return [
            Markup(ink.svg(panel, f"{name}-{i}-", figure.caption)) for i, panel in enumerate(figure.panels)
        ]

    def _free_name(self, wanted: str) -> str:
        plain = re.sub(r"[^a-z0-9]+", "_", wanted.lower()).strip("_") or "figure"
        names = [plain, *(f"{plain}_{i}" for i in range(2, len(self.pngs) + 3))]
        return next(name for name in names if name not in self.pngs)


def render(page: Page) -> tuple[str, dict[str, bytes]]:
    """(the page's HTML, name -> PNG of every figure)."""
    drawing = _Drawing()
    html = _template().render(
        page=page, version=__version__, svgs=drawing.svgs, kind=lambda block: type(block).__name__,
        max_rows=_MAX_SHOWN_ROWS,
        on_page=on_page, csv_uri=_csv_uri, file_name=_file_name, data_uri=_data_uri, text=_text,
    )  # fmt: skip
    return html, drawing.pngs


@cache
def _template() -> Template:
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(
        (files("uuvtai") / "presets" / "report" / "page.html.j2").read_text(encoding="utf-8")
    )


def _csv_uri(data: Data) -> str:
    return "data:text/csv;charset=utf-8," + quote(data.csv())


def _data_uri(mime: str, content: bytes) -> str:
    return f"data:{mime};base64,{base64.b64encode(content).decode()}"


def _file_name(text: str) -> str:
    return re.sub(r"[^\w.-]+", "_", text).strip("_")[:80] or "data"


def _text(value: Any) -> str:
    """A number of a data table as it is, but not longer than anybody reads."""
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
