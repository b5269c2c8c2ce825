"""Scenarios of the simulator, drawn once and kept as the twin's tensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from uuvtai.scene_options import SceneOptions
from uuvtai.sim import Sim
from uuvtai.tree import read_tree
from uuvtai.twin.tensors import MOVERS, N_MOVER, N_STATIC, STATICS, WAY

_BATCH = 512


class TwinScene(NamedTuple):
    """A scene that the twin draws from, and how often."""

    world: str
    n_static: int
    n_dynamic: int
    speed_m_s: float
    weight: float


class ScenarioBank(NamedTuple):
    """n scenarios of a world: ``static`` (n, STATICS, N_STATIC), ``mover`` (n, MOVERS, N_MOVER), ``start``
    and ``goal`` (n, 3) [m], ``yaw`` (n,) [rad]."""

    static: torch.Tensor
    mover: torch.Tensor
    start: torch.Tensor
    goal: torch.Tensor
    yaw: torch.Tensor


def draw_bank(world: str, count: int, seed: int) -> ScenarioBank:
    """Episodes 0 .. count - 1 of ``seed`` in a world, with every body that the twin can hold. Raises
    ConfigError."""
    config = SceneOptions(world, n_static=STATICS, n_dynamic=MOVERS, speed_m_s=1.5).config()
    rows = min(count, _BATCH)
    sim = Sim(config, rows, read_tree("bt", config.teacher.max_node))
    parts = []
    for first in range(0, count, rows):
        mask, seeds = torch.ones(rows, dtype=torch.int32), torch.full((rows,), seed, dtype=torch.int32)
        sim.draw(mask, seeds, torch.arange(rows, dtype=torch.int32) + first)
        parts.append(bank_of(sim))
    return ScenarioBank(*(torch.cat(tensors)[:count] for tensors in zip(*parts, strict=True)))


def bank_of(sim: Sim) -> ScenarioBank:
    """What a simulator has drawn. Raises ValueError where the twin cannot hold it."""
    s = sim.s
    read = {
        name: sim.rows(getattr(struct, name))
        for struct, names in (
            (s.world, ("kind", "pos_w", "size", "yaw")),
            (s.path, ("n_way", "way_w", "radius_m", "length_m", "phase_m", "speed_m_s")),
        )
        for name in names
    }
    n, lanes = read["n_way"].shape
    first = read["kind"].shape[1] - lanes
    rest, moving = slice(0, STATICS), slice(first, first + min(lanes, MOVERS))
    if (read["kind"][:, STATICS:first] != 0).any() or (read["kind"][:, moving.stop :] != 0).any():
        raise ValueError(
            f"the twin holds {STATICS} obstacles at rest and {MOVERS} moving ones; there are more"
        )
    static, mover = np.zeros((n, STATICS, N_STATIC), np.float32), np.zeros((n, MOVERS, N_MOVER), np.float32)
    held = min(STATICS, first)
    static[:, :held, 0], static[:, :held, 5] = read["kind"][:, rest][:, :held], read["yaw"][:, rest][:, :held]
    static[:, :held, 1:3] = read["pos_w"][:, :held, :2]
    static[:, :held, 3:5] = read["size"][:, :held, :2]
    k = min(lanes, MOVERS)
    mover[:, :k, 0], mover[:, :k, 1] = read["kind"][:, moving], read["pos_w"][:, moving, 2]
    mover[:, :k, 2], mover[:, :k, 3] = read["size"][:, moving, 0], read["size"][:, moving, 2]
    for column, name in enumerate(("n_way", "radius_m", "length_m", "phase_m", "speed_m_s"), 4):
        mover[:, :k, column] = read[name][:, :k]
    mover[:, :k, WAY:] = read["way_w"][:, :k].reshape(n, k, -1)
    return ScenarioBank(
        torch.from_numpy(static),
        torch.from_numpy(mover),
        torch.from_numpy(sim.rows(s.mission.start_w).copy()),
        torch.from_numpy(sim.rows(s.mission.goal_w).copy()),
        torch.from_numpy(sim.rows(s.mission.start_yaw).copy()),
    )
