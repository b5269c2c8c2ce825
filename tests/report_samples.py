"""Documents as the commands write them, made up to try layouts with; none of their figures was measured."""

import json

from uuvtai.common.statistics import wilson_interval

N = 16
SPEEDS = (0.2, 0.4, 0.6, 0.8, 1.5, 3.0)


def rates(k_success, k_collision, n=N):
    """Counts, rates and intervals of one condition."""
    return {
        "episodes": n,
        "outcomes": {"success": k_success, "collision": k_collision, "ttc": 0, "out_of_tank": 0,
        "timeout": n - k_success - k_collision},
        "success_rate": k_success / n, "success_ci95": wilson_interval(k_success, n),
        "collision_rate": k_collision / n, "collision_ci95": wilson_interval(k_collision, n),
        "time_mean_s": 12.0, "tts_s": None if k_success == 0 else 12.0 * n / k_success,
        "time_to_success_mean_s": None if k_success == 0 else 9.0 + k_success / 2,
    }  # fmt: skip


def sweep_document(agent="bt", axes=None):
    """A sweep of the paper's grid; D = 0 has no speed."""
    axes = axes or {"S": [4, 8, 12], "D": [0, 3, 6, 9, 15], "v_m_s": list(SPEEDS)}
    cells = []
    for s in axes["S"]:
        for d in axes["D"]:
            for v in axes["v_m_s"] if d else [None]:
                lost = min(N, round(d * (v or 0) / 3))
                cells.append({"S": s, "D": d, "v_m_s": v, "agent": agent, **rates(N - lost, lost // 2)})
    return {"schema": 1, "world": "pool", "axes": axes, "cells": cells}


def noise_sweep():
    """A sweep over one axis of names, two agents."""
    cells = [
        {"sensors": name, "agent": agent, **rates(16 - i - j, i)}
        for j, agent in enumerate(("bt", "best"))
        for i, name in enumerate(("clean", "paper", "nominal", "harsh"))
    ]
    return {
        "schema": 1,
        "world": "pool",
        "axes": {"sensors": ["clean", "paper", "nominal", "harsh"]},
        "cells": cells,
    }


def robustness_sweep():
    """One axis at a time, two agents; one axis has lists for values, one is of the scene."""
    scene = {"S": 8, "D": 6, "v_m_s": 0.6}
    places = [
        {},
        {"D": 9},
        {"disturbance.current_m_s": [0.0, 0.2, 0.0]},
        {"sensors": "clean"},
        {"sensors": "harsh"},
    ]
    cells = [
        {**scene, **place, "agent": name, **rates(N - i - j, i)}
        for j, name in enumerate(("bt", "best"))
        for i, place in enumerate(places)
    ]
    return {
        "schema": 1, "world": "pool", "episodes_per_seed": N, "cells": cells, "one_at_a_time": True,
        "axes": {"D": [9], "disturbance.current_m_s": [[0.0, 0.2, 0.0]], "sensors": ["clean", "harsh"]},
        "unchanged": {"D": 6, "disturbance.current_m_s": [0.0, 0.0, 0.0], "sensors": None},
    }  # fmt: skip


def agent(name, k_success=6, k_collision=2, n=8, **more):
    """One entry of an evaluation."""
    detail = [
        {
            "seed": 0,
            "episode": i,
            "outcome": "success" if i < k_success else "collision",
            "time_s": 10.0 + i,
            "min_clearance_m": 0.3 - 0.01 * i,
        }
        for i in range(n)
    ]
    found = {
        "return_mean": 3.0, "min_clearance_mean_m": 0.3, "path_length_mean_m": 8.0,
        "replans_per_episode": 12.0, "env_steps_per_s": 600.0,
    }  # fmt: skip
    return {"name": name, **rates(k_success, k_collision, n), **found, "episodes_detail": detail, **more}


def evaluation_document(*agents):
    """An evaluation of these agents."""
    scene = {
        "world": "pool", "S": 8, "D": 6, "v_m_s": 0.6, "sensors": "paper", "seeds": [0],
        "episodes_per_seed": 8,
    }  # fmt: skip
    return {"schema": 1, **scene, "agents": list(agents or (agent("straight", 3, 5), agent("bt")))}


CAUSE = {
    "label": "undetected_above", "count": 2, "share": 1.0, "knew_share": 0.5, "undetected_median_s": 1.7,
    "evading_median_s": None,
    "last_chance_median_s": 0.2, "meaning": "it was above the sonar's fan all through the last 0.3 "
                                            "s", "remarks": {},
}  # fmt: skip

STAGES = (
    "dynamics", "sonar", "depth", "mapping", "clearance", "planning", "observation", "behavior", "reward",
    "export",
)  # fmt: skip
PROFILE = {
    "schema": 1,
    "machine": {"cpu": "some processor", "cores": 2, "device": "cpu"},
    "rows": [
        {
            "num_envs": n, "agent": "bt", "S": 8, "D": 6, "depth_every": 5, "compile_s": 20.0,
            "memory_mb": 0.3 * n,
            "env_steps_per_s": {"step": 90.0 * n, "step_inference": 80.0 * n, "train": None},
            "stages_us_per_env_step": {name: (i + 1.0) * scale for i, name in enumerate(STAGES)},
        }
        for n, scale in ((1, 90.0), (1024, 1.0))
    ],
    "paper_latency": [
        {"component": "Full loop", "mean_ms": 3.1, "max_ms": 9.0, "paper_mean_ms": 28.63,
        "paper_max_ms": 39.88},
        {"component": "Replanning rate", "replans_per_episode": 20.0, "hz": 1.4,
        "paper_replans_per_episode": 54, "paper_hz": 2.3},
    ],
    "paper_density": [
        {"D": d, "loop_ms": 2 + 0.1 * d, "replans_per_episode": 20.0, "paper_loop_ms": 20 + d,
        "paper_replans": 50.0} for d in (0, 6, 15)
    ],
}  # fmt: skip


def metrics(n=30, offset=0.0):
    """Records of a training."""
    return [
        {
            "iteration": i, "time/env_steps": 1000.0 * i, "time/env_steps_per_s": 900.0,
            "rollout/ep_rew_mean": -30 + i + offset,
            "rollout/success_rate": i / (2 * n), "rollout/collision_rate": 1 - i / (2 * n),
            "world_model/dynamics_loss": 100.0 / i,
            "world_model/reconstruction_loss": 9.0 - i / n,
            **({"eval/success_rate": i / n} if i % 10 == 0 else {}),
        }
        for i in range(1, n + 1)
    ]  # fmt: skip


def write_run(folder, argv=("uuv", "eval"), config="seed: 0\n", **files):
    """A run folder of documents by path (``__`` stands for a slash, lists become JSON lines)."""
    folder.mkdir(parents=True, exist_ok=True)
    record = {
        "schema": 1, "argv": list(argv), "started": "2026-01-01T00:00:00+0000", "status": "finished",
        "seeds": [0], "git_sha": "abc",
        "versions": {"uuvtai": "0.1.0"}, "hardware": {"cpu": "some processor", "cores": 2, "system": "Linux"},
        "exit": 0, "wall_s": 3.0,
    }  # fmt: skip
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "config.yaml").write_text(config)
    for name, document in files.items():
        lines = isinstance(document, list)
        path = folder / f"{name.replace('__', '/')}.{'jsonl' if lines else 'json'}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(map(json.dumps, document)) if lines else json.dumps(document))
    return folder
