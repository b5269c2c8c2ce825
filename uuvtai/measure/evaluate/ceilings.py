"""Privileged yardsticks beside the methods: the oracle's row of the table, and what a method lacks of it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from operator import attrgetter
from typing import Any

import numpy as np
import torch

from uuvtai.closed_form import describe_scenario
from uuvtai.config import Config
from uuvtai.measure.episodes.methods import TRUTH
from uuvtai.measure.episodes.playing import EpisodeResult, Job, Progress
from uuvtai.measure.evaluate.eval_request import ORACLE
from uuvtai.measure.evaluate.summary import summary
from uuvtai.plan_codes import PLANNERS, REASONS, TRIGGERS
from uuvtai.privileged.oracle import earliest_arrival
from uuvtai.sim import Sim

_UNKNOWN = (
    "return_mean",
    "min_clearance_mean_m",
    "path_length_mean_m",
    "replans_per_episode",
    "env_steps_per_s",
)
"""What the oracle does not tell: it drives no vehicle."""

_UNKNOWN_OF_EPISODE = ("return", "min_clearance_m", "path_length_m", "replans")


def scenarios_of(sim: Sim, jobs: list[Job]) -> list[dict[str, Any]]:
    """``describe_scenario``'s document of every job. No row of the simulator runs afterwards."""
    found = [
        scenario
        for first in range(0, len(jobs), sim.num_envs)
        for scenario in _drawn(sim, jobs[first : first + sim.num_envs])
    ]
    sim.sleep()
    return found


def _drawn(sim: Sim, jobs: list[Job]) -> Iterator[dict[str, Any]]:
    mask, seed, number = (torch.zeros(sim.num_envs, dtype=torch.int32) for _ in range(3))
    for row, job in enumerate(jobs):
        mask[row], seed[row], number[row] = 1, job.seed, job.episode
    sim.draw(mask.to(sim.device), seed.to(sim.device), number.to(sim.device))
    rows, read = list(range(len(jobs))), {}
    for row in rows:

        def values(name: str, row: int = row) -> np.ndarray:
            if name not in read:
                read[name] = sim.rows(attrgetter(name)(sim.s), rows)
            return read[name][row]

        yield describe_scenario(values)


def oracle_entry(
    config: Config, jobs: list[Job], scenarios: list[dict[str, Any]], progress: Progress | None = None
) -> dict[str, Any]:
    """The oracle's entry of ``uuv eval --json``: success with the earliest arrival, or timeout, which here
    means "not reachable"."""
    begun, results = time.perf_counter(), []
    for job, scenario in zip(jobs, scenarios, strict=True):
        results.append(_result(job, earliest_arrival(scenario, config).time_s, config))
        if progress:
            progress(len(results), len(jobs), 0, None)
    entry = summary(ORACLE, results, 0, time.perf_counter() - begun)
    details = [detail | dict.fromkeys(_UNKNOWN_OF_EPISODE) for detail in entry["episodes_detail"]]
    return entry | dict.fromkeys(_UNKNOWN) | {"episodes_detail": details, "privileged": True}


def _result(job: Job, time_s: float | None, config: Config) -> EpisodeResult:
    horizon = config.episode.horizon_steps * config.episode.control_dt_s
    return EpisodeResult(
        seed=job.seed,
        episode=job.episode,
        outcome="timeout" if time_s is None else "success",
        time_s=round(horizon if time_s is None else time_s, 6),
        episode_return=0.0,
        min_clearance_m=0.0,
        path_length_m=0.0,
        replans=dict.fromkeys(TRIGGERS, 0),
        planned_by=dict.fromkeys(PLANNERS, 0),
        fallbacks=dict.fromkeys(REASONS, 0),
        ticks=np.zeros(0),
        acted=np.zeros(0),
    )


def remainder_of(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What each method lacks of 100 %, split: ``remainder`` of ``uuv eval --json``, for methods whose
    ``+truth`` and the oracle are there.

    Episodes, as differences of successes that add up to ``missed``: sensing = with the true tracks less
    without, forecast_decision = the oracle's less that (with the vehicle's inertia, which the oracle has
    not), physics = what the oracle cannot reach either. A part may be negative where knowing more did not
    help; ``lost_with_truth`` counts the episodes that the method won and its ``+truth`` did not.
    """
    won = {entry["name"]: _won(entry) for entry in entries}
    if ORACLE not in won:
        return []
    ceiling = won[ORACLE]
    return [
        {
            "method": name,
            "episodes": entries[0]["episodes"],
            "missed": entries[0]["episodes"] - len(own),
            "sensing": len(with_truth) - len(own),
            "forecast_decision": len(ceiling) - len(with_truth),
            "physics": entries[0]["episodes"] - len(ceiling),
            "lost_with_truth": len(own - with_truth),
        }
        for name, own in won.items()
        if (with_truth := won.get(f"{name}+{TRUTH}")) is not None
    ]


def _won(entry: dict[str, Any]) -> set[tuple[int, int]]:
    return {
        (detail["seed"], detail["episode"])
        for detail in entry["episodes_detail"]
        if detail["outcome"] == "success"
    }
