"""From panels to SVG for the page and PNG for the disk. matplotlib is imported here and in ``figures.py``
only, when something is drawn."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from uuvtai.report.blocks import Hover, Panel
from uuvtai.report.colours import PALETTE, on_page

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK = "#1b1c1d"
"""Colour of text, axes and grids: a mark that becomes the page's own text colour, in light and dark"""

_SVG = "http://www.w3.org/2000/svg"
_XLINK = "http://www.w3.org/1999/xlink"
_INCH_PX = 96
_SMALLEST = 0.8
"""A panel is never shown smaller than this share of its size, or its text could not be read: it scrolls in
its box instead"""

_STYLE = {
    "text.parse_math": False,  # a name with dollars is a name
    "text.usetex": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "uuvtai",  # the same figure is the same file
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.18,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.6,
    **dict.fromkeys(
        (
            "text.color",
            "axes.labelcolor",
            "axes.edgecolor",
            "axes.titlecolor",
            "xtick.color",
            "ytick.color",
            "grid.color",
        ),
        INK,
    ),
}


def svg(panel: Panel, prefix: str, label: str) -> str:
    """The panel as an inline ``<svg>``: text in the page's colour, ids that begin with ``prefix``, hover
    texts as ``<title>``."""
    with _style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(panel.width_in, panel.height_in), layout="constrained")
        hover = _drawn(panel, figure.subplots())
        text = io.StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    root = ElementTree.fromstring(text.getvalue())
    _strip(root)
    _recolour(root)
    _add_titles(root, hover)
    _rename(root, prefix)
    _size(root, panel, label)
    return ElementTree.tostring(root, encoding="unicode")


def png(panels: Sequence[Panel], columns: int = 2) -> bytes:
    """All panels on one white sheet, ``columns`` side by side."""
    rows = math.ceil(len(panels) / columns)
    columns = min(columns, len(panels))
    size = (columns * max(p.width_in for p in panels), rows * max(p.height_in for p in panels))
    with _style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=size, dpi=150, layout="constrained", facecolor="white")
        axes = figure.subplots(rows, columns, squeeze=False).flatten()
        for spare in axes[len(panels) :]:
            spare.remove()
        for panel, place in zip(panels, axes, strict=False):
            _drawn(panel, place)
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


@contextmanager
def _style() -> Iterator[None]:
    import matplotlib

    # the defaults first: a reader's own matplotlibrc does not change a report
    settings: Any = {**matplotlib.rcParamsDefault, "backend": "agg", **_STYLE}
    with matplotlib.rc_context(settings):
        yield


def _drawn(panel: Panel, axes: Axes) -> Hover:
    axes.set_facecolor("none")
    return panel.draw(axes)


def _strip(root: ElementTree.Element) -> None:
    """Without metadata and without the style sheet, which in a page would reach beyond this figure."""
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in (f"{{{_SVG}}}metadata", f"{{{_SVG}}}style"):
                parent.remove(child)


def _recolour(root: ElementTree.Element) -> None:
    """The ink becomes the page's text colour, the series' colours variables of the page, which has lighter
    ones for the dark."""
    named = {INK: "currentColor"} | {colour: on_page(colour) for colour in PALETTE}
    for element in root.iter():
        style = element.get("style")
        if style:
            for colour, name in named.items():
                style = style.replace(colour, name)
            element.set("style", style)


def _add_titles(root: ElementTree.Element, hover: Hover) -> None:
    by_id = {element.get("id"): element for element in root.iter()}
    for identity, text in hover.items():
        title = ElementTree.Element(f"{{{_SVG}}}title")
        title.text = text
        by_id[identity].insert(0, title)


def _rename(root: ElementTree.Element, prefix: str) -> None:
    """Several figures share a page: their ids must not meet."""
    for element in root.iter():
        for name, value in list(element.attrib.items()):
            if name == "id":
                element.set(name, prefix + value)
            elif name == f"{{{_XLINK}}}href":
                element.set(name, value.replace("#", f"#{prefix}", 1))
            elif "url(#" in value:
                element.set(name, value.replace("url(#", f"url(#{prefix}"))


def _size(root: ElementTree.Element, panel: Panel, label: str) -> None:
    width = panel.width_in * _INCH_PX
    for name in ("width", "height", "version"):
        root.attrib.pop(name, None)
    root.set("style", f"width: 100%; max-width: {width:.0f}px; min-width: {_SMALLEST * width:.0f}px")
    root.set("role", "img")
    root.set("aria-label", label)


ElementTree.register_namespace("", _SVG)
ElementTree.register_namespace("xlink", _XLINK)
