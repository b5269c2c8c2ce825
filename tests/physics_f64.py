"""Run the plant in double precision (a process has one Taichi precision, the tests' is single) and print what
it did as JSON.

stdin: {"substeps": [..], "n_sample", "cases": [{"wrench", "current", "rpy_deg", "nu", "neutral"}, ..]}; cases
are the envs of a plant. stdout: {"<substeps>": {"position": [sample][case][3], "rpy_deg": .., "nu": ..}},
sampled every tenth control step.
"""

from __future__ import annotations

import json
import sys

import numpy as np

from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config, VehicleConfig
from uuvtai.logs.topics.motion import angles_of, quaternion_of
from uuvtai.sim.plant import Plant


def main() -> None:
    """One plant, all cases, every substep count."""
    job = json.load(sys.stdin)
    cases = job["cases"]
    config = Config(vehicle=VehicleConfig(attitude_hold=job.get("attitude_hold", "none")))
    plant = Plant(config, start_taichi(precision="f64"), n_env=len(cases))
    out = {str(n): run(plant, cases, n, job["n_sample"]) for n in job["substeps"]}
    json.dump(out, sys.stdout)


def run(plant: Plant, cases: list[dict], substeps: int, n_sample: int) -> dict:
    """Trajectories of all cases at one substep."""
    plant.reset()
    v = plant.vehicle
    plant.write(plant.actuation.external_wrench_b, [c.get("wrench", [0] * 6) for c in cases])
    plant.write(plant.current.vel_w, [c.get("current", [0] * 3) for c in cases])
    plant.write(v.quat_wb, [quaternion_of(np.radians(c.get("rpy_deg", [0] * 3))) for c in cases])
    nu = np.array([c.get("nu", [0] * 6) for c in cases], dtype=float)
    plant.write(v.vel_b, nu[:, :3])
    plant.write(v.rate_b, nu[:, 3:])
    buoyancy = plant.read(plant.params.buoyancy_n)
    weight = plant.read(plant.params.mass_kg) * plant.config.vehicle.gravity_m_s2
    plant.write(plant.params.buoyancy_n, np.where([c.get("neutral", False) for c in cases], weight, buoyancy))
    samples = []
    for _ in range(n_sample):
        q = plant.read(v.quat_wb)
        samples.append(
            (
                plant.read(v.pos_w),
                np.degrees([angles_of(*x) for x in q]),
                np.c_[plant.read(v.vel_b), plant.read(v.rate_b)],
            )
        )
        for _ in range(10):
            plant.step(substeps=substeps, dt_s=0.02)
    return {name: [s[i].tolist() for s in samples] for i, name in enumerate(("position", "rpy_deg", "nu"))}


main()
