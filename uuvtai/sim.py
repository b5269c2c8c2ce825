"""The simulator: allocates every struct and runs the stages in order. ``Sim.step`` is the page to read first.

Data goes one way: action -> actuation -> dynamics -> world -> referee -> sensing -> pose -> tracking ->
mapping -> clearance -> planning -> teacher -> features -> reward. A pass works on the rows whose
``clock.awake`` is 1: all running rows in a step, only the rows being reset in a reset.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import partial

import numpy as np
import taichi as ti
import torch

from uuvtai import tree_codes as codes
from uuvtai.binding import bind_all
from uuvtai.config import Config
from uuvtai.copying import copied_rows
from uuvtai.initial import allocate_state, fill_constants
from uuvtai.kernels.baselines import dynamic_window, path_integral, potential_field, velocity_obstacle
from uuvtai.kernels.core.rows import copy_rows
from uuvtai.kernels.perception import (
    elevation,
    forecast,
    futures,
    look,
    mapping,
    mixture,
    motion_columns,
    pose,
    spotting,
    tracking,
)
from uuvtai.kernels.planning import clearance, exposure, features, route, triggers, voronoi
from uuvtai.kernels.privileged import true_map, true_tracks
from uuvtai.kernels.sensors import depth, proprioception, sonar
from uuvtai.kernels.task import episode, reward
from uuvtai.kernels.teacher import evasion, leaves, threats
from uuvtai.kernels.vehicle import actuation, dynamics, lost_thruster
from uuvtai.kernels.world import scenarios
from uuvtai.mixture_weights import put_weights, read_weights
from uuvtai.native.making import adopt
from uuvtai.rrt import RouteFallback, RoutePlanner
from uuvtai.runtime import start_taichi
from uuvtai.scenario import Scene, check_scenarios, set_scenes
from uuvtai.sensing import Mission, SensorSource
from uuvtai.sizes import array_sizes, check_size
from uuvtai.stages import Stages, timed_stage
from uuvtai.taichi_patches.memory import Memory, address_of
from uuvtai.tree import FlatTree, load_tree


class SimulatedSensors:
    """The simulator's own: from the truth, with errors as configured."""

    def sense_motion(self, stages: Stages) -> None:
        """All instruments but sonar and camera."""
        proprioception.sense_proprioception(stages.proprioception)

    def sense_sonar(self, stages: Stages) -> None:
        """The ring of beams."""
        sonar.cast_sonar(stages.sonar)

    def sense_depth(self, stages: Stages) -> None:
        """The depth camera."""
        depth.cast_depth(stages.depth)


class Sim:
    """Thousands of vehicles in their worlds, stepped together.

    ``action`` is a torch tensor (n_env, 4) in [-1, 1] on the simulator's device: the behaviour tree writes
    its choice there, the next ``step`` reads it; overwrite it to drive otherwise. ``observation`` is None
    until somebody asks by ``observe``. While ``privileged`` is on (a yardstick, off in a new simulator), the
    tracks of moving bodies are the truth. ``planner`` plans the routes on the host in place of the
    simulator's own planners; None in a new simulator. ``sensors`` fills what the stack senses; in a new
    simulator its own kernels.
    """

    def __init__(self, config: Config, num_envs: int, tree: FlatTree, device: str = "cpu") -> None:
        """Raises ValueError or MemoryError for sizes that cannot work, RuntimeError for a missing device."""
        self.config, self.num_envs = config, num_envs
        runtime = start_taichi(device)
        self.device = torch.device(runtime.device)
        check_size(config, num_envs, runtime.device)
        learned = read_weights(config.forecast.learned) if config.forecast.learned else {}
        self.s = allocate_state(array_sizes(config, num_envs, runtime.device))
        self.io = bind_all(Stages, self.s, config.model_copy(update={"world": config.world.compiled()}))
        self.action = torch.zeros(num_envs, 4, device=self.device)
        self.reward = torch.zeros(num_envs, device=self.device)
        self.terminated = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
        self.truncated = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
        self.observation: torch.Tensor | None = None
        self._every_row = torch.arange(num_envs, dtype=torch.int32, device=self.device)
        self.fallback = RouteFallback(config)
        self.planner: RoutePlanner | None = None
        self.sensors: SensorSource = SimulatedSensors()
        self.stage_s: dict[str, float] | None = None
        self.privileged = False
        self._watches = lost_thruster.is_watched(config.vehicle, config.actuation)
        self._memory = self.memory()
        self._put = self._memory.put
        if config.runtime.native and self.device.type == "cpu":
            recipe = partial(_recipe, config, num_envs)
            adopt(vars(self.io).values(), self._memory, recipe, alone=num_envs == 1)
        self.use_tree(tree)
        self.set_scenes()
        fill_constants(self.s, config, self._put)
        put_weights(self.s.mixture, learned, self._put)

    def use_tree(self, tree: FlatTree) -> None:
        """Drive by another behaviour tree from the next tick on: nothing is compiled again."""
        self.tree = tree
        load_tree(self.s.table, tree, self._put)
        for field in (self.s.baselines.vel_w, self.s.baselines.plan_w) if self._has_baseline() else ():
            self._put(field, np.zeros((*field.shape, 3), np.float32))

    def set_scenes(self, scenes: Sequence[Scene] = ()) -> None:
        """Deal (S, D, v) out to the envs in turn, for their next scenarios; none = the world's own.
        ValueError where slots are too few."""
        world = self.config.world
        own = (world.n_static, world.n_dynamic, world.dynamic_speed_m_s)
        set_scenes(self.s.scene, world, scenes or [own], self._put)

    def observe(self) -> torch.Tensor:
        """(n_env, n_obs), from the next pass on written for every awake row (``features.columns``)."""
        if self.observation is None:
            width = features.observation_width(self.config.features)
            self.observation = torch.zeros(self.num_envs, width, device=self.device)
        return self.observation

    # --------------------------------------------------------------------------------------------------- step

    def step(self, action: torch.Tensor | None = None) -> None:
        """One control step of every running env, driven by ``action`` (default: what the tree chose)."""
        if action is not None:
            self.action.copy_(action)
        io, rules = self.io, self.config.episode
        with self._stage("dynamics"):
            if self._watches:
                lost_thruster.watch_thrusters(io.thrusters)
            actuation.command_thrusters(io.actuation, self.action)
            dynamics.move_vehicle(io.dynamics, rules.control_dt_s, rules.substeps)
        with self._stage("world"):
            episode.advance_clock(io.episode)
            scenarios.move_obstacles(io.world)
            episode.judge(io.episode)
        self._perceive()
        with self._stage("reward"):
            reward.compute_reward(io.reward, self.reward, self.terminated, self.truncated)

    def _perceive(self) -> None:
        """Sensing to teacher for the rows that are awake.

        Behind ``sensors`` no stage reads the truth but yardsticks, and none draws a random number by the
        episode's key but the fallback planner (``_plan_seed``): the same readings in the same steps give
        the same commands (``uuvtai.pilot``).
        """
        io, c = self.io, self.config
        with self._stage("proprioception"):
            self.sensors.sense_motion(io)
        estimated = c.sensors.localization == "estimated"
        if estimated:
            with self._stage("pose"):
                pose.predict_pose(io.pose)
        with self._stage("sonar"):
            self.sensors.sense_sonar(io)
        if estimated and c.pose.use_walls:
            with self._stage("pose"):
                pose.correct_pose(io.pose)
        with self._stage("depth"):
            self.sensors.sense_depth(io)
        with self._stage("tracking"):
            self._track()
        with self._stage("mapping"):
            mapping.update_map(io.mapping)
            if c.mapping.stamp > 0:
                true_map.stamp_truth(io.true_map)
        with self._stage("clearance"):
            clearance.compute_clearance(io.clearance)
        with self._stage("planning"):
            if c.quiet.weight_seen > 0:
                exposure.average_traffic(io.exposure)
            triggers.fire_triggers(io.triggers)
            if self.planner is None:
                voronoi.plan_routes(io.voronoi)
                self.fallback.serve(io, self._plan_seed)
            else:
                self.fallback.serve_by(self.planner, io, self.rows)
            route.follow_route(io.route)
        with self._stage("teacher"):
            threats.assess_threats(io.threats)
            evasion.plan_evasion(io.evasion)
            if self._has_baseline():
                self._plan_by_baseline()
            leaves.tick_tree(io.teacher, self.action)
        if self.observation is not None:
            with self._stage("features"):
                self._observe(self.observation)

    def _track(self) -> None:
        """Moving bodies: where they are, how they turn, where they will be, how high they are."""
        io, c = self.io, self.config
        if self.privileged:
            true_tracks.take_true_tracks(io.true_tracks)
        else:
            tracking.track_bodies(io.tracking)
            if c.spotting.use_camera:  # where the fan misses a body
                spotting.scan_columns(io.spotting)
                spotting.follow_spots(io.spotting)
            if c.elevation.use_camera:  # where the fan does not show how high it is
                look.look_at_bodies(io.look)
        forecast.learn_habits(io.forecast)
        forecast.forecast_tracks(io.forecast)
        if c.forecast.turn_back_s:
            futures.weigh_futures(io.futures)
        if c.forecast.learned or c.forecast.keep_columns:
            motion_columns.remember_past(io.past)
            motion_columns.describe_motion(io.past)
        if c.forecast.learned:
            mixture.mix_futures(io.mixture)
        elevation.bound_heights(io.heights)

    def _has_baseline(self) -> bool:
        return max(self.tree.leaf) >= codes.FIRST_BASELINE

    def _plan_by_baseline(self) -> None:
        """The local planners of the literature whose leaves are in the tree."""
        io, used = self.io, self.tree.leaf
        if codes.DYNAMIC_WINDOW in used:
            dynamic_window.plan_dynamic_window(io.dynamic_window)
        if codes.POTENTIAL_FIELD in used:
            potential_field.plan_potential_field(io.potential_field)
        if codes.VELOCITY_OBSTACLE in used:
            velocity_obstacle.plan_velocity_obstacle(io.velocity_obstacle)
        if codes.PATH_INTEGRAL in used:
            path_integral.plan_path_integral(io.path_integral)

    def _observe(self, obs: torch.Tensor) -> None:
        io, c = self.io, self.config.features
        features.sense_sectors(io.features)
        features.write_observation(io.features, obs)
        if c.n_track > 0:
            features.write_bodies(io.features, obs)
        if c.teacher:
            features.write_advice(io.features, obs)

    def reset(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Begin episode ``number`` of ``seed`` in the rows where ``mask`` is 1 (all int32, shape (n_env,)),
        up to the first observation."""
        io = self.io
        if self.planner is not None:
            self.planner.reset(mask)
        self.draw(mask, seed, number)
        dynamics.reset_vehicle(io.dynamics)
        actuation.reset_actuation(io.actuation)
        self._forget()
        reward.reset_reward(io.reward)
        episode.reset_referee(io.episode)
        self._perceive()
        episode.wake(io.episode)

    def _forget(self) -> None:
        """Empty readings and memory of the stack in the rows that are awake."""
        io = self.io
        proprioception.reset_proprioception(io.proprioception)
        if self.config.sensors.localization == "estimated":
            pose.reset_pose(io.pose)
        sonar.reset_sonar(io.sonar)
        depth.reset_depth(io.depth)
        tracking.reset_tracks(io.tracking)
        forecast.reset_forecast(io.forecast)
        if self.config.forecast.learned or self.config.forecast.keep_columns:
            motion_columns.reset_past(io.past)
        mapping.reset_map(io.mapping)
        if self.config.quiet.weight_seen > 0:
            exposure.reset_exposure(io.exposure)
        route.reset_route(io.route)
        leaves.reset_teacher(io.teacher)

    def begin_mission(self, mission: Mission) -> None:
        """Begin in row 0 alone, without a world: ``sensors`` delivers what is sensed there, ``step_mission``
        goes on. The other rows sleep."""
        mask, seed, number = torch.zeros(3, self.num_envs, dtype=torch.int32, device=self.device)
        mask[0], seed[0], number[0] = 1, mission.seed, mission.episode
        self.sleep()
        episode.begin_episodes(self.io.episode, mask, seed, number)
        for field, place in (
            (self.s.mission.start_w, mission.start),
            (self.s.mission.goal_w, mission.goal),
            (self.s.vehicle.pos_w, mission.start),
        ):
            places = self.rows(field)
            places[0] = place
            self._put(field, places)
        self._forget()
        self._perceive()
        episode.wake(self.io.episode)

    def step_mission(self) -> None:
        """One control step more of ``begin_mission``: perception to the tree's choice, nothing is moved."""
        episode.advance_clock(self.io.episode)
        self._perceive()

    def draw(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Draw the scenarios of a ``reset`` to look at them, and nothing more: no row is ready for a step."""
        episode.begin_episodes(self.io.episode, mask, seed, number)
        with self._stage("world"):
            scenarios.generate_scenarios(self.io.world)
            scenarios.move_obstacles(self.io.world)
        check_scenarios(self.rows(self.s.world.faults)[mask.cpu().numpy() == 1])

    def sleep_ended(self) -> None:
        """Put the rows whose episode has ended to sleep; they cost nothing until their next reset."""
        episode.sleep_ended(self.io.episode)

    def sleep(self) -> None:
        """Put every row to sleep, as in a new simulator."""
        self.s.clock.active.fill(0)
        self.s.clock.awake.fill(0)

    def _plan_seed(self, env: int) -> int:
        """Seed of the fallback planner's random numbers: a function of the episode's key and step alone."""
        return (int(self.s.episode.key[env]) + 0x9E3779B1 * int(self.s.clock.step[env])) & 0x7FFFFFFF

    # ----------------------------------------------------------------------------------------------- reading

    def rows(self, field: ti.Field, envs: list[int] | None = None) -> np.ndarray:
        """Host copy of these rows of a field alone, shape (len(envs), ...); None = all envs."""
        if self.device.type == "cpu":
            return self._memory.rows(field, slice(self.num_envs) if envs is None else envs)
        rows = self._every_row if envs is None else torch.tensor(envs, dtype=torch.int32, device=self.device)
        return copied_rows(field, rows)

    def read_into(self, field: ti.Field, out: torch.Tensor) -> None:
        """Copy a whole field into ``out`` on the device, without a wait or a copy through the host."""
        copy_rows(field, self._every_row, out)

    def memory(self) -> Memory:
        """Where every array lies, when all kernels are done: for a capture."""
        return Memory(self.s, self.s.clock.active, address_of(self.s.clock.active, self.device), self.device)

    def _stage(self, name: str) -> AbstractContextManager[None]:
        return timed_stage(name, self.stage_s)


def _recipe(config: Config, num_envs: int) -> bytes:
    """What another process builds the same kernels by (``other_end``)."""
    return f"{num_envs}\n{config.model_dump_json()}".encode()
