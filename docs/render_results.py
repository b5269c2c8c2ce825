"""README's tables and the page of results, from the results in docs/data, and the table of safety rules:
``python -m docs.render_results``.

``--check`` changes nothing and lists what differs. ``--keep RUN`` first takes in a finished run: of
``uuv reproduce``, or with ``--row NAME`` of the ``uuv eval --explain`` that the row's command gives.
"""

from __future__ import annotations

import argparse
import difflib
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from uuvtai.link.safety import RULES
from uuvtai.measure.reproduce.claims import pooled
from uuvtai.measure.reproduce.markdown import results_page
from uuvtai.measure.reproduce.steps import RETIRED_SEEDS
from uuvtai.outcomes import COLLIDED
from uuvtai.tables.heatmap import cell_name
from uuvtai.tables.table import text_table

Document = dict[str, Any]

ROOT = Path(__file__).resolve().parents[1]
EVALUATIONS, REPRODUCTION = "docs/data/evaluations_90007.json", "docs/data/reproduce.json"
README, RESULTS, SAFETY = "README.md", "docs/results.md", "docs/safety.md"
TABLE = re.compile(
    r"(?P<head><!-- table: (?P<name>\w+) -->\n)(?P<body>.*?)(?P<foot>^<!-- end -->)", re.M | re.S
)
LITERATURE = {"mppi", "dwa", "potential_field", "velocity_obstacle"}
"""agents whose rows docs/baselines.md shows"""


# ----------------------------------------------------------------------------------------------------- README


def measured(document: Document) -> str:
    """The lines above README's table."""
    seed = document["seed"]
    seen = (
        "This seed was looked at while tuning."
        if seed in RETIRED_SEEDS
        else "No tuning used this seed, and each agent was evaluated on it once."
    )
    return (
        f"Measured here: {document['episodes']:,} episodes of seed {seed} in each row, paper sensing, "
        "S = 8.\n"
        f"{seen} Success, collision and endings are\n"
        "those of `bt`, in the last row of `paper`. `-` = not evaluated or not kept.\n"
        f"Commands and counts of all rows: `{EVALUATIONS}`."
    )


def evaluations(document: Document) -> str:
    """README's table: the tree in every world, other agents beside it, and why the rest failed."""
    head = [
        "world (D, v in m/s)",
        "success",
        "collision",
        "contact / TTC stop / out / timeout",
        "`best`: success / collision",
        "`capped`",
        "`planner`",
        "`straight`",
        "most frequent causes of failure",
    ]
    shown = [row for row in document["rows"] if LITERATURE.isdisjoint(row["methods"])]
    return text_table(head, [_evaluated(row) for row in shown])


def _evaluated(row: Document) -> list[str]:
    methods, own = row["methods"], row["methods"][row["shows"]]
    ends = " / ".join(str(own["outcomes"][end]) for end in ("collision", "ttc", "out_of_tank", "timeout"))
    best, capped = (
        f"{_percent(methods[name], 'success')} / {_percent(methods[name], *COLLIDED)}"
        if name in methods
        else "-"
        for name in ("best", "capped")
    )
    others = [
        f"{_percent(methods[name], 'success')} %" if name in methods else "-"
        for name in ("planner", "straight")
    ]
    causes = ", ".join(f"{cause['label']} {cause['count']}" for cause in own["causes"][:2])
    collision = str(pooled([own], *COLLIDED)).partition(" = ")[2]
    return [row["title"], str(pooled([own], "success")), collision, ends, best, capped, *others, causes]


def _percent(method: Document, *outcomes: str) -> str:
    return f"{100 * pooled([method], *outcomes).rate:.1f}"


def safety_rules(document: Document) -> str:
    """The table of ``uuv pilot``'s rules, as they are in the code."""
    rows = []
    for rule in RULES:
        actions = (
            action.name.lower().replace("_", " ") + (f" after {seconds:g} s" if seconds else "")
            for seconds, action in rule.actions
        )
        rows.append(f"| {rule.name} | {rule.meaning} | {', '.join(actions)} | `-k {rule.case}` |")
    return "\n".join(["| what | when | action | its test |", "| --- | --- | --- | --- |", *rows])


TABLES: dict[str, Callable[[Document], str]] = {
    "measured": measured,
    "evaluations": evaluations,
    "safety_rules": safety_rules,
}


# ------------------------------------------------------------------------------------------------------ pages


def pages(root: Path = ROOT) -> dict[str, str]:
    """What README, the page of results and the page of safety should say, by path."""
    shown, reproduced = (json.loads((root / name).read_text("utf-8")) for name in (EVALUATIONS, REPRODUCTION))
    readme, safety = (
        TABLE.sub(
            lambda found: f"{found['head']}{TABLES[found['name']](shown)}\n{found['foot']}",
            (root / name).read_text("utf-8"),
        )
        for name in (README, SAFETY)
    )
    return {README: readme, RESULTS: results_page(reproduced), SAFETY: safety}


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
    files = ("eval/result.json", "run.json")
    result, record = (json.loads((run / file).read_text("utf-8")) for file in files)
    document = json.loads((root / EVALUATIONS).read_text("utf-8"))
    row = next((row for row in document["rows"] if row["name"] == name), None)
    if row is None:
        raise ValueError(f"no row {name!r}; there are {', '.join(row['name'] for row in document['rows'])}")
    how = {"commit": record["git_sha"], "date": record["started"], "machine": record["hardware"]}
    agents = {method["name"]: _kept(method) | how for method in result["methods"]}
    if wrong := [agent for agent, kept in agents.items() if kept["episodes"] != document["episodes"]]:
        raise ValueError(f"{', '.join(wrong)}: not {document['episodes']} episodes")
    row["methods"] |= agents
    row["paired"] = [pair for pair in row["paired"] if agents.keys().isdisjoint({pair["a"], pair["b"]})]
    row["paired"] += result["paired"]
    _write(root / EVALUATIONS, document)


def keep_reproduction(run: Path, root: Path = ROOT) -> None:
    """Keep what the page of results needs of a reproduction."""
    document = json.loads((run / "reproduce.json").read_text("utf-8"))
    names = ("schema", "budget", "seed", "notes", "started", "git_sha", "hardware", "commands", "claims")
    small = {name: document[name] for name in (*names, "inconsistencies") if name in document}
    small["table_main"] = {
        name: [_kept(entry) for entry in entries] for name, entries in document["table_main"].items()
    }
    small["ceilings"] = {"methods": [_kept(entry) for entry in document["ceilings"]["methods"]]}
    small["sweeps"] = {name: _small_sweep(sweep) for name, sweep in document["sweeps"].items()}
    small["profile"] = {
        "paper_latency": document["profile"]["paper_latency"],
        "paper_density": document["profile"]["paper_density"],
        "rows": [
            {name: row[name] for name in ("num_envs", "env_steps_per_s")}
            for row in document["profile"]["rows"]
        ],
    }
    _write(root / REPRODUCTION, small)


_KEPT = ("name", "episodes", "outcomes", "time_mean_s", "time_to_success_mean_s", "causes")


def _kept(entry: Document) -> Document:
    return {name: entry[name] for name in _KEPT if name in entry}


def _small_sweep(sweep: Document) -> Document:
    names = {cell_name(axis) for axis in sweep["axes"]} | {"S", "D", "v_m_s", "method", *_KEPT}
    rest = {name: sweep[name] for name in ("axes", "one_at_a_time", "unchanged") if name in sweep}
    return rest | {"cells": [{k: cell[k] for k in cell if k in names} for cell in sweep["cells"]]}


def _write(path: Path, document: Document) -> None:
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


# ---------------------------------------------------------------------------------------------------- command


def main(arguments: list[str] | None = None) -> int:
    """Renew or check; 1 where something differs or a run cannot be kept."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.render_results", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--check", action="store_true", help="change nothing, list what differs")
    parser.add_argument("--keep", type=Path, metavar="RUN", help="run folder whose results to keep")
    parser.add_argument("--row", help="row of README's table that the kept run evaluated")
    chosen = parser.parse_args(arguments)
    if chosen.keep:
        try:
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
