"""How long every array axis is, and how much memory a simulator of that size takes: known before anything is
allocated."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import get_type_hints

from uuvtai import state
from uuvtai.config import Config, ForecastConfig, SonarConfig
from uuvtai.config.task import TERMS
from uuvtai.errors import SettingError, SizeError
from uuvtai.forecast_codes import N_BEND, N_COLUMN, N_FRAME, N_HIDDEN, N_MODE, N_PAST, N_SAID, N_WEIGHT
from uuvtai.kernels.core.grid import grid_shape
from uuvtai.kernels.core.lanes import LANES
from uuvtai.kernels.perception.mapping import look_period_s, scans_in
from uuvtai.kernels.planning.clearance_keys import offset_bits
from uuvtai.kernels.vehicle.lost_thruster import response_size
from uuvtai.multibeam import elevations, heard_bearings
from uuvtai.native.gpu_shape import is_gpu_shaped
from uuvtai.plan_codes import N_PLANNER, N_REASON, N_TRIGGER
from uuvtai.scenario import scenario_sizes
from uuvtai.stages import SimState
from uuvtai.tuned_numbers import TUNED

_MAX_ENVS = 1 << 20
_ROWS = (1, 8, 64, 256)
"""sizes of a batch that are allocated; beyond them powers of two"""
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
        "n_future": N_MODE if config.forecast.learned else 1,
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
        "n_trigger": N_TRIGGER,
        "n_planner": N_PLANNER,
        "n_reason": N_REASON,
        "n_sector": config.features.n_sector,
        "n_node": config.teacher.max_node,
        "n_candidate": config.teacher.n_candidate,
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
        "n_past": N_PAST,
        "n_bend": N_BEND,
        "n_frame": N_FRAME,
        "n_column": N_COLUMN,
        "n_hidden": 2 * N_HIDDEN,
        "n_said": N_SAID,
        "n_weight": N_WEIGHT,
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
    return f"use --num-envs {max(1, fitting)} or fewer"


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
