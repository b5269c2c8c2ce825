"""An evaluation in the terminal: the table of methods, pairs of methods, and why episodes failed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.text import Text

from uuvtai.endings import plain, say
from uuvtai.show.screen import Screen
from uuvtai.tables.method_tables import DAGGER, causes_table, methods_table, paired_table
from uuvtai.tables.wording import bodies, sensing, vehicle


def show_evaluation(screen: Screen, result: dict[str, Any], folder: Path) -> None:
    """All of a ``uuv eval --json`` document: methods, pairs, and why episodes failed."""
    show_methods(screen, result)
    show_pairs(screen, result["paired"])
    if any("causes" in method for method in result["methods"]):
        show_causes(screen, result)
        say(f"facts of every failure, and which of them are recorded: {folder / 'eval/explain.json'}")


def show_methods(screen: Screen, result: dict[str, Any]) -> None:
    """Table of methods of a ``uuv eval --json`` document, and what belongs below it."""
    speed = f"v = {result['v_m_s']} m/s, " if result["D"] else ""
    title = (
        f"{result['world']}: {bodies(result)}, {speed}{vehicle(result)}{sensing(result)}, "
        f"{len(result['seeds'])} {'seed' if len(result['seeds']) == 1 else 'seeds'} x "
        f"{result['episodes_per_seed']} episodes"
    )
    screen.table(methods_table(result["methods"], title))
    for part in result["remainder"]:
        _show_remainder(screen, part)
    for m in result["methods"]:
        if m["privileged"]:
            screen.line(f"{DAGGER} {m['name']} is privileged: {_privilege(m['name'])}", "dim")


def show_pairs(screen: Screen, pairs: list[dict[str, Any]]) -> None:
    """Every two methods on the episodes that both played (``measure.evaluate.paired``); nothing where one
    method played alone."""
    if not pairs:
        return
    screen.line("")
    screen.table(paired_table(pairs, f"the same {pairs[0]['episodes']} episodes, two methods at a time"))


def _show_remainder(screen: Screen, part: dict[str, Any]) -> None:
    screen.line(
        f"{part['method']} misses {part['missed']} of {part['episodes']}: {part['sensing']} by sensing (told "
        f"of the moving bodies it arrives), {part['forecast_decision']} by forecast, decision and inertia (a "
        f"point had a way), {part['physics']} by physics (the oracle finds none)"
    )


def _privilege(name: str) -> str:
    if name == "oracle":
        return (
            "it knows the future and has no inertia; timeout = not reachable. An upper bound, no controller"
        )
    return "it is told where every moving body is and how it moves; what stands still it senses"


_REMARKABLE_SHARE = 0.2
"""Remarks on fewer of a cause's episodes are left to the JSON."""

_LEGEND = (
    "knew: share whose forecast of the killer, made 1 s before the end, was right. Medians before the end: "
    "unseen = since a beam last met the killer, evading = since evasion began, chance = until when some "
    "velocity still escaped. worst: seed:episode of the hardest hit"
)


def show_causes(screen: Screen, result: dict[str, Any]) -> None:
    """Causes of every method of a ``uuv eval --explain --json`` document."""
    for m in result["methods"]:
        if "explain" in m:
            _show_method(screen, m)
    if any(m.get("explain") for m in result["methods"]):
        screen.line(_LEGEND, "dim")


def _show_method(screen: Screen, m: dict[str, Any]) -> None:
    failed = len(m["explain"])
    screen.line("")
    if not failed:
        screen.line(f"{m['name']}: no episode failed, nothing to explain")
        return
    screen.table(causes_table(m, f"{m['name']}: why {failed} of {m['episodes']} episodes failed"))
    for c in m["causes"]:
        remarks = ", ".join(
            f"{k} {remark}" for remark, k in c["remarks"].items() if k >= _REMARKABLE_SHARE * c["count"]
        )
        meaning = Text(plain(c["label"]), style="bold").append(plain(f": {c['meaning']}"), style="not bold")
        screen.line(meaning.append(plain(f" ({remarks})"), style="not bold dim") if remarks else meaning)
