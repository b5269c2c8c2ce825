"""What it costs to drive by an identified vehicle: six random vehicles as they are, and as ``uuv identify``
finds them from five minutes of noisy driving, in the same episodes of pool (8, 6, 0.6).

The drives are those of the first six vehicles of ``identify``; the tree drives both, paper sensing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.common import Job, Row
from benchmarks.identify import MINUTES, SEED, driven, told_of
from uuvtai.identify.identified import identified
from uuvtai.identify.motion_model import changed
from uuvtai.loader import load_config
from uuvtai.measure.episodes.playing import jobs_of, run_episodes
from uuvtai.sim import Sim
from uuvtai.statistics import mcnemar_p, wilson_interval
from uuvtai.tree import read_tree

THREADS = 1
LONGEST_S = 3600
_VEHICLES, _EPISODES, _SEED = 6, 500, 77002
_SCENE = {"world.n_static": 8, "world.n_dynamic": 6, "world.dynamic_speed_m_s": 0.6}


def measure(job: Job) -> list[Row]:
    """A row for each vehicle, and one for all of them."""
    count, episodes, minutes = (1, 16, 1.5) if job.quick else (_VEHICLES, _EPISODES, MINUTES)
    config = load_config("open", vehicle="bluerov2_16v")
    truth, turned, _ = driven(config, count, minutes, SEED)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    rows = []
    for number, (true, drive) in enumerate(zip(truth, turned, strict=True), 1):
        told, measure_of = told_of(config, true, "gain")
        pair = (
            _arrivals(changed(told, measure_of), episodes),
            _arrivals(identified([drive], told).keys, episodes),
        )
        found.append(pair)
        rows.append(_row(f"vehicle {number}", *pair))
        job.say(f"{rows[-1].what}: {rows[-1].note}")
    together = [np.concatenate(side) for side in zip(*found, strict=True)]
    return [*rows, _row("all of them", together[0], together[1])]


def _arrivals(keys: dict[str, Any], episodes: int) -> np.ndarray:
    """Which episodes (bool) end at the goal with these keys of the vehicle section."""
    overrides = _SCENE | {f"vehicle.{name}": value for name, value in keys.items()}
    sim = Sim(load_config("pool", "paper", "bluerov2_16v", overrides=overrides), 256, read_tree("bt"))
    results, _ = run_episodes(sim, jobs_of([_SEED], episodes))
    return np.array([result.outcome == "success" for result in results])


def _row(what: str, true: np.ndarray, found: np.ndarray) -> Row:
    only_true, only_found = int((true & ~found).sum()), int((found & ~true).sum())
    low, high = wilson_interval(int(found.sum()), len(found)) or (0.0, 1.0)
    note = (
        f"{found.sum()} of {len(found)} [{100 * low:.1f}, {100 * high:.1f}]; only the true one arrives: "
        f"{only_true}, only the identified one: {only_found}; exact McNemar p "
        f"{mcnemar_p(only_true, only_found):.2g}"
    )
    return Row(
        f"success as identified, {what}",
        100 * float(found.mean()),
        "%",
        100 * float(true.mean()),
        "true vehicle",
        note=note,
        details={"true": _letters(true), "found": _letters(found)},
    )


def _letters(arrived: np.ndarray) -> str:
    return "".join("01"[int(one)] for one in arrived)
