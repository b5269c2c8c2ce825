"""The oracle: could a vehicle that knows the whole future have reached the goal, and how early? A search
through space and time.

Obstacles do not react, so a scenario fixes what is forbidden where and when. Every node of a lattice that can
be reached alive is followed through time, step by step, until one lies within the goal's radius. What is
found is the earliest arrival of a kinematic point:

- Optimistic: no inertia (any velocity at once); the hull is a ball of its smallest radius; the level speed is
  that of the body's diagonal in any direction, between the eight directions of the lattice up to 8 % more;
  bodies are looked at once a time step (0.12 s).
- Pessimistic: positions are nodes (level 0.1 m apart) at whole time steps; moves along the lattice count as
  full speed for the time to collision, also in a slow approach; climbing and diving count as standing still
  for it.

So it bounds success from above but for the rounding to nodes; research/LOG.md says how often a pilot arrived
where the oracle saw no way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.privileged.lattice import AXES, DIAGONALS, HEAVE_EVERY, MOVES, STAY, Referee, lattice_of
from uuvtai.privileged.obstacles import obstacles_of

Array = np.ndarray

_DIAGONAL_SHARE = math.sqrt(2.0) - 1.0
"""Share of the time steps that allow diagonal moves: then the diagonal is as fast as the axes, and what can
be reached is an octagon."""


@dataclass(frozen=True)
class Arrival:
    """What the oracle says of one scenario."""

    time_s: float | None
    """earliest arrival; None = not reachable within the horizon"""


def earliest_arrival(scenario: dict[str, Any], config: Config) -> Arrival:
    """Earliest arrival in a scenario (``describe_scenario``'s document) under the rules of ``config``: goal
    radius, horizon, safety."""
    rules = config.episode
    grid = lattice_of(np.array(scenario["start"]), config)
    n_step = int(rules.horizon_steps * rules.control_dt_s / grid.dt_s)
    bodies = obstacles_of(scenario, grid.dt_s * np.arange(n_step + 1))
    referee = Referee(grid, [body for body in bodies if not body.moves], config)
    moving = [body for body in bodies if body.moves]
    goal = grid.near(np.array(scenario["goal"]), rules.goal_radius_m)
    reached = np.zeros_like(grid.inside)
    reached[grid.start] = True
    blocked = referee.blocked(moving, 0, reached)
    reached &= ~blocked[0]
    for step in range(n_step + 1):
        if (reached & goal).any():
            return Arrival(step * grid.dt_s)
        if step == n_step or not reached.any():
            break
        after = referee.blocked(moving, step + 1, reached)
        reached = _moved(reached, blocked, after, step)
        blocked = after
    return Arrival(None)


def _moved(reached: Array, blocked: Array, after: Array, step: int) -> Array:
    """Nodes that can be reached one step later; ``blocked`` and ``after`` are the referee's masks at both
    ends of the step."""
    out = np.zeros_like(reached)
    for move in _moves_of(step):
        here, there = _shifted(MOVES[move])
        out[there] |= (reached[here] & ~blocked[move][here]) & ~after[move][there]
    if step % HEAVE_EVERY == HEAVE_EVERY - 1:
        level = out.copy()
        out[1:] |= level[:-1] & ~after[0][1:]
        out[:-1] |= level[1:] & ~after[0][:-1]
    return out


def _moves_of(step: int) -> list[int]:
    kinds = [STAY, AXES]
    if math.floor((step + 1) * _DIAGONAL_SHARE) > math.floor(step * _DIAGONAL_SHARE):
        kinds.append(DIAGONALS)
    return [move for kind in kinds for move in range(kind.start, kind.stop)]


def _shifted(move: Array) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """(nodes that a level move leaves, nodes it reaches), pairwise."""
    pairs = [
        (slice(max(0, -d), -d if d > 0 else None), slice(max(0, d), d if d < 0 else None))
        for d in (0, move[1], move[0])
    ]
    return tuple(leave for leave, _ in pairs), tuple(reach for _, reach in pairs)
