"""Several figures of a sweep's page as one picture: ``python -m docs.writers.panels OUT FIGURE...`` puts the
right half of each, its collisions, four in a row."""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

COLUMNS = 4


def panelled(figures: list[Image.Image]) -> Image.Image:
    """One picture of their right halves, all of one size, white where there is none. ValueError for
    figures of several sizes."""
    if len({figure.size for figure in figures}) != 1:
        raise ValueError("figures must be of one size")
    width, height = figures[0].size
    half, rows = width // 2, -(-len(figures) // COLUMNS)
    out = Image.new("RGB", (half * min(COLUMNS, len(figures)), height * rows), "white")
    for number, figure in enumerate(figures):
        part = figure.convert("RGB").crop((width - half, 0, width, height))
        out.paste(part, (half * (number % COLUMNS), height * (number // COLUMNS)))
    return out


def main() -> None:
    """Read the figures, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("figures", type=Path, nargs="+")
    chosen = parser.parse_args()
    panelled([Image.open(path) for path in chosen.figures]).save(chosen.out, optimize=True)


if __name__ == "__main__":
    main()
