"""Panels that only a paper has: bars with intervals, and the ways that vehicles took."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uuvtai.report.blocks import Hover
from uuvtai.report.colours import method_colours
from uuvtai.report.ink import INK
from uuvtai.report.paper_style import PaperPanel
from uuvtai.report.plain_text import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from uuvtai.logs.recording import Recording

_BAR_IN, _FRAME_IN = 0.21, 0.55
_TOPS = (10.0, 20.0, 50.0, 100.0)
"""ends of an axis of shares [%]"""
_MOST_IN = 4.2
"""height of a tank as deep as it is long"""
_RESTS, _MOVES = "#8a929b", "#d9480f"


def bars(methods: Sequence[dict[str, Any]], key: str) -> PaperPanel:
    """Rate ``key`` ('success', 'collision') of every method [%], with its 95 % interval."""
    known = [m for m in methods if m.get(f"{key}_rate") is not None]
    colours = method_colours([m["name"] for m in methods])

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
    """The ways of several methods through one episode, and the episode in words. Raises LogError."""
    from uuvtai.logs.picture import check_same_episode
    from uuvtai.logs.recording import PICTURE_TOPICS, drawing, load_recording

    found = [load_recording(path, PICTURE_TOPICS) for path in logs]
    check_same_episode(found)
    scenario = found[0].scenario
    with drawing(logs[0]):
        (x0, x1), (y0, y1) = scenario["tank"]["x_m"], scenario["tank"]["y_m"]
        ratio = (y1 - y0) / (x1 - x0)
        said = f"world {scenario['world']}, seed {scenario['seed']}, episode {scenario['episode']}"
        endings = "; ".join(
            f"{shown(one.method)}: {one.ending} after {one.duration_s:.1f} s" for one in found
        )

    def draw(axes: Axes) -> Hover:
        with drawing(logs[0]):
            _draw_ways(axes, found)
        return {}

    def height(width_in: float) -> float:
        return min(0.6 + 0.15 * -(-len(found) // 3) + ratio * (width_in - 0.5), _MOST_IN)

    moment = f"when {shown(found[0].method)} ends"
    return PaperPanel(
        draw, height, spans=True
    ), f"{said}. {endings}. Moving bodies are drawn where they are {moment}"


def _draw_ways(axes: Axes, found: Sequence[Recording]) -> None:
    from matplotlib.patches import Polygon

    from uuvtai.logs.painting import tank_outline

    scenario = found[0].scenario
    axes.grid(False)
    axes.set_aspect("equal")
    axes.add_patch(Polygon(tank_outline(scenario["tank"]), facecolor="none", edgecolor=INK, linewidth=1.0))
    _draw_bodies(axes, scenario, found[0].duration_s)
    colours = method_colours([shown(one.method) for one in found])
    for one in found:
        at = one.positions
        ink = colours[shown(one.method)]
        axes.plot(at[:, 0], at[:, 1], color=ink, linewidth=1.2, label=shown(one.method))
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


def _draw_bodies(axes: Axes, scenario: dict[str, Any], time_s: float) -> None:
    """What rests, filled; what moves, as an outline where it is when the first method ends, on its path."""
    import numpy as np
    from matplotlib.patches import Polygon

    from uuvtai.closed_form import body_positions
    from uuvtai.logs.painting import body_outline

    for body in scenario["bodies"]:
        outline = body_outline(body, body_positions(body, np.array([time_s]))[0])
        if body["path"] is None:
            axes.add_patch(Polygon(outline, facecolor=_RESTS, edgecolor="none"))
            continue
        period = body["path"]["length_m"] / max(body["path"]["speed_m_s"], 1e-6)
        way = body_positions(body, np.linspace(0, period, 181))
        axes.plot(way[:, 0], way[:, 1], color=_MOVES, linewidth=0.5, linestyle=(0, (3, 2)), alpha=0.45)
        axes.add_patch(Polygon(outline, facecolor="none", edgecolor=_MOVES, linewidth=0.8))
