"""Are turns as probable as the futures say? ``python -m docs.writers.turn_backs`` plays episodes with
futures on and compares each track's probability to turn, back or a corner, with what the body then did, in
closed form.

Writes ``docs/data/turn_backs.json``, counts by bins of the probability, and ``docs/turn_backs.png`` from it;
``--draw`` draws anew what is kept. A track is looked at once per horizon, so that no two of its moments
overlap.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import Any

import numpy as np

from docs.writers.figure_sources import ROOT
from uuvtai.statistics import wilson_interval

KEPT, PICTURE = ROOT / "docs/data/turn_backs.json", ROOT / "docs/turn_backs.png"
CELLS = {"pool": "pool (8, 9, 1.5)", "gauntlet": "gauntlet (8, 9, 1.5)"}
SEED, EPISODES = 77001, 100
TURN_BACK_S = (0.4, 0.8)
EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)
BODY_M = 0.5
"""a track belongs to the nearest moving body this close to where it is forecast now"""
CORNER_RAD, BACK_RAD = np.radians(30.0), np.radians(120.0)
"""a course that changes by more is a turn, by more than the second a turn back"""
_STEP_S = 0.02

Moment = tuple[float, str, bool, bool]
"""(probability; circle, line, none, or other way; turned; turned back)"""


class Watcher:
    """Recorder of ``run_episodes``: each straight track's probability to turn, and what came."""

    def __init__(self) -> None:
        self.moments: list[Moment] = []
        self._bodies: dict[int, list[dict[str, Any]]] = {}

    def begin(self, sim: Any, row: int, job: Any) -> None:
        """Keep the paths of the moving bodies of this row."""
        from operator import attrgetter

        from uuvtai.closed_form import describe_scenario

        found = describe_scenario(lambda name: sim.rows(attrgetter(name)(sim.s), [row])[0])
        self._bodies[row] = [body for body in found["bodies"] if body["path"]]

    def step(self, sim: Any) -> None:
        """Look at the rows that are a whole number of horizons old."""
        steps = sim.rows(sim.s.clock.step)
        due = [row for row in sorted(self._bodies) if steps[row] % round(TURN_BACK_S[-1] / _STEP_S) == 0]
        if not due:
            return
        back = sim.rows(sim.s.futures.share, due)[..., : len(TURN_BACK_S)].sum(-1)
        share = back + sim.rows(sim.s.futures.corner, due)
        place = sim.rows(sim.s.forecast.pos_w, due)
        there = sim.rows(sim.s.forecast.radius_m, due)[..., 0] >= 0
        for i, row in enumerate(due):
            for track in np.flatnonzero(there[i] & (share[i] > 0)):
                probability = min(float(share[i, track]), 1.0)
                way = place[i, track, 1] - place[i, track, 0]
                seen = what_came(self._bodies[row], place[i, track, 0], way, steps[row] * _STEP_S)
                self.moments.append((probability, *seen))

    def end(self, sim: Any, row: int, result: Any) -> None:
        """The row is over."""
        del self._bodies[row]


def what_came(
    bodies: list[dict[str, Any]], place: np.ndarray, way: np.ndarray, now_s: float
) -> tuple[str, bool, bool]:
    """(kind of the body's path, it turned, it turned back) within the horizon, of the body that the track at
    this place, on this way, stands for."""
    from uuvtai.closed_form import path_positions

    times = now_s + np.arange(-0.5, TURN_BACK_S[-1] / _STEP_S + 1) * _STEP_S
    paths = [path_positions(body["path"], times) for body in bodies]
    away = [float(np.linalg.norm(path[:2].mean(0) - place)) for path in paths]
    nearest = int(np.argmin(away))
    if away[nearest] > BODY_M:
        return "none", False, False
    course = np.unwrap(np.arctan2(*np.diff(paths[nearest], axis=0).T[::-1]))
    changed = np.abs(np.angle(np.exp(1j * (course - course[0])))).max()
    if abs(np.angle(np.exp(1j * (course[0] - np.arctan2(way[1], way[0]))))) > 0.5 * np.pi:
        return "other way", False, False
    if bodies[nearest]["path"]["shape"] == "circle":
        return "circle", False, False
    return "line", bool(changed > CORNER_RAD), bool(changed > BACK_RAD)


def counted(moments: list[Moment]) -> list[dict[str, Any]]:
    """Moments by bins of their probability."""
    probability = np.array([moment[0] for moment in moments])
    of_bin = np.minimum(np.searchsorted(EDGES, probability, side="right") - 1, len(EDGES) - 2)
    rows = []
    for nth in range(len(EDGES) - 1):
        inside = [moment for moment, found in zip(moments, of_bin, strict=True) if found == nth]
        rows.append({
            "from": EDGES[nth],
            "to": EDGES[nth + 1],
            "moments": len(inside),
            "mean_probability": round(float(np.mean([m[0] for m in inside])), 4) if inside else None,
            "turned": sum(m[2] for m in inside),
            "turned_back": sum(m[3] for m in inside),
            "on_circles": sum(m[1] == "circle" for m in inside),
            "no_body": sum(m[1] == "none" for m in inside),
            "other_way": sum(m[1] == "other way" for m in inside),
        })  # fmt: skip
    return rows


def played(world: str, episodes: int) -> list[Moment]:
    """All moments of this world's episodes, driven by the behaviour tree."""
    from uuvtai.loader import load_config
    from uuvtai.measure.episodes.playing import jobs_of, run_episodes
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

    scene = {"world.n_static": 8, "world.n_dynamic": 9, "world.dynamic_speed_m_s": 1.5}
    config = load_config(world, None, overrides={**scene, "forecast.turn_back_s": list(TURN_BACK_S)})
    watcher = Watcher()
    run_episodes(Sim(config, episodes, read_tree("bt"), "cpu"), jobs_of([SEED], episodes), watcher)
    return watcher.moments


def drawn(kept: dict[str, Any]) -> bytes:
    """PNG: shares with their Wilson intervals over each bin's mean probability, a panel for each cell."""
    import io

    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(9.0, 4.3), sharey=True, layout="constrained")
    for panel, (cell, rows) in zip(panels, kept["cells"].items(), strict=True):
        panel.plot([0, 1], [0, 1], color="#7a7d80", linewidth=1, linestyle="--", label="as forecast")
        for name, colour, mark in (("turned", "#0b6fb8", "o"), ("turned_back", "#c2571a", "s")):
            if name == "turned_back" and all(row["turned"] == row["turned_back"] for row in rows):
                continue
            x, low, share, high = np.array([point for row in rows if (point := _point(row, name))]).T
            label = "turned back" if name == "turned_back" else "turned by more than 30 degrees"
            spread = [share - low, high - share]
            panel.errorbar(x, share, spread, fmt=mark, ms=4.5, color=colour, label=label)
        n_moment = sum(row["moments"] - row["no_body"] - row["other_way"] for row in rows)
        panel.set(title=f"{cell}, {n_moment:,} moments", xlim=(0, 1), ylim=(0, 1), aspect="equal")
        panel.set_xlabel(f"forecast probability of a turn within {TURN_BACK_S[-1]} s")
        panel.grid(alpha=0.2)
        panel.legend(frameon=False, loc="upper left")
    panels[0].set_ylabel("share that turned within it, 95 % Wilson")
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=100, facecolor="white", metadata={"Software": None})
    return out.getvalue()


def _point(row: dict[str, Any], name: str) -> tuple[float, float, float, float] | None:
    """(mean probability, lower bound, share, upper bound) of a bin; tracks of no body are left out."""
    n = row["moments"] - row["no_body"] - row["other_way"]
    interval = wilson_interval(row[name], n)
    return interval and (row["mean_probability"], interval[0], row[name] / n, interval[1])


def main(arguments: list[str] | None = None) -> int:
    """Play, keep and draw."""
    parser = argparse.ArgumentParser(prog="python -m docs.writers.turn_backs", description="see the module")
    parser.add_argument("--draw", action="store_true", help="draw what is kept")
    if not parser.parse_args(arguments).draw:
        cells = {CELLS[world]: counted(played(world, EPISODES)) for world in CELLS}
        about = (
            f"Moments of tracks that go straight, {EPISODES} episodes of seed {SEED} in each cell by `bt`, "
            f"forecast.turn_back_s {TURN_BACK_S}: probability of a turn within {TURN_BACK_S[-1]} s, and "
            "how many bodies did turn (course changed by more than 30 degrees) and turn back (120) within it"
        )
        rows = {cell: [json.dumps(row) for row in rows] for cell, rows in cells.items()}
        texts = [
            f"  {json.dumps(cell)}: [\n   " + ",\n   ".join(lines) + "\n  ]" for cell, lines in rows.items()
        ]
        text = f'{{\n "about": {json.dumps(about)},\n "cells": {{\n' + ",\n".join(texts) + "\n }\n}\n"
        KEPT.write_text(text, encoding="utf-8")
    PICTURE.write_bytes(drawn(json.loads(KEPT.read_text(encoding="utf-8"))))
    return 0


if __name__ == "__main__":
    os.environ.setdefault("UUV_NUM_THREADS", "1")
    sys.exit(main())
