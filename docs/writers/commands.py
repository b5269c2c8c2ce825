"""One page per command of ``uuv``, from the Typer app itself."""

from __future__ import annotations

import functools
import re

import typer
from typer.cli import get_docs_for_click

from docs.writers.markdown import contents
from uuvtai import cli
from uuvtai.common import exits
from uuvtai.report.tables import text_table

SEE = {
    "eval": ("evaluate", "extend"),
    "train": ("quickstart", "learning"),
    "simulate": ("simulator", "extend"),
    "watch": ("logs",),
    "drive": ("logs", "evaluate"),
    "identify": ("on_a_vehicle",),
    "sweep": ("evaluate",),
    "reproduce": ("evaluate", "results"),
    "report": ("evaluate",),
    "export": ("on_a_vehicle",),
    "replay": ("logs", "on_a_vehicle"),
    "pilot": ("safety", "on_a_vehicle"),
    "sitl": ("on_a_vehicle",),
    "presets": ("reference/configuration",),
    "examples": ("extend",),
    "doctor": ("quickstart", "performance"),
    "log": ("logs", "reference/topics", "security"),
}
"""prose about a command"""

EXIT_CODES = (
    (exits.OK, "done"),
    (
        exits.FAILED,
        "failed while running: a file that cannot be read or written, a device that is missing, a worker "
        "lost too often",
    ),
    (
        exits.USAGE,
        "usage or configuration: nothing was begun, nothing was written; the message says what to type "
        "instead",
    ),
    (
        exits.GATE,
        "finished, but a gate was not met: `uuv export` found that an exported policy disagrees, `uuv "
        "replay` that commands do, `uuv pilot` ended by a safe action",
    ),
    (
        exits.INTERRUPTED,
        "interrupted (Ctrl-C); what was finished is kept, and the message names the command that goes on",
    ),
)


@functools.cache
def app() -> typer.core.TyperGroup:
    """The command line as Typer runs it."""
    found = typer.main.get_command(cli.app)
    assert isinstance(found, typer.core.TyperGroup)
    return found


def pages() -> dict[str, str]:
    """The list of commands with the exit codes, and a page for each."""
    commands = app().commands
    return {"commands.md": _list(), **{f"commands/{name}.md": _page(name) for name in commands}}


def _page(name: str) -> str:
    root = app()
    text = words(
        get_docs_for_click(
            obj=root.commands[name], ctx=typer.Context(root, info_name="uuv"), name=f"uuv {name}"
        )
    )
    links = ", ".join(f"[{page.rpartition('/')[2]}](../../{page}.md)" for page in SEE.get(name, ()))
    more = f"More: {links}. " if links else ""
    return f"{text.rstrip()}\n\n{more}Exit codes: [commands](../commands.md#exit-codes).\n"


def words(text: str) -> str:
    """Markdown in which ``<time>`` of a help text stays words: outside of code an angle bracket would begin a
    tag, which no page shows."""
    return re.sub(
        r"```.*?```|`[^`\n]*`|<", lambda found: found[0] if found[0] != "<" else r"\<", text, flags=re.S
    )


def _list() -> str:
    root = app()
    rows = [
        [f"[`uuv {name}`](commands/{name}.md)", command.help or ""] for name, command in root.commands.items()
    ]
    codes = [[str(code), meaning] for code, meaning in EXIT_CODES]
    return "\n\n".join(
        [
            "# Commands",
            "Results go to stdout, progress and messages to stderr. `--json` prints one document and nothing "
            "else on stdout.",
            text_table(["command", "does"], rows),
            "## Exit codes",
            text_table(["code", "meaning"], codes),
            contents([f"commands/{name}" for name in root.commands]),
        ]
    )
