"""Pages that say what the code says: commands, configuration, log topics, stages, causes of failure. Written
anew by every build, never committed."""

from __future__ import annotations

import shutil
from pathlib import Path

from docs.writers import commands, configuration, failure_causes, stages, topics

Pages = dict[str, str]
"""Markdown by path below ``docs/reference``"""


def pages() -> Pages:
    """Every generated page."""
    return {
        **commands.pages(),
        **configuration.pages(),
        "topics.md": topics.page(),
        "stages.md": stages.page(),
        "failure_causes.md": failure_causes.page(),
    }


def write_reference(folder: Path) -> None:
    """Write all pages into ``folder``; what an earlier build left there goes."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, text in pages().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
