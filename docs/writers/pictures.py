"""README's picture anew: ``python -m docs.writers.pictures`` plays one episode with three controllers and
writes ``docs/pool.png``.

The other pictures are figures of pages: ``pool_grid_best.png`` and ``robustness_collision.png`` come from
``uuv report`` of the sweeps named in ``docs/robustness.md``, ``training.png`` and ``trainers.png`` from the
commands beside them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from docs.writers.evaluations import ONE_THREAD
from docs.writers.figure_sources import ROOT

COMMAND = (
    "eval --controller straight --controller planner --controller bt --world pool -S 8 -D 6 -v 0.6 "
    "--seeds 0 --episodes 1 --record 1"
)


def pool(target: Path) -> Path:
    """Play and draw. Raises subprocess.CalledProcessError, OSError, and StopIteration where no picture was
    drawn."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        words = [sys.executable, "-m", "uuvtai", *COMMAND.split(), "--run-dir", str(run)]
        subprocess.run(
            words, cwd=ROOT, env={**os.environ, **ONE_THREAD}, stdout=subprocess.DEVNULL, check=True
        )
        drawn = next(
            path for path in sorted((run / "pictures").glob("*.png")) if "clearance" not in path.name
        )
        shutil.copy(drawn, target)
    return target


def main(arguments: list[str] | None = None) -> int:
    """Renew the picture."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.writers.pictures", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("--out", type=Path, default=ROOT / "docs/pool.png", help="default docs/pool.png")
    print(pool(parser.parse_args(arguments).out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
