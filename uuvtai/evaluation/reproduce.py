"""Runs the steps of a reproduction, gathers what they found, judges the claims and writes it all down."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from uuvtai.common.enums import COLLIDED, LETTERS
from uuvtai.common.errors import SettingError
from uuvtai.common.files import FileError, read_json
from uuvtai.common.statistics import mean
from uuvtai.config.loader import load_config
from uuvtai.evaluation import claims
from uuvtai.evaluation.agents import load_agents
from uuvtai.evaluation.claims import LEVEL, pooled, tts_s
from uuvtai.evaluation.reproduce_steps import (
    BUDGETS,
    EVALUATION_SEED,
    RETIRED_SEEDS,
    TRAINED,
    Budget,
    Step,
    is_done,
    result_file,
    run_step,
    steps_of,
)
from uuvtai.logs.run_folder import RunFolder, RunFolderError, default_run_dir, refuse_place
from uuvtai.plugins.api import is_plugin, plugin_spec, refuse_code
from uuvtai.report.build import report
from uuvtai.report.reproduction import claim_table
from uuvtai.report.tables import Table, change_name, markdown, seconds, text_table, varies_alone
from uuvtai.report.timing import ENVS, SPEEDS, density_table, latency_table

# ---- A reproduction as sections of the report: what the page shows, in the order of the paper.

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
        _section("Every agent in full", {"kind": "run", "path": "eval/main"}),
    ]


_CEILINGS = "bt+truth is told where every moving obstacle is, oracle knows the future: oracles, no agents."


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
        printed = claims.TABLE_MAIN.get(name)
        theirs = ["-"] * 3
        if printed:
            theirs = [f"{printed.success:.2f}", f"{printed.collision:.2f}", f"{printed.tts_s}"]
        own = tts_s(entries)
        rates = [str(pooled(entries, "success")), str(pooled(entries, *COLLIDED))]
        rows.append([name, str(len(entries)), *rates, "-" if own is None else f"{own:.1f}", *theirs])
    measured = ["success", "collision", "TTS s"]
    columns = ["agent", "training seeds", *measured, *(f"paper: {name}" for name in measured)]
    caption = f"Table main, ours beside the paper's as printed; {document['commands']['eval/main']}"
    return {"kind": "table", "columns": columns, "rows": rows, "caption": caption, "n_left": 1}


def _notes() -> list[Described]:
    heading = {"kind": "heading", "text": "Where the paper's figures do not add up"}
    return [heading, *({"kind": "prose", "text": text} for text in claims.INCONSISTENCIES)]


def _trade_off(document: dict[str, Any]) -> list[Described]:
    """Success against collision from fast to careful, with the paper's point, where it was swept."""
    sweep = document["sweeps"].get("caution")
    if sweep is None:
        return []
    points = [_point(sweep["cells"], caution) for caution in sweep["axes"]["behavior.caution"]]
    rates = {"collision_rate": claims.MODERATE_COLLISION, "success_rate": claims.MODERATE_SUCCESS}
    block = {
        "kind": "trade_off",
        "series": [{"name": "bt, behavior.caution from fast to careful", "points": points}],
        "marks": [{"name": "paper", **rates}],
        "caption": "Mean over S <= 8, D <= 9, v <= 1.5 m/s (D = 0 once per S)",
        "command": document["commands"]["sweep/caution"],
    }
    return [block]


def _point(cells: Sequence[dict[str, Any]], caution: float) -> Described:
    own = [cell for cell in cells if cell["behavior.caution"] == caution]
    return {"collision_rate": pooled(own, *COLLIDED).rate, "success_rate": pooled(own, "success").rate}


# ---- The key tables of a reproduction as Markdown: docs/results.md is one of these pages.


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
        _claim_lines(document),
        _main(document),
        _ceilings(document),
        *(
            f"## Sweep: {name}\n`{document['commands'][f'sweep/{name}']}`\n\n{_sweep_lines(sweep)}"
            for name, sweep in document["sweeps"].items()
        ),
        _timing(document),
        "## Where the paper's figures do not add up\n"
        + "\n".join(f"- {text}" for text in document["inconsistencies"]),
    ]
    return "\n\n".join(["\n".join(head), *parts]) + "\n"


def _claim_lines(document: dict[str, Any]) -> str:
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
        printed = claims.TABLE_MAIN.get(name)
        theirs = ["-"] * 3
        if printed:
            shares = f"{printed.success:.2f} / {printed.collision:.2f}"
            theirs = [shares, f"{printed.tts_s} s", f"{printed.mean_time_s} s"]
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
    columns = ["agent", "training seeds", "success", "collision", "the paper: success / collision"]
    columns += ["TTS", "the paper: TTS", "mean time", "the paper: mean time", "mean time of successes"]
    return f"## Table main and ablations\n`{document['commands']['eval/main']}`\n\n{note}\n\n" + text_table(
        columns, rows
    )


def _ceilings(document: dict[str, Any]) -> str:
    rows = []
    for m in document["ceilings"]["agents"]:
        rates = [str(pooled([m], "success")), str(pooled([m], *COLLIDED))]
        rows.append([f"`{m['name']}`", *rates, seconds(m["time_to_success_mean_s"])])
    note = "`bt+truth` is told the true obstacles, `oracle` knows the future: privileged, no agents."
    return f"## Ceilings\n{note} `{document['commands']['eval/ceilings']}`\n\n" + text_table(
        ["", "success", "collision", "mean time of successes"], rows
    )


def _sweep_lines(sweep: dict[str, Any]) -> str:
    """Rows: agent and every axis but the speed; columns: speeds; cells: success / collision in %."""
    if varies_alone(sweep):
        return _alone(sweep)
    axes = [("v_m_s" if name == "v" else name) for name in sweep["axes"]]
    across = "v_m_s" if "v_m_s" in axes else axes[-1]
    down = [name for name in axes if name != across]
    values = list(dict.fromkeys(cell.get(across) for cell in sweep["cells"]))
    lines: dict[tuple[Any, ...], dict[Any, str]] = {}
    for cell in sweep["cells"]:
        key = (cell["agent"], *(str(cell.get(name, "")) for name in down))
        lines.setdefault(key, {})[str(cell.get(across))] = _both(cell)
    speeds = ["nothing moves" if value is None else f"{across} = {value}" for value in values]
    rows = [
        [*map(str, key), *(found.get(str(value), "") for value in values)] for key, found in lines.items()
    ]
    return "success / collision in %\n\n" + text_table(["agent", *down, *speeds], rows)


def _alone(sweep: dict[str, Any]) -> str:
    """Rows: what is changed; columns: agents; cells: success / collision in %."""
    agents = list(dict.fromkeys(cell["agent"] for cell in sweep["cells"]))
    lines: dict[str, dict[str, str]] = {}
    for cell in sweep["cells"]:
        lines.setdefault(change_name(cell, sweep), {})[cell["agent"]] = _both(cell)
    rows = [[name, *(found.get(agent, "") for agent in agents)] for name, found in lines.items()]
    return "success / collision in %, one axis at a time\n\n" + text_table(["changed", *agents], rows)


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


REQUEST, RESULT, PAGE = "reproduce_request.json", "reproduce.json", "results.md"


class ReproductionWatch(Protocol):
    """Shows how far it is."""

    def note(self, text: str) -> None: ...


def reproduce(
    budget: str, run_dir: Path | None, watch: ReproductionWatch, own: Sequence[str] = ()
) -> tuple[dict[str, Any], Path]:
    """Begin a reproduction: its document and its folder. ``own``: plugins of the user's, compared with ours.
    Raises ValueError for an unknown budget, RunFolderError, PluginError."""
    if budget not in BUDGETS:
        raise SettingError(f"--budget {budget!r}: {' or '.join(BUDGETS)}")
    refuse_place(run_dir)
    config, plugins = load_config("pool"), [plugin_spec(name).absolute().text for name in own]
    load_agents(plugins, config.behavior.max_node)  # refuses what cannot be loaded before hours have passed
    root = (run_dir or default_run_dir(f"reproduce-{budget}")).absolute()
    folder = RunFolder(root, config, [EVALUATION_SEED])
    request: dict[str, Any] = {"schema": 1, "budget": budget, "own": plugins}
    folder.write_json(REQUEST, request)
    return _run(folder, request, watch), root


def resume(place: Path, watch: ReproductionWatch, allow_code: bool = False) -> tuple[dict[str, Any], Path]:
    """Go on with a reproduction that was killed or interrupted; finished steps stay as they are.
    ``allow_code``: Python files that the folder names may be run. Raises RunFolderError."""
    root = place.absolute()
    folder = RunFolder.held(root, "uuv reproduce")
    try:
        request = _request(root)
        refuse_code(root, request["own"], allow_code)
        folder.go_on({})
        return _run(folder, request, watch), root
    finally:
        folder.release()


def _request(root: Path) -> dict[str, Any]:
    """What a reproduction that was begun had been asked for. Raises RunFolderError."""
    file = root / REQUEST
    try:
        request = read_json(file, folder=root)
        known = request["budget"] in BUDGETS
        known = known and all(isinstance(name, str) and is_plugin(name) for name in request.get("own", []))
    except (FileError, OSError, KeyError, TypeError) as error:
        raise RunFolderError(
            f"{file}: cannot be read ({error}); give the folder that 'uuv reproduce' printed"
        ) from None
    if not known:
        raise RunFolderError(f"{file}: no budget of this version; begin a new reproduction")
    return {"own": []} | request


def _run(folder: RunFolder, request: dict[str, Any], watch: ReproductionWatch) -> dict[str, Any]:
    steps = steps_of(BUDGETS[request["budget"]], folder.path, request["own"])
    try:
        with folder.recorded():
            for number, step in enumerate(steps, start=1):
                _step(step, f"{number}/{len(steps)} {step.name}", folder, watch)
            document = document_of(folder.path, request, steps)
            folder.write_json(RESULT, document)
            folder.write(PAGE, results_page(document))
    except KeyboardInterrupt:
        watch.note(f"what is finished is kept; go on with: uuv reproduce --resume {folder.path}")
        raise
    watch.note(f"report: {report([folder.path]).page}")  # the page tells how the run ended
    return document


def _step(step: Step, name: str, folder: RunFolder, watch: ReproductionWatch) -> None:
    if is_done(step, folder.path) and result_file(step, folder.path).exists():
        watch.note(f"{name}: done before")
        return
    watch.note(f"{name}: uuv {' '.join(step.argv(folder.path))}")
    began = time.perf_counter()
    run_step(step, folder.path)
    watch.note(f"{name}: {time.perf_counter() - began:.0f} s")


# -------------------------------------------------------------------------------------------------- gathering


def document_of(root: Path, request: dict[str, Any], steps: Sequence[Step]) -> dict[str, Any]:
    """The ``uuv reproduce --json`` document: results of every step by its folder, and the verdicts."""
    results = {step.folder: read_json(result_file(step, root), folder=root) for step in steps}
    record = read_json(root / "run.json", folder=root)
    budget = BUDGETS[request["budget"]]
    own = [plugin_spec(name).label for name in request["own"]]
    by_preset = _by_preset(results["eval/main"], budget, own)
    document = {
        "schema": 1,
        "title": f"The paper reproduced, budget {request['budget']}",
        "budget": request["budget"],
        "seed": EVALUATION_SEED,
        "started": record["started"],
        "git_sha": record["git_sha"],
        "hardware": record["hardware"],
        "versions": record["versions"],
        "python": sys.version.split()[0],
        "commands": {
            step.folder: "uuv " + " ".join(_shown(part, root) for part in step.argv(root)) for step in steps
        },
        "table_main": by_preset,
        "claims": [vars(claim) for claim in _claims(root, results, by_preset, own)],
        "inconsistencies": list(claims.INCONSISTENCIES),
        "ceilings": results["eval/ceilings"],
        "transfer": results["eval/transfer"],
        "sweeps": {
            folder.removeprefix("sweep/"): found
            for folder, found in results.items()
            if folder.startswith("sweep/")
        },
        "profile": results["profile"],
    }
    return document | {"sections": sections_of(document, budget)}


def _shown(part: str, root: Path) -> str:
    """An argument without the machine's paths."""
    return part.replace(str(root), "RUN")


def _by_preset(main: dict[str, Any], budget: Budget, own: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """Entries of the agents' table by preset; of their single episodes how each ended."""
    entries = {
        entry["name"]: {k: v for k, v in entry.items() if k != "episodes_detail"}
        | {"ends": "".join(LETTERS[e["outcome"]] for e in entry["episodes_detail"])}
        for entry in main["agents"]
    }
    trained = {
        preset: [entries[f"{preset}-{seed}"] for seed in range(budget.training_seeds)] for preset in TRAINED
    }
    return trained | {name: [entries[name]] for name in ("bt", "planner", "straight", *own)}


def _claims(
    root: Path, results: dict[str, Any], by_preset: dict[str, Any], own: Sequence[str]
) -> list[claims.Claim]:
    cells = results["sweep/pool"]["cells"]
    names = list(dict.fromkeys(cell["agent"] for cell in cells))
    agent = next(name for name in names if name not in ("bt", *own))
    there = next(entry for entry in results["eval/transfer"]["agents"] if entry["name"] not in ("bt", *own))
    found = [
        *claims.of_table_main(by_preset),
        *claims.of_training(_metrics(root / "train" / "curriculum-0")),
        *(claim for name in (agent, "bt") for claim in claims.of_sweep(cells, name)),
        *claims.of_timing(results["profile"]),
        *(claims.of_transfer(by_preset["curriculum"][0], there)),
    ]
    return claims.judged(found)


def _metrics(run: Path) -> list[dict[str, Any]]:
    from uuvtai.learning.runner import read_metrics

    return read_metrics(run)
