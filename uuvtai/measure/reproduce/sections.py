"""A reproduction as sections of the report: what the page shows, in the order of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from uuvtai.measure.reproduce import paper
from uuvtai.measure.reproduce.claims import pooled, tts_s
from uuvtai.measure.reproduce.steps import TRAINED, Budget
from uuvtai.outcomes import COLLIDED

Described = dict[str, Any]


def sections_of(document: dict[str, Any], budget: Budget) -> list[Described]:
    """``sections`` of ``reproduce.json`` (the format is told in ``uuvtai.report.reproduction``)."""
    curves = [f"train/{preset}-{seed}" for preset in TRAINED for seed in range(budget.training_seeds)]
    return [
        _section(
            "The paper's claims",
            {"kind": "verdicts", "items": [_item(claim) for claim in document["claims"]]},
        ),
        _section("Table main and ablations", _main_table(document), *_notes()),
        _section("Training", {"kind": "curves", "paths": curves}),
        _section("Robustness over conditions", *_trade_off(document), {"kind": "run", "path": "sweep/pool"}),
        *[
            _section(f"Sweep: {name}", {"kind": "run", "path": f"sweep/{name}"})
            for name in document["sweeps"]
            if name != "pool"
        ],
        _section("Ceilings", {"kind": "prose", "text": _CEILINGS}, {"kind": "run", "path": "eval/ceilings"}),
        _section("Transfer to a second scene", {"kind": "run", "path": "eval/transfer"}),
        _section("Trajectories: scenario A", {"kind": "run", "path": "eval/scenario_a"}),
        _section("Trajectories: scenario B", {"kind": "run", "path": "eval/scenario_b"}),
        _section("Time", {"kind": "run", "path": "profile"}),
        _section("Every method in full", {"kind": "run", "path": "eval/main"}),
    ]


_CEILINGS = (
    "bt+truth is told where every moving body is, oracle knows the future: privileged yardsticks, no methods."
)


def _section(title: str, *blocks: Described) -> Described:
    return {"title": title, "blocks": list(blocks)}


def _item(claim: dict[str, Any]) -> Described:
    tested = "" if claim["p_holm"] is None else f"; p = {claim['p']:.3g}, by Holm {claim['p_holm']:.3g}"
    return {
        "claim": claim["text"],
        "verdict": claim["verdict"],
        "numbers": f"here {claim['ours']}; the paper: {claim['theirs']}{tested}",
    }


def _main_table(document: dict[str, Any]) -> Described:
    rows = []
    for name, entries in document["table_main"].items():
        printed = paper.TABLE_MAIN.get(name)
        theirs = (
            [f"{printed.success:.2f}", f"{printed.collision:.2f}", f"{printed.tts_s}"]
            if printed
            else ["-"] * 3
        )
        own = tts_s(entries)
        ours = [
            str(pooled(entries, "success")),
            str(pooled(entries, *COLLIDED)),
            "-" if own is None else f"{own:.1f}",
        ]
        rows.append([name, str(len(entries)), *ours, *theirs])
    columns = [
        "method",
        "training seeds",
        "success",
        "collision",
        "TTS s",
        "paper: success",
        "paper: collision",
        "paper: TTS s",
    ]
    caption = f"Table main, ours beside the paper's as printed; {document['commands']['eval/main']}"
    return {"kind": "table", "columns": columns, "rows": rows, "caption": caption, "n_left": 1}


def _notes() -> list[Described]:
    heading = {"kind": "heading", "text": "Where the paper's figures do not add up"}
    return [heading, *({"kind": "prose", "text": text} for text in paper.INCONSISTENCIES)]


def _trade_off(document: dict[str, Any]) -> list[Described]:
    """Success against collision from fast to careful, with the paper's point; nothing where it was not
    swept."""
    sweep = document["sweeps"].get("caution")
    if sweep is None:
        return []
    points = [_point(sweep["cells"], caution) for caution in sweep["axes"]["teacher.caution"]]
    series = [{"name": "bt, teacher.caution from fast to careful", "points": points}]
    marks = [
        {"name": "paper", "collision_rate": paper.MODERATE_COLLISION, "success_rate": paper.MODERATE_SUCCESS}
    ]
    caption = "Mean over S <= 8, D <= 9, v <= 1.5 m/s (D = 0 once per S)"
    return [
        {
            "kind": "trade_off",
            "series": series,
            "marks": marks,
            "caption": caption,
            "command": document["commands"]["sweep/caution"],
        }
    ]


def _point(cells: Sequence[dict[str, Any]], caution: float) -> Described:
    own = [cell for cell in cells if cell["teacher.caution"] == caution]
    return {"collision_rate": pooled(own, *COLLIDED).rate, "success_rate": pooled(own, "success").rate}
