"""Tables of the pages and the page of results, from committed results: ``python -m docs.render_results``.

``--check`` changes nothing and lists what differs. ``--keep RUN`` first takes in a finished run: of
``uuv reproduce``, with ``--row NAME`` of the ``uuv eval --explain`` that the row's command gives, or with
``--sweep NAME`` of the ``uuv sweep`` that docs/data/sweeps.json gives.
"""

from __future__ import annotations

import argparse
import base64
import csv
import difflib
import json
import re
import shlex
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.digest import digest
from uuvtai.common.enums import COLLIDED, FINAL_OUTCOMES, LETTERS
from uuvtai.evaluation import claims
from uuvtai.evaluation.claims import ends_of, pooled
from uuvtai.evaluation.reproduce import claims_of, results_page
from uuvtai.evaluation.reproduce_steps import BUDGETS, RETIRED_SEEDS
from uuvtai.report.tables import cell_name, place_of, seconds, text_table
from uuvtai.vehicle.safety import RULES

Document = dict[str, Any]
Cells = list[Document]

ROOT = Path(__file__).resolve().parents[1]
REPRODUCTION = "docs/data/reproduce.json"
EVALUATIONS = "docs/data/evaluations.json"
SWEEPS, BENCHMARKS = "docs/data/sweeps.json", "benchmarks/results"
README, RESULTS = "README.md", "docs/results.md"
ROBUSTNESS, SAFETY, SPEEDS = "docs/robustness.md", "docs/safety.md", "benchmarks/README.md"
TABLE = re.compile(
    r"(?P<head><!-- table: (?P<name>\w+) -->\n)(?P<body>.*?)(?P<foot>^<!-- end -->)", re.M | re.S
)
SHORT = {  # rows of README's table
    "pool_6": "`pool`, 6 at 0.6 m/s",
    "gauntlet_9_fast": "`gauntlet`, 9 at 1.5 m/s",
    "maze_6": "`maze`, 6 at 0.6 m/s",
    "column_9_fast": "`column`, 9 at 1.5 m/s",
    "pool_6_harsh_estimated": "`pool`, 6 at 0.6 m/s, harsh sensors, position estimated",
}


# ------------------------------------------------------------------------------------------------ evaluations


def measured(root: Path) -> str:
    """The lines above a table of evaluations."""
    document = _read(root / EVALUATIONS)
    seed, rows = document["seed"], [row for row in document["rows"] if "seed" not in row]
    agents = [agent for row in rows for agent in row["agents"].values()]
    seen = "This seed was looked at while tuning." if seed in RETIRED_SEEDS else "No tuning used this seed."
    commits = ", ".join(sorted({agent["commit"][:7] for agent in agents}))
    return (
        f"{document['episodes']:,} episodes of seed {seed} a row, eight static obstacles or its own; "
        f"{max(agent['date'] for agent in agents)[:10]}, commits {commits}.\n{seen}"
    )


def short(root: Path) -> str:
    """README's table: success of the tree, the best agent and the policy in five worlds."""
    rows, names = {row["name"]: row["agents"] for row in _read(root / EVALUATIONS)["rows"]}, SHORT.items()
    agents = ("bt", "best", "policy")
    lines = [[title, *(_percent(rows[name][who], "success") for who in agents)] for name, title in names]
    return text_table(["world, dynamic obstacles", *(f"`{who}`" for who in agents)], lines)


def evaluations(root: Path) -> str:
    """The tree in every world, other agents beside it, and why the rest failed."""
    document = _read(root / EVALUATIONS)
    head = [
        "world (D, v in m/s)", "success", "collision", "contact / TTC stop / out / timeout",
        "`best`: success / collision (p)", "`policy`: the same", "`planner`", "most frequent causes",
    ]  # fmt: skip
    note = (
        "Success, collision and endings are those of `bt`; `-` = not evaluated; p: McNemar's, beside `bt`.\n"
        f"Counts: `{EVALUATIONS}`.\n\n"
    )
    return note + text_table(head, [_evaluated(row) for row in document["rows"] if row["agents"]])


def _evaluated(row: Document) -> list[str]:
    agents, own = row["agents"], row["agents"][row["shows"]]
    ends = "/".join(str(own["outcomes"][end]) for end in ("collision", "ttc", "out_of_tank", "timeout"))
    best, policy = (_beside(agents, name) + _p(row, name) for name in ("best", "policy"))
    planner = f"{_percent(agents['planner'], 'success')} %" if "planner" in agents else "-"
    causes = ", ".join(f"{cause['label']} {cause['count']}" for cause in own["causes"][:2])
    collision = str(pooled([own], *COLLIDED)).partition(" = ")[2]
    title = row["title"] + (f", seed {row['seed']}" if "seed" in row else "")
    return [title, str(pooled([own], "success")), collision, ends, best, policy, planner, causes]


def _percent(agent: Document, *outcomes: str) -> str:
    return f"{100 * pooled([agent], *outcomes).rate:.1f}"


# --------------------------------------------------------------------------------------------- other pages


def local_planners(root: Path) -> str:
    """Every agent beside the tree, planners of the literature and the paper's stack among them."""
    rows = {row["name"]: row for row in _read(root / EVALUATIONS)["rows"]}
    worlds = [rows[name] for name in ("pool_6", "pool_9_fast", "gauntlet_9_fast")]
    names = ("bt", "best", "policy", "capped", "paper", "mppi", "dwa", "bt+truth", "best+truth", "oracle")
    lines = [[f"`{name}`", *(_beside_bt(row, name) for row in worlds)] for name in names]
    return text_table(["", *(row["title"] for row in worlds)], lines)


def _beside_bt(row: Document, name: str) -> str:
    if name not in row["agents"]:
        return "-"
    own = row["agents"][name]
    said = f"{_both(own)}, {own['time_to_success_mean_s']:.1f} s"
    return said + _p(row, name)


def _p(row: Document, name: str) -> str:
    """Of McNemar's test against the tree; nothing for the tree itself."""
    pair = next((pair for pair in row["paired"] if {pair["a"], pair["b"]} == {"bt", name}), None)
    return f" ({pair['mcnemar_p']:.2g})" if pair else ""


def _beside(agents: Document, name: str) -> str:
    """Success / collision; - = not evaluated."""
    return _both(agents[name]) if name in agents else "-"


def _both(agent: Document) -> str:
    return f"{_percent(agent, 'success')}/{_percent(agent, *COLLIDED)}"


def sweep_commands(root: Path) -> str:
    """How each of the kept sweeps was run."""
    return "\n".join(["```sh", *(sweep["command"] for sweep in _read(root / SWEEPS).values()), "```"])


def grid(root: Path) -> str:
    """The paper's grid in two worlds: rates over many cells, and cells without a collision."""
    pool, gauntlet = (_cells(root, name) for name in ("pool", "gauntlet"))
    moderate = "S <= 8, D <= 9, v <= 1.5"
    theirs = f"{claims.WITHOUT_COLLISION} of {claims.MODERATE_CONDITIONS}"
    few, corner = [c for c in pool if c["D"] <= claims.FEW_MOVERS], [c for c in pool if _is_corner(c)]
    lines = [
        [f"`pool`, {moderate}: the paper", f"{100 * claims.MODERATE_SUCCESS:.1f} %",
         f"{100 * claims.MODERATE_COLLISION:.1f} %", "", theirs],
        *_by_agent(_moderate(pool), f"`pool`, {moderate}", True),
        ["`pool`, D <= 3, all S and v: the paper", "",
         f"below {100 * claims.FEW_MOVERS_COLLISION:.1f} %", "", ""],
        *_by_agent(few, "`pool`, D <= 3, all S and v"),
        *_by_agent(corner, "the corner S = 12, D = 15, v = 3.0"),
        *_by_agent([c for c in pool if c["v_m_s"] == claims.CORNER["v_m_s"]], "`pool`, v = 3.0, all S and D"),
        *_by_agent(pool, "`pool`, all cells"),
        *_by_agent(_moderate(gauntlet), f"`gauntlet`, {moderate}", True),
        *_by_agent(gauntlet, "`gauntlet`, all cells"),
    ]  # fmt: skip
    head = ["", "success", "collision", "weighted as the paper's 40 conditions", "cells without a collision"]
    return text_table(head, lines)


def _by_agent(cells: Cells, where: str, weighted: bool = False) -> list[list[str]]:
    return [
        [
            f"{where}: `{agent}`",
            str(pooled(own, "success")),
            str(pooled(own, *COLLIDED)).partition(" = ")[2],
            _weighted(own) if weighted else "",
            f"{sum(not any(cell['outcomes'][o] for o in COLLIDED) for cell in own)} of {len(own)}",
        ]
        for agent, own in _of_agents(cells).items()
    ]


def _of_agents(cells: Cells) -> dict[str, Cells]:
    names = sorted({cell["agent"] for cell in cells}, key=lambda name: (name != "bt", name))
    return {name: [cell for cell in cells if cell["agent"] == name] for name in names}


def _weighted(cells: Cells) -> str:
    """Success / collision [%] where a cell in which nothing moves counts once for each of the paper's five
    speeds."""
    weights = [5 if cell["v_m_s"] is None else 1 for cell in cells]
    rates = [
        sum(w * pooled([cell], *ends).rate for w, cell in zip(weights, cells, strict=True)) / sum(weights)
        for ends in (("success",), COLLIDED)
    ]
    return "/".join(f"{100 * share:.1f}" for share in rates)


def _moderate(cells: Cells) -> Cells:
    return [
        cell for cell in cells if all((cell[name] or 0) <= most for name, most in claims.MODERATE.items())
    ]


def _is_corner(cell: Document) -> bool:
    return all(cell[name] == value for name, value in claims.CORNER.items())


def caution(root: Path) -> str:
    """The tree from fast to careful, over the paper's moderate conditions."""
    cells, lines = _moderate(_cells(root, "caution")), []
    for value in dict.fromkeys(cell["behavior.caution"] for cell in cells):
        own = [cell for cell in cells if cell["behavior.caution"] == value]
        (row,) = _by_agent(own, "")
        arrived = sum(cell["outcomes"]["success"] for cell in own)
        total_s = sum(cell["outcomes"]["success"] * (cell["time_to_success_mean_s"] or 0.0) for cell in own)
        named = f"{value}" + (" (default)" if value == 1.0 else "")
        lines.append([named, *row[1:3], seconds(total_s / arrived if arrived else None)])
    return text_table(["caution", "success", "collision", "time to success"], lines)


def one_at_a_time(root: Path) -> str:
    """What else may go wrong: a row a change, each a cell of its own."""
    lines: dict[str, dict[str, list[str]]] = {}
    for name in ("robustness", "dead_reckoning"):
        for cell in _cells(root, name):
            changes = [f"`{axis}={cell[axis]}`" for axis in place_of(cell)]
            shown = [
                str(pooled([cell], "success")).partition(" = ")[2],
                str(pooled([cell], *COLLIDED)).partition(" = ")[2],
                str(cell["outcomes"]["timeout"]),
                seconds(cell["time_to_success_mean_s"]),
            ]
            lines.setdefault(", ".join(changes) or "nothing", {})[cell["agent"]] = shown
    columns = ["success [95 %]", "collision [95 %]", "timeouts", "time"]
    head = ["changed", *(f"`{m}`: {c}" if c == columns[0] else c for m in ("bt", "best") for c in columns)]
    return text_table(head, [[name, *row["bt"], *row["best"]] for name, row in lines.items()])


def speeds(root: Path) -> str:
    """The newest kept speeds, each with its date, the commit that was timed, and whether that is today's."""
    kept = {}
    for path in sorted((root / BENCHMARKS).glob("*.json")):
        _date, device, what = path.stem.split("_", 2)
        kept[what, device] = _read(path)
    today = {what: digest(what) for what in TIMED}
    lines = [
        [f"`{what}`", row["what"], _figure(row["ours"], row["unit"]), _peer(row), document["date"][:10],
         document["commit"][:7] + "*" * (document.get("digest") != today[what]),
         document["machine"].get("gpu", document["machine"]["device"])]
        for (what, device), document in sorted(kept.items()) if what in TIMED
        for row in document["rows"][: TIMED[what]]
    ]  # fmt: skip
    note = "`*`: the code that the benchmark times has changed since, or was not noted.\n\n"
    return note + text_table(["benchmark", "what", "here", "peer", "measured", "commit", "device"], lines)


TIMED = {
    "scale": 3, "sonar": 4, "clearance": 6, "dynamics": 3, "route": 2, "tick": 3, "paced": 2,
    "quadrants": 8,
}  # fmt: skip
"""benchmarks of speed, and how many of their rows the page shows"""


def _figure(value: float, unit: str) -> str:
    return f"{value:,.0f} {unit}" if value >= 100 else f"{value:.2f} {unit}"


def _peer(row: Document) -> str:
    return "-" if row["peer"] is None else f"{_figure(row['peer'], '').strip()} ({row['peer_name']})"


def safety_rules(root: Path) -> str:
    """The rules of ``uuv pilot``, as they are in the code."""
    lines = []
    for rule in RULES:
        actions = (
            action.name.lower().replace("_", " ") + (f" after {seconds:g} s" if seconds else "")
            for seconds, action in rule.actions
        )
        lines.append([rule.name, rule.meaning, ", ".join(actions), f"`-k {rule.case}`"])
    return text_table(["what", "when", "action", "its test"], lines)


_MADE: dict[str, tuple[Callable[[Path], str], ...]] = {
    README: (measured, short),
    ROBUSTNESS: (measured, evaluations, local_planners, sweep_commands, grid, caution, one_at_a_time),
    SPEEDS: (speeds,),
    SAFETY: (safety_rules,),
}
TABLES = {page: {table.__name__: table for table in made} for page, made in _MADE.items()}


# ------------------------------------------------------------------------------------------------------ pages


def pages(root: Path = ROOT) -> dict[str, str]:
    """What the pages should say, by path."""
    found = {
        page: TABLE.sub(
            lambda found, made=made: f"{found['head']}{made[found['name']](root)}\n{found['foot']}",
            (root / page).read_text("utf-8"),
        )
        for page, made in TABLES.items()
    }
    kept = json.loads((root / REPRODUCTION).read_text("utf-8"), object_hook=_unpacked)
    told = [kept[budget] for budget in BUDGETS if budget in kept]
    judged = [document | {"claims": [vars(claim) for claim in claims_of(document)]} for document in told]
    return found | {RESULTS: results_page(*judged)}


def _read(path: Path) -> Document:
    return json.loads(path.read_text("utf-8"))


def differences(root: Path = ROOT) -> list[str]:
    """Lines of the pages that differ from the results; none = all agree."""
    return [
        line
        for name, wanted in pages(root).items()
        for line in difflib.unified_diff(
            (root / name).read_text("utf-8").splitlines(), wanted.splitlines(), name, "results", "", "", 0, ""
        )
    ]


# ------------------------------------------------------------------------------------------------- a new run


def keep_row(name: str, run: Path, root: Path = ROOT) -> None:
    """Put the agents of an evaluation in their row. Raises ValueError for an unknown row."""
    result, record, document = map(_read, (run / "eval/result.json", run / "run.json", root / EVALUATIONS))
    row = next((row for row in document["rows"] if row["name"] == name), None)
    if row is None:
        raise ValueError(f"no row {name!r}; there are {', '.join(row['name'] for row in document['rows'])}")
    how = {"commit": record["git_sha"], "date": record["started"], "machine": record["hardware"]}
    agents = {agent["name"]: _kept(agent) | how for agent in result["agents"]}
    if wrong := [agent for agent, kept in agents.items() if kept["episodes"] != document["episodes"]]:
        raise ValueError(f"{', '.join(wrong)}: not {document['episodes']} episodes")
    if row.pop("seed", None):  # it was of an older one
        row |= {"agents": {}, "paired": []}
    row["agents"] |= agents
    row["paired"] = [pair for pair in row["paired"] if agents.keys().isdisjoint({pair["a"], pair["b"]})]
    row["paired"] += result["paired"]
    _write(root / EVALUATIONS, document)


def keep_reproduction(run: Path, root: Path = ROOT) -> None:
    """Keep what the page needs of a reproduction, beside those of other budgets; verdicts are made anew."""
    document, kept = _read(run / "reproduce.json"), _read(root / REPRODUCTION)
    small = {name: value for name, value in document.items() if name not in ("sections", "claims")}
    for entries in small["table_main"].values():
        entries[:] = [_packed(entry, "trained_steps", "return_mean", *_TIMES) for entry in entries]
    if document["sweep"]:
        cells = document["sweep"]["cells"]
        small["sweep"] = {"cells": [_packed(cell, "agent", "S", "D", "v_m_s") for cell in cells]}
        small["transfer"] = {"agents": [_packed(agent, "name") for agent in document["transfer"]["agents"]]}
    kept.pop("quick", None)
    _write(root / REPRODUCTION, kept | {document["budget"]: small})


def _packed(entry: Document, *names: str) -> Document:
    """Of an agent or a cell these, and how each episode ended: compressed letters, for all its counts."""
    word = base64.b64encode(zlib.compress(_ends(entry)["ends"].encode(), 9)).decode()
    return {name: entry[name] for name in names if name in entry} | {"packed": word}


def _unpacked(found: Document) -> Document:
    if packed := found.pop("packed", None):
        ends = zlib.decompress(base64.b64decode(packed)).decode()
        counts = {end: ends.count(letter) for end, letter in LETTERS.items()}
        return found | {"ends": ends, "episodes": len(ends), "outcomes": counts}
    return found


_TIMES = ("time_mean_s", "time_to_success_mean_s")
_KEPT = ("name", "episodes", "outcomes", "ends", *_TIMES, "causes")


def _kept(entry: Document) -> Document:
    kept = {name: entry[name] for name in _KEPT if name in entry}
    if "causes" in kept:
        kept["causes"] = [{name: cause[name] for name in ("label", "count")} for cause in kept["causes"]]
    return kept


def _ends(cell: Document) -> dict[str, str]:
    """How its episodes ended, a letter each; nothing where that was not kept."""
    ends = ends_of(cell)
    return {"ends": "".join(LETTERS[end] for end in ends.values())} if ends else {}


_COUNTS = dict(zip(("success", "contact", "ttc_stop", "out_of_tank", "timeout"), FINAL_OUTCOMES, strict=True))
"""columns of a kept sweep"""


def keep_sweep(name: str, run: Path, root: Path = ROOT) -> None:
    """Keep the cells of a sweep, and how each episode ended. Raises KeyError for an unknown sweep."""
    sweep, record, known = map(_read, (run / "sweep.json", run / "run.json", root / SWEEPS))
    left_out = re.compile(r" --(run-dir|workers|num-envs) ('[^']*'|\S+)| --json")
    command = left_out.sub("", shlex.join(record["argv"][1:]))
    how = {"commit": record["git_sha"], "date": record["started"], "cpu": record["hardware"]["cpu"]}
    how |= {"command": f"uuv {command}", "episodes": sweep["episodes_per_seed"], "seeds": sweep["seeds"]}
    known[name] |= how
    axes = [cell_name(axis) for axis in sweep["axes"]]
    axes = [axis for axis in axes if any(cell.get(axis) is not None for cell in sweep["cells"])]
    last = "time_to_success_mean_s"
    with (root / f"docs/data/sweep_{name}.csv").open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow([*axes, "agent", "episodes", *_COUNTS, last, "ends"])
        for cell in sweep["cells"]:
            values = ["" if cell.get(axis) is None else cell[axis] for axis in axes]
            counts = [cell["outcomes"][end] for end in _COUNTS.values()]
            mean_s = cell[last] if cell[last] is None else round(cell[last], 2)
            rows.writerow(
                [*values, cell["agent"], cell["episodes"], *counts, mean_s, _ends(cell).get("ends")]
            )
    _write(root / SWEEPS, known)


def _cells(root: Path, name: str) -> Cells:
    """Of a kept sweep, as ``uuv sweep --json`` has them."""
    with (root / f"docs/data/sweep_{name}.csv").open(encoding="utf-8") as stream:
        return [_cell(row) for row in csv.DictReader(stream)]


def _cell(row: dict[str, str]) -> Document:
    outcomes = {end: int(row.pop(column)) for column, end in _COUNTS.items()}
    ends = {name: text for name in ("agent", "ends") if (text := row.pop(name, ""))}
    return {name: _value(text) for name, text in row.items()} | ends | {"outcomes": outcomes}


def _value(text: str) -> Any:
    try:
        return json.loads(text) if text else None
    except ValueError:
        return text


def _write(path: Path, document: Document) -> None:
    """With every innermost object on a line of its own."""
    text = re.sub(r"\{[^{}]*\}", lambda found: re.sub(r"\n *", "", found[0]), json.dumps(document, indent=1))
    path.write_text(text + "\n", encoding="utf-8")


# ---------------------------------------------------------------------------------------------------- command


def main(arguments: list[str] | None = None) -> int:
    """Renew or check; 1 where something differs or a run cannot be kept."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.render_results", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--check", action="store_true", help="change nothing, list what differs")
    parser.add_argument("--keep", type=Path, metavar="RUN", help="run folder whose results to keep")
    parser.add_argument("--row", help="row of the evaluations that the kept run is")
    parser.add_argument("--sweep", help="sweep of docs/data/sweeps.json that the kept run is")
    chosen = parser.parse_args(arguments)
    if chosen.keep:
        try:
            if chosen.sweep:
                keep_sweep(chosen.sweep, chosen.keep)
            else:
                keep_row(chosen.row, chosen.keep) if chosen.row else keep_reproduction(chosen.keep)
        except (OSError, ValueError, KeyError) as error:
            print(f"{chosen.keep}: not kept: {error}", file=sys.stderr)
            return 1
    if chosen.check:
        found = differences()
        print(*found, sep="\n", end="\n" if found else "", file=sys.stderr)
        return 1 if found else 0
    for name, text in pages().items():
        (ROOT / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
