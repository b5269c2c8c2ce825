"""What a simulator is made of before its first step: sizes, arrays, scenarios, constants. Arrays of closed
ones are used again, for Taichi gives neither their memory nor their code back."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_type_hints

import numpy as np
import taichi as ti
import torch

from uuvtai import state
from uuvtai.common import enums
from uuvtai.common.errors import SettingError, SizeError, UserError
from uuvtai.common.obstacle_motion import KIND_NAMES
from uuvtai.common.tree_codes import MAX_NODES
from uuvtai.compile.launch import forget, is_gpu_shaped
from uuvtai.compile.memory import Memory, Put, address_of, put_by_kernel
from uuvtai.config import Config, ForecastConfig, SonarConfig, VehicleConfig, WorldConfig
from uuvtai.config.behavior import TUNED, configured_factors
from uuvtai.config.multibeam import elevations, heard_bearings
from uuvtai.config.task import TERMS
from uuvtai.kernels.core.grid import grid_shape, outside_cells
from uuvtai.kernels.core.simd import LANES, WORD
from uuvtai.kernels.core.stage import copy_rows
from uuvtai.kernels.perception.mapping import look_period_s, scans_in
from uuvtai.kernels.planning.clearance_gpu import offset_bits
from uuvtai.kernels.vehicle.thruster_fault import response_size
from uuvtai.kernels.world.motion import FAULT_MOVING
from uuvtai.kernels.world.scenario import FAULT_ENDPOINTS, FAULT_JOINED, FAULT_STATIC, coarse_size
from uuvtai.sim.stages import SimState, Stages, bind_all
from uuvtai.state import FixedTable, GridMask, SceneState

# ------------------------------------------------------------------------------------------------------------
# Thruster geometry: which wrench each thruster gives, and the least-squares way back over the axes that the
# frame can command.


_AXIS_ORDER = (0, 1, 2, 5, 3, 4)
"""Who comes first where a frame cannot command all axes: surge, sway, heave, yaw, then roll, then pitch."""

_RANK_TOLERANCE = 0.02
"""An axis whose lever over the axes before it is smaller than this (m, or 1 for forces) would ask for absurd
thrusts: left out."""


def allocation_matrices(vehicle_cfg: VehicleConfig) -> tuple[np.ndarray, np.ndarray]:
    """(wrench_of_thrust (6, n), thrust_of_wrench (n, 6)), float64; columns of axes that cannot be commanded
    are zero.

    The 6-thruster frame cannot pitch: its moment about y is always -0.0725 F_x - 0.0025 F_z.
    """
    position = np.array([t.position_m for t in vehicle_cfg.thrusters])
    direction = np.array([t.direction for t in vehicle_cfg.thrusters])
    lengths = np.linalg.norm(direction, axis=1, keepdims=True)
    if (lengths < 1e-6).any():
        raise SettingError(
            f"vehicle.thrusters.{int(np.argmin(lengths))}.direction is zero: give the way positive thrust "
            "pushes"
        )
    direction = direction / lengths
    wrench_of_thrust = np.vstack([direction.T, np.cross(position, direction).T])
    axes = controllable_axes(wrench_of_thrust)
    thrust_of_wrench = np.zeros((len(vehicle_cfg.thrusters), 6))
    thrust_of_wrench[:, axes] = np.linalg.pinv(wrench_of_thrust[axes])
    return wrench_of_thrust, thrust_of_wrench


def controllable_axes(wrench_of_thrust: np.ndarray) -> list[int]:
    """Axes (0-5) that can be commanded independently, chosen one by one in the order of importance."""
    axes: list[int] = []
    for axis in _AXIS_ORDER:
        row = wrench_of_thrust[axis]
        if axes:
            basis = wrench_of_thrust[axes]
            row = row - np.linalg.lstsq(basis.T, row, rcond=None)[0] @ basis
        if np.linalg.norm(row) > _RANK_TOLERANCE:
            axes.append(axis)
    return sorted(axes)


# ------------------------------------------------------------------------------------------------------------
# Scenarios seen from the host: body slots, the table of explicit obstacles, faults.


N_CORNER = 5  # Most waypoints of a random path.

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
class ObstacleSlots:
    """Layout of an obstacle list: explicit obstacles at rest, random static ones, explicit moving ones,
    random moving ones."""

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
    def n_obstacle(self) -> int:
        return self.first_dynamic + self.n_dynamic


def obstacle_slots(world_cfg: WorldConfig) -> ObstacleSlots:
    """Slots of every env's body list."""
    return ObstacleSlots(
        world_cfg.n_fixed_static, world_cfg.static_slots, world_cfg.n_fixed_moving, world_cfg.dynamic_slots
    )


def scenario_sizes(world_cfg: WorldConfig) -> dict[str, int]:
    """Lengths of the array axes that the world decides."""
    slots, tank = obstacle_slots(world_cfg), world_cfg.tank
    return {
        "n_obstacle": slots.n_obstacle,
        "n_dynamic": slots.n_dynamic,
        "n_fixed": max(1, len(world_cfg.fixed)),
        "n_corner": max(N_CORNER, *(len(obstacle.path) for obstacle in world_cfg.fixed), 0),
        "n_coarse_row": coarse_size(tank)[0],
        "n_coarse_word": -(-coarse_size(tank)[1] // WORD),
    }


def load_fixed(table: FixedTable, world_cfg: WorldConfig) -> None:
    """Fill the table of explicit obstacles: those at rest first, then those with a path."""
    at_rest = [obstacle for obstacle in world_cfg.fixed if not obstacle.path]
    moving = [obstacle for obstacle in world_cfg.fixed if obstacle.path]
    for i, obstacle in enumerate(at_rest + moving):
        z, size = world_cfg.center_and_size(obstacle)
        table.kind[i] = _KINDS[obstacle.kind]
        table.pos_w[i] = (obstacle.x_m, obstacle.y_m, z)
        table.size[i] = size
        table.yaw[i] = math.radians(obstacle.yaw_deg)
        table.n_way[i] = len(obstacle.path)
        table.speed_m_s[i] = -1.0 if obstacle.speed_m_s is None else obstacle.speed_m_s
        for j, way in enumerate(obstacle.path):
            table.way_w[i, j] = (way.x_m, way.y_m)


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


# ------------------------------------------------------------------------------------------------------------
# A new simulator's arrays: every struct, and what no step changes.


LENGTHENED = (
    *("n_ray", "n_pixel_row", "n_pixel_col", "n_latency", "n_delay"),
    *("n_echo", "n_heard", "n_bin", "n_elevation", "n_trial", "n_control"),
    *("n_future", "n_past", "n_bend", "n_frame", "n_column", "n_hidden", "n_said", "n_weight"),
)
"""axes whose lengths follow from sensors and options"""


def allocate_state(sizes: dict[str, int]) -> SimState:
    """Every struct, with the lengths of ``array_sizes``; those that other options lengthen lie last, so
    that the others keep their places, and what was compiled for them holds."""
    ti.sync()  # what others have declared is placed by itself: a tree takes 1,024 nodes, and we need 950
    kinds = sorted(get_type_hints(SimState).items(), key=lambda pair: rank(pair[1]))
    built = {}
    for name, kind in kinds:
        built[name] = state.allocate(kind, sizes)
        if sizes["n_env"] % LANES == 0 and (beyond := state.bytes_of(kind, sizes) % 64):
            ti.field(ti.u8, shape=64 - beyond)  # the next one begins with a line of memory
    return SimState(**built)


def rank(kind: type) -> int:
    """0 for a struct that has the same length whatever sensors and options are; else how late it lies."""
    axes = {axis for declared in dataclasses.fields(kind) for axis in declared.metadata["shape"]}
    return max((LENGTHENED.index(axis) + 1 for axis in axes.intersection(LENGTHENED)), default=0)


def fill_constants(s: SimState, config: Config, put: Put) -> None:
    """What no step changes: explicit obstacles, the tank's bounds on the map, the thrusters' geometry, a
    learned forecast, factors on the tree's numbers. Raises ForecastError, FileError."""
    if config.forecast.learned:
        from uuvtai.sim.forecast_weights import put_weights, read_weights

        put_weights(s.mixture, read_weights(config.forecast.learned), put)
    put(s.table.factor, configured_factors(config.slow, config.fast))
    load_fixed(s.fixed, config.world)
    load_bounds(s.mask, np.array(outside_cells(config.world.tank, config.mapping.cell_m)), put)
    wrench_of_thrust, thrust_of_wrench = allocation_matrices(config.vehicle)
    put(s.allocation.wrench_of_thrust, wrench_of_thrust.astype(np.float32))
    put(s.allocation.thrust_of_wrench, thrust_of_wrench.astype(np.float32))


def load_bounds(mask: GridMask, outside: np.ndarray, put: Put = put_by_kernel) -> None:
    """``outside``: booleans (n_row, n_col), True outside the tank (``kernels.grid.outside_cells``)."""
    n_row, n_col = outside.shape
    padded = np.zeros((n_row, -(-n_col // WORD) * WORD), dtype=bool)
    padded[:, :n_col] = outside
    put(mask.outside, outside.astype(np.int32))
    put(mask.outside_bits, np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64))


# ------------------------------------------------------------------------------------------------------------


_free: list[Arrays] = []


@dataclass(frozen=True)
class Arrays:
    """What a simulator has of Taichi, and what it was made for."""

    sizes: tuple[str, dict[str, int]]
    """device, and length of every axis"""
    settings: str
    """of the config that the bundles hold, as JSON"""
    s: SimState
    io: Stages
    memory: Memory

    def give_back(self) -> None:
        """Nobody uses them any more: to the system the memory, to the next simulator the rest."""
        forget(vars(self.io).values())
        self.memory.clear()
        _free.append(self)


def arrays_for(config: Config, sizes: dict[str, int], device: torch.device) -> Arrays:
    """Those of a closed simulator of these sizes, all zero; at best of one with the same config, whose
    kernels need not be compiled again. New ones where there are none."""
    settings = config.model_dump_json(include=set(Config.model_fields))
    fit = [found for found in _free if found.sizes == (device.type, sizes)]
    found = next((found for found in fit if found.settings == settings), fit[0] if fit else None)
    if found:
        _free.remove(found)
        if found.settings == settings:
            return found
    s = found.s if found else allocate_state(sizes)
    io = bind_all(Stages, s, config.model_copy(update={"world": config.world.compiled()}))
    anchor = s.clock.running
    memory = found.memory if found else Memory(s, anchor, address_of(anchor, device), device).in_huge_pages()
    return Arrays((device.type, sizes), settings, s, io, memory)


# ------------------------------------------------------------------------------------------------------------
# How long every array axis is, and how much memory a simulator of that size takes: known before anything is
# allocated.


_MAX_ENVS = 1 << 20
_ROWS = (1, 8, 64, 256)  # sizes of a batch that are allocated; beyond them powers of two
_PLAN_SLOTS = 64
"""Plans under way at once: far more than a CPU has cores, and the planner's scratch stays small."""
_GPU_PLAN_SLOTS, _ENVS_PER_PLAN = 16, 16
"""On a GPU a slot is a thread: as many as envs plan in a busy step, and no fewer than the first number."""
_MAP_SLOTS = 64
"""Maps under way at once on a CPU: more than it has cores, and their scratch stays in its caches. On a GPU
every env has its own."""


def rows_for(n_env: int) -> int:
    """Rows that are allocated for so many envs: one of few sizes, for each is compiled for itself. Rows
    beyond ``n_env`` sleep for ever."""
    return next((rows for rows in _ROWS if n_env <= rows), 1 << (n_env - 1).bit_length())


def array_sizes(config: Config, n_env: int, device: str = "cpu") -> dict[str, int]:
    """Length of every named axis in ``state``; that of ``n_env`` is what is allocated."""
    tank, sensors, n_env = config.world.tank, config.sensors, rows_for(n_env)
    n_row, n_col = grid_shape(tank, config.mapping.cell_m)
    for_gpu = device == "cuda" or is_gpu_shaped()
    return {
        "n_env": n_env,
        "n_thruster": len(config.vehicle.thrusters),
        "n_wrench": 6,
        "n_response": response_size(config.vehicle),
        "n_delay": 1 + round(config.disturbance.thruster_delay_s / config.episode.control_dt_s),
        **scenario_sizes(config.world),
        "n_ray": sensors.sonar.n_ray,
        "n_latency": sensors.sonar.latency_steps // sensors.sonar.period_steps + 2,
        **_image_sizes(sensors.sonar),
        "n_echo": sensors.sonar.n_ray if sensors.sonar.mechanical else 1,
        "n_cloud": 8,
        "n_pixel_row": sensors.depth.rows,
        "n_pixel_col": sensors.depth.cols,
        "n_track": config.tracking.n_track,
        "n_cluster": config.tracking.n_cluster,
        "n_height": LANES,
        "n_turn_row": 7,
        "n_turn": config.forecast.n_turn,
        "n_forecast": round(config.tracking.horizon_s / config.tracking.forecast_dt_s) + 1,
        "n_future": enums.N_MODE if config.forecast.learned else 1,
        **_network_sizes(config.forecast),
        "n_row": n_row,
        "n_col": n_col,
        "n_packet": n_col // LANES,
        "n_slot": n_env if for_gpu else min(n_env, _MAP_SLOTS),
        "n_plan": min(n_env, max(_GPU_PLAN_SLOTS, n_env // _ENVS_PER_PLAN) if for_gpu else _PLAN_SLOTS),
        "n_heap": n_row * n_col,
        "n_path": 2048,
        "n_ahead": math.ceil(config.route.risk_horizon_m / config.mapping.cell_m) + 2,
        "n_way": config.route.n_way,
        "n_trigger": enums.N_TRIGGER,
        "n_planner": enums.N_PLANNER,
        "n_reason": enums.N_REASON,
        "n_sector": config.observation.n_sector,
        "n_node": MAX_NODES,
        "n_candidate": config.behavior.n_candidate,
        "n_tuned": len(TUNED),
        "n_trial": config.baselines.n_trial,
        "n_control": _n_control(config),
        "n_term": len(TERMS),
    }


def _image_sizes(sonar_cfg: SonarConfig) -> dict[str, int]:
    """Axes of the image in which a sonar detects; as short as can be where it does not."""
    if sonar_cfg.detector == "none":
        return dict.fromkeys(("n_heard", "n_bin", "n_elevation"), 1)
    return {
        "n_heard": len(heard_bearings(sonar_cfg)),
        "n_bin": sonar_cfg.image_bins,
        "n_elevation": len(elevations()),
    }


def _network_sizes(forecast_cfg: ForecastConfig) -> dict[str, int]:
    """Axes of a learned forecast; as short as can be where there is none."""
    if not forecast_cfg.learned and not forecast_cfg.keep_columns:
        return dict.fromkeys(("n_past", "n_bend", "n_frame", "n_column", "n_hidden", "n_said"), 1) | {
            "n_weight": LANES
        }
    return {
        "n_past": enums.N_PAST,
        "n_bend": enums.N_BEND,
        "n_frame": enums.N_FRAME,
        "n_column": enums.N_COLUMN,
        "n_hidden": 2 * enums.N_HIDDEN,
        "n_said": enums.N_SAID,
        "n_weight": enums.N_WEIGHT,
    }


def _n_control(config: Config) -> int:
    """Decisions within the horizon of MPPI."""
    decision_s = config.baselines.period_steps * config.episode.control_dt_s
    return max(1, round(config.baselines.mppi.horizon_s / decision_s))


def memory_bytes(config: Config, n_env: int, device: str = "cpu") -> int:
    """Memory that the simulator's arrays take [bytes]."""
    sizes = array_sizes(config, n_env, device)
    return sum(state.bytes_of(struct, sizes) for struct in get_type_hints(SimState).values())


def check_size(config: Config, n_env: int, device: str) -> None:
    """Refuse sizes that cannot work before anything is allocated: SettingError or SizeError with the estimate
    and what to type."""
    if n_env < 1:
        raise SettingError(f"--num-envs {n_env}: at least 1 env is needed, for example --num-envs 64")
    if n_env > _MAX_ENVS:
        raise SizeError(
            f"--num-envs {n_env}: more than {_MAX_ENVS} envs are not supported; use a smaller number"
        )
    needed, free = memory_bytes(config, n_env, device), free_memory_bytes(device)
    if free is not None and needed > 0.9 * free:
        raise SizeError(
            f"--num-envs {n_env} needs about {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free on "
            f"{device}: {_smaller(config, n_env, device, free)}"
        )
    _check_kernels(config)


def _smaller(config: Config, n_env: int, device: str, free: int) -> str:
    """What to type where the memory is too small."""
    alone = memory_bytes(config, 1, device)
    if alone > 0.9 * free:
        return (
            "not even one env fits; make the map coarser (--set mapping.cell_m=...), the tank smaller, or "
            "free memory"
        )
    fitting = int(n_env * 0.9 * free / memory_bytes(config, n_env, device))
    while (
        fitting > 1 and memory_bytes(config, fitting, device) > 0.9 * free
    ):  # what all envs share takes its part too
        fitting = fitting * 9 // 10
    return f"use --num-envs {max(1, fitting)} or fewer (to train: --set train.num_envs)"


def _check_kernels(config: Config) -> None:
    """SettingError for what the kernels' counters and keys cannot hold; else Taichi would say so, in the
    middle of compiling."""
    mapping, sensors = config.mapping, config.sensors
    try:
        offset_bits(config.clearance, mapping)
        for seconds in (mapping.free_confident_s, mapping.promote_s):
            scans_in(seconds, look_period_s(mapping, sensors.sonar, config.episode))
    except ValueError as error:
        raise SettingError(str(error)) from None


def free_memory_bytes(device: str) -> int | None:
    """Free memory of the device [bytes]; None where it cannot be told."""
    if device == "cuda":
        import torch

        return torch.cuda.mem_get_info()[0]
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        for line in meminfo.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


# ------------------------------------------------------------------------------------------------------------
# Rows of Taichi's arrays: by a kernel where NumPy cannot see the device's memory.


_TORCH_DTYPE = {
    ti.f32: torch.float32,
    ti.i32: torch.int32,
    ti.i16: torch.int16,
    ti.u8: torch.uint8,
    ti.i8: torch.int8,
    ti.u32: torch.uint32,
    ti.u16: torch.uint16,
}


class HostCounts:
    """A simulator's numbers for the host, with as few waits for a GPU as can be."""

    def __init__(self, memory: Memory, outcome: ti.Field, num_envs: int) -> None:
        """``outcome``: the termination check's, a code of ``outcomes`` a row."""
        self._memory, self._outcome, self._num_envs = memory, outcome, num_envs
        self.any_ended: int | None = None
        """not 0 where an episode had ended, or rested, at the last ``number``; None: nobody has looked"""

    def number(self, field: ti.Field) -> int:
        """The one number of a field without axes. The wait for it tells ``any_ended``, too."""
        if self._memory.device.type == "cpu":
            return self._memory.number(field)
        ended = self._memory.tensor(self._outcome)[: self._num_envs].ne(enums.RUNNING).any()
        number, self.any_ended = torch.stack((self._memory.tensor(field), ended.to(torch.int32))).tolist()
        return number

    def rows(self, field: ti.Field, envs: list[int] | None = None) -> np.ndarray:
        """Copy of these rows of a field, shape (len(envs), ...); None = all of them."""
        if self._memory.device.type == "cpu":
            return self._memory.rows(field, slice(self._num_envs) if envs is None else envs)
        chosen = range(self._num_envs) if envs is None else envs
        return copied_rows(field, torch.tensor(chosen, dtype=torch.int32, device=self._memory.device))

    def has_any(self, field: ti.Field) -> bool:
        """Whether a number of a field of one axis is not 0."""
        if self._memory.device.type == "cpu":
            return bool(np.count_nonzero(self._memory.live(field)))
        return bool(self._memory.tensor(field).any())


def copied_rows(field: ti.Field, chosen: torch.Tensor) -> np.ndarray:
    """Host copy of the rows ``chosen`` (int32, on the field's device), shape (len(chosen), ...)."""
    inner = (field.n,) if hasattr(field, "n") else ()
    out = torch.empty(
        (len(chosen), *field.shape[1:], *inner), dtype=_TORCH_DTYPE[field.dtype], device=chosen.device
    )
    copy_rows(field, chosen, out)
    return out.cpu().numpy()
