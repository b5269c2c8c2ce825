"""The gallery anew: ``python -m docs.writers.pictures`` runs the commands of ``docs/gallery.md`` and writes
the pictures into ``docs/gallery/``, and what is printed into the page.

The other pictures are figures of pages: ``pool_grid_bt.png`` and, by ``panels``, ``robustness_collision.png``
come from ``uuv report`` of the sweeps named in ``docs/robustness.md``, ``training.png`` and ``trainers.png``
from the commands beside them.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from docs.writers.evaluations import ONE_THREAD
from docs.writers.figure_sources import ROOT
from docs.writers.markdown import shell_blocks

PAGE = "docs/gallery.md"
PICTURES = "docs/gallery"
PRINTED = re.compile(r"(<!-- printed -->\n```text\n).*?(^```$)", re.M | re.S)
"""where the page shows what the commands of the shell block before it print"""


def renewed(page: str, folder: Path) -> str:
    """Run the page's commands in ``folder``; the page with what they print. Raises
    subprocess.CalledProcessError, OSError."""
    done, begin = "", 0
    for place in [*PRINTED.finditer(page), None]:
        part = page[begin : place.start() if place else None]
        printed = [_run(line, folder) for _mark, lines in shell_blocks(part) for line in lines]
        done += part
        if place:
            done += place[1] + "".join(row.rstrip() + "\n" for row in printed[-1].splitlines()) + place[2]
            begin = place.end()
    return done


def _run(line: str, folder: Path) -> str:
    """What a line ``uuv ...`` prints."""
    print(line, file=sys.stderr)
    words = [sys.executable, "-m", "uuvtai", *shlex.split(line)[1:]]
    env = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(ROOT)}
    return subprocess.run(words, cwd=folder, env=env, stdout=subprocess.PIPE, text=True, check=True).stdout


def main(arguments: list[str] | None = None) -> int:
    """Renew the gallery."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.writers.pictures", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        text = renewed((ROOT / PAGE).read_text(encoding="utf-8"), Path(folder))
        shutil.rmtree(ROOT / PICTURES, ignore_errors=True)
        shutil.copytree(Path(folder) / PICTURES, ROOT / PICTURES)
    (ROOT / PAGE).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
