"""Blocks of an evaluation (the document of ``uuv eval --json``): methods, why they failed, how far the risk
head can be believed."""

from __future__ import annotations

from typing import Any

from uuvtai.outcomes import ENDINGS
from uuvtai.report.blocks import Block, Data, Figure, Heading, Prose, Table
from uuvtai.report.colours import method_colours
from uuvtai.report.figures import Line, intervals, rates_text, reliability
from uuvtai.report.wording import accidents, number, percent, rate

Method = dict[str, Any]


def evaluation(result: dict[str, Any], command: str = "") -> list[Block]:
    """Everything that an evaluation has to show but its pictures."""
    methods = result["methods"]
    blocks: list[Block] = [Prose(conditions(result)), methods_table(methods)]
    if methods:
        blocks.append(_rates_figure(methods, command))
    blocks += paired_table(result.get("paired", []))
    blocks.append(_planning_table(methods))
    for method in methods:
        blocks += [*_causes(method), *_risk(method, command)]
    return blocks


def conditions(result: dict[str, Any]) -> str:
    """The scene in a sentence."""
    speed = f", v = {result['v_m_s']} m/s" if result["D"] else ""
    seeds = ", ".join(map(str, result["seeds"]))
    return (
        f"World {result['world']}, S = {result['S']} resting and D = {result['D']} moving obstacles{speed}, "
        f"{result['sensors']} sensing; "
        f"seeds {seeds}, {result['episodes_per_seed']} episodes each, the same ones for every method."
    )


def methods_table(methods: list[Method]) -> Table:
    """One row a method: rates with counts and 95 % Wilson intervals, how the rest ended, both times."""
    columns = [
        "method",
        "success",
        "collision",
        "contact / TTC / out / timeout",
        "time to goal s",
        "TTS s",
        "return",
        "closest m",
    ]
    caption = (
        "Methods. Collision counts contacts, TTC stops and episodes out of the tank; intervals are 95 % "
        "Wilson. "
        "Time to goal: mean over successes; TTS: mean time over success rate."
    )
    return Table(
        columns,
        [_method_row(m) for m in methods],
        caption,
        data=_methods_data(methods),
        swatches=_swatches(methods),
    )


def _swatches(methods: list[Method]) -> list[str]:
    names = [m["name"] for m in methods]
    colours = method_colours(names)
    return [colours[name] for name in names]


def _method_row(method: Method) -> list[str]:
    o = method["outcomes"]
    return [
        method["name"],
        rate(o["success"], method["episodes"], method["success_ci95"]),
        rate(accidents(o), method["episodes"], method["collision_ci95"]),
        f"{o['collision']} / {o['ttc']} / {o['out_of_tank']} / {o['timeout']}",
        number(method["time_to_success_mean_s"]),
        number(method["tts_s"]),
        number(method.get("return_mean")),
        number(method.get("min_clearance_mean_m"), 2),
    ]


_PLAIN = (
    "success_rate",
    "collision_rate",
    "time_to_success_mean_s",
    "time_mean_s",
    "tts_s",
    "return_mean",
    "min_clearance_mean_m",
)


def _methods_data(methods: list[Method]) -> Data:
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
        _methods_data(methods),
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


def paired_table(pairs: list[dict[str, Any]]) -> list[Block]:
    """Who alone arrives, how sure that is, and the difference in time where both do; [] without two
    methods."""
    if not pairs:
        return []
    columns = [
        "a",
        "b",
        "episodes",
        "both arrive",
        "only a",
        "only b",
        "McNemar's p",
        "time of a s",
        "time of b s",
        "a - b s",
    ]
    rows = [_pair_row(pair) for pair in pairs]
    caption = (
        "Pairs of methods on the same episodes: who alone arrives, with McNemar's exact p, and the mean "
        "times where both arrive, their "
        "difference with its 95 % bootstrap interval. The values of p are not adjusted for the number of "
        "pairs"
    )
    bounds = [
        [*pair[:-1], *(pair[-1] or (None, None))]
        for pair in ([*(p.get(k) for k in _PAIRED), p.get(_BOUNDS)] for p in pairs)
    ]
    data = Data(
        ["a", "b", "episodes", *_PAIRED, f"{_BOUNDS}_low", f"{_BOUNDS}_high"],
        [[p["a"], p["b"], p["episodes"], *numbers] for p, numbers in zip(pairs, bounds, strict=True)],
    )
    return [Table(columns, rows, caption, n_left=2, data=data)]


_BOUNDS = "time_difference_ci95"


def _pair_row(pair: dict[str, Any]) -> list[str]:
    bounds = pair.get(_BOUNDS)
    interval = f" [{bounds[0]:.2f}, {bounds[1]:.2f}]" if bounds else ""
    counts = [str(pair[key]) for key in ("episodes", "both", "only_a", "only_b")]
    times = [number(pair.get(key), 2) for key in ("time_a_mean_s", "time_b_mean_s")]
    return [
        pair["a"],
        pair["b"],
        *counts,
        _p_value(pair["mcnemar_p"]),
        *times,
        number(pair.get("time_difference_mean_s"), 2) + interval,
    ]


def _p_value(p: float | None) -> str:
    """Two digits; what is smaller than anybody distinguishes is told as a bound."""
    return "-" if p is None else "< 0.0001" if p < 1e-4 else f"{p:.2g}"


def _planning_table(methods: list[Method]) -> Table:
    columns = [
        "method",
        "replans an episode",
        "initial / stuck / safety / intersection",
        "Voronoi / RRT",
        "path m",
        "env-steps/s",
    ]
    rows = []
    for m in methods:
        triggers, planners = m.get("replans_by_trigger", {}), m.get("planned_by", {})
        rows.append(
            [
                m["name"],
                number(m.get("replans_per_episode")),
                " / ".join(
                    str(triggers.get(name, "-")) for name in ("initial", "stuck", "safety", "intersection")
                ),
                " / ".join(str(planners.get(name, "-")) for name in ("voronoi", "rrt")),
                number(m.get("path_length_mean_m")),
                number(m.get("env_steps_per_s"), 0),
            ]
        )
    return Table(columns, rows, "Planning", swatches=_swatches(methods))


# -------------------------------------------------------------------------------------------- causes and risk


def _causes(method: Method) -> list[Block]:
    if not method.get("causes"):
        return []
    columns = ["cause", "n", "share", "knew", "unseen s", "evading s", "last chance s", "meaning"]
    rows = [
        [
            c["label"].replace("_", " "),
            str(c["count"]),
            percent(c["share"], 0),
            percent(c["knew_share"], 0),
            *(number(c[key]) for key in ("unseen_median_s", "evading_median_s", "last_chance_median_s")),
            c["meaning"],
        ]
        for c in method["causes"]
    ]
    caption = (
        f"Why {len(method['explain'])} of {method['episodes']} episodes of {method['name']} failed. "
        "Knew: share whose forecast of the killer 1 s before the end was right; the times are medians before "
        "the end"
    )
    return [Table(columns, rows, caption)]


def _risk(method: Method, command: str) -> list[Block]:
    risk = method.get("risk")
    if not risk:
        return []
    bins = risk["reliability"]
    said = (
        f"At {risk['moments']:,} moments the risk head of {method['name']} gave the probability of an "
        "accident soon: Brier score "
        f"{number(risk['brier'], 4)} (base rate alone {number(risk['brier_base_rate'], 4)}), expected "
        "calibration error "
        f"{number(risk['ece'], 4)}, area under the ROC curve {number(risk.get('auroc'), 3)}."
    )
    if "accidents" in risk:
        low, high = risk["missed_ci95"]
        said += (
            f" The alarm missed {risk['missed']} of {risk['accidents']} accidents, {percent(low)} to "
            f"{percent(high)} "
            f"(promised {percent(risk['promised_miss_rate'])}), and was raised in "
            f"{percent(risk['alarm_rate_safe'])} of the safe moments."
        )
    columns = ["said", "came", "moments"]
    data = Data(columns, list(zip(bins["predicted"], bins["observed"], bins["samples"], strict=True)))
    caption = (
        "Reliability: a point's area grows with the number of its moments; on the dashed line a "
        "forecast can be taken at its word"
    )
    panel = reliability(bins, method["name"])
    return [
        Heading(f"Risk: {method['name']}"),
        Prose(said),
        Figure(f"reliability_{method['name']}", [panel], caption, data, command),
    ]
