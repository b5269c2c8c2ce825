"""The navigation stack's stages that are more than one kernel, each a short list; ``Sim.perceive`` runs them
in order, and ``forget`` empties their memory.

Nothing here reads the truth but the yardsticks, ``true_map`` and ``true_tracks``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
import taichi as ti
import torch

from uuvtai import tree_codes as codes
from uuvtai.config import Config, FeaturesConfig
from uuvtai.kernels.baselines import dynamic_window, path_integral, potential_field, velocity_obstacle
from uuvtai.kernels.perception import (
    echoes,
    elevation,
    forecast,
    look,
    mapping,
    mixture,
    motion_columns,
    pose,
    spotting,
    tracking,
)
from uuvtai.kernels.planning import features, route, triggers, voronoi
from uuvtai.kernels.privileged import true_map, true_tracks
from uuvtai.kernels.teacher import evasion, leaves, threats
from uuvtai.sensing import forget_readings
from uuvtai.stages import Stages
from uuvtai.state import BaselineState


def recall(stages: Stages, config: Config) -> None:
    """A mechanical beam's scan has what it heard before, too."""
    if config.sensors.sonar.mechanical:
        echoes.recall_echoes(stages.echoes)


def track(stages: Stages, config: Config, privileged: bool) -> None:
    """Moving bodies: where they are, how they turn, where they will be, how high they are."""
    if privileged:
        true_tracks.take_true_tracks(stages.true_tracks)
    else:
        tracking.track_bodies(stages.tracking)
        if config.spotting.use_camera:  # where the fan misses a body
            spotting.scan_columns(stages.spotting)
            spotting.follow_spots(stages.spotting)
        if config.elevation.use_camera:  # where the fan does not show how high it is
            look.look_at_bodies(stages.look)
    forecast.learn_habits(stages.forecast)
    forecast.forecast_tracks(stages.forecast)
    if config.forecast.learned or config.forecast.keep_columns:
        motion_columns.remember_past(stages.past)
        motion_columns.describe_motion(stages.past)
    if config.forecast.learned:
        mixture.mix_futures(stages.mixture)
    elevation.bound_heights(stages.heights)


def draw_map(stages: Stages, config: Config) -> None:
    """The map's two layers."""
    mapping.update_map(stages.mapping)
    if config.mapping.stamp > 0:
        true_map.stamp_truth(stages.true_map)


def plan(stages: Stages, config: Config, by_voronoi: bool) -> None:
    """Which envs want a route; ``by_voronoi``: plan them, else they wait for the host's planner."""
    triggers.fire_triggers(stages.triggers)
    if by_voronoi:
        voronoi.plan_routes(stages.voronoi)


def choose(stages: Stages, used: Collection[int], action: torch.Tensor) -> None:
    """The behaviour tree's choice, into ``action``; ``used``: codes of its leaves."""
    threats.assess_threats(stages.threats)
    evasion.plan_evasion(stages.evasion)
    if _has_baseline(used):
        _plan_by_baseline(stages, used)
    leaves.tick_tree(stages.teacher, action)


def clear_baselines(
    baselines: BaselineState, used: Collection[int], put: Callable[[ti.Field, np.ndarray], None]
) -> None:
    """A tree with such leaves begins without the plans of an earlier one."""
    for field in (baselines.vel_w, baselines.plan_w) if _has_baseline(used) else ():
        put(field, np.zeros((*field.shape, 3), np.float32))


def _has_baseline(used: Collection[int]) -> bool:
    """Whether a local planner of the literature is among these leaves."""
    return max(used) >= codes.FIRST_BASELINE


def _plan_by_baseline(stages: Stages, used: Collection[int]) -> None:
    if codes.DYNAMIC_WINDOW in used:
        dynamic_window.plan_dynamic_window(stages.dynamic_window)
    if codes.POTENTIAL_FIELD in used:
        potential_field.plan_potential_field(stages.potential_field)
    if codes.VELOCITY_OBSTACLE in used:
        velocity_obstacle.plan_velocity_obstacle(stages.velocity_obstacle)
    if codes.PATH_INTEGRAL in used:
        path_integral.plan_path_integral(stages.path_integral)


def observe(stages: Stages, features_cfg: FeaturesConfig, out: torch.Tensor) -> None:
    """What the policy reads, into ``out`` (n_env, n_obs)."""
    features.sense_sectors(stages.features)
    features.write_observation(stages.features, out)
    if features_cfg.n_track > 0:
        features.write_bodies(stages.features, out)
    if features_cfg.teacher:
        features.write_advice(stages.features, out)


def forget(stages: Stages, config: Config) -> None:
    """Empty readings and memory of the stack in the rows that are awake."""
    forget_readings(stages)
    if config.sensors.sonar.mechanical:
        echoes.reset_echoes(stages.echoes)
    if config.sensors.localization == "estimated":
        pose.reset_pose(stages.pose)
    tracking.reset_tracks(stages.tracking)
    forecast.reset_forecast(stages.forecast)
    if config.forecast.learned or config.forecast.keep_columns:
        motion_columns.reset_past(stages.past)
    mapping.reset_map(stages.mapping)
    route.reset_route(stages.route)
    leaves.reset_teacher(stages.teacher)
