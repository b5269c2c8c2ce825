"""An evaluation in the terminal: the table of methods, how hard the condition is, pairs of methods, and the
risk head."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uuvtai.endings import say
from uuvtai.outcomes import COLLIDED
from uuvtai.show.cause_table import show_causes
from uuvtai.show.screen import Column, Screen
from uuvtai.show.words import number, probability, rate, with_interval

_DAGGER = "\u2020"

_METHODS = (
    Column("method", left=True),
    Column("success [95 %]"),
    Column("collision [95 %]"),
    Column("contact/ttc/\nout/timeout", 1),
    Column("time to\ngoal s", 2),
    Column("TTS s", 4),
    Column("replans", 3),
    Column("steps/s", 5),
)

_PAIRS = (
    Column("a : b", left=True),
    Column("only a\narrives"),
    Column("only b\narrives"),
    Column("p\n(McNemar)"),
    Column("time a - b, where both\narrive: s [95 %]", 1),
    Column("both\narrive", 2),
)


def show_evaluation(screen: Screen, result: dict[str, Any], folder: Path) -> None:
    """All of a ``uuv eval --json`` document: methods, pairs, risk, and why episodes failed."""
    show_methods(screen, result)
    show_pairs(screen, result["paired"])
    for method in result["methods"]:
        if "risk" in method:
            show_risk(screen, method["name"], method["risk"])
    if any("causes" in method for method in result["methods"]):
        show_causes(screen, result)
        say(f"facts of every failure, and which of them are recorded: {folder / 'eval/explain.json'}")


def show_methods(screen: Screen, result: dict[str, Any]) -> None:
    """Table of methods of a ``uuv eval --json`` document, and what belongs below it."""
    speed = f"v = {result['v_m_s']} m/s, " if result["D"] else ""
    title = (
        f"{result['world']}: S = {result['S']}, D = {result['D']}, {speed}{result['sensors']} sensing, "
        f"{len(result['seeds'])} {'seed' if len(result['seeds']) == 1 else 'seeds'} x "
        f"{result['episodes_per_seed']} episodes"
    )
    screen.table(_METHODS, [_method(m) for m in result["methods"]], title)
    _show_condition(screen, result["condition"])
    for part in result["remainder"]:
        _show_remainder(screen, part)
    for m in result["methods"]:
        if m["privileged"]:
            screen.line(f"{_DAGGER} {m['name']} is privileged: {_privilege(m['name'])}", "dim")


def _method(m: dict[str, Any]) -> list[str]:
    o = m["outcomes"]
    return [
        f"{m['name']} {_DAGGER}" if m["privileged"] else m["name"],
        rate(o["success"], m["episodes"], m["success_ci95"]),
        rate(sum(o[name] for name in COLLIDED), m["episodes"], m["collision_ci95"]),
        f"{o['collision']}/{o['ttc']}/{o['out_of_tank']}/{o['timeout']}",
        number(m["time_to_success_mean_s"]),
        number(m["tts_s"]),
        number(m["replans_per_episode"]),
        "-" if m["env_steps_per_s"] is None else f"{m['env_steps_per_s']:,.0f}",
    ]


def show_pairs(screen: Screen, pairs: list[dict[str, Any]]) -> None:
    """Every two methods on the episodes that both played (``measure.evaluate.paired``); nothing where one
    method played alone."""
    if not pairs:
        return
    screen.line("")
    screen.table(
        _PAIRS,
        [_pair(pair) for pair in pairs],
        f"the same {pairs[0]['episodes']} episodes, two methods at a time",
    )


def _pair(pair: dict[str, Any]) -> list[str]:
    return [
        f"{pair['a']} : {pair['b']}",
        str(pair["only_a"]),
        str(pair["only_b"]),
        probability(pair["mcnemar_p"]),
        with_interval(pair["time_difference_mean_s"], pair["time_difference_ci95"]),
        str(pair["both"]),
    ]


def _show_remainder(screen: Screen, part: dict[str, Any]) -> None:
    screen.line(
        f"{part['method']} misses {part['missed']} of {part['episodes']}: {part['sensing']} by sensing (told "
        "of the moving bodies it "
        f"arrives), {part['forecast_decision']} by forecast, decision and inertia (a point had a way), "
        f"{part['physics']} by physics "
        "(the oracle finds none)"
    )


def _privilege(name: str) -> str:
    if name == "oracle":
        return (
            "it knows the future and has no inertia; timeout = not reachable. An upper bound, no controller"
        )
    return "it is told where every moving body is and how it moves; what stands still it senses"


def _show_condition(screen: Screen, condition: dict[str, Any]) -> None:
    """How hard the condition is, in one line."""
    detection, rides = (
        condition["detection"],
        rate(condition["rides_threatened"], condition["rides"], condition["rides_threatened_ci95"]),
    )
    if detection is None:
        return
    screen.line(
        f"threat rate {condition['threats_per_min']:.2f} per minute ({condition['threats']} moving bodies in "
        f"{condition['ride_minutes']:.1f} min of blind rides; {rides} of the rides meet one), required "
        "detection distance "
        f"{detection['required_m']:.1f} m (closing {detection['closing_m_s']:.1f} m/s, "
        f"{detection['aside_s']:.1f} s to move aside)"
    )


def show_risk(screen: Screen, name: str, risk: dict[str, Any]) -> None:
    """How far the policy's probability of an accident soon can be believed."""
    screen.line(
        f"{name}: risk of an accident soon at {risk['moments']:,} moments: Brier {risk['brier']:.4f} "
        f"(base rate {risk['brier_base_rate']:.4f}), ECE {risk['ece']:.4f}, AUROC {number(risk['auroc'], 3)}"
    )
    bins = risk["reliability"]
    pairs = zip(bins["predicted"], bins["observed"], bins["samples"], strict=True)
    screen.line("  said -> came (n): " + ", ".join(f"{p:.2f} -> {o:.2f} ({n:,.0f})" for p, o, n in pairs))
    if "accidents" in risk:
        low, high = risk["missed_ci95"]
        screen.line(
            f"  alarm: missed {risk['missed']} of {risk['accidents']} accidents, {100 * low:.1f} to "
            f"{100 * high:.1f} % "
            f"(promised {100 * risk['promised_miss_rate']:g} %), raised in "
            f"{100 * risk['alarm_rate_safe']:.1f} % of the safe moments"
        )
