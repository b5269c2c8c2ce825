"""The simulator: allocates every struct and runs the stages in order. ``Sim.step`` is the page to read first.

Data goes one way: action -> actuation -> dynamics -> world -> termination check -> sensing -> pose ->
tracking -> mapping -> clearance -> planning -> behaviour tree -> observation -> reward. A pass works on the
rows whose ``clock.active`` is 1: all running rows in a step, only the rows being reset in a reset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np
import taichi as ti
import torch

from uuvtai.common.errors import DivergenceError
from uuvtai.compile.codegen import adopt
from uuvtai.compile.launch import Rows
from uuvtai.compile.memory import Memory, address_of
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config
from uuvtai.kernels.oracle import true_state
from uuvtai.kernels.perception import localization, mapping
from uuvtai.kernels.planning import clearance, observation, route
from uuvtai.kernels.sensors import proprioception
from uuvtai.kernels.task import episode, reward
from uuvtai.kernels.vehicle import control, dynamics, thruster_fault
from uuvtai.kernels.world import scenario
from uuvtai.sim import stack
from uuvtai.sim.behavior_tree import FlatTree, load_tree
from uuvtai.sim.rrt import RouteFallback, RoutePlanner
from uuvtai.sim.setup import (
    HostCounts,
    Scene,
    array_sizes,
    arrays_for,
    check_scenarios,
    check_size,
    fill_constants,
    set_scenes,
)
from uuvtai.sim.stack import SensorSource, SimulatedSensors
from uuvtai.sim.stages import timed_stage


class Sim:
    """Thousands of vehicles in their worlds, stepped together.

    ``action`` is a torch tensor (n_env, 4) in [-1, 1] on the simulator's device: the behaviour tree writes
    its choice there, the next ``step`` reads it; overwrite it to drive otherwise. ``observation`` is None
    until somebody asks by ``observe``. ``privileged`` (an oracle): the tracks of moving obstacles are the
    truth. ``planner``: plans the routes on the host in place of the simulator's own planners; None: nobody.
    ``sensors``: fills what the stack senses, in a new simulator its own kernels.
    """

    def __init__(self, config: Config, num_envs: int, tree: FlatTree, device: str = "cpu") -> None:
        """Raises ValueError or MemoryError for sizes that cannot work, RuntimeError for a missing device."""
        self.config, self.num_envs = config, num_envs
        self.device = torch.device(start_taichi(device).device)
        check_size(config, num_envs, self.device.type)
        self._arrays = arrays_for(config, array_sizes(config, num_envs, self.device.type), self.device)
        self.s, self.io, self._memory = self._arrays.s, self._arrays.io, self._arrays.memory
        self.action = torch.zeros(num_envs, 4, device=self.device)
        self.reward = torch.zeros(num_envs, device=self.device)
        whole = torch.zeros(5, num_envs, dtype=torch.int32, device=self.device)
        self.terminated, self.truncated, *self._asked = whole
        self.observation: torch.Tensor | None = None
        self.fallback = RouteFallback(config)
        self.planner: RoutePlanner | None = None
        self.sensors: SensorSource = SimulatedSensors(config.sensors)
        self.stage_s: dict[str, float] | None = None
        self.privileged = False
        self.put = self._memory.put
        self._speeds = self._memory.live(self.s.vehicle.vel_b) if self.device.type == "cpu" else None
        self.counts = HostCounts(self._memory, self.s.termination.outcome, num_envs)
        self._rows = Rows() if config.runtime.native and self.device.type == "cpu" else None
        if self._rows:
            adopt(vars(self.io).values(), self._memory, self._recipe, alone=num_envs == 1)
        self.use_tree(tree)
        self.set_scenes()
        fill_constants(self.s, config, self.put)

    def use_tree(self, tree: FlatTree) -> None:
        """Drive by another behaviour tree from the next tick on: nothing is compiled again."""
        self.tree = tree
        load_tree(self.s.table, tree, self.put)
        stack.clear_baselines(self.s.baselines, tree.leaf, self.put)

    def set_scenes(self, scenes: Sequence[Scene] = ()) -> None:
        """Deal (S, D, v) to the envs' next scenarios; none: the world's own. ValueError: too few slots."""
        set_scenes(self.s.scene, self.config.world, scenes, self.put)

    def observe(self) -> torch.Tensor:
        """(n_env, n_obs), from the next pass on written for every active row (``observation.columns``)."""
        if self.observation is None:
            width = observation.observation_width(self.config.observation)
            self.observation = torch.zeros(self.num_envs, width, device=self.device)
        return self.observation

    def step(self, action: torch.Tensor | None = None) -> None:
        """One control step of every running env, driven by ``action`` (default: what the tree chose)."""
        if action is not None:
            self.action.copy_(action)
        self._launched(self._move)
        if self._speeds is not None and not math.isfinite(np.add.reduce(self._speeds, axis=None)):
            bad = np.flatnonzero(~np.isfinite(self.rows(self.s.vehicle.vel_b)).all(axis=1))
            raise DivergenceError(
                f"the motion of {len(bad)} of {self.num_envs} vehicles diverged, first that of env {bad[0]}: "
                "inertia, damping and gains of this vehicle do not belong together, or take more "
                "episode.substeps; look at it alone: uuv simulate --vehicle ..."
            )
        self.perceive()
        with self._stage("reward"):
            reward.compute_reward(self.io.reward, self.reward, self.terminated, self.truncated)

    def _move(self) -> None:
        io, c, rules = self.io, self.config, self.config.episode
        with self._stage("dynamics"):
            if thruster_fault.is_watched(c.vehicle, c.actuation):
                thruster_fault.watch_thrusters(io.thrusters)
            control.command_thrusters(io.actuation, self.action)
            dynamics.move_vehicle(io.dynamics, rules.control_dt_s, rules.substeps)
        with self._stage("world"):
            episode.advance_clock(io.episode)
            scenario.move_obstacles(io.world)
            episode.check_termination(io.episode)

    def perceive(self) -> None:
        """Sensing to behaviour tree for the rows that are active.

        Behind ``sensors`` only oracles read the truth, and only the fallback planner draws random numbers
        by the episode's key (``_plan_seed``): the same readings give the same commands
        (``uuvtai.vehicle.onboard``).
        """
        self._perceive(self._act)

    def _perceive(self, act: Callable[[], None]) -> None:
        if type(self.sensors) is SimulatedSensors:
            self._launched(self._look)
        else:  # a vehicle's do more than launch
            self._sense()
            self._launched(self._see)
        with self._stage("planning"):
            self.fallback.serve(self.io, self._plan_seed, self.rows, self.counts.number, self.planner)
        self._launched(act)

    def _look(self) -> None:
        self._sense()
        self._see()

    def _sense(self) -> None:
        io, c = self.io, self.config
        with self._stage("proprioception"):
            self.sensors.sense_motion(io)
            if self.sensors.loses_velocity:
                proprioception.find_velocity(io.velocity)
        estimated = c.sensors.localization == "estimated"
        if estimated:
            with self._stage("localization"):
                localization.predict_pose(io.localization)
        with self._stage("sonar"):
            self.sensors.sense_sonar(io)
            stack.recall(io, c)
        if estimated and c.localization.use_walls:
            with self._stage("localization"):
                localization.correct_pose(io.localization)
        with self._stage("depth"):
            self.sensors.sense_depth(io)

    def _see(self) -> None:
        io, c = self.io, self.config
        with self._stage("tracking"):
            stack.track(io, c, self.privileged)
        with self._stage("mapping"):
            mapping.update_map(io.mapping)
        with self._stage("clearance"):
            clearance.compute_clearance(io.clearance)
        with self._stage("planning"):
            stack.plan(io, c, self.planner is None)

    def _act(self) -> None:
        io, c = self.io, self.config
        with self._stage("planning"):
            route.follow_route(io.route)
        with self._stage("behavior"):
            stack.choose(io, self.tree.leaf, self.action)
        if self.observation is not None:
            with self._stage("observation"):
                stack.observe(io, c.observation, self.observation)

    def _launched(self, work: Callable[[], None]) -> None:
        """Do ``work``, which is nothing but launches; by what they are launched on they are known again."""
        on = self.io, self.config, self.tree, self.action, self.observation, self.privileged, self.sensors
        if self._rows is None or self.stage_s is not None:
            work()
        else:
            self._rows.play(work, (*on, self.planner is None))

    def reset(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Begin episode ``number`` of ``seed`` where ``mask`` is 1 (int32, (n_env,)), and look around."""
        if self.planner is not None:
            self.planner.reset(mask)
        self._draw(self._begin_anew, mask, seed, number)
        self._perceive(self._act_and_wake)

    def _act_and_wake(self) -> None:
        self._act()
        episode.wake(self.io.episode)

    def _begin_anew(self) -> None:
        self._begin()
        io = self.io
        dynamics.reset_vehicle(io.dynamics)
        control.reset_actuation(io.actuation)
        stack.forget(io, self.config)
        reward.reset_reward(io.reward)
        episode.reset_termination(io.episode)

    def draw(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """Draw the scenarios of a ``reset`` to look at them, and nothing more: no row is ready for a step."""
        self._draw(self._begin, mask, seed, number)

    def draw_routes(self, mask: torch.Tensor, seed: torch.Tensor, number: torch.Tensor) -> None:
        """As ``draw``, with the route of each vehicle that knows where everything is that does not move."""
        self._draw(self._begin_anew, mask, seed, number)
        self.sensors.sense_motion(self.io)
        true_state.stamp_static(self.io.true_map)
        clearance.compute_clearance(self.io.clearance)
        stack.plan(self.io, self.config, by_voronoi=True)
        self.fallback.serve(self.io, self._plan_seed, self.rows, self.counts.number)

    def _draw(self, begin: Callable[[], None], *asked: torch.Tensor) -> None:
        for kept, given in zip(self._asked, asked, strict=True):
            kept.copy_(given)
        self._launched(begin)
        if self.counts.has_any(self.s.world.faults):
            check_scenarios(self.rows(self.s.world.faults)[asked[0].cpu().numpy() == 1])

    def _begin(self) -> None:
        episode.begin_episodes(self.io.episode, *self._asked)
        with self._stage("world"):
            scenario.generate_scenarios(self.io.world)
            scenario.move_obstacles(self.io.world)

    def deactivate_ended(self) -> None:
        """Put the rows whose episode has ended to sleep; they cost nothing until their next reset."""
        episode.deactivate_ended(self.io.episode)

    def sleep(self) -> None:
        """Put every row to sleep, as in a new simulator."""
        self.s.clock.running.fill(0)
        self.s.clock.active.fill(0)

    def _plan_seed(self, env: int) -> int:
        """Seed of the fallback planner's random numbers: a function of the episode's key and step alone."""
        return (int(self.s.episode.key[env]) + 0x9E3779B1 * int(self.s.clock.step[env])) & 0x7FFFFFFF

    def rows(self, field: ti.Field, envs: list[int] | None = None) -> np.ndarray:
        """Host copy of these rows of a field alone, shape (len(envs), ...); None = all envs."""
        return self.counts.rows(field, envs)

    def close(self) -> None:
        """Give the memory back; nothing of the simulator can be used afterwards but ``config``."""
        arrays, config = self._arrays, self.config
        vars(self).clear()
        self.config = config
        arrays.give_back()

    def memory(self) -> Memory:
        """Where every array lies, when all kernels are done: for a capture."""
        return Memory(
            self.s, self.s.clock.running, address_of(self.s.clock.running, self.device), self.device
        )

    def _stage(self, name: str) -> AbstractContextManager[None]:
        return timed_stage(name, self.stage_s)

    def _recipe(self) -> bytes:
        """What another process builds the same kernels by (``other_end``)."""
        return f"{self.num_envs}\n{self.config.model_dump_json(include=set(Config.model_fields))}".encode()
