"""The shipped presets in the terminal: a sentence for each, and what one of them states, with its comments,
units and sources."""

from __future__ import annotations

import contextlib
import difflib
import json
import re
from pathlib import Path

import typer
from rich.text import Text

from uuvtai.endings import UsageError, plain, say
from uuvtai.files import read_text
from uuvtai.shipped import KINDS, preset_names, shipped_file
from uuvtai.show.screen import Screen
from uuvtai.tables.table import Column, Table
from uuvtai.tables.wording import bodies

_PRESETS = (Column("", left=True), Column("", prose=True))
_MAX_BYTES = 1 << 20
_SENTENCE = re.compile(r"(.+?[.])(?:\s+(?=[A-Z0-9])|$)", re.S)


def sentence(kind: str, name: str) -> str:
    """What a shipped preset says of itself first: its first comment's first sentence."""
    text = read_text(shipped_file(kind, name), _MAX_BYTES)
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
    """Kind -> name -> sentence, of everything that is shipped."""
    return {kind: {name: sentence(kind, name) for name in preset_names(kind)} for kind in KINDS}


def show_presets(screen: Screen) -> None:
    """Every kind with its presets."""
    for number, (kind, found) in enumerate(sentences().items()):
        if number:
            screen.line("")
        screen.line(Text(kind, style="bold"))
        screen.table(Table(_PRESETS, [[f"  {name}", said] for name, said in found.items()]))
    screen.line("")
    screen.line(
        "one of them as it is written: uuv presets show NAME; every key that it gives: uuv presets show NAME "
        "--all",
        "dim",
    )


def show_stated(kind: str, name: str, as_json: bool) -> None:
    """A preset as it is written, its comments included. Raises ConfigError, FileError, OSError."""
    from uuvtai import loader

    path = loader.preset_path(kind, name)
    if as_json and path.suffix not in (".xml", ".md"):
        typer.echo(json.dumps(loader.stated(path), allow_nan=False))
        return
    text = plain(read_text(path, _MAX_BYTES)).rstrip("\n")
    if as_json:
        typer.echo(json.dumps({"schema": 1, "text": text}, allow_nan=False))
        return
    typer.echo(text)
    if kind == "world":
        with contextlib.suppress(loader.ConfigError):  # a file is shown although it cannot be used
            told = bodies(loader.load_config(name).world.bodies)
            vehicle, sensors = (loader.preset_of(other, name, None) for other in ("vehicle", "sensors"))
            say(f"{told}, vehicle {vehicle}, sensors {sensors}")
    if (base := loader.base_of(path)) is not None:
        say(f"it changes these keys of {base} (uuv presets show {kind}/{base}); every key: --all")


def kind_and_name(action: str, name: str | None) -> tuple[str, str]:
    """(kind, name) of 'NAME' or 'KIND/NAME' after ``show``; a path is taken for a world's. UsageError for
    another action, and for a name that no kind has."""
    if action != "show" or not name:
        raise UsageError("write 'uuv presets' or 'uuv presets show NAME'")
    kind, slash, rest = name.partition("/")
    if slash and kind in KINDS:
        return kind, rest
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
