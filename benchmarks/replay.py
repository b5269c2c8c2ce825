"""Twenty logs of six worlds fed to the stack again without the simulator: steps whose command is equal to the
last bit, and what lost, late and dead sensors change."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

import zstandard
from mcap.records import Channel, Message

from benchmarks.common import Job, Row
from uuvtai.logs.reader import records
from uuvtai.sim.sim import Sim
from uuvtai.vehicle.onboard import OnboardPilot
from uuvtai.vehicle.replay import Faults, LogFeed, outage_of, replay

THREADS = 1
LONGEST_S = 10800
SEED = 77001
CASES = (
    ("pool", "paper", ("-D", "6", "--speed", "0.6"), 4),
    ("pool", "nominal", ("-D", "6", "--speed", "0.6"), 3),
    ("pool", "harsh", ("-D", "6", "--speed", "0.6"), 2),
    ("gauntlet", "nominal", ("-D", "9", "--speed", "1.5"), 3),
    ("maze", "nominal", ("-D", "6", "--speed", "0.6"), 3),
    ("column", "paper", ("-D", "9", "--speed", "1.5"), 2),
    ("netpen", "", (), 2),
    ("transfer", "", (), 1),
)
"""world, sensors ('' = the world's own), scenario, logs"""
FAULTS = {
    "nothing": Faults(),
    "every fifth message lost": Faults(drop=0.2),
    "up to 100 ms late": Faults(jitter_s=0.1),
    "DVL dead from 5 to 10 s": Faults(outages=(outage_of("dvl:5:10"),)),
    "all three": Faults(drop=0.2, jitter_s=0.1, outages=(outage_of("dvl:5:10"),)),
}
_INSTRUMENTS, _IMAGES = ("/sensors/imu", "/sensors/dvl", "/sensors/pressure"), ("/camera/exact",)


def measure(job: Job) -> list[Row]:
    """A row a case and a row a fault; RuntimeError where a command is not finite."""
    cases = CASES[:1] if job.quick else CASES
    with tempfile.TemporaryDirectory() as name:
        rows, disturbed = [], []
        for case in cases:
            logs = _recorded(case, Path(name))
            found = [_replayed(log) for log in logs]
            disturbed += [documents for documents in found if len(documents) > 1]
            rows.append(_equality(case, logs, [documents["nothing"] for documents in found]))
            job.say(f"{rows[-1].what}: {rows[-1].note}")
            _SIMS.clear()
        rows += [_change(fault, [documents[fault] for documents in disturbed]) for fault in FAULTS]
    return rows


def _recorded(case: tuple[str, str, tuple[str, ...], int], folder: Path) -> list[Path]:
    world, sensors, scene, count = case
    run_dir = folder / f"{world}_{sensors}"
    sensing = ("--sensors", sensors) if sensors else ()
    subprocess.run(
        [
            *(sys.executable, "-m", "uuvtai", "eval", "--agent", "bt", "--world", world, *sensing, *scene),
            *("--episodes", str(count), "--num-envs", str(count), "--record", str(count), "--depth-images"),
            *("--seeds", str(SEED), "--device", "cpu", "--run-dir", str(run_dir), "--json"),
        ],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    return sorted((run_dir / "logs").glob("*.mcap"))


_SIMS: dict[str, Sim] = {}
"""by config: its kernels are compiled once for all logs of a case"""


def _pilot(feed: LogFeed) -> OnboardPilot:
    key = feed.config.model_dump_json()
    if key not in _SIMS:
        _SIMS[key] = Sim(feed.config, 1, feed.tree)
    return OnboardPilot(_SIMS[key], feed.mission)


def _replayed(log: Path) -> dict[str, dict[str, Any]]:
    found = {name: replay(log, faults, build=_pilot) for name, faults in FAULTS.items()}
    if wrong := [name for name, document in found.items() if not document["change"]["finite"]]:
        raise RuntimeError(f"{log.name}: commands that are not finite under {wrong}")
    return found


def _equality(
    case: tuple[str, str, tuple[str, ...], int], logs: list[Path], found: list[dict[str, Any]]
) -> Row:
    steps = sum(document["steps"] for document in found)
    equal = sum(document["agreement"][0]["equal_steps"] for document in found)
    all_equal = sum(document["equal"] for document in found)
    sizes = _sizes(logs, found)
    ticks = [document["tick_ms"] for document in found]
    return Row(
        f"{case[0]}, {case[1] or 'its own'} sensing, {len(logs)} logs",
        100.0 * equal / steps,
        "% of the commands equal",
        floor=100.0,
        note=f"{all_equal} of {len(logs)} logs equal in every step, {steps:,} steps; a step takes "
        f"{median(tick['median'] for tick in ticks):.2f} ms, 99 %: "
        f"{median(tick['99th percentile'] for tick in ticks):.1f} ms; log {sizes['log']:.0f} kB/s, of which "
        f"instruments {sizes['instruments']:.1f}; exact images {sizes['images']:.0f} beside",
        details={"logs": found, "sizes_kb_per_s": sizes, "tree": "bt", "seed": SEED},
    )


def _sizes(logs: list[Path], found: list[dict[str, Any]]) -> dict[str, float]:
    """[kB/s] of whole logs without the exact images, and of the topics that replays need."""
    seconds = 0.02 * sum(document["steps"] for document in found)
    parts: Counter[str] = Counter()
    for log in logs:
        names, contents = {}, {"instruments": b"", "images": b""}
        for record in records(log):
            if isinstance(record, Channel):
                names[record.id] = record.topic
            elif isinstance(record, Message):
                topic = names[record.channel_id]
                kind = "instruments" if topic in _INSTRUMENTS else "images" if topic in _IMAGES else ""
                if kind:
                    contents[kind] += record.data
        packer = zstandard.ZstdCompressor()
        parts += Counter({kind: len(packer.compress(content)) for kind, content in contents.items()})
        parts["log"] += log.stat().st_size - len(packer.compress(contents["images"]))
    return {kind: size / 1e3 / seconds for kind, size in parts.items()}


def _change(fault: str, found: list[dict[str, Any]]) -> Row:
    """Over all logs; the logged vehicle drives its own way, whatever the pilot asks for."""
    steps = sum(document["steps"] for document in found)
    beyond = sum(document["change"]["steps_beyond_tenth"] for document in found)
    held = sum(document["change"]["held_steps"] for document in found)
    node = sum(document["agreement"][2]["equal_steps"] for document in found)
    apart = sorted(document["change"]["position_m"] for document in found)
    return Row(
        f"replayed, {fault}",
        100.0 * beyond / steps,
        "% of the commands more than 0.1 off",
        note=f"{len(found)} logs, {steps:,} steps: same node of the tree in {100 * node / steps:.1f} %, "
        f"stopped in {held}; own position off by {median(apart):.2f} m (median of the logs' largest), "
        f"{apart[-1]:.2f} m at most; all commands finite",
        less_is_better=True,
    )
