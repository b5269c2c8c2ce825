"""Tables of ``docs/benchmark.md``: its scenes, and the entries in ``docs/data/benchmark/``."""

from __future__ import annotations

from typing import Any

from docs.writers.figure_sources import Counts, Sources
from uuvtai.measure.benchmark.benchmark_scenes import SCENES
from uuvtai.tables.benchmark_tables import counts_of
from uuvtai.tables.table import text_table

FOLDER = "docs/data/benchmark"
DASH = "-"


def entries(sources: Sources) -> list[dict[str, Any]]:
    """The entries that the page shows, the one that arrives most often first."""
    paths = sorted((sources.root / FOLDER).glob("*.json"))
    found = [sources.json(path.relative_to(sources.root).as_posix()) for path in paths]
    return sorted(found, key=_arrivals, reverse=True)


def _arrivals(entry: dict[str, Any]) -> int:
    return sum(scene["outcomes"]["success"] for scene in entry["scenes"])


def benchmark_scenes(_sources: Sources) -> str:
    """One row a scene."""
    rows = [
        [
            f"`{bench.name}`",
            f"`{bench.world}`",
            str(bench.n_static),
            str(bench.n_dynamic),
            DASH if bench.speed_m_s is None else f"{bench.speed_m_s:g} m/s",
            bench.about,
        ]
        for bench in SCENES
    ]
    return text_table(["benchmark", "world", "S", "D", "v", "what it is"], rows)


def benchmark(sources: Sources) -> str:
    """Success with its 95 % Wilson interval / collision in % of every entry in every scene."""
    rows = [
        [f"`{entry['pilot']['name']}`", *(_cell(entry, bench.name) for bench in SCENES)]
        for entry in entries(sources)
    ]
    return text_table(["pilot", *(f"`{bench.name}`" for bench in SCENES)], rows)


def _cell(entry: dict[str, Any], name: str) -> str:
    """'99 [95, 100] / 1'."""
    scene = next((scene for scene in entry["scenes"] if scene["name"] == name), None)
    if scene is None:
        return DASH
    found = counts_of(scene)
    counts = Counts(found["episodes"], found["outcomes"])
    low, high = (100 * counts.field(f"success_{end}") for end in ("low", "high"))
    rates = [100 * counts.field(f"{ending}_rate") for ending in ("success", "collision")]
    return f"{rates[0]:.0f} [{low:.0f}, {high:.0f}] / {rates[1]:.0f}"
