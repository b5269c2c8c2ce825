"""Tables in README and docs that are written from committed results; each is named in the text by ``<!--
table: NAME -->``."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

from docs.writers.benchmark_pages import benchmark, benchmark_scenes
from docs.writers.dead_tables import dead_commands, dead_thrusters
from docs.writers.figure_sources import Counts, SourceError, Sources, fitting, pooled, rated, share, weighted
from docs.writers.forecast_tables import forecast_pieces, forecast_scores
from docs.writers.learned_search import learned_curve, learned_numbers
from docs.writers.learned_trials import learned_before, learned_fresh, learned_trials, stack_trials
from docs.writers.link_tables import (
    aboard,
    ardusub_identified,
    closed_loop,
    identified_before,
    identified_vehicles,
    real_ardusub,
    terminals,
)
from docs.writers.newcomer_tables import newcomer, newcomer_zero
from docs.writers.parity_tables import parity_success, parity_tracks
from docs.writers.pieces import BEFORE, CELLS, DASH, PIECES, beside
from docs.writers.pose_tables import pose_endings, pose_errors
from docs.writers.quick_seeds import quick_failures, quick_seeds
from docs.writers.rehearsal_tables import rehearsal
from docs.writers.replay_tables import changed, lossy, replayed
from docs.writers.sonar_tables import sonars
from docs.writers.tenfold import tenfold, tenfold_claims
from docs.writers.trial_tables import (
    bfloat16,
    chooser_trials,
    finetune_curve,
    finetune_late,
    finetune_policy,
    learning_trials,
    quick_curve,
    quick_policy,
    quick_shallow,
    tuned_trials,
    twin_cold,
    twin_curve,
    twin_forecast,
    twin_policy,
    twin_warm,
)
from docs.writers.tuner_tables import fast_slopes, tuner_slopes
from docs.writers.twin_recipe import twin_memory, twin_recipe, twin_recipe_later
from docs.writers.vehicle_tables import vehicle_commands, vehicles
from uuvtai.measure.reproduce import paper
from uuvtai.measure.reproduce.steps import RETIRED_SEEDS
from uuvtai.tables.method_tables import milliseconds
from uuvtai.tables.table import text_table

# ------------------------------------------------------------------------------------------------ evaluations


def measured(sources: Sources) -> str:
    """The line above README's table: what was played, and whether the seed was free of tuning."""
    shown = sources.evaluations()
    seen = (
        "was looked at while tuning (figures of a seed that was not will replace these)"
        if shown["seed"] in RETIRED_SEEDS
        else "was never used for tuning and looked at once for each pilot"
    )
    kept = f" {shown['note']}" if "note" in shown else ""
    counts = sorted({m["episodes"] for entry in shown["rows"] for m in entry["methods"].values()})
    older = f" {OLDER} = played by the default pilot before." if any(map(_is_older, shown["rows"])) else ""
    return (
        f"Measured here: {' or '.join(f'{count:,}' for count in counts)} episodes of seed {shown['seed']} in "
        f"each row, paper sensing, S = 8.\nThis seed {seen}. Success, collision and endings are\nthose of "
        f"`bt`, in the last row of `paper`. `-` = not played or not kept.{older}{kept}\n"
        "`python -m docs.writers.evaluations` plays all rows; commands and counts: `docs/data/`."
    )


OLDER = "†"
"""mark of a row that the pilot before played"""


def _is_older(entry: dict[str, Any]) -> bool:
    """Whether a row was played by another default pilot than today's: ``older`` in its entry says so."""
    return entry.get("older", False)


def _title(entry: dict[str, Any]) -> str:
    return f"{entry['title']} {OLDER}" if _is_older(entry) else entry["title"]


def evaluations(sources: Sources) -> str:
    """README's table: the tree in every world, beside the yardsticks, and why the rest failed."""
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
    shown = [entry for entry in sources.evaluations()["rows"] if LITERATURE.isdisjoint(entry["methods"])]
    return text_table(head, [_evaluated(entry) for entry in shown])


def _evaluated(entry: dict[str, Any]) -> list[str]:
    methods = {name: Counts(m["episodes"], m["outcomes"]) for name, m in entry["methods"].items()}
    name = entry.get("shows", "bt")
    own = methods[name]
    ends = " / ".join(str(own.count(ending)) for ending in ("collision", "ttc", "out_of_tank", "timeout"))
    others = [
        f"{100 * methods[other].field('success_rate'):.1f} %" if other in methods else DASH
        for other in ("planner", "straight")
    ]
    capped, best = (_both(methods[other], 1) if other in methods else DASH for other in ("capped", "best"))
    return [
        _title(entry),
        share(own, "success"),
        rated(own, "collision"),
        ends,
        best,
        capped,
        *others,
        _causes(entry["methods"][name]),
    ]


def _causes(method: dict[str, Any]) -> str:
    """The two most frequent labels of ``uuv eval --explain`` with their counts."""
    caption = [f"{cause['label']} {cause['count']}" for cause in method["causes"][:2]]
    return ", ".join(caption) or ("" if method["outcomes"]["success"] == method["episodes"] else DASH)


def own_pieces(sources: Sources) -> str:
    """The examples of own pieces beside the tree: counts, time, McNemar's exact test, time of her code."""
    shown = sources.own_pieces()
    pairs = {pair["b"]: pair for pair in shown["paired"]}
    head = [
        "row",
        "success",
        "collision",
        "time to goal s",
        "p beside `bt`",
        "own code: ms a decision (slowest)",
    ]
    return text_table(head, [_own_piece(entry, pairs.get(entry["name"])) for entry in shown["methods"]])


def _own_piece(entry: dict[str, Any], pair: dict[str, Any] | None) -> list[str]:
    counts, own = Counts(entry["episodes"], entry["outcomes"]), entry.get("own")
    took = DASH if own is None else f"{milliseconds(own['decision_ms'])} ({milliseconds(own['slowest_ms'])})"
    p = DASH if pair is None else f"{pair['mcnemar_p']:.2g}"
    time = f"{entry['time_to_success_mean_s']:.1f}"
    return [f"`{entry['name']}`", share(counts, "success"), rated(counts, "collision"), time, p, took]


LITERATURE = frozenset({"mppi", "dwa", "potential_field", "velocity_obstacle"})
LOCAL_PLANNERS = ("bt", "capped", "mppi", "dwa", "potential_field", "velocity_obstacle")


def local_planners(sources: Sources) -> str:
    """Local planners of the literature beside the tree, wherever they were played: success / collision, time
    to success, p of McNemar's exact test against ``bt``, success for success."""
    entries = [
        entry for entry in sources.evaluations()["rows"] if not LITERATURE.isdisjoint(entry["methods"])
    ]
    if not entries:
        return "Not among the evaluations that are shown."
    rows = [[f"`{name}`", *(_beside_tree(entry, name) for entry in entries)] for name in LOCAL_PLANNERS]
    return text_table(["", *map(_title, entries)], rows)


def _beside_tree(entry: dict[str, Any], name: str) -> str:
    method = entry["methods"][name]
    time = method["time_to_success_mean_s"]
    pair = next((pair for pair in entry["paired"] if {pair["a"], pair["b"]} == {"bt", name}), None)
    p = "" if pair is None else f", p = {pair['mcnemar_p']:.2g}"
    counts = Counts(method["episodes"], method["outcomes"])
    return f"{_both(counts, 1)}, {DASH if time is None else f'{time:.1f} s'}{p}"


def policy(sources: Sources) -> str:
    """The shipped policy beside its tree wherever both were played: counts, and who alone arrives."""
    head = [
        "world (D, v in m/s)",
        "`bt`",
        "`best`",
        "`bt`: collision",
        "`best`: collision",
        "only `bt`, only `best` arrives",
        "exact McNemar p",
    ]
    rows = []
    for entry in sources.evaluations()["rows"]:
        methods = {name: Counts(m["episodes"], m["outcomes"]) for name, m in entry["methods"].items()}
        pair = next(
            (p for p in entry["paired"] if {p["a"], p["b"]} == {"bt", "best"} and "only_a" in p), None
        )
        if pair is None:
            continue
        only = (pair["only_a"], pair["only_b"]) if pair["a"] == "bt" else (pair["only_b"], pair["only_a"])
        cells = [
            rated(methods[name], ending) for ending in ("success", "collision") for name in ("bt", "best")
        ]
        rows.append([entry["title"], *cells, f"{only[0]}, {only[1]}", f"{pair['mcnemar_p']:.2g}"])
    return text_table(head, rows) if rows else "Not among the evaluations that are shown."


def switched_off(sources: Sources) -> str:
    """The pilot with each piece off, on the same episodes: success / collision, and against the first row's
    successes who alone arrives and p of McNemar's exact test."""
    rows = sources.pieces()["rows"]
    played = {(row["piece"], row["cell"]): row["outcomes"] for row in rows}
    cells = [cell for cell in CELLS if any(found == cell.name for _piece, found in played)]
    table = []
    for piece in (*PIECES, BEFORE):
        shown = [beside(played, piece.name, "all", cell.name) for cell in cells]
        if any(text != DASH for text in shown):
            table.append([piece.title, *(f"`{key}`" if key else "" for key in [piece.settings]), *shown])
    capped = [beside(played, "diagonal", BEFORE.name, cell.name) for cell in cells]
    if any(text != DASH for text in capped):
        table.append(["at most 0.6 m/s, against the pilot before", "", *capped])
    return text_table(["off", "by", *(cell.title for cell in cells)], table)


# ----------------------------------------------------------------------------------------------------- sweeps


def grid(sources: Sources) -> str:
    """The paper's grid, pooled as the paper pools it, for both methods and both worlds."""
    head = [
        "",
        "success [95 %]",
        "collision [95 %]",
        "weighted as the paper's 40 conditions",
        "cells without a collision",
    ]
    spotless = f"{paper.WITHOUT_COLLISION} of {paper.MODERATE_CONDITIONS}"
    rows = [
        [
            "`pool`, S <= 8, D <= 9, v <= 1.5: the paper",
            f"{paper.MODERATE_SUCCESS}",
            f"{paper.MODERATE_COLLISION}",
            "",
            spotless,
        ],
        *_pooled_rows(sources, "pool", "", ("moderate",), True),
        ["`pool`, D <= 3, all S and v: the paper", "", f"below {paper.FEW_MOVERS_COLLISION}", "", ""],
        *_pooled_rows(sources, "pool", "", ("D<=3",)),
        *_pooled_rows(sources, "pool", "the corner S = 12, D = 15, v = 3.0: ", ("S=12", "D=15", "v_m_s=3.0")),
        *_pooled_rows(sources, "gauntlet", "`gauntlet`, S <= 8, D <= 9, v <= 1.5: ", ("moderate",), True),
        *_pooled_rows(sources, "gauntlet", "`gauntlet`, all cells: ", ()),
    ]
    return text_table(head, rows)


def _pooled_rows(
    sources: Sources, sweep: str, title: str, conditions: Sequence[str], is_weighted: bool = False
) -> list[list[str]]:
    rows = []
    for method in ("bt", "best"):
        cells = fitting(sources.cells(sweep), [method, *conditions])
        spotless = sum(pooled([cell]).count("collided") == 0 for cell in cells)
        paper_like = weighted(cells) if is_weighted else None
        both = "" if paper_like is None else _both(paper_like, 1)
        counts = pooled(cells)
        rows.append(
            [
                f"{title}`{method}`",
                share(counts, "success"),
                share(counts, "collision"),
                both,
                f"{spotless} of {len(cells)}",
            ]
        )
    return rows


def _both(counts: Counts, digits: int = 0) -> str:
    """success / collision in %."""
    return (
        f"{100 * counts.field('success_rate'):.{digits}f} / {100 * counts.field('collision_rate'):.{digits}f}"
    )


def sweep_commands(sources: Sources) -> str:
    """What made the sweeps of the grid and of caution, and how long each took."""
    return _commands(sources, ("pool", "gauntlet", "caution"))


def sweep_commands_alone(sources: Sources) -> str:
    """What made the sweeps of one thing at a time."""
    return _commands(sources, ("robustness", "dead_reckoning"))


def _commands(sources: Sources, names: Sequence[str]) -> str:
    about = sources.json("docs/data/sweeps.json")
    lines = [
        f"{about[name]['command']}  # {about[name]['wall_s'] / 60:.0f} min on one thread" for name in names
    ]
    return "\n".join(["```sh", *lines, "```"])


def caution(sources: Sources) -> str:
    """Success and collision against ``teacher.caution``."""
    cells = sources.cells("caution")
    rows = []
    for value in dict.fromkeys(cell["teacher.caution"] for cell in cells):
        own = fitting(cells, [f"teacher.caution={value}"])
        counts = pooled(own)
        name = f"{value} (default)" if value == "1.0" else value
        rows.append(
            [
                name,
                share(counts, "success"),
                rated(counts, "collision"),
                _both(weighted(own), 1),
                f"{counts.time_s:.1f} s",
            ]
        )
    rows.append(
        [
            "the paper",
            f"{100 * paper.MODERATE_SUCCESS:.1f} %",
            f"{100 * paper.MODERATE_COLLISION:.1f} %",
            "",
            "",
        ]
    )
    return text_table(["caution", "success [95 %]", "collision [95 %]", "weighted", "time to success"], rows)


def alone(sources: Sources) -> str:
    """One thing changed at a time: a row a change."""
    found: dict[str, dict[str, Counts]] = {}
    for sweep in ("robustness", "dead_reckoning"):
        for cell in sources.cells(sweep):
            axes = [
                name
                for name in cell
                if name
                not in ("method", "episodes", "success", "contact", "ttc_stop", "out_of_tank", "timeout")
            ]
            caption = (
                ", ".join(
                    f"`{name}={cell[name]}`"
                    for name in axes
                    if cell[name] and name != "time_to_success_mean_s"
                )
                or "nothing"
            )
            found.setdefault(caption, {})[cell["method"]] = pooled([cell])
    head = [
        "changed",
        "`bt`: success [95 %]",
        "collision [95 %]",
        "timeouts",
        "time",
        "`best`: success [95 %]",
        "collision [95 %]",
        "timeouts",
        "time",
    ]
    return text_table(
        head,
        [
            [caption, *_alone(methods.get("bt")), *_alone(methods.get("best"))]
            for caption, methods in found.items()
        ],
    )


def _alone(counts: Counts | None) -> list[str]:
    if counts is None:
        return [DASH] * 4
    time = DASH if counts.time_s is None else f"{counts.time_s:.1f} s"
    return [rated(counts, "success"), rated(counts, "collision"), str(counts.count("timeout")), time]


# ------------------------------------------------------------------------------------------------- benchmarks


def learning_cost(sources: Sources) -> str:
    """Rates of training beside Stable-Baselines3's."""
    rows = []
    for row in sources.benchmark("learning")["rows"]:
        sensing = row["what"].partition(" sensing")[0] + (
            ", `ppo.bfloat16=true`" if "bfloat16" in row["what"] else ""
        )
        floor = f"{row['floor']:,.0f}: {'met' if row['met'] else 'not met'}"
        us = row["details"]["us_per_env_step"]
        rows.append(
            [
                sensing,
                f"{row['ours']:,.0f}",
                floor,
                *(f"{us[k]:.0f} us" for k in ("simulate", "infer", "learn")),
                f"{row['peer']:,.0f}",
            ]
        )
    return text_table(
        ["sensing", "env-steps/s", "floor", "simulate", "infer", "learn", "Stable-Baselines3"], rows
    )


def world_model_errors(sources: Sources) -> str:
    """Errors of the world model beside "as before"."""
    rows = []
    for row in sources.benchmark("world_model")["rows"]:
        if row["peer_name"] != "as before":
            continue
        found = _noted(
            r"([\d.]+) of its error, 95 % in ([\d.]+) \.\. ([\d.]+); squared standardised residual ([\d.]+)",
            row,
        )
        unit = "" if row["unit"] == "1" else f" {row['unit']}"
        error, before = (f"{row[side]:.3g}{unit}" for side in ("ours", "peer"))
        rows.append(
            [
                row["what"].removeprefix("RMSE "),
                error,
                before,
                f"{found[1]} ({found[2]} .. {found[3]})",
                found[4],
            ]
        )
    return text_table(
        ["targets", "RMSE", '"as before"', "ratio, 95 %", "squared standardised residual"], rows
    )


_SWITCHES = {
    "all on": "defaults",
    "plain NLL": "`beta_nll=0` (plain likelihood)",
    "gradient": "`stop_target_gradient=false`",
    "SI targets": "`normalise_targets=false`",
    "values": "`predict_change=false`",
    "values, SI": "`predict_change=false normalise_targets=false`",
    "MSE": "`likelihood=false` (MSE)",
}


def world_model_switches(sources: Sources) -> str:
    """Each switch turned alone."""
    columns = _row(sources, "world_model", "switches")["details"]["table"]
    traits = [*list(columns["all on"])[:9], "latent spread"]
    rows = [[title, *(_short(columns[name][trait]) for trait in traits)] for name, title in _SWITCHES.items()]
    return text_table(["", *(trait.removeprefix("RMSE ") for trait in traits)], rows)


def _short(value: float) -> str:
    return DASH if math.isnan(value) else f"{value:.3g}"


def risk(sources: Sources) -> str:
    """What the risk head knows, beside what stands next to it."""
    brier, ece, auroc, miss = (
        _row(sources, "world_model", f"risk: {what}")
        for what in ("Brier score", "ECE", "AUROC", "conformal miss rate")
    )
    found = _noted(
        r"(\d+ of \d+) accidents, 95 % in ([\d.]+) \.\. ([\d.]+); promised ([\d.]+) from (\d+) accidents; "
        r"threshold ([\d.]+), alarm in (\d+) %",
        miss,
    )
    low, high, promised = (100 * float(found[i]) for i in (2, 3, 4))
    rows = [
        ["Brier score", f"{brier['ours']:.4f}", f"{brier['peer']:.4f} base rate"],
        ["ECE", f"{ece['ours']:.4f}", f"{ece['peer']:.4f} before isotonic regression"],
        ["AUROC", f"{auroc['ours']:.3f}", f"{auroc['peer']:.3f} smallest time to collision of a sector"],
        [
            f"missed accidents at a promised {promised:.0f} %",
            f"{found[1]} ({low:.1f} .. {high:.1f} %)",
            f"threshold {found[6]} from {found[5]} accidents",
        ],
        ["alarm in safe moments", f"{found[7]} %", ""],
    ]
    return text_table(["", "head", "beside"], rows)


def risk_bins(sources: Sources) -> str:
    """The reliability diagram as numbers."""
    columns = _row(sources, "world_model", "risk: ECE")["details"]["table"]
    rows = [
        [name, *(f"{value:.2f}" for value in columns[name].values())] for name in ("predicted", "observed")
    ]
    rows.append(["moments", *(f"{value:.0f}" for value in columns["moments"].values())])
    return text_table(rows[0], rows[1:])


def risk_alarms(sources: Sources) -> str:
    """The risk alarm on the tree's episodes beside thresholds, for both ways to miss an accident."""
    rows = []
    for row in sources.benchmark("risk")["rows"]:
        if not row["what"].startswith("false alarms"):
            continue
        table = row["details"]["table"]
        for name in table["false alarms"]:
            at = {column: values[name] for column, values in table.items()}
            rows.append(
                [
                    row["what"].removeprefix("false alarms, missed by "),
                    name,
                    f"{_percent(at, 'false alarms')} [{_percent(at, 'low')}, {_percent(at, 'high')}]",
                    *(_percent(at, f"false alarms {world}") for world in ("gauntlet", "pool")),
                    f"{_percent(at, 'missed')} [{_percent(at, 'missed low')}, {_percent(at, 'missed high')}]",
                ]
            )
    return text_table(["missed by", "alarm", "false alarms, %", "gauntlet", "pool", "missed, %"], rows)


def _percent(values: dict[str, float], name: str) -> str:
    return f"{100 * values[name]:.1f}"


def _row(sources: Sources, what: str, text: str) -> dict[str, Any]:
    return next(row for row in sources.benchmark(what)["rows"] if row["what"] == text)


def _noted(pattern: str, row: dict[str, Any]) -> re.Match[str]:
    """Figures that a benchmark tells in its note alone."""
    found = re.search(pattern, row["note"])
    if not found:
        raise SourceError(f"{row['what']!r}: the note says something else: {row['note']!r}")
    return found


TABLES: dict[str, Callable[[Sources], str]] = {
    made.__name__: made
    for made in (
        measured,
        evaluations,
        local_planners,
        own_pieces,
        newcomer,
        newcomer_zero,
        switched_off,
        policy,
        grid,
        sweep_commands,
        sweep_commands_alone,
        caution,
        alone,
        dead_commands,
        dead_thrusters,
        learning_cost,
        tenfold,
        tenfold_claims,
        world_model_errors,
        world_model_switches,
        risk,
        risk_bins,
        risk_alarms,
        parity_success,
        parity_tracks,
        pose_endings,
        pose_errors,
        replayed,
        changed,
        lossy,
        closed_loop,
        real_ardusub,
        terminals,
        identified_vehicles,
        identified_before,
        ardusub_identified,
        aboard,
        sonars,
        vehicle_commands,
        vehicles,
        twin_curve,
        twin_recipe,
        twin_recipe_later,
        twin_memory,
        twin_warm,
        twin_cold,
        twin_policy,
        twin_forecast,
        finetune_curve,
        finetune_policy,
        finetune_late,
        quick_curve,
        quick_policy,
        quick_shallow,
        quick_seeds,
        quick_failures,
        chooser_trials,
        tuned_trials,
        learning_trials,
        tuner_slopes,
        learned_curve,
        learned_numbers,
        fast_slopes,
        learned_trials,
        learned_before,
        learned_fresh,
        bfloat16,
        stack_trials,
        forecast_scores,
        forecast_pieces,
        benchmark_scenes,
        benchmark,
        rehearsal,
    )
}
