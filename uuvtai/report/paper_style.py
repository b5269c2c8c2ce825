"""Panels that only a paper has: bars with intervals, and the ways that vehicles took."""

from __future__ import annotations

import io
import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uuvtai.common.colours import agent_colours
from uuvtai.report.blocks import Hover, Panel
from uuvtai.report.figures import INK, styled
from uuvtai.report.html import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Sheet

    from uuvtai.logs.drawing import Recording


# ---- Figures as journals want them: PDF and SVG, as wide as one or two columns of a page, text of one size.

ONE_COLUMN_IN, TWO_COLUMNS_IN = 3.5, 7.16  # widths of IEEE's columns
TEXT_PT = 8.0
_LEAST_PT = 5.0  # of the words in a cell that is too narrow for more
_CURVE_IN = 2.1  # height of a panel that has no wish of its own
_ROOM = 0.94  # of a cell's width that its words may take

_STYLE: dict[str, Any] = {
    "font.family": ["STIXGeneral", "DejaVu Sans"],  # both come with matplotlib; the second has more letters
    "font.size": TEXT_PT,
    "axes.titlesize": TEXT_PT,
    "axes.labelsize": TEXT_PT,
    "xtick.labelsize": TEXT_PT,
    "ytick.labelsize": TEXT_PT,
    "legend.fontsize": TEXT_PT,
    "pdf.fonttype": 42,  # fonts that publishers accept, text that can be searched
    "svg.fonttype": "path",  # looks the same where the font is missing
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "grid.linewidth": 0.5,
    "legend.handlelength": 1.4,
    "lines.linewidth": 1.1,
}


@dataclass(frozen=True)
class PaperPanel:
    """One pair of axes, and how high it is [in] where it has a width [in]."""

    draw: Callable[[Axes], Hover]
    height_in: Callable[[float], float]
    is_cells: bool = False  # its words stand in cells of one unit
    spans: bool = False  # takes the whole width, also of two columns


def of_panel(panel: Panel, is_cells: bool = False, spans: bool = False) -> PaperPanel:
    height = _CURVE_IN if panel.height_in == Panel.height_in and not is_cells else panel.height_in
    return PaperPanel(panel.draw, lambda _width: height, is_cells, spans)


def height_in(panels: Sequence[PaperPanel], width_in: float) -> float:
    """Of the figure [in]."""
    return math.fsum(_row_heights(panels, width_in)[1])


def _row_heights(panels: Sequence[PaperPanel], width_in: float) -> tuple[int, list[float]]:
    """How many panels stand side by side, and the height of each row [in]."""
    is_wide = width_in > ONE_COLUMN_IN
    across = 2 if is_wide and len(panels) > 1 and not any(panel.spans for panel in panels) else 1
    rows = [panels[i : i + across] for i in range(0, len(panels), across)]
    return across, [max(panel.height_in(width_in / across) for panel in row) for row in rows]


def sheets(panels: Sequence[PaperPanel], width_in: float) -> dict[str, bytes]:
    """The figure as 'pdf' and 'svg': one panel below the other in one column, two side by side in two."""
    across, heights = _row_heights(panels, width_in)
    with styled(_STYLE), warnings.catch_warnings():
        from matplotlib.figure import Figure as Sheet

        warnings.filterwarnings("ignore", "Glyph")  # a name may have letters that no font here has

        sheet = Sheet(figsize=(width_in, math.fsum(heights)), layout="constrained", facecolor="white")
        grid = sheet.subplots(len(heights), across, squeeze=False, gridspec_kw={"height_ratios": heights})
        for spare in grid.flatten()[len(panels) :]:
            spare.remove()
        places = list(zip(panels, grid.flatten(), strict=False))
        for panel, axes in places:
            axes.set_facecolor("none")
            panel.draw(axes)
        _settle(sheet, [axes for panel, axes in places if panel.is_cells])
        return {"pdf": _saved(sheet, "pdf", "CreationDate"), "svg": _saved(sheet, "svg", "Date")}


def _saved(sheet: Sheet, kind: str, date: str) -> bytes:
    file = io.BytesIO()
    sheet.savefig(file, format=kind, metadata={"Creator": "uuvtai", date: None})
    return file.getvalue()


def _settle(sheet: Sheet, cells: Sequence[Axes]) -> None:
    """All text of one size, smaller where cells are narrow; names under an axis turn where they touch."""
    from matplotlib.text import Text

    for text in sheet.findobj(Text):
        text.set_fontsize(TEXT_PT)
    sheet.draw_without_rendering()
    for axes in sheet.axes:
        if _touch([label for label in axes.get_xticklabels() if label.get_text()]):
            axes.tick_params(axis="x", labelrotation=30)
            for label in axes.get_xticklabels():
                label.set_horizontalalignment("right")
    for axes in cells:
        _shrink(axes)


def _touch(labels: Sequence[Any]) -> bool:
    boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
    return any(left.x1 > right.x0 for left, right in itertools.pairwise(boxes))


def _shrink(axes: Axes) -> None:
    """The words in the cells of one pair of axes, so that the widest fits."""
    (x0, _), (x1, _) = axes.transData.transform([(0, 0), (1, 0)])
    widest = max((text.get_window_extent().width for text in axes.texts if text.get_text()), default=0.0)
    share = _ROOM * (x1 - x0) / widest if widest else 1.0
    for text in axes.texts if share < 1.0 else []:
        text.set_fontsize(max(_LEAST_PT, share * TEXT_PT))


_BAR_IN, _FRAME_IN = 0.21, 0.55
_TOPS = (10.0, 20.0, 50.0, 100.0)  # ends of an axis of shares [%]
_MOST_IN = 4.2  # height of a tank as deep as it is long
_RESTS, _MOVES = "#8a929b", "#d9480f"


def bars(agents: Sequence[dict[str, Any]], key: str) -> PaperPanel:
    """Rate ``key`` ('success', 'collision') of every agent [%], with its 95 % interval."""
    known = [m for m in agents if m.get(f"{key}_rate") is not None]
    colours = agent_colours([m["name"] for m in agents])

    def draw(axes: Axes) -> Hover:
        for place, m in enumerate(known):
            low, high = (100 * bound for bound in m[f"{key}_ci95"])
            axes.barh(place, 100 * m[f"{key}_rate"], height=0.62, color=colours[m["name"]])
            axes.plot([low, high], [place, place], color=INK, linewidth=0.9, marker="|", markersize=4)
        highest = max((100 * m[f"{key}_ci95"][1] for m in known), default=100.0)
        axes.set_yticks(range(len(known)), [m["name"] for m in known])
        axes.set_ylim(len(known) - 0.5, -0.5)
        axes.set_xlim(0, next((top for top in _TOPS if highest <= top), _TOPS[-1]))
        axes.set_xlabel(f"{key} [%]")
        axes.grid(False, axis="y")
        return {}

    return PaperPanel(draw, lambda _width: _FRAME_IN + _BAR_IN * max(2, len(known)))


def ways(logs: Sequence[Path]) -> tuple[PaperPanel, str]:
    """The ways of several agents through one episode, and the episode in words. Raises LogError."""
    from uuvtai.logs.drawing import PICTURE_TOPICS, drawing, load_recording
    from uuvtai.logs.picture import check_same_episode

    found = [load_recording(path, PICTURE_TOPICS) for path in logs]
    check_same_episode(found)
    scenario = found[0].scenario
    with drawing(logs[0]):
        (x0, x1), (y0, y1) = scenario["tank"]["x_m"], scenario["tank"]["y_m"]
        ratio = (y1 - y0) / (x1 - x0)
        said = f"world {scenario['world']}, seed {scenario['seed']}, episode {scenario['episode']}"
        ends = "; ".join(
            f"{shown(one.agent)}: {one.outcome_text} after {one.duration_s:.1f} s" for one in found
        )

    def draw(axes: Axes) -> Hover:
        with drawing(logs[0]):
            _draw_ways(axes, found)
        return {}

    def height(width_in: float) -> float:
        return min(0.6 + 0.15 * -(-len(found) // 3) + ratio * (width_in - 0.5), _MOST_IN)

    moment = f"when {shown(found[0].agent)} ends"
    return PaperPanel(
        draw, height, spans=True
    ), f"{said}. {ends}. Moving obstacles are drawn where they are {moment}"


def _draw_ways(axes: Axes, found: Sequence[Recording]) -> None:
    from matplotlib.patches import Polygon

    from uuvtai.logs.drawing import tank_outline

    scenario = found[0].scenario
    axes.grid(False)
    axes.set_aspect("equal")
    axes.add_patch(Polygon(tank_outline(scenario["tank"]), facecolor="none", edgecolor=INK, linewidth=1.0))
    _draw_obstacles(axes, scenario, found[0].duration_s)
    colours = agent_colours([shown(one.agent) for one in found])
    for one in found:
        at = one.positions
        ink = colours[shown(one.agent)]
        axes.plot(at[:, 0], at[:, 1], color=ink, linewidth=1.2, label=shown(one.agent))
        end = "o" if one.outcome == "success" else "X"
        axes.plot([at[-1, 0]], [at[-1, 1]], color=ink, marker=end, markersize=4.5, linestyle="none")
    start, goal = scenario["start"], scenario["goal"]
    axes.plot([start[0]], [start[1]], color=INK, marker="s", markersize=4, linestyle="none", label="start")
    axes.plot([goal[0]], [goal[1]], color=INK, marker="*", markersize=8, linestyle="none", label="goal")
    (x0, x1), (y0, y1) = scenario["tank"]["x_m"], scenario["tank"]["y_m"]
    axes.set_xlim(x0 - 0.1, x1 + 0.1)
    axes.set_ylim(y0 - 0.1, y1 + 0.1)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, borderaxespad=0.2, columnspacing=1.0,
        handletextpad=0.4,
    )  # fmt: skip


def _draw_obstacles(axes: Axes, scenario: dict[str, Any], time_s: float) -> None:
    """What rests, filled; what moves, as an outline where it is when the first agent ends, on its path."""
    import numpy as np
    from matplotlib.patches import Polygon

    from uuvtai.common.obstacle_motion import obstacle_positions
    from uuvtai.logs.drawing import obstacle_outline

    for obstacle in scenario["obstacles"]:
        outline = obstacle_outline(obstacle, obstacle_positions(obstacle, np.array([time_s]))[0])
        if obstacle["path"] is None:
            axes.add_patch(Polygon(outline, facecolor=_RESTS, edgecolor="none"))
            continue
        period = obstacle["path"]["length_m"] / max(obstacle["path"]["speed_m_s"], 1e-6)
        way = obstacle_positions(obstacle, np.linspace(0, period, 181))
        axes.plot(way[:, 0], way[:, 1], color=_MOVES, linewidth=0.5, linestyle=(0, (3, 2)), alpha=0.45)
        axes.add_patch(Polygon(outline, facecolor="none", edgecolor=_MOVES, linewidth=0.8))
