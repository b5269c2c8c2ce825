"""Columns that a network chooses by, made of those of ``set_columns`` and ``tree_columns``: how close each
body comes if the tree's velocity is driven on, and the policy's."""

from __future__ import annotations

import torch

HULL_M = 0.22
FAR_SIGHT_M, OVERLAP_M, HORIZON_S, SOFT_M = 3.0, -1.0, 3.0, 0.3
AT_WAY, AT_VELOCITY, AT_WIDTH, AT_LATER = slice(1, 3), slice(5, 7), 7, (slice(12, 14), slice(14, 16))
"""columns of a body: way to it [4 m], velocity [m/s], width [m], way to where it is in 1 s and 2 s [4 m]"""
APPROACH_WIDTH = 14
"""columns added to every body"""


def with_approach(bodies: torch.Tensor, tree: torch.Tensor, policy: torch.Tensor) -> torch.Tensor:
    """Bodies (..., lanes, n) with APPROACH_WIDTH more columns, for velocities (..., 2) [m/s] in the mirrored
    world."""
    added = [column for velocity in (tree, policy) for column in _approach(bodies, velocity)]
    return torch.cat([bodies, torch.stack(added, -1) * bodies[..., :1]], -1)


def _approach(bodies: torch.Tensor, velocity: torch.Tensor) -> list[torch.Tensor]:
    """Time [s] and distance [m] of the closest approach along straight lines, distances in 1 s and 2 s where
    the body is forecast, nearness, and the velocity itself."""
    own = velocity[..., None, :]
    way, reach = 4.0 * bodies[..., AT_WAY], 0.5 * bodies[..., AT_WIDTH] + HULL_M
    moves = bodies[..., AT_VELOCITY] - own
    when = (-(way * moves).sum(-1) / moves.square().sum(-1).clamp(min=1e-3)).clamp(0.0, HORIZON_S)
    gaps = [(way + when[..., None] * moves).norm(dim=-1) - reach]
    for seconds, place in enumerate(AT_LATER, start=1):
        gaps.append((4.0 * bodies[..., place] - seconds * own).norm(dim=-1) - reach)
    near = 1.0 / (SOFT_M + gaps[0].clamp(min=0.0))
    told = [gap.clamp(OVERLAP_M, FAR_SIGHT_M) for gap in gaps]
    every = 0.0 * when  # of each body the same; an exported graph has nothing that repeats
    return [when, *told, near, *(part + every for part in own.unbind(-1))]


def wished(action: torch.Tensor, fastest: float) -> torch.Tensor:
    """Velocity (..., 2) [m/s] of a policy's action, at most ``fastest``."""
    return fastest * action / action.norm(dim=-1, keepdim=True).clamp(min=1.0)
