"""What the figures show, panel by panel: heat maps, curves with seed bands, intervals, time per stage.

Every function gives a ``Panel`` whose drawing is done later; the hover texts carry counts and intervals.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from uuvtai.common.colours import PALETTE, SERIES, ink_on, on_page, shade
from uuvtai.report.blocks import Hover, Panel
from uuvtai.report.tables import HeatMap, Place, axis_name, number, percent, place_of, rate, value_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# ---- From panels to SVG for the page and PNG for the disk. matplotlib is imported when something is drawn.

INK = "#1b1c1d"  # text, axes and grids: a mark that becomes the page's own colour, in light and dark

_SVG = "http://www.w3.org/2000/svg"
_XLINK = "http://www.w3.org/1999/xlink"
_INCH_PX = 96
_SMALLEST = 0.8
"""A panel is never smaller than this share of its size, or nobody could read it: it scrolls instead"""

_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.titlesize": 10,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.6,
}
_COMMON: dict[str, Any] = {
    "backend": "agg",
    "text.parse_math": False,  # a name with dollars is a name
    "text.usetex": False,
    "svg.hashsalt": "uuvtai",  # the same figure is the same file
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.18,
    "legend.frameon": False,
}
_INKED = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color", "grid.color")


def svg(panel: Panel, prefix: str, label: str) -> str:
    """The panel as ``<svg>``: text in the page's colour, ids with ``prefix``, hover texts as ``<title>``."""
    with styled():
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
    with styled():
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
def styled(own: Mapping[str, Any] = _STYLE) -> Iterator[None]:
    """matplotlib's defaults, what all figures share, and ``own``: a reader's matplotlibrc changes nothing."""
    import matplotlib

    inks = dict.fromkeys(_INKED, INK)
    settings: Any = {**matplotlib.rcParamsDefault, **_COMMON, **inks, **own}
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
    """The ink becomes the page's text colour, the series' colours become variables of the page."""
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


_CELL_IN = (0.62, 0.36)
_MARGIN_IN = (1.15, 0.95)
_LOG_SPAN = 20.0  # A quantity that is positive and spans more than this factor has a logarithmic axis.
_ROOM = 0.09  # A stage is named in its bar where it takes more than this share of the longest one.
_GOLDEN = 0.618034  # Stages that follow each other get colours this share of the scale apart.


@dataclass(frozen=True)
class Line:
    """A curve; ``low`` and ``high`` bound its band or error bars, ``said``: shown over a point."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] | None = None
    high: Sequence[float] | None = None
    said: Sequence[str] = ()
    colour: str = ""  # '#rrggbb' of an agent; none = by the order of the lines


# -------------------------------------------------------------------------------------------------- heat maps


def heat_map(chosen: HeatMap, key: str, title: str) -> Panel:
    """Rate ``key`` [%] of every cell, below it the mean time to success [s]; bright is good in both maps."""

    def draw(axes: Axes) -> Hover:
        axes.set_title(title, loc="left")
        axes.grid(False)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
        axes.set_xlim(0, len(chosen.column_values))
        axes.set_ylim(len(chosen.row_values), 0)
        axes.set_xticks([i + 0.5 for i in range(len(chosen.column_values))], chosen.column_names)
        axes.set_yticks([i + 0.5 for i in range(len(chosen.row_values))], chosen.row_names)
        axes.set_xlabel(axis_name(chosen.column_axis))
        axes.set_ylabel(chosen.row_title)
        for row in _group_begins(chosen):
            axes.axhline(row, color=INK, linewidth=1.0, xmin=-0.02, clip_on=False)
        return dict(_draw_cell(axes, place, key, f"cell-{i}") for i, place in enumerate(chosen.places))

    width = _MARGIN_IN[0] + _CELL_IN[0] * max(4, len(chosen.column_values))
    return Panel(draw, width, _MARGIN_IN[1] + _CELL_IN[1] * len(chosen.row_values))


def _draw_cell(axes: Axes, place: Place, key: str, identity: str) -> tuple[str, str]:
    """(id, hover text) of the cell that was drawn."""
    from matplotlib.patches import Rectangle

    value = place.cell.get(key)
    ground = "none" if value is None else shade(value if key == "success_rate" else 1.0 - value)
    corner, gap = (place.first + 0.02, place.row + 0.03), (0.04, 0.06)
    box = Rectangle(
        corner, place.n_columns - gap[0], 1 - gap[1], facecolor=ground, edgecolor="none", gid=identity
    )
    axes.add_patch(box)
    ink = INK if value is None else ink_on(ground)
    middle = place.first + place.n_columns / 2
    centred: Any = {"color": ink, "ha": "center", "va": "center"}
    axes.text(middle, place.row + 0.34, percent(value, 0), fontsize=8.5, fontweight="bold", **centred)
    mean_s = place.cell.get("time_to_success_mean_s")
    below = "" if mean_s is None else f"{number(mean_s)} s"
    axes.text(middle, place.row + 0.73, below, fontsize=7, **centred)
    return identity, hover_text(place.cell)


def hover_text(cell: dict[str, Any]) -> str:
    where = ", ".join(f"{axis_name(name)} = {value_name(value)}" for name, value in place_of(cell).items())
    return f"{where}\n{rates_text(cell)}"


def rates_text(cell: dict[str, Any]) -> str:
    """Rates of a cell or an agent with count and interval, a line each."""
    n = cell["episodes"]
    rates = [
        f"{name} {rate(round(share * n), n, cell.get(f'{name}_ci95'))}"
        for name in ("success", "collision")
        if (share := cell.get(f"{name}_rate")) is not None
    ]
    return "\n".join([*rates, f"mean time to success {number(cell.get('time_to_success_mean_s'))} s"])


def _group_begins(chosen: HeatMap) -> list[int]:
    """Rows at which the slowest row axis takes its next value."""
    if len(chosen.row_axes) < 2:
        return []
    first = [values[0] for values in chosen.row_values]
    return [row for row in range(1, len(first)) if first[row] != first[row - 1]]


# ----------------------------------------------------------------------------------------------------- curves


def curves(lines: Sequence[Line], title: str, x_label: str, share: bool = False, zero: bool = False) -> Panel:
    """Curves with their bands; ``share``: drawn in per cent from 0 to 100; ``zero``: the axis begins at 0."""

    def draw(axes: Axes) -> Hover:
        axes.set_title(title, loc="left")
        axes.set_xlabel(x_label)
        scale = 100.0 if share else 1.0
        for i, line in enumerate(lines):
            colour = _colour(line, i)
            few = {"marker": "o", "markersize": 3} if len(line.x) <= 12 else {}
            axes.plot(line.x, [scale * y for y in line.y], color=colour, label=line.name, **few)
            if line.low is not None and line.high is not None:
                low, high = ([scale * y for y in bound] for bound in (line.low, line.high))
                axes.fill_between(line.x, low, high, color=colour, alpha=0.2, linewidth=0)
        _frame(axes, lines, share, zero)
        return {}

    return Panel(draw)


def intervals(
    lines: Sequence[Line], names: Sequence[str], title: str, x_label: str, joined: bool = True
) -> Panel:
    """Shares with their intervals at named places, joined where these are values of one axis. ``x`` of a line
    counts places.

    Lines that are not joined have a place of their own each, which names them.
    """

    def draw(axes: Axes) -> Hover:
        axes.set_title(title, loc="left")
        axes.set_xlabel(x_label)
        hover: Hover = {}
        for i, line in enumerate(lines):
            shift = 0.12 * (i - (len(lines) - 1) / 2) if joined else 0.0
            hover |= _draw_intervals(axes, i, line, shift, joined)
        axes.set_xticks(range(len(names)), names)
        axes.set_xlim(-0.5, len(names) - 0.5)
        _frame(axes, lines if joined else [], share=True, zero=True)
        axes.set_ylim(-0.03 * (top := _top(lines)), 1.03 * top)
        return hover

    return Panel(draw, width_in=max(4.4, 1.6 + 0.55 * len(names)))


def _colour(line: Line, i: int) -> str:
    return line.colour or SERIES[i % len(SERIES)]


def _top(lines: Sequence[Line]) -> float:
    """End of an axis of shares [%] that shows the highest bound, in round steps."""
    highest = max((100 * y for line in lines for y in (line.high or line.y)), default=100.0)
    return next((top for top in (10.0, 20.0, 50.0) if highest <= top), 100.0)


def _draw_intervals(axes: Axes, i: int, line: Line, shift: float, joined: bool) -> Hover:
    """Points and error bars of one line, moved aside by ``shift`` so that lines do not cover each other."""
    colour, places = _colour(line, i), [x + shift for x in line.x]
    axes.plot(
        places,
        [100 * y for y in line.y],
        color=colour,
        marker="o",
        markersize=5,
        linewidth=0.8 if joined else 0,
        label=line.name,
    )
    for k, (x, low, high) in enumerate(zip(places, line.low or line.y, line.high or line.y, strict=True)):
        bar: Any = {"linewidth": 2.4, "solid_capstyle": "butt", "gid": f"interval-{i}-{k}"}
        axes.plot([x, x], [100 * low, 100 * high], color=colour, **bar)
    return {f"interval-{i}-{k}": text for k, text in enumerate(line.said)}


def _frame(axes: Axes, lines: Sequence[Line], share: bool, zero: bool) -> None:
    if share:
        axes.set_ylim(-3, 103)
        axes.set_ylabel("%")
    elif zero:
        axes.set_ylim(bottom=0)
    elif (y := [y for line in lines for y in line.y]) and max(y) > _LOG_SPAN * min(y) > 0:
        axes.set_yscale("log")
    if len(lines) > 1:
        axes.legend(loc="best")


# ------------------------------------------------------------------------------------------------------- time


def stages(rows: Sequence[tuple[str, dict[str, float]]], title: str) -> Panel:
    """Time per stage as one bar a row, widest first: (row's name, stage -> us per env-step)."""

    def draw(axes: Axes) -> Hover:
        axes.set_title(title, loc="left")
        axes.set_xlabel("us per env-step")
        axes.grid(False, axis="y")
        longest = max(sum(spent.values()) for _, spent in rows)
        hover: Hover = {}
        for row, (_name, spent) in enumerate(rows):
            hover |= _stage_bar(axes, row, spent, longest)
        axes.set_yticks(range(len(rows)), [name for name, _ in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        return hover

    return Panel(draw, 8.6, 0.9 + 0.55 * len(rows))


def _stage_bar(axes: Axes, row: int, spent: dict[str, float], longest: float) -> Hover:
    """One bar; a stage keeps its colour in every row, and its name where there is room for it."""
    hover: Hover = {}
    left, whole, order = 0.0, sum(spent.values()), list(spent)
    for stage, us in sorted(spent.items(), key=lambda item: -item[1]):
        i = order.index(stage)
        gid, ground = f"stage-{row}-{i}", shade(0.1 + 0.85 * (i * _GOLDEN % 1.0))
        axes.barh(row, us, left=left, height=0.7, color=ground)[0].set_gid(gid)
        if us > _ROOM * longest:
            centred: Any = {"ha": "center", "va": "center", "fontsize": 7}
            axes.text(left + us / 2, row, f"{stage}\n{us:.1f}", color=ink_on(ground), **centred)
        hover[gid] = f"{stage}: {us:.2f} us per env-step, {percent(us / whole if whole else None)}"
        left += us
    return hover
