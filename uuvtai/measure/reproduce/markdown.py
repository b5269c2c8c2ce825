"""The key tables of a reproduction as Markdown: docs/results.md is one of these pages."""

from __future__ import annotations

from typing import Any

from uuvtai.measure.reproduce import paper
from uuvtai.measure.reproduce.claims import LEVEL, pooled, tts_s
from uuvtai.measure.reproduce.steps import RETIRED_SEEDS
from uuvtai.outcomes import COLLIDED
from uuvtai.statistics import mean
from uuvtai.tables.claim_table import claim_table
from uuvtai.tables.one_at_a_time import change_name, varies_alone
from uuvtai.tables.table import Table, markdown, text_table
from uuvtai.tables.timing_tables import ENVS, SPEEDS, density_table, latency_table
from uuvtai.tables.wording import seconds


def results_page(document: dict[str, Any]) -> str:
    """The whole page of a ``uuv reproduce --json`` document."""
    machine, seed = document["hardware"], document["seed"]
    tuned = "was looked at while tuning" if seed in RETIRED_SEEDS else "was never trained or tuned on"
    head = [
        "# Results",
        f"`uuv reproduce --budget {document['budget']}`, {document['started']}, commit "
        f"{document['git_sha'] or 'unknown'}, {machine['cpu']}, {machine['cores']} cores. Intervals are 95 % "
        f"(Wilson). RUN is the reproduction's folder; the evaluations' seed, {seed}, {tuned}.",
        *document.get("notes", []),
    ]
    parts = [
        _claims(document),
        _main(document),
        _ceilings(document),
        _sweeps(document),
        _timing(document),
        _paper_notes(document),
    ]
    return "\n\n".join(["\n".join(head), *parts]) + "\n"


def _claims(document: dict[str, Any]) -> str:
    note = (
        "A claim with a p value is decided where that value, adjusted by Holm for all tests of this page, is "
        f"below {LEVEL}; else it cannot be judged. Rates are compared by Fisher's exact test, with a printed "
        "value by the exact binomial test. Episodes of one number go together in all cells of a grid: only "
        "as many count as independent ones would say the same. Where single episodes were not kept, there is "
        "neither interval nor test. Claims without a p value set one number beside another: one run, one "
        "machine, no test. The paper's rates are of another simulator: one that is reached says nothing "
        "about who is better."
    )
    return f"## The paper's claims\n{note}\n\n{markdown(claim_table(document))}"


def _main(document: dict[str, Any]) -> str:
    rows = []
    for name, entries in document["table_main"].items():
        printed = paper.TABLE_MAIN.get(name)
        theirs = (
            [
                f"{printed.success:.2f} / {printed.collision:.2f}",
                f"{printed.tts_s} s",
                f"{printed.mean_time_s} s",
            ]
            if printed
            else ["-"] * 3
        )
        rates = [str(pooled(entries, "success")), str(pooled(entries, *COLLIDED))]
        mean_s = mean([m["time_mean_s"] for m in entries if m["time_mean_s"] is not None])
        arrived = mean(
            [m["time_to_success_mean_s"] for m in entries if m["time_to_success_mean_s"] is not None]
        )
        times = [seconds(tts_s(entries)), theirs[1], seconds(mean_s), theirs[2], seconds(arrived)]
        rows.append([f"`{name}`", str(len(entries)), *rates, theirs[0], *times])
    note = (
        "TTS is the paper's: mean time of all episodes / rate of success. The last column, the mean over the "
        "episodes that arrive, has no peer in the paper."
    )
    columns = ["method", "training seeds", "success", "collision", "the paper: success / collision"]
    columns += ["TTS", "the paper: TTS", "mean time", "the paper: mean time", "mean time of successes"]
    return f"## Table main and ablations\n`{document['commands']['eval/main']}`\n\n{note}\n\n" + text_table(
        columns, rows
    )


def _ceilings(document: dict[str, Any]) -> str:
    rows = [
        [
            f"`{m['name']}`",
            str(pooled([m], "success")),
            str(pooled([m], *COLLIDED)),
            seconds(m["time_to_success_mean_s"]),
        ]
        for m in document["ceilings"]["methods"]
    ]
    note = "`bt+truth` is told the true bodies, `oracle` knows the future: privileged, no methods."
    return f"## Ceilings\n{note} `{document['commands']['eval/ceilings']}`\n\n" + text_table(
        ["", "success", "collision", "mean time of successes"], rows
    )


def _sweeps(document: dict[str, Any]) -> str:
    return "\n\n".join(
        f"## Sweep: {name}\n`{document['commands'][f'sweep/{name}']}`\n\n{_sweep(sweep)}"
        for name, sweep in document["sweeps"].items()
    )


def _sweep(sweep: dict[str, Any]) -> str:
    """Rows: method and every axis but the speed; columns: speeds; cells: success / collision in %."""
    if varies_alone(sweep):
        return _alone(sweep)
    axes = [("v_m_s" if name == "v" else name) for name in sweep["axes"]]
    across = "v_m_s" if "v_m_s" in axes else axes[-1]
    down = [name for name in axes if name != across]
    values = list(dict.fromkeys(cell.get(across) for cell in sweep["cells"]))
    lines: dict[tuple[Any, ...], dict[Any, str]] = {}
    for cell in sweep["cells"]:
        key = (cell["method"], *(str(cell.get(name, "")) for name in down))
        lines.setdefault(key, {})[str(cell.get(across))] = _both(cell)
    columns = [
        "method",
        *down,
        *("nothing moves" if value is None else f"{across} = {value}" for value in values),
    ]
    rows = [
        [*map(str, key), *(found.get(str(value), "") for value in values)] for key, found in lines.items()
    ]
    return "success / collision in %\n\n" + text_table(columns, rows)


def _alone(sweep: dict[str, Any]) -> str:
    """Rows: what is changed; columns: methods; cells: success / collision in %."""
    methods = list(dict.fromkeys(cell["method"] for cell in sweep["cells"]))
    lines: dict[str, dict[str, str]] = {}
    for cell in sweep["cells"]:
        lines.setdefault(change_name(cell, sweep), {})[cell["method"]] = _both(cell)
    rows = [[name, *(found.get(method, "") for method in methods)] for name, found in lines.items()]
    return "success / collision in %, one axis at a time\n\n" + text_table(["changed", *methods], rows)


def _both(cell: dict[str, Any]) -> str:
    return f"{100 * pooled([cell], 'success').rate:.0f} / {100 * pooled([cell], *COLLIDED).rate:.0f}"


def _timing(document: dict[str, Any]) -> str:
    profile = document["profile"]
    timed = [row for row in profile["paper_latency"] if row["mean_ms"] is not None]
    note = (
        '"Global planner" is the mean over the steps that plan a route; "Planner stage, every step" over all '
        "steps, most of which plan none. "
        '"Full loop" is a whole step (simulated truth and sensing, mapping, planning, behaviour tree) and '
        "one decision of world model and policy; what the paper's loop contains it does not say."
    )
    return "\n\n".join(
        [
            f"## Timing\n`{document['commands']['profile']}`",
            note,
            markdown(latency_table(timed, "")),
            markdown(density_table(profile["paper_density"], "")),
            markdown(Table((ENVS, *SPEEDS), profile["rows"])),
        ]
    )


def _paper_notes(document: dict[str, Any]) -> str:
    return "## Where the paper's figures do not add up\n" + "\n".join(
        f"- {text}" for text in document["inconsistencies"]
    )
