"""``uuv identify`` on real ArduSub's own logs: five minutes of sticks in our water, DataFlash and tlog.

``UUV_ARDUSUB`` names ArduSub's binary; without it there is nothing to measure.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.ardusub import BINARY, MANUAL, Rig, ready
from benchmarks.common import Job, Row
from uuvtai.config import Config
from uuvtai.identify.ardusub_log import read_ardusub
from uuvtai.identify.identified import identified
from uuvtai.identify.motion_model import LATE, parameters_of
from uuvtai.loader import load_config
from uuvtai.sim import Sim
from uuvtai.tree import read_tree

THREADS = 1
TOLD_WRONG = ("added_mass", "linear_damping", "quadratic_damping")
"""what ``uuv identify`` is told 30 % too high"""


def measure(job: Job) -> list[Row]:
    """A row for each kind of log."""
    binary = os.environ.get(BINARY, "")
    if not binary:
        return [Row("ArduSub's logs", None, "", note=f"not tried: {BINARY} names no binary")]
    sim = Sim(load_config("open", "multibeam", "bluerov2_16v"), 1, read_tree("bt"))
    rig = Rig(sim, binary, more={"LOG_BACKEND_TYPE": 1, "LOG_BITMASK": 4_194_303})
    with tempfile.TemporaryDirectory() as folder:
        try:
            ready(rig)
            for message in (30, 32, 36):  # ATTITUDE, LOCAL_POSITION_NED, SERVO_OUTPUT_RAW
                rig.order(511, message, 20_000)
            took = rig.take(MANUAL)
            _legs(rig, 60.0 if job.quick else 300.0)
            rig.advance(1.0)
            files = [Path(folder) / "drive.bin", Path(folder) / "drive.tlog"]
            files[0].write_bytes(rig.dataflash()[-1].read_bytes())
            files[1].write_bytes(rig.tlog)
        finally:
            rig.close()
        job.say(f"drive: {took}, {[file.stat().st_size for file in files]} bytes; {rig.said[-2:]}")
        return [_identified_row(file, sim.config, job) for file in files]


def _legs(rig: Rig, seconds: float) -> None:
    """Each axis forth and back, alone and together, one to four seconds each."""
    rng, sticks = np.random.default_rng(7), {"until": 0.0, "next": 0.0, "back": 0.0}
    share = np.zeros(4)

    def each(now_s: float) -> None:
        if now_s >= sticks["until"]:
            if sticks["back"] > 0:
                share[:] *= -1.0
                sticks["until"], sticks["back"] = now_s + sticks["back"], 0.0
            else:
                used = rng.random(4) < 0.5
                share[:] = used * rng.choice([-1.0, 1.0], 4) * rng.uniform(0.2, 0.7, 4)
                sticks["back"] = rng.uniform(1.0, 4.0)
                sticks["until"] = now_s + sticks["back"]
        if now_s >= sticks["next"]:
            sticks["next"] = now_s + 0.05
            rig.push(*share)

    rig.advance(seconds, each)


def _identified_row(file: Path, config: Config, job: Job) -> Row:
    """How many of the true numbers lie within their intervals."""
    vehicle_cfg = config.vehicle
    true = parameters_of(vehicle_cfg)
    told = vehicle_cfg.model_copy(
        update={name: tuple(1.3 * v for v in getattr(vehicle_cfg, name)) for name in TOLD_WRONG}
    )
    found = identified(read_ardusub(file, told), told).document
    fitted = [entry for entry in found["parameters"] if entry["fitted"] and entry["place"] not in LATE]
    delays = ", ".join(
        f"{found['parameters'][i]['name']} {found['parameters'][i]['value']:.3f} s" for i in LATE
    )
    within = [entry["low"] <= true[entry["place"]] <= entry["high"] for entry in fitted]
    for entry in fitted:
        job.say(
            f"{file.name} {entry['name']}: {entry['value']:.3g} [{entry['low']:.3g}, {entry['high']:.3g}], "
            f"true {true[entry['place']]:.3g}"
        )
    return Row(
        f"uuv identify, ArduSub's {file.suffix}",
        float(sum(within)),
        f"of {len(within)} true numbers within their interval",
        note=f"{found['seconds']:g} s; {delays}",
        details={
            "parameters": {e["name"]: [e["value"], e["low"], e["high"], true[e["place"]]] for e in fitted}
        },
    )
