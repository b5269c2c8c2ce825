"""``uuv report``: what a run folder holds as sections, drawn and written whole or not at all."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from uuvtai.common.errors import ODD, UserError
from uuvtai.common.files import FileError, read_bytes, refuse_links_in, refuse_output, refusing
from uuvtai.config.loader import ConfigError
from uuvtai.logs.drawing import OUTCOME_NAMES
from uuvtai.logs.encode import LogError
from uuvtai.logs.run_folder import RunFolderError, write_atomic
from uuvtai.report.blocks import (
    Block,
    Code,
    Facts,
    Figure,
    Gallery,
    Heading,
    Media,
    Notice,
    PageSection,
    Paragraph,
    Player,
)
from uuvtai.report.evaluation import evaluation
from uuvtai.report.html import Page, read_config, read_json, read_lines, render, shown
from uuvtai.report.recorded import Fact, packed_episode
from uuvtai.report.reproduction import reproduction
from uuvtai.report.sweep import by_agent, sweep
from uuvtai.report.tables import Table, axis_name, heads, megabytes, number, varying
from uuvtai.report.timing import timing
from uuvtai.report.training import Training, training

# ---- Episodes, the worst first: recorded ones in the player, pictures of others, as many as fit the page.

PLAYER_BYTES, PICTURE_BYTES = 4_500_000, 2_200_000
"""what all recorded episodes of a page, in base64, and its pictures may weigh: the whole less than 10 MB"""
_MOST_LOGS = 24  # that are read for a page: each takes a second or two

_NAME = re.compile(r"(?P<label>.*?)_?seed(?P<seed>-?\d+)_episode(?P<episode>\d+)(?P<rest>.*)")
_SUCCESS = "success"

Detail = dict[str, Any]


@dataclass(frozen=True)
class _Shown:
    """A file and the episode in it; pictures show the same episode of every agent."""

    path: Path
    agent: str
    episode: tuple[int, int] | None
    details: tuple[tuple[str, Detail], ...]  # (agent, how its episode went)
    remark: str

    @property
    def severity(self) -> tuple[bool, bool, float]:
        """Sorts the worst first: failures, then what came closest; what is not known comes last."""
        failed = any(detail["outcome"] != _SUCCESS for _, detail in self.details)
        told = (detail.get("min_clearance_m") for _, detail in self.details)
        closest = min((clearance_m for clearance_m in told if clearance_m is not None), default=float("inf"))
        return (not self.details, not failed, closest)


def media(folder: Path, result: dict[str, Any] | None) -> list[Block]:
    """The player of a run's logs, then pictures of what it does not hold; ``result``: document of ``uuv eval
    --json``. Raises FileError for a log or a picture that is no plain file."""
    agents = (result or {}).get("agents", [])
    logs = _worst_first(sorted([*folder.glob("logs/*.mcap"), *folder.glob("explain/*.mcap")]), agents)
    player, held = _player(folder, logs, agents)
    pictures = _worst_first(sorted([*folder.glob("pictures/*.png"), *folder.glob("explain/*.png")]), agents)
    pictures = [one for one in pictures if one.episode is None or one.episode not in held]
    blocks: list[Block] = [player] if player.episodes or player.note else []
    if pictures:
        blocks += [Heading("Trajectories over the occupancy map"), _gallery(folder, pictures, PICTURE_BYTES)]
    return blocks


def _player(
    folder: Path, logs: list[_Shown], agents: list[dict[str, Any]]
) -> tuple[Player, set[tuple[int, int] | None]]:
    """Logs of one episode together, and which episodes those are. What cannot be read is named."""
    together: dict[Any, dict[str, _Shown]] = {}
    for one in logs:  # a failure that was recorded again to explain it is the same episode
        together.setdefault(one.episode or one.path.name, {}).setdefault(one.agent or one.path.name, one)
    episodes, held, left_out, budget, n_read = [], set(), [], PLAYER_BYTES, 0
    names = [m["name"] for m in agents]
    for found in together.values():
        some = sorted(found.values(), key=lambda one: names.index(one.agent) if one.agent in names else -1)
        files = [one.path for one in some]
        n_read += len(files)
        these = ", ".join(str(path.relative_to(folder)) for path in files)
        if n_read > _MOST_LOGS or budget <= 0:
            left_out.append(these)
            continue
        try:
            blobs = packed_episode(files, names, _fact_of(some[0].episode, agents))
        except LogError as error:
            left_out.append(f"{these} (cannot be shown: {shown(str(error)[:300])})")
            continue
        size = sum(map(len, blobs))
        if size > budget:
            left_out.append(these)
            continue
        budget -= size
        held.add(some[0].episode)
        episodes.append((_title(some), blobs))
    return Player(episodes, _note(left_out)), held


def _fact_of(episode: tuple[int, int] | None, agents: list[dict[str, Any]]) -> Callable[[str], Fact]:
    """Why each agent failed in an episode, as far as the result says so."""

    def fact(name: str) -> Fact:
        agent = next((m for m in agents if m["name"] == name), {})
        meanings = {cause["label"]: cause["meaning"] for cause in agent.get("causes", [])}
        for row in agent.get("explain", []):
            if isinstance(row, dict) and (row["seed"], row["episode"]) == episode:
                slot = row["touched"].get("slot")
                label = str(row["label"])
                return Fact(
                    label.replace("_", " "), str(meanings.get(label, "")), -1 if slot is None else int(slot)
                )
        return Fact()

    return fact


def _title(logs: list[_Shown]) -> str:
    first = logs[0]
    if first.episode is None:
        return first.path.stem
    went = [f"{name} {_outcome_name(detail)}" for one in logs for name, detail in one.details]
    return f"Seed {first.episode[0]}, episode {first.episode[1]}" + (f": {', '.join(went)}" if went else "")


def _gallery(folder: Path, pictures: Iterable[_Shown], budget: int) -> Gallery:
    """As many files as the budget [bytes] holds, in order; what is too big is named."""
    items, left_out = [], []
    for one in pictures:
        size = one.path.lstat().st_size
        if size > budget:
            left_out.append(f"{one.path.relative_to(folder)} ({megabytes(size)})")
            continue
        budget -= size
        items.append(
            Media(read_bytes(one.path, size, folder), _caption(one), str(one.path.relative_to(folder)))
        )
    return Gallery(items, _note(left_out))


def _note(left_out: Sequence[str]) -> str:
    named = f"Left out to keep this page small, to be found in the run folder: {', '.join(left_out)}."
    return named if left_out else ""


def trimmed(sections: Sequence[PageSection]) -> list[PageSection]:
    """The sections with what the budgets hold of all runs' episodes and pictures, in order."""
    left = {Player: PLAYER_BYTES, Gallery: PICTURE_BYTES}
    return [
        replace(section, blocks=[_trimmed(block, left) for block in section.blocks]) for section in sections
    ]


def _trimmed(block: Block, left: dict[type, int]) -> Block:
    """The block with what its kind's budget [bytes] holds; what it takes is taken from the budget."""
    if isinstance(block, Player):
        sized = [(one, sum(map(len, one[1])), one[0]) for one in block.episodes]
    elif isinstance(block, Gallery):
        sized = [
            (one, len(one.content), f"{one.name} ({megabytes(len(one.content))})") for one in block.items
        ]
    else:
        return block
    kept, left_out = [], []
    for one, size, name in sized:
        if size > left[type(block)]:
            left_out.append(name)
            continue
        left[type(block)] -= size
        kept.append(one)
    note = " ".join(part for part in (block.note, _note(left_out)) if part)
    return Player(kept, note) if isinstance(block, Player) else Gallery(kept, note)


def _worst_first(paths: Iterable[Path], agents: list[dict[str, Any]]) -> list[_Shown]:
    return sorted((_shown(path, agents) for path in paths), key=lambda one: one.severity)


def _shown(path: Path, agents: list[dict[str, Any]]) -> _Shown:
    found = _NAME.fullmatch(path.stem)
    if found is None:
        return _Shown(path, "", None, (), path.stem)
    label, episode = found["label"], (int(found["seed"]), int(found["episode"]))
    names = (m["name"] for m in agents)
    agent = max((name for name in names if f"_{label}".endswith(f"_{name}")), key=len, default="")
    remark = label.removesuffix(agent).strip("_") if agent else found["rest"].strip("_")
    own = [m for m in agents if not label or m["name"] == agent]
    details = tuple(
        (m["name"], d) for m in own for d in m["episodes_detail"] if (d["seed"], d["episode"]) == episode
    )
    return _Shown(path, agent, episode, details, remark.replace("_", " "))


def _caption(one: _Shown) -> str:
    if one.episode is None:
        return one.path.stem
    where = f"seed {one.episode[0]}, episode {one.episode[1]}"
    went = "; ".join(f"{name}: {_outcome(detail)}" for name, detail in one.details)
    said = f"{one.remark}, {where}" if one.remark else where
    return ". ".join(part for part in (said[0].upper() + said[1:], went) if part)


def _outcome(detail: Detail) -> str:
    closest = number(detail.get("min_clearance_m"), 2)
    return f"{_outcome_name(detail)} after {number(detail['time_s'])} s, closest {closest} m"


def _outcome_name(detail: Detail) -> str:
    return OUTCOME_NAMES.get(detail["outcome"], str(detail["outcome"]))


# ---- Where figures come from: the command, the machine, the versions, the config.

MANIFEST_BYTES = 16 << 20  # [bytes] more than any manifest of a checkpoint has


def command_of(record: dict[str, Any]) -> str:
    """The command line of run.json as a person types it; of a script or notebook that it was one."""
    program, *words = [str(word) for word in record.get("argv", [])] or [""]
    if program and Path(program).stem not in ("uuv", "cli"):
        return "called from Python"
    return shlex.join(["uuv", *words]) if program else ""


def status_notice(record: dict[str, Any]) -> list[Block]:
    """A warning where the run did not end well."""
    status = record.get("status", "unknown")
    if status == "finished":
        return []
    return [
        Notice(f"The run is marked '{status}': what follows is what was there when this page was written.")
    ]


def provenance(record: dict[str, Any]) -> list[Block]:
    hardware, versions = record.get("hardware", {}), record.get("versions", {})
    facts = {
        "command": command_of(record),
        "started": record.get("started"),
        "status": record.get("status"),
        "wall time": f"{number(record['wall_s'])} s" if "wall_s" in record else None,
        "seeds": ", ".join(map(str, record.get("seeds", []))),
        "commit": record.get("git_sha"),
        "processor": hardware.get("cpu"),
        "cores": hardware.get("cores"),
        "system": hardware.get("system"),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
        "resumed": "; ".join(str(resumed.get("started")) for resumed in record.get("resumed", [])),
    }
    return [Facts([(name, str(value)) for name, value in facts.items() if value not in (None, "")])]


def config_text(folder: Path) -> list[Block]:
    """config.yaml, folded away."""
    text = read_config(folder)
    return [] if text is None else [Code("config.yaml", text)]


def checkpoints(folder: Path) -> list[Block]:
    rows = []
    for path in sorted((folder / "checkpoints").glob("*/manifest.json")):
        manifest = read_json(folder, str(path.relative_to(folder))) or {}
        files = manifest.get("files", {})
        digest = (files.get("model.safetensors") or {}).get("sha256", "-")
        step, score = str(manifest.get("step", "-")), number(manifest.get("score"), 3)
        rows.append([path.parent.name, step, score, str(digest)[:16]])
    if not rows:
        return []
    columns = heads("checkpoint", "iteration", "score", "sha256 of the model (first 16 digits)")
    return [Table(columns, rows, "Checkpoints")]


def origins(agents: list[dict[str, Any]], trainings: list[Path]) -> list[Block]:
    """By its checkpoint's sha256, the training that made each policy of an evaluation; [] without."""
    kept = {
        hashlib.sha256(read_bytes(path, MANIFEST_BYTES, run)).hexdigest(): (run.name, path.parent.name)
        for run in trainings
        for path in (run / "checkpoints").glob("*/manifest.json")
    }
    sentences = []
    for agent in agents if trainings else []:
        digest = str(agent.get("checkpoint", {}).get("sha256", ""))
        if digest in kept:
            sentences.append(
                "{} is checkpoint {} of the training {}.".format(agent["name"], *reversed(kept[digest]))
            )
        elif digest:
            sentences.append(
                f"{agent['name']} (checkpoint {digest[:16]}) is none of the checkpoints that these "
                "trainings keep."
            )
    return [Paragraph(" ".join(sentences))] if sentences else []


NOTHING = (
    "has nothing to report yet: no eval/result.json, metrics.jsonl, sweep.json, profile.json or "
    "reproduce.json"
)


PAGE, FIGURES = "report.html", "figures"


@dataclass(frozen=True)
class Report:
    page: Path
    figures: list[Path]


def report(runs: list[Path], out: Path | None = None, force: bool = False) -> Report:
    """Write the page of a run folder to ``out`` (default: its report.html) and its figures as PNG to
    ``figures/`` beside the page (of another name: ``NAME_figures/``).

    Several folders make one page, for which ``out`` must be given: trainings (seeds of an agent, or agents)
    are compared in one section, what the other folders hold follows, an evaluation beside the training that
    it is of. Everything is read and drawn before anything is written. The default page and its figures are
    renewed; elsewhere files are replaced with ``force`` only, and files of the run never. Raises ConfigError
    for a folder without anything to report or with a damaged file, FileError for a link in it or for a file
    that would be replaced, RunFolderError where the page cannot be written.
    """
    if len(runs) > 1 and out is None:
        raise ConfigError(
            f"{len(runs)} run folders: say where their common page is to be written: --out FILE"
        )
    for run in runs:
        refuse_run(run)
    target = out or runs[0] / PAGE
    if target.is_dir():
        raise ConfigError(
            f"{target}: is a folder; give the page a name, for example --out {target / 'report.html'}"
        )
    _refuse_place(target, runs, force)
    with damage_named(runs[0] if len(runs) == 1 else target):
        page = _of_several(runs) if len(runs) > 1 else _of_run(runs[0])
        html, pngs = render(replace(page, sections=trimmed(page.sections)))
    beside = FIGURES if target.name == PAGE else f"{target.stem}_{FIGURES}"
    figures = [target.parent / beside / f"{name}.png" for name in pngs]
    for figure in figures:
        _refuse_place(figure, runs, force)
    return _write(target, html, dict(zip(figures, pngs.values(), strict=True)))


def refuse_run(run: Path) -> None:
    """Raise ConfigError for what is no folder, FileError for one with a link in it."""
    if not run.is_dir():
        raise ConfigError(
            f"{run}: is no run folder; give one that 'uuv eval', 'uuv train' or 'uuv sweep' printed"
        )
    with refusing(ConfigError, f"{run}: cannot be read"):
        refuse_links_in(run)


def _refuse_place(target: Path, runs: list[Path], force: bool) -> None:
    """Raise FileError where no file may go: a run's earlier report may be renewed, its other files not."""
    place, renewed = Path(os.path.realpath(target)), force
    for run in (Path(os.path.realpath(run)) for run in runs):
        if place == run / PAGE or place.parent == run / FIGURES:
            renewed = force or len(runs) == 1
        elif place.is_relative_to(run) and place.exists() and place.suffix != ".html":
            raise FileError(f"{target}: is part of the run {run.name}; give --out another name")
    if target.parent.is_symlink() and target.parent.name.endswith(FIGURES):
        raise FileError(f"{target.parent}: is a link; give --out a place where it is a folder")
    refuse_output(target, [], renewed)


def _write(target: Path, html: str, figures: dict[Path, bytes]) -> Report:
    where = "give a place that can be written: --out FILE"
    with refusing(RunFolderError, f"{target}: cannot write it", where):
        for path, content in figures.items():
            write_atomic(path, content)
        write_atomic(target, html.encode())
    return Report(target, list(figures))


# ---------------------------------------------------------------------------------------------------- compose


def _of_run(run: Path) -> Page:
    record = read_json(run, "run.json") or {}
    document = read_json(run, "reproduce.json")
    sections = reproduction(document, run, _nested, _curves_of) if document else []
    sections += content(run)
    if not sections:
        raise ConfigError(
            f"{run}: {NOTHING}; give a run folder that 'uuv eval', 'uuv train' or 'uuv sweep' printed"
        )
    name = run.resolve().name
    title = str(document["title"]) if document else _title_of(run, record)
    closing = PageSection(
        "Where this comes from", [*provenance(record), *checkpoints(run), *config_text(run)]
    )
    about = (name, record.get("started"), record.get("hardware", {}).get("cpu"))
    return Page(
        title, ", ".join(str(part) for part in about if part), status_notice(record), [*sections, closing]
    )


def _title_of(run: Path, record: dict[str, Any]) -> str:
    """'best, bt in gauntlet', 'bt over S, D in pool', 'Replay: dive.mcap'; else the folder's name."""
    result, swept = read_json(run, "eval/result.json") or {}, read_json(run, "sweep.json") or {}
    names = [str(m["name"]) for m in result.get("agents", [])] or [*by_agent(swept.get("cells", []))]
    if names:
        axes = [] if result else [axis_name(name) for name in varying(swept["axes"])]
        over = f" over {_few(axes, 'settings')}" if axes else ""
        return f"{_few(names, 'agents')}{over} in {Path(str((result or swept).get('world', '-'))).stem}"
    command, what = [*map(str, record.get("argv", [])), "", "", ""][1:3]
    name = run.resolve().name if what.startswith("-") or not what else Path(what).name
    return f"{_KINDS[command]}: {name}" if command in _KINDS else run.resolve().name


_MOST_IN_TITLE = 4
_KINDS = {"replay": "Replay", "train": "Training", "profile": "Profile"}


def _few(names: list[str], what: str) -> str:
    return ", ".join(names) if len(names) <= _MOST_IN_TITLE else f"{len(names)} {what}"


def _of_several(runs: list[Path]) -> Page:
    """Trainings in one section, then what the other folders hold, each under its folder's name."""
    trainings = [run for run in runs if (run / "metrics.jsonl").exists()]
    others = [run for run in runs if run not in trainings]
    sections = [PageSection("Training", _curves_of(trainings))] if trainings else []
    for run in others:
        sections += _named_after(run, trainings)
    closing = [
        block
        for run in runs
        for block in (Heading(run.name), *provenance(read_json(run, "run.json") or {}), *config_text(run))
    ]
    titles = [_title_of(run, read_json(run, "run.json") or {}) for run in runs]
    title = "; ".join(titles) if others else f"{len(runs)} trainings"
    return Page(title, "", [], [*sections, PageSection("Where this comes from", closing)])


def _named_after(run: Path, trainings: list[Path]) -> list[PageSection]:
    """Sections of one of several folders. An evaluation names the trainings of its policies."""
    with damage_named(run):
        sections = content(run)
        agents = (read_json(run, "eval/result.json") or {}).get("agents", [])
    if not sections:
        raise ConfigError(f"{run}: {NOTHING}")
    origin = origins(agents, trainings)
    named = [
        replace(section, title=f"{section.title}: {run.name}", blocks=_figures_of(run, section.blocks))
        for section in sections
    ]
    return [replace(named[0], blocks=[*origin, *named[0].blocks]), *named[1:]]


def _figures_of(run: Path, blocks: Sequence[Block]) -> list[Block]:
    return [
        replace(block, name=f"{run.name}_{block.name}") if isinstance(block, Figure) else block
        for block in blocks
    ]


def content(run: Path) -> list[PageSection]:
    command = command_of(read_json(run, "run.json") or {})
    result = read_json(run, "eval/result.json")
    episodes = media(run, result)
    found = [
        PageSection("Evaluation", evaluation(result, command, episodes) if result else []),
        PageSection("Sweep", sweep(document, command) if (document := read_json(run, "sweep.json")) else []),
        PageSection("Training", _curves_of([run]) if (run / "metrics.jsonl").exists() else []),
        PageSection(
            "Time", timing(document, command) if (document := read_json(run, "profile.json")) else []
        ),
        PageSection("Episodes", [] if result else episodes),
    ]
    return [replace(one, blocks=_filled(one.blocks)) for one in found if one.blocks]


def _filled(blocks: Sequence[Block]) -> list[Block]:
    """Cells are made here, where a damaged document is refused with the folder that it lies in."""
    return [block.filled("page") if isinstance(block, Table) else block for block in blocks]


def _nested(run: Path) -> list[Block]:
    """Blocks of a run folder within a reproduction, the figures named after it."""
    with damage_named(run):
        blocks = [block for section in content(run) for block in section.blocks]
    if not blocks:
        raise ConfigError(f"{run}: {NOTHING}")
    return _figures_of(run, blocks)


def _curves_of(runs: list[Path]) -> list[Block]:
    commands = [command_of(read_json(run, "run.json") or {}) for run in runs]
    trainings = [training_of(run) for run in runs]
    return training(trainings, "\n".join(command for command in commands if command))


def training_of(run: Path) -> Training:
    argv = [str(word) for word in (read_json(run, "run.json") or {}).get("argv", [])]
    after = argv[argv.index("train") + 1 :] if "train" in argv else []
    preset = Path(after[0]).stem if after and not after[0].startswith("-") else ""
    return Training(run.resolve().name, read_config(run) or "", read_lines(run, "metrics.jsonl"), preset)


@contextmanager
def damage_named(run: Path) -> Iterator[None]:
    """A document that lacks what its schema promises is refused with the folder that it lies in."""
    try:
        yield
    except UserError:
        raise
    except (*ODD, AssertionError, SyntaxError) as error:
        what = f"{type(error).__name__}: {error}"
        raise ConfigError(
            f"{run}: a result file there is not as this version writes it ({what}); make the run again"
        ) from error
