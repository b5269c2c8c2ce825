"""Your own behaviour tree: ``patient.xml`` beside the built-in ones on the same episodes: a table.

``python examples/custom_tree.py``, which is ``uuv eval --agent examples/patient.xml`` from Python
"""

from __future__ import annotations

from pathlib import Path

import uuvtai
from uuvtai.evaluation.episodes import jobs_of, run_episodes
from uuvtai.evaluation.results import summary
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.sim import Sim

TREES = (str(Path(__file__).with_name("patient.xml")), "bt", "planner")


def main(sim: Sim | None = None, episodes: int = 128) -> str:
    """The table: success with its 95 % interval, contacts and stops, time."""
    sim = sim or uuvtai.make("pool", num_envs=64).sim
    lines = [f"{'tree':10} {'success':>24} {'collision':>10} {'time s':>7}"]
    for name in TREES:
        sim.use_tree(read_tree(name, sim.config.behavior.max_node))
        results, env_steps = run_episodes(sim, jobs_of([0], episodes))
        found = summary(Path(name).stem, results, env_steps, wall_s=0.0)
        won, (low, high) = found["outcomes"]["success"], found["success_ci95"]
        rate = f"{won}/{episodes} ({100 * low:.0f} .. {100 * high:.0f} %)"
        lines.append(
            f"{found['name']:10} {rate:>24} {100 * found['collision_rate']:8.1f} % "
            f"{found['time_mean_s']:7.1f}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(main())
