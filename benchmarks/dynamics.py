"""Velocity loop, allocation, rotors and two midpoint substeps of Fossen's equation, against the same on NumPy
and torch arrays, and fused by torch.compile."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.common import Job, Row, seconds_per_call
from benchmarks.peers.vehicle_arrays import Vehicles
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config
from uuvtai.kernels.vehicle import control, dynamics
from uuvtai.sim.plant import Plant

DEVICES = ("cpu", "cuda")
FLOOR = 4e6
"""[env-steps/s] at 16,384 envs on two CPU cores"""
_CHECKED_STEPS = 25
_FUSED = "torch.compile"
AGREEMENT = 2e-5
"""[m, m/s, rad/s] half a second of single precision on both sides"""
_MOST_APART = 1e-3
"""share of the vehicles that may be farther apart: the thrusters' dead band is a jump, and rounding may end
on either side of it"""


def measure(job: Job) -> list[Row]:
    """Env-steps per second of all cores, peers in the same run."""
    n_env = 256 if job.quick else 16_384
    config = Config()
    plant = Plant(config, start_taichi(job.device), n_env)
    plant.reset()
    peers = {"NumPy": Vehicles(config, n_env, np)}
    peers |= {name: Vehicles(config, n_env, torch, job.device) for name in ("torch", _FUSED)}
    steps = {name: _step_of_peer(peer, name, job.device) for name, peer in peers.items()}
    actions = np.random.default_rng(0).uniform(-1, 1, (n_env, 4)).astype(np.float32)
    given = torch.from_numpy(actions.T).contiguous().to(job.device)
    turned = dict.fromkeys(peers, given) | {"NumPy": np.ascontiguousarray(actions.T)}
    apart = disagreement(plant, peers, steps, actions, turned)
    others = apart > AGREEMENT
    worst = float(apart[~others].max(initial=0.0))
    if others.mean() > _MOST_APART:
        raise RuntimeError(
            f"kernels and peers disagree by {apart.max():.2g}, in {others.sum()} of {n_env} envs"
        )

    ours = _step_of(config, plant, torch.from_numpy(actions).to(job.device))
    theirs = {name: partial(step, turned[name]) for name, step in steps.items()}
    cost = seconds_per_call({"ours": ours, **theirs}, job.seconds, clock=time.perf_counter)
    cpu_ns = 1e9 * seconds_per_call({"ours": ours}, job.seconds / 3)["ours"] / n_env
    row = Row(
        what=f"actuation and {config.episode.substeps} substeps, {n_env:,} envs",
        ours=n_env / cost["ours"],
        unit="env-steps/s",
        details={"num_envs": n_env, "disagreement": worst, "at_the_dead_band": int(others.sum())},
    )
    rows = [replace(row, peer=n_env / cost[name], peer_name=name) for name in peers]
    rows[0].floor = FLOOR if not job.quick and job.device == "cpu" else None
    rows[0].note = f"{cpu_ns:.0f} ns of CPU time; apart by {worst:.1g} after {_CHECKED_STEPS} steps"
    return rows


def _step_of(config: Config, plant: Plant, shared: torch.Tensor) -> Callable[[], None]:
    """One call: actuation and dynamics of a control step."""
    rules = config.episode

    def step() -> None:
        control.command_thrusters(plant.actuation_io, shared)
        dynamics.move_vehicle(plant.dynamics_io, rules.control_dt_s, rules.substeps)
        if shared.is_cuda:
            torch.cuda.synchronize()

    return step


def _step_of_peer(peer: Vehicles, name: str, device: str) -> Callable[[Any], None]:
    """The same of a peer, for its actions."""
    fused = peer.compiled() if name == _FUSED else None

    def step(action: Any) -> None:
        if fused:
            fused(action)
        else:
            peer.control(action)
            peer.move()
        if device == "cuda":
            torch.cuda.synchronize()

    return step


def disagreement(
    plant: Plant, peers: dict[str, Vehicles], steps: dict[str, Callable], actions: np.ndarray, turned: dict
) -> np.ndarray:
    """Largest difference in position, velocity and turn rate of every env after half a second from rest."""
    worst = np.zeros(len(actions))
    for _ in range(_CHECKED_STEPS):
        plant.step(actions)
    for name, peer in peers.items():
        for _ in range(_CHECKED_STEPS):
            steps[name](turned[name])
        for field, values in (
            (plant.vehicle.pos_w, peer.pos),
            (plant.vehicle.vel_b, peer.vel),
            (plant.vehicle.rate_b, peer.rate),
        ):
            found = values if isinstance(values, np.ndarray) else values.cpu().numpy()
            worst = np.maximum(worst, np.abs(field.to_numpy() - found.T).max(axis=1))
    return worst
