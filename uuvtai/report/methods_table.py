"""Blocks of an evaluation (the document of ``uuv eval --json``): methods, and why they failed."""

from __future__ import annotations

from typing import Any

from uuvtai.outcomes import ENDINGS
from uuvtai.report.blocks import Block, Figure, Paragraph
from uuvtai.report.colours import method_colours
from uuvtai.report.figures import Line, intervals, rates_text
from uuvtai.tables.method_tables import causes_table, methods_table, paired_table
from uuvtai.tables.table import Column, Data, Table
from uuvtai.tables.wording import bodies, number, sensing, vehicle

Method = dict[str, Any]


def evaluation(result: dict[str, Any], command: str = "") -> list[Block]:
    """Everything that an evaluation has to show but its pictures."""
    methods = result["methods"]
    table = methods_table(methods, _METHODS, data=evaluation_data(methods), swatches=_swatches(methods))
    blocks: list[Block] = [Paragraph(conditions(result)), table]
    if methods:
        blocks.append(_rates_figure(methods, command))
    blocks += _paired(result.get("paired", []))
    blocks.append(Table(_PLANNING, methods, "Planning", swatches=_swatches(methods)))
    for method in methods:
        blocks += _causes(method)
    return blocks


_METHODS = (
    "Methods. Collision counts contacts, TTC stops and episodes out of the tank; intervals are 95 % Wilson. "
    "Time to goal: mean over successes; TTS: mean time over success rate."
)


def conditions(result: dict[str, Any]) -> str:
    """The scene in a sentence."""
    speed = f", v = {result['v_m_s']} m/s" if result["D"] else ""
    seeds = ", ".join(map(str, result["seeds"]))
    return (
        f"World {result['world']}, {bodies(result, ' resting', ' moving obstacles')}{speed}, "
        f"{vehicle(result)}{sensing(result)}; seeds {seeds}, {result['episodes_per_seed']} episodes each, "
        "the same ones for every method."
    )


def _swatches(methods: list[Method]) -> list[str]:
    names = [m["name"] for m in methods]
    colours = method_colours(names)
    return [colours[name] for name in names]


_PLAIN = (
    "success_rate",
    "collision_rate",
    "time_to_success_mean_s",
    "time_mean_s",
    "tts_s",
    "return_mean",
    "min_clearance_mean_m",
)


def evaluation_data(methods: list[Method]) -> Data:
    """Counts, rates, bounds and times of every method as numbers."""
    bounds = ("success_ci95_low", "success_ci95_high", "collision_ci95_low", "collision_ci95_high")
    rows = [
        [
            m["name"],
            m["episodes"],
            *(m["outcomes"][name] for name in ENDINGS),
            *_bounds(m),
            *(m.get(name) for name in _PLAIN),
        ]
        for m in methods
    ]
    return Data(["method", "episodes", *ENDINGS, *bounds, *_PLAIN], rows)


def _bounds(m: dict[str, Any]) -> list[float | None]:
    return [*(m["success_ci95"] or (None, None)), *(m["collision_ci95"] or (None, None))]


def _rates_figure(methods: list[Method], command: str) -> Figure:
    names = [m["name"] for m in methods]
    colours = _swatches(methods)
    panels = [
        intervals(
            [_rates_line(i, m, key, colours[i]) for i, m in enumerate(methods)], names, key, "", joined=False
        )
        for key in ("success", "collision")
    ]
    return Figure(
        "methods",
        panels,
        "Success and collision of every method with 95 % Wilson intervals",
        evaluation_data(methods),
        command,
    )


def _rates_line(place: int, method: Method, key: str, colour: str) -> Line:
    """The one point of a method; none where it played nothing."""
    if method[f"{key}_rate"] is None:
        return Line(method["name"], [], [], [], [], colour=colour)
    low, high = method[f"{key}_ci95"]
    return Line(
        method["name"],
        [place],
        [method[f"{key}_rate"]],
        [low],
        [high],
        [f"{method['name']}\n{rates_text(method)}"],
        colour,
    )


_PAIRED = (
    "both",
    "only_a",
    "only_b",
    "mcnemar_p",
    "time_a_mean_s",
    "time_b_mean_s",
    "time_difference_mean_s",
)


_BOUNDS = "time_difference_ci95"


def _paired(pairs: list[dict[str, Any]]) -> list[Block]:
    """[] without two methods."""
    if not pairs:
        return []
    caption = (
        "Pairs of methods on the same episodes: who alone arrives, with McNemar's exact p, and the mean "
        "times where both arrive, their difference with its 95 % bootstrap interval. The values of p are not "
        "adjusted for the number of pairs"
    )
    return [paired_table(pairs, caption, data=paired_data(pairs))]


def paired_data(pairs: list[dict[str, Any]]) -> Data:
    """Pairs of methods as numbers."""
    keys = ("a", "b", "episodes", *_PAIRED)
    rows = [[*map(pair.get, keys), *(pair.get(_BOUNDS) or (None, None))] for pair in pairs]
    return Data([*keys, f"{_BOUNDS}_low", f"{_BOUNDS}_high"], rows)


def _counts(method: Method, key: str, *names: str) -> str:
    return " / ".join(str(method.get(key, {}).get(name, "-")) for name in names)


_PLANNING = (
    Column("method", left=True, of=lambda m: m["name"]),
    Column("replans an episode", of=lambda m: number(m.get("replans_per_episode"))),
    Column(
        "initial / stuck / safety / intersection",
        of=lambda m: _counts(m, "replans_by_trigger", "initial", "stuck", "safety", "intersection"),
    ),
    Column("Voronoi / RRT / own", of=lambda m: _counts(m, "planned_by", "voronoi", "rrt", "own")),
    Column("path m", of=lambda m: number(m.get("path_length_mean_m"))),
    Column("env-steps/s", of=lambda m: number(m.get("env_steps_per_s"), 0)),
)


# -------------------------------------------------------------------------------------------- causes


def _causes(method: Method) -> list[Block]:
    if not method.get("causes"):
        return []
    caption = (
        f"Why {len(method['explain'])} of {method['episodes']} episodes of {method['name']} failed. "
        "Knew: share whose forecast of the killer 1 s before the end was right; the times are medians before "
        "the end"
    )
    return [causes_table(method, caption)]
