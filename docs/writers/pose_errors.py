"""How far off is the estimated pose, and does the filter know? ``python -m docs.writers.pose_errors`` plays
episodes with ``nominal`` and ``harsh`` sensing and compares estimate, covariance and truth at fixed moments.

Writes ``docs/data/pose_77002.json``, with the ending of every episode; ``--before COMMIT`` adds those of
the same episodes by that commit's own code. ``docs/simulator.md`` shows both.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from docs.writers.evaluations import commit_of_package
from docs.writers.figure_sources import ROOT
from docs.writers.pieces import LETTERS, Cell, Piece, Turn
from uuvtai.run_folder import hardware, write_atomic

SEED, EPISODES = 77002, 600
KEPT = ROOT / f"docs/data/pose_{SEED}.json"
PRESETS = ("nominal", "harsh")
MOMENTS_S = (2.0, 5.0, 10.0)
_STEP_S = 0.02
_UPPER = np.triu_indices(3)

Look = dict[str, np.ndarray]
"""per episode at one moment: ``off`` (n, 4) error of x, y, heading, z; ``cov`` (n, 3, 3) of the first three,
``z_var`` (n,), ``speed`` (n,) length of the velocity's error"""


class PoseWatcher:
    """Recorder of ``run_episodes``: errors and covariance of the pose at each of the moments."""

    def __init__(self) -> None:
        self.looks: dict[float, list[Look]] = {moment: [] for moment in MOMENTS_S}
        self._rows: set[int] = set()

    def begin(self, sim: Any, row: int, job: Any) -> None:
        """An episode begins in this row."""
        self._rows.add(row)

    def step(self, sim: Any) -> None:
        """Look at the rows that are as old as one of the moments."""
        steps = sim.rows(sim.s.clock.step)
        for moment, looks in self.looks.items():
            due = [row for row in sorted(self._rows) if steps[row] == round(moment / _STEP_S)]
            if due:
                looks.append(looked(sim, due))

    def end(self, sim: Any, row: int, result: Any) -> None:
        """The row is over."""
        self._rows.discard(row)


def looked(sim: Any, rows: list[int]) -> Look:
    """Estimate less truth of these rows, and what the filter says of it."""
    s = sim.s
    pos, quat, vel = (
        sim.rows(field, rows).astype(float) for field in (s.vehicle.pos_w, s.vehicle.quat_wb, s.vehicle.vel_b)
    )
    told, rpy, said = (sim.rows(field, rows).astype(float) for field in (s.ego.pos_w, s.ego.rpy, s.ego.vel_b))
    w, x, y, z = quat.T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turn = np.angle(np.exp(1j * (rpy[:, 2] - yaw)))
    cov = np.zeros((len(rows), 3, 3))
    cov[:, _UPPER[0], _UPPER[1]] = cov[:, _UPPER[1], _UPPER[0]] = sim.rows(s.ego.pose_cov, rows)
    return {
        "off": np.column_stack([told[:, :2] - pos[:, :2], turn, told[:, 2] - pos[:, 2]]),
        "cov": cov,
        "z_var": sim.rows(s.ego.z_var, rows).astype(float),
        "speed": np.linalg.norm(said - vel, axis=1),
    }


def summed(looks: list[Look]) -> dict[str, Any]:
    """One moment: number of episodes, NEES of (x, y, heading) and of z, root mean squares of the errors."""
    one = {name: np.concatenate([look[name] for look in looks]) for name in looks[0]}
    off, level = one["off"], one["off"][:, :3]
    nees = np.einsum("ei,ei->e", level, np.linalg.solve(one["cov"], level[..., None])[..., 0])
    return {
        "episodes": len(off),
        "nees": round(float(nees.mean()), 3),
        "nees_z": round(float((off[:, 3] ** 2 / one["z_var"]).mean()), 3),
        "place_mm": round(1e3 * rms(np.hypot(off[:, 0], off[:, 1])), 2),
        "place_sigma_mm": round(1e3 * float(np.sqrt((one["cov"][:, 0, 0] + one["cov"][:, 1, 1]).mean())), 2),
        "depth_mm": round(1e3 * rms(off[:, 3]), 2),
        "heading_mrad": round(1e3 * rms(off[:, 2]), 3),
        "speed_mm_s": round(1e3 * rms(one["speed"]), 2),
    }


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def played(preset: str) -> dict[str, Any]:
    """All episodes with this sensing, driven by the behaviour tree."""
    from uuvtai.loader import load_config
    from uuvtai.measure.episodes.playing import jobs_of, run_episodes
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

    scene = {"world.n_static": 8, "world.n_dynamic": 6, "world.dynamic_speed_m_s": 0.6}
    watcher = PoseWatcher()
    sim = Sim(load_config("pool", preset, overrides=scene), 256, read_tree("bt"), "cpu")
    results, _ = run_episodes(sim, jobs_of([SEED], EPISODES), watcher)
    return {
        "sensors": preset,
        "commit": commit_of_package(),
        "machine": hardware(),
        "outcomes": "".join(LETTERS[result.outcome] for result in results),
        "moments": {f"{moment:g} s": summed(looks) for moment, looks in watcher.looks.items()},
    }


def before(commit: str) -> dict[str, Any]:
    """Endings of the same episodes by another commit's own code."""
    from benchmarks.before import checked_out

    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, checked_out(commit, Path(folder) / "tree") as (full, tree):
        for preset in PRESETS:
            cell = Cell(preset, preset, f"--world pool -S 8 -D 6 -v 0.6 --sensors {preset}")
            found[preset] = Turn(Piece("before", ""), cell, tree, full).play(SEED, EPISODES)["outcomes"]
    return {"commit": full, "outcomes": found}


def main(arguments: list[str] | None = None) -> int:
    """Play and keep."""
    parser = argparse.ArgumentParser(prog="python -m docs.writers.pose_errors", description="see the module")
    parser.add_argument(
        "--before", default="", help="a commit: its endings are added, nothing else is played"
    )
    chosen = parser.parse_args(arguments)
    if chosen.before:
        kept = json.loads(KEPT.read_text(encoding="utf-8")) | {"before": before(chosen.before)}
    else:
        kept = {
            "schema": 1,
            "about": f"pool (8, 6, 0.6), {EPISODES} episodes of seed {SEED} by `bt`, position estimated",
            "seed": SEED,
            "letters": {letter: name for name, letter in LETTERS.items()},
            "rows": [played(preset) for preset in PRESETS],
        }
    write_atomic(KEPT, (json.dumps(kept, indent=1) + "\n").encode())
    return 0


if __name__ == "__main__":
    os.environ.setdefault("UUV_NUM_THREADS", "1")
    sys.exit(main())
