"""What ``uuv eval --json`` says of played episodes: one entry per method, and the whole document."""

from __future__ import annotations

from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.measure.episodes.playing import EpisodeResult
from uuvtai.measure.evaluate.paired import paired
from uuvtai.outcomes import COLLIDED, ENDINGS
from uuvtai.plan_codes import PLANNERS, REASONS, TRIGGERS
from uuvtai.sim import Sim
from uuvtai.statistics import bootstrap_interval, mean, rate, time_to_success_s, wilson_interval
from uuvtai.tree import node_use


def summary(
    name: str,
    results: list[EpisodeResult],
    env_steps: int,
    wall_s: float,
    env_steps_per_s: float | None = None,
) -> dict[str, Any]:
    """One method's entry of ``uuv eval --json`` (docs: interfaces); rates without episodes are None, never
    NaN.

    ``env_steps_per_s`` is a ``StepClock``'s: of simulating alone, where ``wall_s`` is all the time that the
    method took.
    """
    n = len(results)
    outcomes = {outcome: sum(r.outcome == outcome for r in results) for outcome in ENDINGS}
    collided = sum(outcomes[o] for o in COLLIDED)
    time_mean, to_goal = (
        mean([r.time_s for r in results]),
        [r.time_s for r in results if r.outcome == "success"],
    )
    return {
        "name": name,
        "episodes": n,
        "outcomes": outcomes,
        "success_rate": rate(outcomes["success"], n),
        "success_ci95": _as_list(wilson_interval(outcomes["success"], n)),
        "collision_rate": rate(collided, n),
        "collision_ci95": _as_list(wilson_interval(collided, n)),
        "return_mean": mean([r.episode_return for r in results]),
        "return_ci95": _as_list(bootstrap_interval([r.episode_return for r in results])),
        "time_mean_s": time_mean,
        "tts_s": time_to_success_s(time_mean, rate(outcomes["success"], n)),
        "time_to_success_mean_s": mean(to_goal),
        "time_to_success_ci95": _as_list(bootstrap_interval(to_goal)),
        "min_clearance_mean_m": mean([r.min_clearance_m for r in results]),
        "path_length_mean_m": mean([r.path_length_m for r in results]),
        "replans_per_episode": mean([float(sum(r.replans.values())) for r in results]),
        "replans_by_trigger": _summed(TRIGGERS, [r.replans for r in results]),
        "planned_by": _summed(PLANNERS, [r.planned_by for r in results]),
        "fallbacks_by_reason": _summed(REASONS, [r.fallbacks for r in results]),
        "env_steps": env_steps,
        "wall_s": round(wall_s, 3),
        "env_steps_per_s": None if env_steps_per_s is None else round(env_steps_per_s, 1),
        "episodes_detail": [
            {
                "seed": r.seed,
                "episode": r.episode,
                "outcome": r.outcome,
                "time_s": r.time_s,
                "return": r.episode_return,
                "min_clearance_m": r.min_clearance_m,
                "path_length_m": r.path_length_m,
                "replans": sum(r.replans.values()),
            }
            for r in results
        ],
    }


def tree_use(sim: Sim, results: list[EpisodeResult]) -> list[dict[str, Any]]:
    """Per node of the tree: the share of episodes that ticked it, its ticks, and the control steps in which
    it set the action."""
    ticks, acted = (
        np.stack([getattr(r, which) for r in results]).astype(np.int64) for which in ("ticks", "acted")
    )
    return [vars(use) for use in node_use(ticks, acted, len(sim.tree.names))]


def document(
    config: Config,
    world: str,
    sensors: str,
    vehicle: str,
    seeds: list[int],
    episodes: int,
    methods: list[dict[str, Any]],
) -> dict[str, Any]:
    """The whole ``uuv eval --json`` document."""
    return {
        "schema": 1,
        "world": world,
        **config.world.bodies,
        "v_m_s": config.world.dynamic_speed_m_s,
        "sensors": sensors,
        "vehicle": vehicle,
        "localization": config.sensors.localization,
        "seeds": seeds,
        "episodes_per_seed": episodes,
        "methods": methods,
        "paired": paired(methods),
    }


def _as_list(interval: tuple[float, float] | None) -> list[float] | None:
    return None if interval is None else list(interval)


def _summed(names: tuple[str, ...], counts: list[dict[str, int]]) -> dict[str, int]:
    return {name: sum(c.get(name, 0) for c in counts) for name in names}
