"""What a worker of a sweep is given and what it gives back: plain data, so that it may run in any process on
any machine."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from uuvtai.config import Config

if TYPE_CHECKING:
    from uuvtai.measure.episodes.playing import EpisodeResult
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim

Row = dict[str, Any]
"""one method in one cell, an entry of ``cells`` in ``uuv sweep --json``"""


@dataclass(frozen=True)
class Task:
    """Cells of one config, which one simulator serves, and one method that plays them."""

    config: Config
    """with room for the largest scene"""
    controller: str | None
    policy: str | None
    """exactly one of the two"""
    scenes: tuple[Scene, ...]
    """of the cells, in order"""
    labels: tuple[dict[str, Any], ...]
    """of the cells: values of the axes, which go into the rows"""
    seeds: tuple[int, ...]
    episodes: int
    """per seed"""
    num_envs: int
    device: str = "auto"


@dataclass
class _Kept:
    """The simulator of this process's last task: the next one of the same config does not compile again."""

    key: tuple[str, int, str] | None = None
    sim: Any = field(default=None)


_kept = _Kept()


def play(task: Task) -> list[Row]:
    """Play all episodes of the task's cells; one row per cell, in their order."""
    from uuvtai.measure.episodes.methods import policies_of, trees_of
    from uuvtai.measure.episodes.playing import Job, run_episodes

    limit = task.config.teacher.max_node
    found = (
        trees_of([task.controller], limit)
        if task.controller
        else policies_of([task.policy or ""], limit, lambda _text: None)
    )
    method = found[0]
    sim = _sim_of(task, method.config_of(task.config))
    sim.use_tree(method.tree)
    sim.planner = method.planner_for(sim)
    jobs = [
        Job(seed, episode, scene)
        for scene in task.scenes
        for seed in task.seeds
        for episode in range(task.episodes)
    ]
    note = method.driver_for(sim)
    results, _env_steps = run_episodes(sim, jobs, driver=note.pilot if note else None)
    if method.own:
        method.own.close()
    each = len(task.seeds) * task.episodes
    return [
        row_of(method.name, label, results[i * each : (i + 1) * each]) for i, label in enumerate(task.labels)
    ]


def _sim_of(task: Task, config: Config) -> Sim:
    from uuvtai.shipped import TRAINING_TREE
    from uuvtai.sim import Sim
    from uuvtai.tree import read_tree

    key = (config.model_dump_json(), task.num_envs, task.device)
    if _kept.key != key:
        _kept.key, _kept.sim = None, None
        _kept.sim = Sim(config, task.num_envs, read_tree(TRAINING_TREE, config.teacher.max_node), task.device)
        _kept.key = key
    return _kept.sim


def row_of(method: str, label: dict[str, Any], results: list[EpisodeResult]) -> Row:
    """One method in one cell: what ``uuv eval`` says of a method, without what a clock measured, and every
    episode's end."""
    from uuvtai.measure.evaluate.summary import summary

    found = summary(method, results, 0, 0.0)
    for name in (
        "name",
        "env_steps",
        "wall_s",
        "env_steps_per_s",
        "replans_by_trigger",
        "planned_by",
        "fallbacks_by_reason",
    ):
        found.pop(name)
    details = found.pop("episodes_detail")
    return {
        **label,
        "method": method,
        **found,
        "episode_outcomes": [entry["outcome"] for entry in details],
        "episode_times_s": [entry["time_s"] for entry in details],
    }
