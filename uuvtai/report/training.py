"""Blocks of trainings: reward, success, losses; seeds of one agent as a mean line with a band."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from uuvtai.common.colours import agent_colours
from uuvtai.common.statistics import wilson_interval
from uuvtai.config.loader import parsed_yaml
from uuvtai.report.blocks import Block, Figure, Paragraph
from uuvtai.report.figures import Line, curves
from uuvtai.report.tables import Cell, Column, Data, Table, number, percent, rate

Metrics = list[dict[str, Any]]

_STEPS = "time/env_steps"
PANELS = (
    ("rollout/ep_rew_mean", "reward per episode", False),
    ("rollout/success_rate", "success in training", True),
    ("rollout/collision_rate", "collision in training", True),
    ("eval/success_rate", "success in evaluation", True),
    ("world_model/reconstruction_loss", "reconstruction loss", False),
    ("world_model/dynamics_loss", "dynamics loss", False),
)
"""(metric, title, is a share): the paper's four curves, collision, evaluations in between if any"""


@dataclass(frozen=True)
class Training:
    """One training: its folder's name, its config as text, what it recorded."""

    name: str
    config: str
    metrics: Metrics
    preset: str = ""


@dataclass(frozen=True)
class AgentRuns:
    """Trainings that differ in their seed only."""

    name: str
    runs: Sequence[Training]


def training(runs: Sequence[Training], command: str = "") -> list[Block]:
    """Curves of these trainings, grouped into agents, and where each ended."""
    agents = grouped([run for run in runs if run.metrics])
    colours = agent_colours([agent.name for agent in agents])
    panels, rows = [], []
    for key, title, share in PANELS:
        lines = [line for agent in agents if (line := _line(agent, key, colours[agent.name])) is not None]
        if lines:
            panels.append(curves(lines, title, "million env-steps", share))
            rows += [
                [line.name, key, *point]
                for line in lines
                for point in zip(line.x, line.y, line.low or line.y, line.high or line.y, strict=True)
            ]
    if not panels:
        return [Paragraph("No iteration was recorded.")]
    data = Data(["agent", "metric", "million_env_steps", "mean", "lowest", "highest"], rows)
    seeds = (
        "the line is the mean over seeds, the band reaches from the lowest to the highest seed; "
        if any(len(agent.runs) > 1 for agent in agents)
        else ""
    )
    caption = (
        f"Training curves: {seeds}shares and rewards over the episodes that ended last, as the trainer "
        "records them"
    )
    return [Figure("training", panels, caption, data, command), _last_table(agents)]


def grouped(runs: Sequence[Training]) -> list[AgentRuns]:
    """Trainings with the same config but for the seed are one agent, named by their preset or folder."""
    by_config: dict[str, list[Training]] = {}
    for run in runs:
        by_config.setdefault(_without_seed(run), []).append(run)
    groups = list(by_config.values())
    names = [_agent_name(group) for group in groups]
    unique = len(set(names)) == len(names)
    return [
        AgentRuns(name if unique else group[0].name, group) for name, group in zip(names, groups, strict=True)
    ]


def _config_of(run: Training) -> dict[str, Any]:
    """Raises ConfigError."""
    return _parsed(run.config, f"{run.name}/config.yaml")


@lru_cache(maxsize=64)
def _parsed(text: str, where: str) -> dict[str, Any]:
    config = parsed_yaml(text, where)
    return config if isinstance(config, dict) else {}


def _without_seed(run: Training) -> str:
    config = _config_of(run)
    alike = config | {"train": {key: value for key, value in _section(config).items() if key != "seed"}}
    return json.dumps(alike, sort_keys=True, default=str)


def _section(config: dict[str, Any]) -> dict[str, Any]:
    train = config.get("train")
    return train if isinstance(train, dict) else {}


def _agent_name(group: Sequence[Training]) -> str:
    """The preset, or the first folder's name, for several seeds without its number."""
    name = group[0].name
    return group[0].preset or (name.rstrip("_-0123456789") if len(group) > 1 else "") or name


def _line(agent: AgentRuns, key: str, colour: str) -> Line | None:
    """Mean over the seeds at the iterations that all of them have; None where the metric is missing."""
    by_iteration = [
        {row["iteration"]: row for row in run.metrics if _is_number(row.get(key)) and _STEPS in row}
        for run in agent.runs
    ]
    common = sorted(set.intersection(*(set(rows) for rows in by_iteration)))
    if not common:
        return None
    values = [[rows[i][key] for rows in by_iteration] for i in common]
    x = [by_iteration[0][i][_STEPS] / 1e6 for i in common]
    name = f"{agent.name} ({len(values[0])} seeds)" if len(values[0]) > 1 else agent.name
    band = ([min(v) for v in values], [max(v) for v in values]) if len(values[0]) > 1 else (None, None)
    return Line(name, x, [sum(v) / len(v) for v in values], *band, colour=colour)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _judged(run: Training) -> str | Cell:
    """Success in the last evaluation in between, with its count and interval; the config says of how many
    episodes. Without an interval where several scenes have the same episode numbers, which go together."""
    rows = [row for row in run.metrics if _is_number(row.get("eval/success_rate"))]
    share = rows[-1]["eval/success_rate"] if rows else None
    n = _section(_config_of(run)).get("evaluate_episodes")
    if share is None or not isinstance(n, int):
        return percent(share)
    k, scenes = round(share * n), [key for key in rows[-1] if key.startswith("eval/success_")]
    return rate(k, n, None if len(scenes) > 2 else wilson_interval(k, n))


def _last(key: str, form: Callable[..., str], *digits: int) -> Callable[[Training], str]:
    return lambda run: form(run.metrics[-1].get(key), *digits)


_LAST = (
    Column("training", left=True, of=lambda run: run.name),
    Column("iterations", of=_last("iteration", number, 0)),
    Column("env-steps", of=_last(_STEPS, number, 0)),
    Column("reward", of=_last("rollout/ep_rew_mean", number, 2)),
    Column("success", of=_last("rollout/success_rate", percent)),
    Column("collision", of=_last("rollout/collision_rate", percent)),
    Column("success in evaluation", of=_judged),
    Column("env-steps/s", of=_last("time/env_steps_per_s", number, 0)),
)


def _last_table(agents: Sequence[AgentRuns]) -> Table:
    colours = agent_colours([agent.name for agent in agents])
    swatches = [colours[agent.name] for agent in agents for _ in agent.runs]
    runs = [run for agent in agents for run in agent.runs]
    return Table(
        _LAST, runs, "Where each training ended: the record of its last iteration", swatches=swatches
    )
