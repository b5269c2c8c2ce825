"""What each command shows in the terminal."""

from __future__ import annotations

import difflib
import json
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.text import Text

from uuvtai.common.exits import UsageError, plain, say
from uuvtai.common.files import read_text
from uuvtai.common.presets import KINDS, built_in_file, preset_names
from uuvtai.common.tree_codes import ACTION, LEAVES
from uuvtai.console.screen import Screen
from uuvtai.report.evaluation import DAGGER, agents_table, causes_table, limit_of_p, paired_table, who_arrived
from uuvtai.report.sweep import by_agent, cell_table, grid_table
from uuvtai.report.tables import (
    Column,
    Table,
    heads,
    number,
    obstacles,
    percent,
    sensing,
    varies_alone,
    varying,
    vehicle,
)
from uuvtai.report.timing import density_table, latency_table

if TYPE_CHECKING:
    from uuvtai.sim.behavior_tree import TreeReport


def show_evaluation(screen: Screen, result: dict[str, Any], folder: Path) -> None:
    """All of a ``uuv eval --json`` document: agents, pairs, and why episodes failed."""
    show_agents(screen, result)
    show_pairs(screen, result["paired"])
    if limit := limit_of_p(result["agents"]):
        screen.line(limit, "dim")
    if any("causes" in agent for agent in result["agents"]):
        show_causes(screen, result)
        say(f"facts of every failure, and which of them are recorded: {folder / 'eval/explain.json'}")
    if said := who_arrived(result["agents"]):
        screen.line(said, "bold")


def show_training(screen: Screen, result: dict[str, Any]) -> None:
    """What a ``uuv train --json`` document leads on to: checkpoint, the next command."""
    run = shlex.quote(result["run"])
    learner, score = result["learner"], result["score"]
    told = "" if score is None or learner != "ppo" else f" ({percent(score)} in its evaluation)"
    given = {"search": f"--agent {run}/stack.yaml", "forecast": f"--set forecast.learned={run}"}
    screen.line(f"{'newest' if score is None else 'best'} checkpoint: {result['checkpoint']}{told}")
    screen.line(f"next: uuv eval {given.get(learner, f'--agent {run}')} --agent bt")


def show_agents(screen: Screen, result: dict[str, Any]) -> None:
    """Table of agents of a ``uuv eval --json`` document, and what belongs below it."""
    speed = f"v = {result['v_m_s']} m/s, " if result["D"] else ""
    title = (
        f"{result['world']}: {obstacles(result)}, {speed}{vehicle(result)}{sensing(result)}, "
        f"{len(result['seeds'])} {'seed' if len(result['seeds']) == 1 else 'seeds'} x "
        f"{result['episodes_per_seed']} episodes"
    )
    screen.table(agents_table(result["agents"], title))
    for part in result["remainder"]:
        screen.line(
            f"{part['agent']} misses {part['missed']} of {part['episodes']}: {part['sensing']} by sensing "
            f"(told of the moving obstacles it arrives), {part['forecast_decision']} by forecast, decision "
            f"and inertia (a point had a way), {part['physics']} by physics (the oracle finds none)"
        )
    for m in result["agents"]:
        if m["privileged"]:
            screen.line(f"{DAGGER} {m['name']} is privileged: {_privilege(m['name'])}", "dim")


def show_pairs(screen: Screen, pairs: list[dict[str, Any]]) -> None:
    """Every two agents on the episodes that both ran (``evaluation.results``); nothing where one
    agent ran alone."""
    if not pairs:
        return
    screen.line("")
    screen.table(paired_table(pairs, f"the same {pairs[0]['episodes']} episodes, two agents at a time"))


def _privilege(name: str) -> str:
    if name == "oracle":
        return "it knows the future and has no inertia; timeout = not reachable. An upper bound, no agent"
    if name == "human":
        return "the page showed what no vehicle senses"
    return "it is told where every moving obstacle is and how it moves; what stands still it senses"


_REMARKABLE_SHARE = 0.2  # Remarks on fewer of a cause's episodes are left to the JSON.

_LEGEND = (
    "knew: share whose forecast of the obstacle, made 1 s before the end, was right. Medians before the end: "
    "unseen = since a beam last met it, evading = since evasion began, chance = until when some "
    "velocity still escaped. worst: seed:episode of the hardest hit"
)


def show_causes(screen: Screen, result: dict[str, Any]) -> None:
    """Causes of every agent of a ``uuv eval --explain --json`` document."""
    for m in result["agents"]:
        if "explain" in m:
            _show_agent(screen, m)
    if any(m.get("explain") for m in result["agents"]):
        screen.line(_LEGEND, "dim")


def _show_agent(screen: Screen, m: dict[str, Any]) -> None:
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


# ---- A profile in the terminal: time per stage, rates, one bar per batch size, and the paper's timing tables
# beside ours.

_RATES = {
    "step": "random actions",
    "tree": "driven by the tree",
    "step_inference": "+ policy",
    "train": "+ training",
}
_FLAME_WIDTH = 100
_FLAME_COLORS = (
    "blue", "cyan", "green", "yellow", "magenta", "red", "bright_blue", "bright_cyan", "bright_green",
    "bright_yellow",
)  # fmt: skip


def show_profile(screen: Screen, result: dict[str, Any]) -> None:
    """Tables of a ``uuv profile --json`` document."""
    rows = result["rows"]
    machine = f"{result['machine']['cpu']}, {result['machine']['cores']} cores, {result['machine']['device']}"
    stages = list(rows[0]["stages_us_per_env_step"])
    screen.table(_by_batch_size(rows, stages, machine))
    screen.line("")
    for row in rows:
        _show_flame(screen, row)
    if result["paper_latency"]:
        _show_latency(screen, result)
    if result["paper_density"]:
        screen.line("")
        title = "loop time against moving obstacles (one env)"
        screen.table(density_table(result["paper_density"], title))


def _by_batch_size(rows: list[dict[str, Any]], stages: list[str], title: str) -> Table:
    # the largest batch is what most people come for, the first one what a vehicle would do; sizes between
    # them go first
    priorities = [0 if i == len(rows) - 1 else 1 if i == 0 else 2 for i in range(len(rows))]
    sizes = [
        Column(f"{row['num_envs']} env", priority) for row, priority in zip(rows, priorities, strict=True)
    ]
    lines = [[stage, *(f"{row['stages_us_per_env_step'][stage]:.2f}" for row in rows)] for stage in stages]
    lines += [
        [f"env-steps/s: {meaning}", *(number(row["env_steps_per_s"].get(name), 0) for row in rows)]
        for name, meaning in _RATES.items()
    ]
    lines.append(["memory MB", *(f"{row['memory_mb']:,.0f}" for row in rows)])
    lines.append(["compile s", *(f"{row['compile_s']:.1f}" for row in rows)])
    return Table([Column("us per env-step", left=True), *sizes], lines, title, sections=[len(stages) - 1])


def _show_flame(screen: Screen, row: dict[str, Any]) -> None:
    """Stages of a step as one bar, each as wide as its share of the time; a name stands where it has room."""
    stages = {name: us for name, us in row["stages_us_per_env_step"].items() if us > 0}
    total, bar, edge = sum(stages.values()), Text(), 0.0
    before, after = f"{row['num_envs']:>6} env ", f" {total:.1f} us"
    room = min(_FLAME_WIDTH, screen.console.width - len(before) - len(after))
    for (name, us), color in zip(stages.items(), _FLAME_COLORS * 2, strict=False):
        first, edge = round(room * edge / total), edge + us
        width = round(room * edge / total) - first
        bar.append((name if len(name) <= width else "").ljust(width), style=f"black on {color}")
    screen.line(Text(before).append(bar).append(after))


def _show_latency(screen: Screen, result: dict[str, Any]) -> None:
    rows = [row for row in result["paper_latency"] if row["component"] != "Replanning rate"]
    screen.line("")
    title = "beside the paper's timing table (one env; theirs on a workstation with an RTX 5090)"
    screen.table(latency_table(rows, title))
    for row in result["paper_latency"]:
        if row["component"] == "Replanning rate":
            ours = f"{row['replans_per_episode']:.1f} replans an episode, {row['hz']:.2f} Hz"
            screen.line(f"{ours} (paper: {row['paper_replans_per_episode']}, {row['paper_hz']} Hz)", "dim")
    loop = result["real_time"]
    times = ", ".join(f"{name} {loop[f'{name}_ms']:.2f}" for name in ("p50", "p99", "max"))
    verdict = f"{loop['budget_ms']:.0f} ms a step {'kept' if loop['within'] else 'NOT kept'}"
    screen.line(f"{verdict}: {times} ms; {loop['late']} of {loop['steps']} steps late")


# ---- The built-in presets in the terminal: a sentence for each, and what one of them states, with its
# comments, units and sources.

_PRESETS = (Column("", left=True), Column("", prose=True))
_MAX_BYTES = 1 << 20
_SENTENCE = re.compile(r"(.+?[.])(?:\s+(?=[A-Z0-9])|$)", re.S)


def sentence(kind: str, name: str) -> str:
    """What a built-in preset says of itself first: its first comment's first sentence."""
    text = read_text(built_in_file(kind, name), _MAX_BYTES)
    if kind == "tree":
        said = text.partition("<!--")[2].partition("-->")[0]
    else:
        lines = text.splitlines()
        head = lines[: next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))]
        said = " ".join(line.lstrip("# ") for line in head)
    said = " ".join(said.split()).removeprefix(f"{name}: ")
    first = _SENTENCE.match(said)
    return first.group(1) if first else said


def sentences() -> dict[str, dict[str, str]]:
    """Kind -> name -> sentence, of everything that is built in."""
    return {kind: {name: sentence(kind, name) for name in preset_names(kind)} for kind in KINDS}


def show_presets(screen: Screen) -> None:
    """Every kind with its presets."""
    for place, (kind, found) in enumerate(sentences().items()):
        if place:
            screen.line("")
        screen.line(Text(kind, style="bold"))
        screen.table(Table(_PRESETS, [[f"  {name}", said] for name, said in found.items()]))
    screen.line("")
    screen.line(
        "one of them as it is written: uuv presets show NAME; every key that it gives: uuv presets show NAME "
        "--all",
        "dim",
    )


def show_stated(kind: str, name: str, as_json: bool, out: Path | None = None) -> None:
    """A preset as it is written, its comments included; a world is checked too, and drawn to ``out`` or
    beside a file of the user's. Raises ConfigError, WorldError, FileError, LogError, OSError."""
    from uuvtai.config import loader

    path = loader.preset_path(kind, name)
    if as_json and path.suffix not in (".xml", ".md"):
        typer.echo(json.dumps(loader.stated(path), allow_nan=False))
        return
    text = plain(read_text(path, _MAX_BYTES)).rstrip("\n")
    if as_json:
        typer.echo(json.dumps({"schema": 1, "text": text}, allow_nan=False))
        return
    typer.echo(text)
    if (base := loader.base_of(path)) is not None:
        say(f"it changes these keys of {base} (uuv presets show {kind}/{base}); every key: --all")
    stated = loader.stated(path) if kind == "world" else {}
    if "world" in stated or stated.get("extends") in preset_names("world"):
        beside = None if path == built_in_file(kind, name) else path.with_suffix(".world.png")
        _show_world(name, out or beside)


def _show_world(name: str, out: Path | None) -> None:
    """What is remarkable of a world, its picture, and whether episodes can begin in it."""
    from uuvtai.config import loader
    from uuvtai.report import world

    config = loader.load_config(name)
    vehicle, sensors = (loader.preset_of(other, name, None) for other in ("vehicle", "sensors"))
    told, problem, label = world.check(config)
    say("\n".join([*told, f"vehicle {vehicle}, sensors {sensors}"]))
    if out is not None:
        say(f"picture: {world.picture(name, config.world, label, out)}")
    if problem:
        raise world.WorldError(f"{name}: {problem}")
    if out is not None:
        say(f"next: uuv eval --world {shlex.quote(name)} --agent bt --episodes 8 --record 1 --report")


def kind_and_name(action: str, name: str | None, run: Path | None = None) -> tuple[str, str]:
    """(kind, name) of 'NAME' or 'KIND/NAME' after ``show``; a path is taken for a tree's or a world's, any
    name for a tree of an evaluation's ``run``. UsageError for another action, or a name that no kind has."""
    if action != "show" or not name:
        raise UsageError("write 'uuv presets' or 'uuv presets show NAME'")
    kind, slash, rest = name.partition("/")
    if slash and kind in KINDS:
        return kind, rest
    if run is not None or name.endswith(".xml"):
        return "tree", name
    kinds = [kind for kind in KINDS if name in preset_names(kind)]
    for other in kinds[1:]:
        say(f"there is another one: uuv presets show {other}/{name}")
    if not kinds and not slash and not Path(name).suffix:
        known = "; ".join(f"{kind}: {', '.join(names)}" for kind in KINDS if (names := preset_names(kind)))
        raise UsageError(f"{name!r} is no preset{near(name) or '.'} There are {known}")
    return (kinds[0] if kinds else "world"), name


def near(name: str) -> str:
    """'; did you mean ...' for a name that no kind of preset has, or nothing."""
    known = {name: kind for kind in reversed(KINDS) for name in preset_names(kind)}
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}' ({known[close[0]]})?" if close else ""


# ---- Watched episodes in the terminal: how each ended.

_WATCHED = (
    Column("agent", of=lambda entry: entry["agent"]),
    Column("seed", of=lambda entry: str(entry["seed"])),
    Column("episode", of=lambda entry: str(entry["episode"])),
    Column("outcome", of=lambda entry: entry["outcome"]),
    Column("time s", of=lambda entry: f"{entry['time_s']:.1f}"),
    Column("min clearance m", 1, of=lambda entry: f"{entry['min_clearance_m']:.2f}"),
    Column("real-time factor", 2, of=lambda entry: f"{entry['real_time_factor']:.2f}"),
)


def show_watched(screen: Screen, watched: list[dict[str, Any]]) -> None:
    """A row per episode of ``uuv watch --json``."""
    screen.table(Table(_WATCHED, watched))


# ---- What was exported, in the terminal: do a policy's engines agree, and how long does each take.


def _largest(engine: dict[str, Any]) -> str:
    value, name = max((math.inf if n is None else n, name) for name, n in engine["difference"].items())
    return f"{value:.1e} ({name})"


_ENGINES = (
    Column("engine", left=True, of=lambda one: one["engine"]),
    Column("", left=True, of=lambda one: "agrees" if one["agrees"] else "DIFFERS"),
    Column("largest difference", 1, of=_largest),
    Column("p50 ms", 2, of=lambda one: f"{one['p50_ms']:.3f}"),
    Column("p99 ms", 3, of=lambda one: f"{one['p99_ms']:.3f}"),
)


def show_stack(document: dict[str, Any]) -> None:
    """What ``uuv export LOG`` wrote."""
    size = f"{document['bytes'] / 2**20:.1f} MiB"
    machines = " and ".join(document["machines"])
    say(f"wrote {document['folder']} ({size}): {document['kernels']} kernels for {machines}")
    say(f"there: python3 -m uuv_stack decides {document['checked_steps']} steps of the log anew")


def show_export(screen: Screen, found: dict[str, Any], is_ours: bool = False) -> None:
    """One row per engine of a ``learning.export`` result, where any could run, and what is damaged;
    ``is_ours``: the folder was written just now, so that its program may be named."""
    for damage in found["damages"]:
        say(damage)
    if found["engines"]:
        screen.table(Table(_ENGINES, found["engines"], found["folder"]))
    if is_ours and found["agrees"]:
        screen.line(f"next: python {shlex.quote(str(Path(found['folder']) / 'run_policy.py'))}")


# ---- A recorded episode in the terminal: its topics, how often they come, how it ended.

_TOPICS = (
    Column("topic", left=True, of=lambda topic: topic["topic"]),
    Column("messages", of=lambda topic: str(topic["messages"])),
    Column("Hz", of=lambda topic: number(topic["rate_hz"])),
    Column("schema", 1, left=True, of=lambda topic: topic["schema"]),
)


def show_log(screen: Screen, found: dict[str, Any], file: Path) -> None:
    """Topics of a ``uuv log info --json`` document."""
    screen.table(Table(_TOPICS, found["topics"], str(file)))
    end = f"outcome {found['outcome'] or 'none: the log was cut off'}"
    screen.line(
        f"duration {found['duration_s']:.2f} s, {end if found['is_eval'] else 'not a log of uuv eval'}"
    )


# ---- A behaviour tree in the terminal, with what its nodes did in an evaluation.

_NODES = (*heads("node", "episodes"), Column("ticks", 3), Column("acted", 2), Column("acted %", 1))
_TREE_LEGEND = "episodes: share that ticked the node; acted: control steps whose action the leaf set"


def show_tree_report(screen: Screen, report: TreeReport, dot: bool) -> None:
    """As DOT, as text, or with the use of its nodes where that is known."""
    if dot or not report.is_used:
        typer.echo(plain(report.dot if dot else report.text))
    else:
        show_tree(screen, report.text, report.document["nodes"])


def show_tree(screen: Screen, text: str, nodes: list[dict[str, Any]]) -> None:
    """One row per line of ``text``, for ``nodes`` with their use in an evaluation. Actions alone can act."""
    total = max(1, sum(node["acted"] for node in nodes))
    rows = []
    for line, node in zip(text.split("\n"), nodes, strict=True):
        leaf = LEAVES.get(node["type"])
        is_action = leaf is not None and leaf.kind == ACTION
        acted = [str(node["acted"]), f"{100 * node['acted'] / total:.1f} %"] if is_action else ["", ""]
        rows.append([line, f"{100 * node['share']:.1f} %", str(node["ticks"]), *acted])
    screen.table(Table(_NODES, rows))
    screen.line(_TREE_LEGEND, "dim")


# ---- A sweep in the terminal: a grid for each agent where two axes vary, else one row per cell.


def show_sweep(screen: Screen, result: dict[str, Any]) -> None:
    """Cells of a ``uuv sweep --json`` document."""
    if len(varying(result["axes"])) > 1 and not varies_alone(result):
        for agent, own in by_agent(result["cells"]).items():
            table, note = grid_table(own, result)
            said = f"{agent}: success / collision [%], below it the mean time to success [s].{note}"
            screen.table(replace(table, title=said))
        return
    title = f"{result['world']}: {len(result['cells'])} cells x {result['episodes_per_seed']} episodes"
    screen.table(cell_table(result["cells"], result, title))


# ---- Open-loop physics in the terminal: a dozen moments of ``uuv simulate``.

_ROWS = 12
_STATE = (
    *(Column(name) for name in ("t s", "x m", "y m", "z m")),
    *(Column(name, 3) for name in ("roll deg", "pitch deg")),
    *(Column(name, 1) for name in ("yaw deg", "u m/s")),
    *(Column(name, 2) for name in ("v m/s", "w m/s")),
    *(Column(name, 4) for name in ("p rad/s", "q rad/s", "r rad/s")),
)


def show_simulation(screen: Screen, result: dict[str, Any], title: str, driven: str | None = None) -> None:
    """Position, attitude and body velocities of a ``uuv simulate --json`` document at moments evenly spread;
    ``driven``: who drove to its goal."""
    if driven is not None:
        goal = ", ".join(f"{value:.2f}" for value in result["goal"])
        title = f"{title}, {driven.removeprefix('controller:')} drives to ({goal})"
    rows, n = [], len(result["t"])
    for i in sorted({round(i * (n - 1) / (_ROWS - 1)) for i in range(_ROWS)}) if n else []:
        values = [result["t"][i], *result["position"][i], *result["rpy_deg"][i], *result["nu"][i]]
        rows.append([f"{value:.3f}" for value in values])
    screen.table(Table(_STATE, rows, title))
