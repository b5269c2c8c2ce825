"""The navigation stack's stages that are more than one kernel, each a short list; ``Sim.perceive`` runs them
in order, and ``forget`` empties their memory.

Nothing here reads the truth but the oracles, ``true_map`` and ``true_tracks``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Protocol

import numpy as np
import taichi as ti
import torch

from uuvtai.common import tree_codes as codes
from uuvtai.config import Config, ObservationConfig, SensorsConfig
from uuvtai.kernels.baselines import dwa, mppi
from uuvtai.kernels.behavior import avoidance, threats, tree
from uuvtai.kernels.oracle import true_state
from uuvtai.kernels.perception import (
    camera_tracking,
    height,
    localization,
    mapping,
    prediction,
    prediction_network,
    sensor_model,
    tracking,
)
from uuvtai.kernels.planning import observation, route, triggers, voronoi
from uuvtai.kernels.sensors import depth_camera, mechanical_sonar, proprioception, sonar, sonar_image
from uuvtai.sim.stages import Stages
from uuvtai.state import BaselineState

# ------------------------------------------------------------------------------------------------------------
# Who fills what the stack senses: the simulator's kernels, or somebody outside (``uuvtai.vehicle.onboard``).


class SensorSource(Protocol):
    """Fills readings of the active rows, in this order in every control step."""

    loses_velocity: bool
    """the DVL may be silent where no filter estimates the velocity: then ``find_velocity`` runs"""

    def sense_motion(self, stages: Stages) -> None:
        """Readings of ``ego``: DVL, IMU, pressure, a position where it is given. The pose filter, if any,
        predicts between this and the sonar."""
        ...

    def sense_sonar(self, stages: Stages) -> None:
        """``scan``; the own pose at a ping is the one that ``ego`` holds now."""
        ...

    def sense_depth(self, stages: Stages) -> None:
        """``image``; by now the pose filter has used the scan."""
        ...


class SimulatedSensors:
    """The simulator's own: from the truth, with errors as configured."""

    def __init__(self, sensors_cfg: SensorsConfig) -> None:
        sonar_cfg = sensors_cfg.sonar
        self._mechanical, self._detects = sonar_cfg.mechanical, sonar_cfg.detector != "none"
        self.loses_velocity = proprioception.loses_velocity(sensors_cfg)

    def sense_motion(self, stages: Stages) -> None:
        """All instruments but sonar and camera."""
        proprioception.sense_proprioception(stages.proprioception)

    def sense_sonar(self, stages: Stages) -> None:
        """The ring or fan of beams, or the mechanical one; its image first, where ranges come from that."""
        if self._detects:
            sonar_image.hear(stages.sonar)
        if self._mechanical:
            mechanical_sonar.turn_head(stages.sonar)
        else:
            sonar.cast_sonar(stages.sonar)

    def sense_depth(self, stages: Stages) -> None:
        """The depth camera."""
        depth_camera.cast_depth(stages.depth)


def forget_readings(stages: Stages) -> None:
    """No reading yet in the rows that are active, whoever fills them."""
    proprioception.reset_proprioception(stages.proprioception)
    sonar.reset_sonar(stages.sonar)
    depth_camera.reset_depth(stages.depth)


# ------------------------------------------------------------------------------------------------------------


def recall(stages: Stages, config: Config) -> None:
    """A mechanical beam's scan has what it heard before, too."""
    if config.sensors.sonar.mechanical:
        sensor_model.recall_echoes(stages.echoes)


def track(stages: Stages, config: Config, privileged: bool) -> None:
    """Moving obstacles: where they are, how they turn, where they will be, how high they are."""
    if privileged:
        true_state.take_true_tracks(stages.true_tracks)
    else:
        tracking.track_obstacles(stages.tracking)
        if config.camera_tracking.use_camera:  # where the fan misses an obstacle
            camera_tracking.scan_columns(stages.tracking)
            camera_tracking.follow_spots(stages.tracking)
        if config.height.use_camera:  # where the fan does not show how high it is
            camera_tracking.look_at_obstacles(stages.tracking)
    prediction.learn_turns(stages.tracking)
    prediction.forecast_tracks(stages.tracking)
    if config.forecast.learned or config.forecast.keep_columns:
        prediction_network.remember_past(stages.tracking)
        prediction_network.describe_motion(stages.tracking)
    if config.forecast.learned:
        prediction_network.mix_futures(stages.tracking)
    height.bound_heights(stages.tracking)


def plan(stages: Stages, config: Config, by_voronoi: bool) -> None:
    """Which envs want a route; ``by_voronoi``: plan them, else they wait for the host's planner."""
    triggers.fire_triggers(stages.route)
    if by_voronoi:
        voronoi.plan_routes(stages.route)


def choose(stages: Stages, used: Collection[int], action: torch.Tensor) -> None:
    """The behaviour tree's choice, into ``action``; ``used``: codes of its leaves."""
    threats.assess_threats(stages.behavior)
    avoidance.plan_evasion(stages.behavior)
    if codes.DYNAMIC_WINDOW in used:
        dwa.plan_dynamic_window(stages.local_planner)
    if codes.PATH_INTEGRAL in used:
        mppi.plan_path_integral(stages.local_planner)
    tree.tick_tree(stages.behavior, action)


def clear_baselines(
    baselines: BaselineState, used: Collection[int], put: Callable[[ti.Field, np.ndarray], None]
) -> None:
    """A tree with local planners of the literature begins without the plans of an earlier one."""
    for field in (baselines.vel_w, baselines.plan_w) if max(used) >= codes.FIRST_BASELINE else ():
        put(field, np.zeros((*field.shape, 3), np.float32))


def observe(stages: Stages, observation_cfg: ObservationConfig, out: torch.Tensor) -> None:
    """What the policy reads, into ``out`` (n_env, n_obs)."""
    observation.sense_sectors(stages.observation)
    observation.write_observation(stages.observation, out)
    if observation_cfg.n_track > 0:
        observation.write_obstacles(stages.observation, out)
    if observation_cfg.behavior:
        observation.write_advice(stages.observation, out)


def forget(stages: Stages, config: Config) -> None:
    """Empty readings and memory of the stack in the rows that are active."""
    forget_readings(stages)
    if config.sensors.sonar.mechanical:
        sensor_model.reset_echoes(stages.echoes)
    if config.sensors.localization == "estimated":
        localization.reset_pose(stages.localization)
    tracking.reset_tracks(stages.tracking)
    prediction.reset_forecast(stages.tracking)
    if config.forecast.learned or config.forecast.keep_columns:
        prediction_network.reset_past(stages.tracking)
    mapping.reset_map(stages.mapping)
    route.reset_route(stages.route)
    tree.reset_behavior(stages.behavior)
