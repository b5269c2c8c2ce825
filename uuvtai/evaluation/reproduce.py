"""Runs the steps of a reproduction, gathers what they found, judges the claims and writes it all down."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

from uuvtai.common.enums import COLLIDED, LETTERS
from uuvtai.common.errors import SettingError
from uuvtai.common.files import FileError, read_json
from uuvtai.common.statistics import mean
from uuvtai.config.loader import load_config, load_training
from uuvtai.evaluation import claims
from uuvtai.evaluation.agents import load_agents
from uuvtai.evaluation.claims import LEVEL, Claim, of_method, pooled, tts_s
from uuvtai.evaluation.reproduce_steps import (
    BUDGETS,
    ENV_STEPS,
    EVALUATION_SEED,
    METHODS,
    RETIRED_SEEDS,
    Budget,
    Step,
    is_done,
    result_file,
    row_file,
    run_step,
    steps_of,
)
from uuvtai.logs.run_folder import RunFolder, RunFolderError, default_run_dir, refuse_place
from uuvtai.plugins.api import is_plugin, plugin_spec, refuse_code, to_resume
from uuvtai.report.build import report
from uuvtai.report.reproduction import claim_table
from uuvtai.report.tables import Table, markdown, number, seconds, text_table
from uuvtai.report.timing import ENVS, SPEEDS, density_table, latency_table

if TYPE_CHECKING:
    from uuvtai.evaluation.evaluate import EvaluationWatch

# ---- A reproduction as sections of the report: what the page shows, in the order of the paper.

Described = dict[str, Any]
Rows = tuple[list[str], list[list[str]]]
"""columns and rows of a table"""


def sections_of(document: dict[str, Any], curves: list[str]) -> list[Described]:
    """``sections`` of ``reproduce.json`` (the format is told in ``uuvtai.report.reproduction``); ``curves``:
    folders of the trainings that were made here."""
    verdicts = {"kind": "verdicts", "items": [_item(claim) for claim in document["claims"]]}
    heading = {"kind": "heading", "text": "Where the paper's figures do not add up"}
    notes = [heading, *({"kind": "prose", "text": text} for text in claims.INCONSISTENCIES)]
    mechanism = [_described(table, caption) for caption, table in mechanism_tables(document)]
    beside = {
        "Robustness over conditions": "sweep/pool",
        "Transfer to a second scene": "eval/transfer",
        "Trajectories: scenario A": "eval/scenario_a",
        "Trajectories: scenario B": "eval/scenario_b",
        "Time": "profile",
    }
    found: dict[str, list[Described]] = {
        "The paper's claims": [verdicts],
        "Table main and ablations": [_described(main_table(document), _TTS), *notes],
        "Training": [{"kind": "curves", "paths": curves}, *mechanism],
    }
    runs = {title: path for title, path in beside.items() if path in document["commands"]}
    found |= {title: [{"kind": "run", "path": path}] for title, path in runs.items()}
    return [{"title": title, "blocks": blocks} for title, blocks in found.items()]


def _described(table: Rows, caption: str) -> Described:
    return {"kind": "table", "columns": table[0], "rows": table[1], "caption": caption, "n_left": 1}


def _item(claim: dict[str, Any]) -> Described:
    tested = "" if claim["p_holm"] is None else f"; p = {claim['p']:.3g}, by Holm {claim['p_holm']:.3g}"
    why = f"; {claim['reason']}" if claim["reason"] else ""
    numbers = f"here {claim['ours']}; the paper: {claim['theirs']}{tested}{why}"
    return {"claim": claim["text"], "verdict": claim["verdict"], "numbers": numbers}


# ---- Tables of a reproduction, and all of them as Markdown: docs/results.md is such a page.

_TTS = (
    "TTS is the paper's: mean time of all episodes / rate of success. The mean time of successes has no peer "
    "in the paper."
)


def main_table(document: dict[str, Any]) -> Rows:
    """Every method with its training seeds, and the agents that are not trained."""
    rows = []
    for name, entries in document["table_main"].items():
        printed = claims.TABLE_MAIN.get(name)
        theirs = ["-"] * 4
        if printed:
            shares = f"{printed.success:.2f}/{printed.collision:.2f}"
            theirs = [shares, f"{printed.episode_return}", f"{printed.tts_s} s", f"{printed.mean_time_s} s"]
        all_s = mean([m["time_mean_s"] for m in entries if m["time_mean_s"] is not None])
        arrived = [m["time_to_success_mean_s"] for m in entries if m["time_to_success_mean_s"] is not None]
        paid = number(mean([m["return_mean"] for m in entries]), 1)
        times = [seconds(tts_s(entries)), theirs[2], seconds(all_s), theirs[3], seconds(mean(arrived))]
        rows.append([f"`{name}`", *_rates(entries), theirs[0], paid, theirs[1], *times])
    columns = ["agent", "success by training seed", "success", "collision", "the paper: success / collision"]
    columns += ["return", "the paper: return", "TTS", "the paper: TTS", "mean time", "the paper: mean time"]
    columns += ["mean time of successes"]
    return columns, rows


def _rates(entries: Sequence[dict[str, Any]]) -> list[str]:
    """Of a method over its seeds, of an agent that is not trained over its episodes."""
    if "trained_steps" not in entries[0]:
        return ["-", *(str(pooled(entries, *ends)) for ends in (("success",), COLLIDED))]
    by_seed = ", ".join(f"{100 * pooled([entry], 'success').rate:.1f}" for entry in entries)
    return [by_seed, *(str(of_method(entries, *ends)) for ends in (("success",), COLLIDED))]


def mechanism_tables(document: dict[str, Any]) -> list[tuple[str, Rows]]:
    """(what it says, table) of the scale s_t over time, and of the world model's skill by target."""
    found = document["mechanism"]
    scales = {name: [facts["scale"] for facts in own if facts["scale"]] for name, own in found.items()}
    scale = [[f"`{name}`", *map(_and_range, zip(*own, strict=True))] for name, own in scales.items() if own]
    skilled = {name: own for name, own in found.items() if own[0]["skill"]}
    told = dict.fromkeys(target for own in skilled.values() for facts in own for target in facts["skill"])
    kinds = Counter(target.rpartition("_")[0] for target in told)
    skill = [[f"{kind} ({n})", *(_skill(own, kind) for own in skilled.values())] for kind, n in kinds.items()]
    columns = ["training", "s_t: first", "median", "last", "share of iterations at its limit"]
    return [(_SCALE, (columns, scale)), (_SKILL, (["targets", *(f"`{name}`" for name in skilled)], skill))]


def _skill(own: Sequence[dict[str, Any]], kind: str) -> str:
    found = [item for facts in own for item in facts["skill"].items() if item[1] is not None]
    return _and_range([value for target, value in found if target.rpartition("_")[0] == kind])


def _and_range(values: Sequence[float]) -> str:
    if not values:
        return "-"
    digits = 2 if max(map(abs, values)) < 100 else 0
    low, high = number(min(values), digits), number(max(values), digits)
    return f"{number(fmean(values), digits)} ({low} to {high})"


_SCALE = "The scale s_t of the distillation over a training: mean over the training seeds (range)."
_SKILL = (
    "Skill of the world model in the last quarter of a training: 1 - mean squared error of its prediction / "
    "that of saying *as before*, mean over training seeds and targets of a kind (range). Below 0 it is worse "
    "than no model."
)


def results_page(*documents: dict[str, Any]) -> str:
    """The whole page of ``uuv reproduce --json`` documents; their claims are one family of tests."""
    judged = iter(claims.judged([Claim(**claim) for document in documents for claim in document["claims"]]))
    parts = [f"# Results\n{_HOW}", _TTS, _SCALE, _SKILL]
    shown: set[str] = set()  # agents that are not trained drive alike at every budget
    for document in documents:
        main = {name: found for name, found in document["table_main"].items() if name not in shown}
        shown |= {name for name, found in main.items() if "trained_steps" not in found[0]}
        own = document | {"claims": [vars(next(judged)) for _ in document["claims"]], "table_main": main}
        parts += [_head(own), *(part(own) for name, part in _PARTS.items() if own.get(name))]
    told = "\n".join(f"- {text}" for text in claims.INCONSISTENCIES)
    return "\n\n".join([*parts, f"## Where the paper's figures do not add up\n{told}"]) + "\n"


def _head(document: dict[str, Any]) -> str:
    machine, seed = document["hardware"], document["seed"]
    tuned = "was looked at while tuning" if seed in RETIRED_SEEDS else "was never trained or tuned on"
    others = ", ".join(document["trained_at"])
    trained = f" (trained or evaluated at: {others})" if others else ""
    return (
        f"`uuv reproduce --budget {document['budget']}`, {document['started']}, commit "
        f"{document['git_sha'] or 'unknown'}{trained}, {machine['cpu']}, {machine['cores']} cores. The "
        f"evaluations' seed, {seed}, {tuned}."
    )


def _titled(title: str, document: dict[str, Any]) -> str:
    return f"## {title}, budget {document['budget']}"


_HOW = (
    "A claim with a p value is decided where that value, adjusted by Holm for all tests of this page, is "
    f"below {LEVEL}; else it cannot be judged. Methods are compared by Welch's t over their training seeds "
    "(intervals: Student's, 95 %; the variance is no less than by the episodes), and so are rates within a "
    "margin; other rates of one agent by Fisher's exact test, with a printed value by the exact binomial "
    "test (intervals: Wilson's, 95 %). Episodes of one number go together in all cells of a grid: only as "
    "many count as independent ones would say the same. Claims without a p value set one number beside "
    "another: one run, one machine, no test. The paper's rates are of another simulator: one that is reached "
    "says nothing about who is better. Not judged: when a training converges, trajectories, larger margins. "
    "All drive on the paper's stack, `bt` too; RUN is a reproduction's folder. "
    "Agents that are not trained stand in the first table alone."
)


def _claim_lines(document: dict[str, Any]) -> str:
    title = _titled("The paper's claims", document)
    return f"{title}\n{markdown(claim_table(document))}"


def _main(document: dict[str, Any]) -> str:
    entries = [entry for entries in document["table_main"].values() for entry in entries]
    counts = sorted({entry["trained_steps"] for entry in entries if "trained_steps" in entry})
    trained = f"Env-steps of a training: {', '.join(f'{n:,}' for n in counts)}."
    steps = [step for step in steps_of(BUDGETS[document["budget"]], _RUN) if step.folder in _EXAMPLES]
    told = [" ".join(["uuv", *step.argv(_RUN)]) for step in steps]
    told += [document["commands"][at] for at in ("eval/NAME-SEED", "eval/main")]
    commands = "\n".join(f"`{command}`" for command in told)
    title = f"{_titled('Table main and ablations', document)}\n{commands}"
    return f"{title}\n\n{trained}\n\n" + text_table(*main_table(document))


_RUN, _EXAMPLES = Path("RUN"), ("train/paper-0", "train/paper_10hz-0")  # trainings whose commands are shown


def _mechanism(document: dict[str, Any]) -> str:
    tables = [text_table(*table) for _, table in mechanism_tables(document)]
    return "\n\n".join([_titled("Mechanism", document), *tables])


def _sweep(document: dict[str, Any]) -> str:
    """Rows: S and D; columns: speeds; cells: success/collision in %, of one agent after the other."""
    cells = document["sweep"]["cells"]
    speeds = list(dict.fromkeys(cell["v_m_s"] for cell in cells))
    lines: dict[tuple[Any, ...], dict[Any, list[str]]] = {}
    for cell in cells:
        rates = f"{100 * pooled([cell], 'success').rate:.0f}/{100 * pooled([cell], *COLLIDED).rate:.0f}"
        lines.setdefault((cell["S"], cell["D"]), {}).setdefault(cell["v_m_s"], []).append(rates)
    rows = [[*map(str, key), *(", ".join(found.get(v, ())) for v in speeds)] for key, found in lines.items()]
    head = ["S", "D", *("nothing moves" if v is None else f"v = {v} m/s" for v in speeds)]
    agents = " and ".join(f"`{name}`" for name in dict.fromkeys(cell["agent"] for cell in cells))
    note = f"`{document['commands']['sweep/pool']}`\n\nsuccess/collision in % of {agents}"
    return f"## Sweep\n{note}\n\n" + text_table(head, rows)


def _timing(document: dict[str, Any]) -> str:
    profile = document["profile"]
    timed = [row for row in profile["paper_latency"] if row["mean_ms"] is not None]
    note = (
        '"Global planner" is the mean over the steps that plan a route; "Planner stage, every step" over all '
        "steps, most of which plan none. "
        '"Full loop" is a whole step (simulated truth and sensing, mapping, planning, behavior tree) and '
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


_PARTS: dict[str, Callable[[dict[str, Any]], str]] = {
    "claims": _claim_lines,
    "table_main": _main,
    "mechanism": _mechanism,
    "sweep": _sweep,
    "profile": _timing,
}
"""by what a document has"""

REQUEST, RESULT, PAGE = "reproduce_request.json", "reproduce.json", "results.md"


def reproduce(
    budget: str, run_dir: Path | None, watch: EvaluationWatch, own: Sequence[str] = ()
) -> tuple[dict[str, Any], Path]:
    """Begin a reproduction: its document and its folder. ``own``: plugins of the user's, compared with ours.
    Raises ValueError for an unknown budget, RunFolderError, PluginError."""
    if budget not in BUDGETS:
        raise SettingError(f"--budget {budget!r}: {' or '.join(BUDGETS)}")
    refuse_place(run_dir)
    config, plugins = load_config("pool"), [plugin_spec(name).absolute().text for name in own]
    load_agents(plugins)  # refuses what cannot be loaded before hours have passed
    root = (run_dir or default_run_dir(f"reproduce-{budget}")).absolute()
    folder = RunFolder(root, config, [EVALUATION_SEED])
    request: dict[str, Any] = {"schema": 1, "budget": budget, "own": plugins}
    folder.write_json(REQUEST, request)
    return _run(folder, request, watch), root


def resume(place: Path, watch: EvaluationWatch, allow_code: bool = False) -> tuple[dict[str, Any], Path]:
    """Go on with a reproduction that was killed or interrupted; finished steps stay as they are.
    ``allow_code``: Python files that the folder names may be run. Raises RunFolderError."""
    root = place.absolute()
    folder = RunFolder.held(root, "uuv reproduce", REQUEST)
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


def _run(folder: RunFolder, request: dict[str, Any], watch: EvaluationWatch) -> dict[str, Any]:
    budget = BUDGETS[request["budget"]]
    steps = steps_of(budget, folder.path, request["own"])
    rows = {step.row: row_file(folder.path, step.row) for step in steps if step.row}
    for file in rows.values():
        if file.exists():
            _refuse_other_budget(file, read_json(file, folder=folder.path), budget)
    try:
        with folder.recorded():
            for number, step in enumerate(steps, start=1):
                _step(step, f"{number}/{len(steps)} {step.name}", folder, watch)
                if step.row and step.command[0] == "eval" and not rows[step.row].exists():
                    row = _row(folder.path, step)
                    _refuse_other_budget(folder.path / step.folder, row, budget)
                    folder.write_json(str(Path("rows") / f"{step.row}.json"), row)
            document = document_of(folder.path, request, steps)
            folder.write_json(RESULT, document)
            folder.write(PAGE, results_page(document))
    except KeyboardInterrupt:
        again = to_resume(folder.path, request["own"])
        watch.note(f"what is finished is kept; go on with: uuv reproduce {again}")
        raise
    watch.note(f"report: {report([folder.path]).page}")  # the page tells how the run ended
    return document


def _step(step: Step, name: str, folder: RunFolder, watch: EvaluationWatch) -> None:
    if is_done(step, folder.path):
        watch.note(f"{name}: done before")
        return
    watch.note(f"{name}: uuv {' '.join(step.argv(folder.path))}")
    began = time.perf_counter()
    run_step(step, folder.path)
    watch.note(f"{name}: {time.perf_counter() - began:.0f} s")


# -------------------------------------------------------------------------------------------------- gathering


def document_of(root: Path, request: dict[str, Any], steps: Sequence[Step]) -> dict[str, Any]:
    """The ``uuv reproduce --json`` document: results of every step by its folder, and the verdicts."""
    rows = {step.row: read_json(row_file(root, step.row), folder=root) for step in steps if step.row}
    results = {step.folder: read_json(result_file(step, root), folder=root) for step in steps if not step.row}
    record = read_json(root / "run.json", folder=root)
    commits = {commit for row in rows.values() for commit in row["commits"]}
    budget = BUDGETS[request["budget"]]
    own = [plugin_spec(name).label for name in request["own"]]
    of_method = {
        name: [rows[f"{name}-{seed}"] for seed in range(budget.training_seeds)] for name in budget.methods
    }
    facts = {name: [row["facts"] for row in found] for name, found in of_method.items()}
    untrained = {entry["name"]: [_entry(entry)] for entry in results["eval/main"]["agents"]}
    by_method = {name: [row["entry"] for row in found] for name, found in of_method.items()} | {
        name: untrained[name] for name in ("bt", "planner", "straight", *own)
    }
    document = {
        "schema": 2,
        "title": f"The paper reproduced, budget {request['budget']}",
        "budget": request["budget"],
        "seed": EVALUATION_SEED,
        "started": record["started"],
        "git_sha": record["git_sha"],
        "trained_at": sorted(commits - {record["git_sha"]}),
        "hardware": record["hardware"],
        "versions": record["versions"],
        "python": sys.version.split()[0],
        "commands": dict(_shown(step, root) for step in steps if step.command[0] != "train"),
        "table_main": by_method,
        "mechanism": {name: found for name, found in facts.items() if name.startswith(METHODS[0])},
        "transfer": results.get("eval/transfer"),
        "sweep": results.get("sweep/pool"),
        "profile": results.get("profile"),
    }
    document["claims"] = [vars(claim) for claim in claims_of(document)]
    made = [step.folder for step in steps if step.command[0] == "train" and (root / step.folder).is_dir()]
    return document | {"sections": sections_of(document, made)}


def _shown(step: Step, root: Path) -> tuple[str, str]:
    """Folder and arguments without the machine's paths; NAME-SEED stands for every training."""
    words = " ".join(["uuv", *step.argv(root)]).replace(str(root), "RUN")
    if not step.row:
        return step.folder, words
    return "eval/NAME-SEED", words.replace(step.row, "NAME-SEED")


def _row(root: Path, step: Step) -> dict[str, Any]:
    """All that counts of a training, once it is evaluated."""
    from uuvtai.learning.runner import read_metrics

    training = root / "train" / step.row
    (agent,) = read_json(result_file(step, root), folder=root)["agents"]
    rows = read_metrics(training)
    trained = {"trained_steps": round(rows[-1]["time/env_steps"]) if rows else 0}
    records = [read_json(place / "run.json", folder=root) for place in (training, root / step.folder)]
    commits = [record["git_sha"] for record in records if record.get("git_sha")]
    limit = load_training(METHODS[0]).uncertainty.max_scale
    facts = claims.training_facts(rows, limit)
    return {"schema": 1, "entry": _entry(agent) | trained, "facts": facts, "commits": commits}


def _refuse_other_budget(place: Path, row: Any, budget: Budget) -> None:
    """RunFolderError for a row, made elsewhere or beforehand, that is not of this budget."""
    wanted = budget.iterations * ENV_STEPS
    try:
        steps, episodes = row["entry"]["trained_steps"], len(row["entry"]["ends"])
        if wanted <= steps < 1.1 * wanted and episodes == budget.episodes:
            return
        found = f"{steps:,} env-steps and {episodes} episodes"
    except (KeyError, TypeError, ValueError):
        found = "no row of this version"
    raise RunFolderError(
        f"{place}: {found}, but this budget has {wanted:,} env-steps a training and {budget.episodes} "
        "episodes; move it away and --resume"
    )


def _entry(agent: dict[str, Any]) -> dict[str, Any]:
    """Of an agent's single episodes how each ended, a letter each."""
    ends = "".join(LETTERS[e["outcome"]] for e in agent["episodes_detail"])
    return {k: v for k, v in agent.items() if k != "episodes_detail"} | {"ends": ends}


def claims_of(document: dict[str, Any]) -> list[Claim]:
    """The paper's claims, judged by what the document holds of methods, sweep, times and transfer."""
    main, distilled = document["table_main"], METHODS[0]
    found = [*claims.of_table_main(main), *claims.of_training(document["mechanism"][distilled])]
    if document["sweep"]:
        policy = f"{distilled}-0"
        for name in (policy, "bt"):
            found += claims.of_sweep(document["sweep"]["cells"], name)
        found += claims.of_timing(document["profile"])
        (there,) = [agent for agent in document["transfer"]["agents"] if agent["name"] == policy]
        found += claims.of_transfer(main[distilled][0], there)
    return claims.judged(found)
