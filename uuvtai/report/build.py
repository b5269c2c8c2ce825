"""``uuv report``: find what a run folder holds, compose its sections, draw, and write the page and its
figures, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from uuvtai.errors import UserError
from uuvtai.files import FileError, refuse_links_in, refuse_output
from uuvtai.loader import ConfigError
from uuvtai.report.blocks import Block, Figure, Heading, PageSection
from uuvtai.report.learning_curves import Training, training
from uuvtai.report.media import media, shared
from uuvtai.report.methods_table import evaluation
from uuvtai.report.page import Page, render
from uuvtai.report.provenance import checkpoints, command_of, config_text, origins, provenance, status_notice
from uuvtai.report.reproduction import reproduction
from uuvtai.report.run_files import read_config, read_json, read_lines
from uuvtai.report.sweep import sweep
from uuvtai.report.timing import timing
from uuvtai.run_folder import RunFolderError, write_atomic
from uuvtai.tables.table import Table

NOTHING = (
    "has nothing to report yet: no eval/result.json, metrics.jsonl, sweep.json, profile.json or "
    "reproduce.json"
)


PAGE, FIGURES = "report.html", "figures"


@dataclass(frozen=True)
class Report:
    """What was written."""

    page: Path
    figures: list[Path]


def report(runs: list[Path], out: Path | None = None, force: bool = False) -> Report:
    """Write the page of a run folder to ``out`` (default: its report.html) and its figures as PNG to
    ``figures/`` beside the page.

    Several folders make one page, for which ``out`` must be given: trainings (seeds of a method, or methods)
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
        html, pngs = render(replace(page, sections=shared(page.sections)))
    figures = [target.parent / FIGURES / f"{name}.png" for name in pngs]
    for figure in figures:
        _refuse_place(figure, runs, force)
    return _write(target, html, dict(zip(figures, pngs.values(), strict=True)))


def refuse_run(run: Path) -> None:
    """Raise ConfigError for what is no folder, FileError for one with a link in it."""
    if not run.is_dir():
        raise ConfigError(
            f"{run}: is no run folder; give one that 'uuv eval', 'uuv train' or 'uuv sweep' printed"
        )
    try:
        refuse_links_in(run)
    except OSError as error:
        raise ConfigError(f"{run}: cannot be read ({error.strerror})") from None


def _refuse_place(target: Path, runs: list[Path], force: bool) -> None:
    """Raise FileError where a file must not be written: what the report of a run wrote before may be renewed,
    no other file of a run."""
    place, renewed = Path(os.path.realpath(target)), force
    for run in (Path(os.path.realpath(run)) for run in runs):
        if place == run / PAGE or place.parent == run / FIGURES:
            renewed = force or len(runs) == 1
        elif place.is_relative_to(run) and place.exists() and place.suffix != ".html":
            raise FileError(f"{target}: is part of the run {run.name}; give --out another name")
    if target.parent.is_symlink() and target.parent.name == FIGURES:
        raise FileError(f"{target.parent}: is a link; give --out a place whose {FIGURES}/ is a folder")
    refuse_output(target, [], renewed)


def _write(target: Path, html: str, figures: dict[Path, bytes]) -> Report:
    try:
        for path, content in figures.items():
            write_atomic(path, content)
        write_atomic(target, html.encode())
    except OSError as error:
        raise RunFolderError(
            f"{target}: cannot write it ({error.strerror}); give a place that can be written: --out FILE"
        ) from None
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
    title = str(document["title"]) if document else run.resolve().name
    closing = PageSection(
        "Where this comes from", [*provenance(record), *checkpoints(run), *config_text(run)]
    )
    return Page(title, _subtitle(record), status_notice(record), [*sections, closing])


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
    title = ", ".join(run.resolve().name for run in runs) if others else f"{len(runs)} trainings"
    return Page(title, "", [], [*sections, PageSection("Where this comes from", closing)])


def _named_after(run: Path, trainings: list[Path]) -> list[PageSection]:
    """Sections of one of several folders. An evaluation says which of the trainings its policies come
    from."""
    with damage_named(run):
        sections = content(run)
        methods = (read_json(run, "eval/result.json") or {}).get("methods", [])
    if not sections:
        raise ConfigError(f"{run}: {NOTHING}")
    origin = origins(methods, trainings)
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


def _subtitle(record: dict[str, Any]) -> str:
    return ", ".join(
        str(part) for part in (record.get("started"), record.get("hardware", {}).get("cpu")) if part
    )


def content(run: Path) -> list[PageSection]:
    """Sections of whatever a run folder holds."""
    command = command_of(read_json(run, "run.json") or {})
    result = read_json(run, "eval/result.json")
    found = [
        PageSection("Evaluation", evaluation(result, command) if result else []),
        PageSection("Sweep", sweep(document, command) if (document := read_json(run, "sweep.json")) else []),
        PageSection("Training", _curves_of([run]) if (run / "metrics.jsonl").exists() else []),
        PageSection(
            "Time", timing(document, command) if (document := read_json(run, "profile.json")) else []
        ),
        PageSection("Episodes", media(run, result)),
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
    """What a training run recorded."""
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
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        RecursionError,
        SyntaxError,
        TypeError,
        ValueError,
    ) as error:
        what = f"{type(error).__name__}: {error}"
        raise ConfigError(
            f"{run}: a result file there is not as this version writes it ({what}); make the run again"
        ) from error
