"""The simulator: allocates every struct and runs the stages in order. ``Sim.step`` is the page to read first.

Data goes one way: action -> actuation -> dynamics -> world -> referee -> sensing -> tracking -> mapping -> clearance -> planning ->
features -> teacher -> reward. A pass works on the rows whose ``clock.awake`` is 1: all running rows in a step, only the rows being reset
in a reset.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
import taichi as ti
import torch

from uuvtai import state
from uuvtai.allocation import allocation_matrices
from uuvtai.bounds import load_bounds
from uuvtai.capture import Memory
from uuvtai.config import Config
from uuvtai.kernels.core.grid import outside_cells
from uuvtai.kernels.core.rows import copy_rows, tell_address
from uuvtai.kernels.perception import debug_stamp, debug_tracks, elevation, forecast, look, mapping, spotting, tracking
from uuvtai.kernels.planning import clearance, features, route, triggers, voronoi
from uuvtai.kernels.sensors import depth, proprioception, sonar
from uuvtai.kernels.task import episode, reward
from uuvtai.kernels.teacher.teacher import evasion, teacher, threats
from uuvtai.kernels.vehicle import actuation, dynamics
from uuvtai.kernels.world.world import world
from uuvtai.rrt import RouteFallback
from uuvtai.runtime import start_taichi
from uuvtai.scenario import Scene, check_scenarios, load_fixed, set_scenes
from uuvtai.sizes import array_sizes, check_size
from uuvtai.tree import FlatTree, load_tree

STAGES = (
    "dynamics",
    "world",
    "proprioception",
    "sonar",
    "depth",
    "tracking",
    "mapping",
    "clearance",
    "planning",
    "features",
    "teacher",
    "reward",
)


@dataclass(frozen=True)
class SimState:
    """Every struct of the simulator, by the noun of its stage."""

    clock: state.ClockState
    episode: state.EpisodeState
    vehicle: state.VehicleState
    params: state.VehicleParams
    actuation: state.ActuationState
    allocation: state.Allocation
    current: state.CurrentState
    scene: state.SceneState
    world: state.WorldState
    path: state.PathState
    fixed: state.FixedTable
    scratch: state.ScenarioScratch
    mission: state.MissionState
    referee: state.RefereeState
    ego: state.Proprioception
    ego_memory: state.ProprioceptionMemory
    scan: state.SonarScan
    sonar_memory: state.SonarMemory
    image: state.DepthImage
    tracks: state.TrackState
    clusters: state.ClusterState
    spots: state.SpotState
    habits: state.HabitState
    forecast: state.ForecastState
    mask: state.GridMask
    grid_map: state.MapState
    map_scratch: state.MapScratch
    clearance: state.ClearanceState
    clearance_memory: state.ClearanceMemory
    voronoi: state.VoronoiState
    route: state.RouteState
    features: state.FeatureState
    teacher: state.TeacherState
    table: state.TreeTable
    reward: state.RewardState


class Sim:
    """Thousands of vehicles in their worlds, stepped together.

    ``action`` is a torch tensor (n_env, 4) in [-1, 1] on the simulator's device: the behaviour tree writes its choice there, the next
    ``step`` reads it; overwrite it to drive otherwise. ``observation`` is None until somebody asks by ``observe``. While ``privileged`` is
    on (a yardstick, off in a new simulator), the tracks of moving bodies are the truth.
    """

    def __init__(self, config: Config, num_envs: int, tree: FlatTree, device: str = "cpu") -> None:
        """Raises ValueError or MemoryError for sizes that cannot work, RuntimeError for a missing device."""
        self.config, self.num_envs = config, num_envs
        runtime = start_taichi(device)
        self.device = torch.device(runtime.device)
        check_size(config, num_envs, runtime.device)
        sizes = array_sizes(config, num_envs, runtime.device)
        self.s = SimState(**{f.name: state.allocate(getattr(state, str(f.type).rpartition(".")[2]), sizes) for f in fields(SimState)})
        self.action = torch.zeros(num_envs, 4, device=self.device)
        self.reward = torch.zeros(num_envs, device=self.device)
        self.terminated = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
        self.truncated = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
        self.observation: torch.Tensor | None = None
        self._every_row = torch.arange(num_envs, dtype=torch.int32, device=self.device)
        self.fallback = RouteFallback(config)
        self.stage_s: dict[str, float] | None = None
        self.privileged = False
        self._put = self.memory().put
        self.use_tree(tree)
        self._fill_constants()

    # ------------------------------------------------------------------------------------------------------------ set-up

    def use_tree(self, tree: FlatTree) -> None:
        """Drive by another behaviour tree from the next tick on (trees are data: nothing is compiled again)."""
        self.tree = tree
        load_tree(self.s.table, tree, self._put)

    def set_scenes(self, scenes: Sequence[Scene] = ()) -> None:
        """Deal (S, D, v) out to the envs in turn, for their next scenarios; none = the world's own. ValueError where slots are too few."""
        world = self.config.world
        set_scenes(self.s.scene, world, scenes or [(world.n_static, world.n_dynamic, world.dynamic_speed_m_s)], self._put)

    def observe(self) -> torch.Tensor:
        """From the next pass on, write every awake row's observation into the tensor returned, (n_env, n_obs) (``features.columns``)."""
        if self.observation is None:
            width = features.observation_width(self.config.features)
            self.observation = torch.zeros(self.num_envs, width, device=self.device)
        return self.observation

    def _fill_constants(self) -> None:
        world_cfg = self.config.world
        self.set_scenes()
        load_fixed(self.s.fixed, world_cfg)
        outside = outside_cells(world_cfg.tank, self.config.mapping.cell_m)
        load_bounds(self.s.mask, np.array(outside), self._put)
        wrench_of_thrust, thrust_of_wrench = allocation_matrices(self.config.vehicle)
        self._put(self.s.allocation.wrench_of_thrust, wrench_of_thrust.astype(np.float32))
        self._put(self.s.allocation.thrust_of_wrench, thrust_of_wrench.astype(np.float32))

    # -------------------------------------------------------------------------------------------------------------- step

    def step(self, action: torch.Tensor | None = None) -> None:
        """One control step of every running env, driven by ``action`` (default: what the tree chose)."""
        if action is not None:
            self.action.copy_(action)
        self._move()
        self._perceive()
        self._reward()

    def reset(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Begin episode ``number`` of ``seed`` in the rows where ``mask`` is 1 (all int32, shape (n_env,)), up to the first observation."""
        c, s = self.config, self.s
        self.draw(mask, seed, number)
        dynamics.reset_vehicle(s.vehicle, s.params, s.current, s.mission, s.episode, s.clock, c.vehicle, c.disturbance, c.episode)
        actuation.reset_actuation(s.actuation, s.clock)
        proprioception.reset_proprioception(s.ego, s.ego_memory, s.vehicle, s.episode, s.clock, c.sensors)
        sonar.reset_sonar(s.scan, s.sonar_memory, s.clock)
        depth.reset_depth(s.image, s.clock)
        tracking.reset_tracks(s.tracks, s.clusters, s.clock)
        forecast.reset_forecast(s.forecast, s.habits, s.clock)
        mapping.reset_map(s.grid_map, s.clock)
        route.reset_route(s.route, s.clock)
        teacher.reset_teacher(s.teacher, s.clock)
        reward.reset_reward(s.reward, s.clock)
        episode.reset_referee(s.referee, s.clock, s.vehicle, s.world, c.vehicle, c.world.tank, c.episode)
        self._perceive()
        episode.wake(s.clock)

    def draw(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Draw the scenarios of a ``reset`` and nothing more: to look at them; their rows are not ready to be stepped."""
        c, s = self.config, self.s
        episode.begin_episodes(mask, seed, number, s.clock, s.episode)
        with self._stage("world"):
            world.generate_scenarios(s.world, s.path, s.mission, s.scratch, s.scene, s.fixed, s.episode, s.clock, c.world)
            world.move_obstacles(s.world, s.path, s.clock, c.episode)
        check_scenarios(self.rows(s.world.faults)[mask.cpu().numpy() == 1])

    def sleep_ended(self) -> None:
        """Put the rows whose episode has ended to sleep; they cost nothing until their next reset."""
        episode.sleep_ended(self.s.clock, self.s.referee)

    def sleep(self) -> None:
        """Put every row to sleep, as in a new simulator."""
        self.s.clock.active.fill(0)
        self.s.clock.awake.fill(0)

    def _move(self) -> None:
        c, s = self.config, self.s
        with self._stage("dynamics"):
            actuation.command_thrusters(self.action, s.actuation, s.params, s.allocation, s.ego, s.clock, c.vehicle, c.actuation, c.episode)
            dynamics.move_vehicle(
                s.vehicle,
                s.actuation,
                s.current,
                s.params,
                s.allocation,
                s.episode,
                s.clock,
                c.vehicle,
                c.actuation,
                c.disturbance,
                c.episode.control_dt_s,
                c.episode.substeps,
            )
        with self._stage("world"):
            episode.advance_clock(s.clock)
            world.move_obstacles(s.world, s.path, s.clock, c.episode)
            episode.judge(s.referee, s.clock, s.vehicle, s.world, s.mission, c.vehicle, c.world.tank, c.episode)

    def _perceive(self) -> None:
        """Sensing to teacher for the rows that are awake."""
        c, s = self.config, self.s
        with self._stage("proprioception"):
            proprioception.sense_proprioception(s.ego, s.ego_memory, s.vehicle, s.episode, s.clock, c.sensors, c.vehicle, c.episode)
        with self._stage("sonar"):
            sonar.cast_sonar(
                s.scan, s.sonar_memory, s.ego, s.vehicle, s.world, s.episode, s.clock, c.sensors.sonar, c.world.tank, c.episode
            )
        with self._stage("depth"):
            depth.cast_depth(s.image, s.ego, s.vehicle, s.world, s.episode, s.clock, c.sensors.depth, c.world.tank)
        with self._stage("tracking"):
            self._track()
        with self._stage("mapping"):
            mapping.update_map(
                s.grid_map,
                s.map_scratch,
                s.scan,
                s.image,
                s.tracks,
                s.clusters,
                s.mask,
                s.clock,
                c.mapping,
                c.sensors.sonar,
                c.sensors.depth,
                c.world.tank,
                c.episode,
            )
            if c.mapping.stamp > 0:
                debug_stamp.stamp_truth(s.grid_map, s.world, s.clock, c.mapping, c.world.tank)
        with self._stage("clearance"):
            clearance.compute_clearance(s.clearance, s.clearance_memory, s.grid_map, s.mask, s.clock, c.clearance, c.mapping, c.voronoi)
        with self._stage("features"):
            features.sense_sectors(s.features, s.scan, s.ego, s.clock, c.features, c.sensors.sonar)
        with self._stage("planning"):
            self._plan()
        with self._stage("teacher"):
            self._teach()
        if self.observation is not None:
            with self._stage("features"):
                self._observe(self.observation)

    def _track(self) -> None:
        """Moving bodies: where they are, how they turn, where they will be, how high they are."""
        c, s = self.config, self.s
        if self.privileged:
            debug_tracks.take_true_tracks(
                s.tracks, s.clusters, s.world, s.path, s.ego, s.scan, s.clock, c.elevation, c.sensors.sonar, c.world.tank, c.episode
            )
        else:
            self._sense_bodies()
        forecast.learn_habits(s.habits, s.tracks, s.clusters, s.clock, c.forecast, c.episode)
        forecast.forecast_tracks(
            s.forecast, s.tracks, s.habits, s.clusters, s.image, s.clock, c.forecast, c.tracking, c.world.tank, c.episode
        )
        elevation.bound_heights(s.forecast, s.tracks, s.ego, s.clock, c.elevation, c.world.tank)

    def _sense_bodies(self) -> None:
        """Tracks by the sonar, and by the camera where the fan misses them or does not show their height."""
        c, s = self.config, self.s
        tracking.track_bodies(
            s.tracks,
            s.clusters,
            s.habits,
            s.scan,
            s.clock,
            c.tracking,
            c.forecast,
            c.elevation,
            c.sensors.sonar,
            c.world.tank,
            c.episode,
        )
        if c.spotting.use_camera:
            spotting.scan_columns(s.spots, s.image, s.clock, c.spotting, c.sensors.depth, c.world.tank)
            spotting.follow_spots(
                s.tracks,
                s.spots,
                s.image,
                s.scan,
                s.clock,
                c.spotting,
                c.sensors.depth,
                c.sensors.sonar,
                c.elevation,
                c.tracking,
                c.episode,
            )
        if c.elevation.use_camera:
            look.look_at_bodies(s.tracks, s.image, s.clock, c.elevation, c.sensors.depth, c.world.tank, c.episode)

    def _observe(self, obs: torch.Tensor) -> None:
        c, s = self.config, self.s
        features.write_observation(obs, s.features, s.route, s.ego, s.mission, s.clock, c.features)
        if c.features.n_track > 0:
            features.write_bodies(
                obs, s.features, s.forecast, s.tracks, s.ego, s.clock, c.features, c.forecast, c.tracking, c.world.tank, c.episode
            )
        if c.features.teacher:
            features.write_advice(obs, s.teacher, s.table, s.clock, c.features)

    def _plan(self) -> None:
        c, s = self.config, self.s
        tank = c.world.tank
        triggers.fire_triggers(
            s.route,
            s.clearance,
            s.grid_map,
            s.mask,
            s.forecast,
            s.scan,
            s.ego,
            s.mission,
            s.clock,
            c.route,
            c.voronoi,
            c.tracking,
            c.mapping,
            tank,
            c.episode,
        )
        voronoi.plan_routes(
            s.voronoi,
            s.route,
            s.clearance,
            s.grid_map,
            s.mask,
            s.mission,
            s.ego,
            s.forecast,
            s.clock,
            c.voronoi,
            c.route,
            c.clearance,
            c.mapping,
            tank,
        )
        self.fallback.serve(s.route, s.clearance, s.grid_map, s.mask, s.forecast, s.mission, s.ego, s.clock, self._plan_seed)
        route.follow_route(s.route, s.clearance, s.grid_map, s.ego, s.mission, s.clock, c.route, c.clearance, c.mapping, tank)

    def _plan_seed(self, env: int) -> int:
        """Seed of the fallback planner's random numbers: a function of the episode's key and step alone."""
        return (int(self.s.episode.key[env]) + 0x9E3779B1 * int(self.s.clock.step[env])) & 0x7FFFFFFF

    def _teach(self) -> None:
        c, s = self.config, self.s
        threats.assess_threats(
            s.teacher,
            s.route,
            s.forecast,
            s.scan,
            s.clearance,
            s.ego,
            s.mission,
            s.clock,
            c.teacher,
            c.vehicle,
            c.tracking,
            c.world.tank,
            c.mapping,
            c.episode,
        )
        evasion.plan_evasion(s.teacher, s.forecast, s.clearance, s.ego, s.clock, c.teacher, c.vehicle, c.tracking, c.world.tank, c.mapping)
        teacher.tick_tree(
            s.teacher, self.action, s.table, s.route, s.ego, s.mission, s.clock, c.teacher, c.vehicle, c.world.tank, c.episode
        )

    def _reward(self) -> None:
        c, s = self.config, self.s
        with self._stage("reward"):
            reward.compute_reward(
                self.reward,
                self.terminated,
                self.truncated,
                s.reward,
                s.referee,
                s.vehicle,
                s.route,
                s.actuation,
                s.clock,
                c.reward,
                c.vehicle,
                c.episode,
            )

    # ------------------------------------------------------------------------------------------------------ observation

    def rows(self, field: ti.Field, envs: list[int] | None = None) -> np.ndarray:
        """Host copy of a field's rows, shape (len(envs), ...) (default: all envs); only these rows are copied."""
        chosen = self._every_row if envs is None else torch.tensor(envs, dtype=torch.int32, device=self.device)
        inner = (field.n,) if hasattr(field, "n") else ()
        out = torch.empty((len(chosen), *field.shape[1:], *inner), dtype=_TORCH_DTYPE[field.dtype], device=self.device)
        copy_rows(field, chosen, out)
        return out.cpu().numpy()

    def read_into(self, field: ti.Field, out: torch.Tensor) -> None:
        """Copy a whole field into ``out`` on the device, without a wait or a copy through the host."""
        copy_rows(field, self._every_row, out)

    def tell_step(
        self,
        terms: torch.Tensor,
        episode_terms: torch.Tensor,
        episode_return: torch.Tensor,
        episode_steps: torch.Tensor,
        outcome: torch.Tensor,
    ) -> None:
        """Write how the step went into the caller's tensors: float32 (n_env, n_term) twice, float32 (n_env,), int32 (n_env,) twice."""
        s = self.s
        reward.tell_step(terms, episode_terms, episode_return, episode_steps, outcome, s.reward, s.referee, s.clock)

    def memory(self) -> Memory:
        """Where every array lies, when all kernels are done: for a capture."""
        anchor, address = self.s.clock.active, torch.zeros(1, dtype=torch.int64, device=self.device)
        tell_address(anchor, address)
        ti.sync()
        return Memory(self.s, anchor, int(address[0]), self.device)

    @contextlib.contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Time a stage when somebody asked for it (``stage_s`` is a dict); costs nothing otherwise."""
        if self.stage_s is None:
            yield
            return
        ti.sync()
        begin = time.perf_counter()
        yield
        ti.sync()
        self.stage_s[name] = self.stage_s.get(name, 0.0) + time.perf_counter() - begin


_TORCH_DTYPE = {
    ti.f32: torch.float32,
    ti.i32: torch.int32,
    ti.i16: torch.int16,
    ti.u8: torch.uint8,
    ti.i8: torch.int8,
    ti.u32: torch.uint32,
}
