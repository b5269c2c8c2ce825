"""Tables of one policy in twin and simulator: success, and the tracks that it was shown."""

from __future__ import annotations

from docs.writers.figure_sources import Sources
from uuvtai.tables.table import text_table


def parity_success(sources: Sources) -> str:
    """Success of one policy in twin and simulator."""
    rows = []
    for row in sources.benchmark("parity")["rows"]:
        if row["what"].startswith("success"):
            at = row["details"]
            shares = [
                f"{100 * side['success'] / side['episodes']:.1f} % [{100 * side['interval'][0]:.1f}, "
                f"{100 * side['interval'][1]:.1f}]"
                for side in (at["twin"], at["simulator"])
            ]
            low, high = at["difference"] - at["half"], at["difference"] + at["half"]
            rows.append(
                [
                    row["what"].removeprefix("success, "),
                    *shares,
                    f"{at['difference']:+.1f} [{low:+.1f}, {high:+.1f}]",
                    f"{at['only twin']}, {at['only simulator']}",
                    "yes" if abs(at["difference"]) <= 3 else "**no**",
                ]
            )
    heads = ["scene", "twin", "simulator", "difference, points", "only twin, only simulator", "within 3"]
    return text_table(heads, rows)


_TRACKS = {
    "position error": ("position error, m", ".3f"),
    "velocity error": ("velocity error, m/s", ".2f"),
    "birth delay": ("birth delay, s", ".1f"),
}


def parity_tracks(sources: Sources) -> str:
    """Errors of the tracks in twin and simulator, median and 90th percentile."""
    rows = []
    for row in sources.benchmark("parity")["rows"]:
        for side, values in row["details"].get("tracks", {}).items():
            pairs = [
                f"{values[f'{name}, median']:{form}}, {values[f'{name}, p90']:{form}}"
                for name, (_, form) in _TRACKS.items()
            ]
            shares = [f"{100 * values[name]:.1f}" for name in ("bodies tracked", "never tracked")]
            rows.append([row["what"].removeprefix("tracks, "), side, *pairs, *shares])
    heads = [head for head, _ in _TRACKS.values()]
    return text_table(["scene", "", *heads, "tracked within 6 m, %", "never tracked, %"], rows)
