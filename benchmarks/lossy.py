"""Episodes in which a pilot of its own drives the simulated vehicle by messages that get lost or come late
(pool, S = 8, D = 6, v = 0.6 m/s, nominal sensing): how they end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from benchmarks.common import Job, Row
from benchmarks.replay import FAULTS, SEED
from uuvtai.config import Config
from uuvtai.loader import load_config
from uuvtai.measure.replay.faults import Faults
from uuvtai.measure.replay.live_feed import drive_by_pilot
from uuvtai.sim import Sim
from uuvtai.statistics import wilson_interval
from uuvtai.tree import read_tree

THREADS = 1
LONGEST_S = 7200
DRIVEN = 500
"""episodes of each row"""


def measure(job: Job) -> list[Row]:
    """A row a fault; RuntimeError where a command is not finite."""
    return list(_driven(job))


def _driven(job: Job) -> Iterator[Row]:
    config: Config = load_config(
        "pool", "nominal", overrides={"world.n_dynamic": 6, "world.dynamic_speed_m_s": 0.6}
    )
    tree, count = read_tree("bt"), 2 if job.quick else DRIVEN
    sim, flown = Sim(config, 1, tree), Sim(config, 1, tree)
    for name, faults in FAULTS.items():
        found = [
            drive_by_pilot(
                sim, flown, SEED, episode, Faults(faults.drop, faults.jitter_s, faults.outages, episode)
            )
            for episode in range(count)
        ]
        ends = Counter(str(one["outcome"]) for one in found)
        low, high = wilson_interval(ends["success"], count) or (0.0, 1.0)
        steps, held, other = (sum(int(one[key]) for one in found) for key in ("steps", "held", "other"))
        others = ", ".join(f"{end} {n}" for end, n in sorted(ends.items()) if end != "success") or "none"
        yield Row(
            f"driven, {name}",
            100.0 * ends["success"] / count,
            "% of the episodes a success",
            note=f"{ends['success']} of {count} [{100 * low:.1f}, {100 * high:.1f}]; others: {others}; "
            f"in {steps:,} steps stopped in {held}, another command than undisturbed in {other}",
            details={"endings": dict(ends), "steps": steps, "held": held, "other": other, "seed": SEED},
        )
        job.say(f"driven, {name}: {ends}")
