"""Velocity loop, allocation, rotors and two midpoint substeps of Fossen's equation, against the same on NumPy and torch arrays."""

from __future__ import annotations

import time

import numpy as np
import torch

from benchmarks.common import Job, Row, seconds_per_call
from benchmarks.peers.vehicle_arrays import Vehicles
from uuvtai.config import Config
from uuvtai.kernels import actuation, dynamics
from uuvtai.plant import Plant
from uuvtai.runtime import start_taichi

DEVICES = ("cpu", "cuda")
FLOOR = 4e6
"""[env-steps/s] at 16,384 envs on two CPU cores"""
_CHECKED_STEPS = 25
AGREEMENT = 2e-5
"""[m, m/s, rad/s] half a second of single precision on both sides"""


def measure(job: Job) -> list[Row]:
    """Env-steps per second of all cores, peers in the same run."""
    n_env = 256 if job.quick else 16_384
    config = Config()
    plant = Plant(config, start_taichi(job.device), n_env)
    plant.reset()
    peers = {"NumPy": Vehicles(config, n_env, np), "torch": Vehicles(config, n_env, torch, job.device)}
    actions = np.random.default_rng(0).uniform(-1, 1, (n_env, 4)).astype(np.float32)
    turned = {"NumPy": np.ascontiguousarray(actions.T), "torch": torch.from_numpy(actions.T).contiguous().to(job.device)}
    worst = disagreement(plant, peers, actions, turned)
    if worst > AGREEMENT:
        raise RuntimeError(f"kernels and peers disagree by {worst:.2g}")

    shared = torch.from_numpy(actions).to(job.device)
    c, p = config, plant

    def ours():
        actuation.command_thrusters(shared, p.actuation, p.params, p.allocation, p.ego, p.clock, c.vehicle, c.actuation, c.episode)
        dynamics.move_vehicle(
            p.vehicle, p.actuation, p.current, p.params, p.allocation, p.episode, p.clock,
            c.vehicle, c.actuation, c.disturbance, c.episode.control_dt_s, c.episode.substeps,
        )  # fmt: skip
        if job.device == "cuda":
            torch.cuda.synchronize()

    def theirs(name: str):
        def call():
            peers[name].control(turned[name])
            peers[name].move()
            if job.device == "cuda":
                torch.cuda.synchronize()

        return call

    cost = seconds_per_call({"ours": ours, **{name: theirs(name) for name in peers}}, job.seconds, clock=time.perf_counter)
    cpu = seconds_per_call({"ours": ours}, job.seconds / 3)["ours"]
    rows = []
    for name in peers:
        first = name == "NumPy"
        rows.append(
            Row(
                what=f"actuation and {config.episode.substeps} substeps, {n_env:,} envs",
                ours=n_env / cost["ours"],
                peer=n_env / cost[name],
                peer_name=name,
                unit="env-steps/s",
                floor=FLOOR if first and not job.quick and job.device == "cpu" else None,
                note=f"{1e9 * cpu / n_env:.0f} ns of CPU time; apart by {worst:.1g} after {_CHECKED_STEPS} steps" if first else "",
                details={"num_envs": n_env, "disagreement": worst},
            )
        )
    return rows


def disagreement(plant: Plant, peers: dict[str, Vehicles], actions: np.ndarray, turned: dict) -> float:
    """Largest difference in position, velocity and turn rate after half a second from rest."""
    worst = 0.0
    for _ in range(_CHECKED_STEPS):
        plant.step(actions)
    for name, peer in peers.items():
        for _ in range(_CHECKED_STEPS):
            peer.control(turned[name])
            peer.move()
        for field, values in ((plant.vehicle.pos_w, peer.pos), (plant.vehicle.vel_b, peer.vel), (plant.vehicle.rate_b, peer.rate)):
            found = values if isinstance(values, np.ndarray) else values.cpu().numpy()
            worst = max(worst, float(np.abs(field.to_numpy() - found.T).max()))
    return worst
