"""Scenarios seen from the host: body slots, the table of explicit obstacles, faults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uuvtai.closed_form import KIND_NAMES
from uuvtai.config import FixedObstacle, WorldConfig
from uuvtai.errors import SettingError, UserError
from uuvtai.kernels.world.layout import COARSE_M, FAULT_ENDPOINTS, FAULT_JOINED, FAULT_STATIC
from uuvtai.kernels.world.paths import FAULT_MOVING
from uuvtai.state import FixedTable, SceneState
from uuvtai.taichi_patches.memory import Put, put_by_kernel

N_CORNER = 5
"""Most waypoints of one path."""

_KINDS = {name: kind for kind, name in KIND_NAMES.items()}

FAULTS = {
    FAULT_ENDPOINTS: "start and goal find no place with their gaps: widen spawn_*_m or shrink "
    "start_goal_gap_m",
    FAULT_STATIC: "the static obstacles find no place with their gaps: ask for fewer or smaller ones, or a "
    "smaller static.gap_m",
    FAULT_JOINED: "no layout joins start and goal by free space: ask for fewer static obstacles or a smaller "
    "static.joined_clearance_m",
    FAULT_MOVING: "a moving obstacle finds no path within the walls and away from the start: shrink its "
    "size, path or start_gap_m",
}


class SceneError(UserError, RuntimeError):
    """Scenarios that cannot be placed: how many, why, and what to change."""


@dataclass(frozen=True)
class BodySlots:
    """Layout of a body list: explicit obstacles at rest, random static ones, explicit moving ones, random
    moving ones."""

    n_fixed_static: int
    n_static: int
    n_fixed_moving: int
    n_random_moving: int

    @property
    def n_dynamic(self) -> int:
        """Moving slots; at least one (empty) slot, because arrays cannot be empty."""
        return max(1, self.n_fixed_moving + self.n_random_moving)

    @property
    def first_dynamic(self) -> int:
        return self.n_fixed_static + self.n_static

    @property
    def n_body(self) -> int:
        return self.first_dynamic + self.n_dynamic


def body_slots(world_cfg: WorldConfig) -> BodySlots:
    """Slots of every env's body list."""
    return BodySlots(
        world_cfg.n_fixed_static, world_cfg.static_slots, world_cfg.n_fixed_moving, world_cfg.dynamic_slots
    )


def scenario_sizes(world_cfg: WorldConfig) -> dict[str, int]:
    """Lengths of the array axes that the world decides."""
    slots, tank = body_slots(world_cfg), world_cfg.tank
    return {
        "n_body": slots.n_body,
        "n_dynamic": slots.n_dynamic,
        "n_fixed": max(1, len(world_cfg.fixed)),
        "n_corner": N_CORNER,
        "n_coarse_row": math.ceil((tank.y_m[1] - tank.y_m[0]) / COARSE_M - 1e-9),
        "n_coarse_col": math.ceil((tank.x_m[1] - tank.x_m[0]) / COARSE_M - 1e-9),
    }


def load_fixed(table: FixedTable, world_cfg: WorldConfig) -> None:
    """Fill the table of explicit obstacles: those at rest first, then those with a path."""
    at_rest = [obstacle for obstacle in world_cfg.fixed if not obstacle.path]
    moving = [obstacle for obstacle in world_cfg.fixed if obstacle.path]
    for i, obstacle in enumerate(at_rest + moving):
        z, size = _center_and_size(obstacle, world_cfg)
        table.kind[i] = _KINDS[obstacle.kind]
        table.pos_w[i] = (obstacle.x_m, obstacle.y_m, z)
        table.size[i] = size
        table.yaw[i] = math.radians(obstacle.yaw_deg)
        table.n_way[i] = len(obstacle.path)
        table.speed_m_s[i] = -1.0 if obstacle.speed_m_s is None else obstacle.speed_m_s
        for j, way in enumerate(obstacle.path):
            table.way_w[i, j] = (way.x_m, way.y_m)


def _center_and_size(
    obstacle: FixedObstacle, world_cfg: WorldConfig
) -> tuple[float, tuple[float, float, float]]:
    floor, surface = world_cfg.tank.z_m
    z = 0.5 * (floor + surface) if obstacle.z_m is None else obstacle.z_m
    half_height = 0.5 * (surface - floor if obstacle.height_m is None else obstacle.height_m)
    radius = obstacle.radius_m or 0.0
    if obstacle.kind == "sphere":
        return z, (radius, radius, radius)
    if obstacle.kind == "cylinder":
        return z, (radius, radius, half_height)
    extent_x, extent_y = obstacle.half_extents_m or (0.0, 0.0)
    return z, (extent_x, extent_y, half_height)


Scene = tuple[int, int, float]
"""(S, D, v [m/s])"""


def set_scenes(
    scene: SceneState, world_cfg: WorldConfig, scenes: Sequence[Scene], put: Put = put_by_kernel
) -> None:
    """Deal the scenes (none: the world's own) out to the envs in turn, for their next scenarios. SettingError
    where one does not fit the slots of ``world``."""
    scenes = scenes or [world_cfg.own_scene]
    for n_static, n_dynamic, speed_m_s in scenes:
        for name, wanted, slots in (
            ("static", n_static, world_cfg.static_slots),
            ("dynamic", n_dynamic, world_cfg.dynamic_slots),
        ):
            if not 0 <= wanted <= slots:
                raise SettingError(
                    f"{wanted} {name} obstacles do not fit {slots} slots: set world.{name}_capacity to at "
                    f"least {wanted}"
                )
        if not (math.isfinite(speed_m_s) and speed_m_s >= 0):
            raise SettingError(f"the obstacles' speed must be finite and not negative, got {speed_m_s}")
    dealt = np.resize(np.array(scenes, dtype=np.float32), (scene.n_static.shape[0], 3))
    put(scene.n_static, dealt[:, 0].astype(np.int32))
    put(scene.n_dynamic, dealt[:, 1].astype(np.int32))
    put(scene.speed_m_s, np.ascontiguousarray(dealt[:, 2]))


def check_scenarios(faults: np.ndarray) -> None:
    """Raise SceneError where a scenario could not be placed as asked; ``faults`` is ``WorldState.faults`` of
    the rows just drawn."""
    bad = np.flatnonzero(faults)
    if len(bad) == 0:
        return
    reasons = [text for bit, text in FAULTS.items() if np.any(faults & bit)]
    raise SceneError(f"{len(bad)} of {len(faults)} scenarios cannot be placed: " + "; ".join(reasons))
