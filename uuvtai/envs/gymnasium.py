"""Gymnasium's interfaces: the batch ``UuvVectorEnv`` and the single env ``uuvtai/Nav-v0``, registered when
this is imported.

``gymnasium.make("uuvtai.envs.gymnasium:uuvtai/Nav-v0")`` imports it by itself; Gymnasium reads no
entry points from 1.0 on.
"""

from __future__ import annotations

import operator
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from uuvtai.common.enums import SUCCESS, occupancy
from uuvtai.common.obstacle_motion import describe_scenario
from uuvtai.config import Config
from uuvtai.config.loader import load_config
from uuvtai.envs.vector_env import NUM_ACTIONS, ObservationColumn, VectorEnv, checked_seed
from uuvtai.kernels.core.grid import grid_origin
from uuvtai.logs import drawing
from uuvtai.logs.scenario import scenario_document
from uuvtai.logs.topics.motion import angles_of
from uuvtai.logs.topics.perception import Layer
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.sim import Sim

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    if error.name != "gymnasium":
        raise
    raise ModuleNotFoundError(
        "uuvtai.envs.gymnasium needs Gymnasium; install it with: pip install 'uuvtai[gym]'", name="gymnasium"
    ) from None

__all__ = ["ENV_ID", "UuvEnv", "UuvVectorEnv"]


# ---- Spaces of actions and observations, with bounds where the simulator keeps them.


def action_space() -> spaces.Box:
    """Surge, sway, heave, yaw rate in parts of the vehicle's limits."""
    return spaces.Box(-1.0, 1.0, (NUM_ACTIONS,), np.float32)


def observation_space(table: tuple[ObservationColumn, ...], config: Config) -> spaces.Box:
    """Float32 box (n_obs,) in the units of ``table``; what noise or drift may carry anywhere is unbounded."""
    known = bounds(config)
    low, high = (np.full(table[-1].slice.stop, value, np.float32) for value in (-np.inf, np.inf))
    for column in table:
        low[column.slice], high[column.slice] = known.get(column.name, (-np.inf, np.inf))
    return spaces.Box(low, high, dtype=np.float32)


def bounds(config: Config) -> dict[str, tuple[float, float]]:
    """(low, high) of the columns that cannot leave them, by name."""
    ttc_s = config.observation.ttc_cap_s
    return {
        "heading_error": (-1.0, 1.0),
        "sector_range": (0.0, config.sensors.sonar.max_range_m),
        "sector_ttc": (0.0, ttc_s),
        "path_risk": (0.0, np.inf),
        "obstacle_valid": (0.0, 1.0),
        "obstacle_age": (0.0, np.inf),
        "obstacle_closest_time": (0.0, np.inf),
        "behavior_conflict": (0.0, ttc_s),
        "behavior_class": (0.0, 1.0),
    }


# ---- Seeds as Gymnasium means them, as seeds of our episodes.

_SEEDS = 2**31


def episode_seed(env: gymnasium.Env | gymnasium.vector.VectorEnv, seed: Any) -> int | None:
    """Seed whose episodes ``env`` is to begin with; None = go on with the episodes that follow.

    An int is that seed, folded as ``uuvtai.make`` does. None goes on where the env has been seeded, and draws
    a seed where it has not. The env's generator is seeded along. Raises TypeError or ValueError for what is
    no seed; lists are refused, since env i runs episode i of one seed.
    """
    if seed is not None:
        given = _integer(seed)
        number = checked_seed(given)
        env._np_random, env._np_random_seed = seeding.np_random(given)
        return number
    if env._np_random_seed is not None:
        return None
    return int(env.np_random.integers(_SEEDS))


def _integer(seed: Any) -> int:
    try:
        return operator.index(seed)
    except TypeError:
        message = (
            f"seed must be an int or None, got a {type(seed).__name__}; one seed serves all envs: env i "
            "begins at its episode i"
        )
        raise TypeError(message) from None


# ---- The simulator behind an env of this package.


def simulator(
    world: str,
    num_envs: int,
    sensors: str | None,
    vehicle: str | None,
    overrides: dict[str, Any] | None,
    device: str,
    teacher: str,
) -> Sim:
    """A new simulator; arguments and errors are those of ``uuvtai.make``."""
    if type(num_envs) is not int:
        raise TypeError(f"num_envs must be an int, got {num_envs!r}")
    config = load_config(world, sensors, vehicle, overrides)
    return Sim(config, num_envs, read_tree(teacher), device)


# ---- One decision: an action held for one or several control steps.


class Transition(NamedTuple):
    """What came of a decision in every env. ``obs`` and ``info`` are the simulator's memory: the next step or
    reset writes there."""

    obs: torch.Tensor
    reward: torch.Tensor
    """sum over the control steps"""
    terminated: torch.Tensor
    truncated: torch.Tensor
    info: dict[str, torch.Tensor]


def checked_hold_steps(hold_steps: int) -> int:
    """The number itself; ValueError where an action cannot be held for so many steps."""
    if type(hold_steps) is not int or hold_steps < 1:
        raise ValueError(f"hold_steps must be a whole number of at least 1 control step, got {hold_steps!r}")
    return hold_steps


def carry_out(env: VectorEnv, action: torch.Tensor, hold_steps: int) -> Transition:
    """Hold ``action`` (n_env, 4); rows whose episode ends on the way rest from there on and earn no more
    (``autoreset`` is off)."""
    obs, reward, terminated, truncated, info = env.step(action)
    total = reward.clone()
    for _ in range(hold_steps - 1):
        obs, reward, terminated, truncated, info = env.step(action)
        total += reward
    return Transition(obs, total, terminated.clone(), truncated.clone(), info)


def public_info(info: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """What an env of this package tells in its info, each (n_env, ...), in the simulator's memory.

    The number of the episode is not called "episode", which wrappers of Gymnasium and trainers keep for their
    statistics.
    """
    out = {
        name: info[name]
        for name in ("teacher_action", "seed", "outcome", "episode_return", "episode_steps", "episode_terms")
    }
    return out | {"episode_number": info["episode"], "is_success": info["outcome"] == SUCCESS}


# ---- ``gymnasium.vector.VectorEnv`` on top of the batched environment: three autoreset modes, results as
# NumPy arrays or torch tensors.

BACKENDS = ("numpy", "torch")


class UuvVectorEnv(gymnasium.vector.VectorEnv):
    """``num_envs`` vehicles in their worlds; env i runs the episodes i, i + num_envs, i + 2 num_envs, ... of
    the seed.

    Observations are float32 (num_envs, n_obs) in raw SI units (``native.observation_table`` names the
    columns), actions float32 (num_envs, 4): surge, sway, heave, yaw rate in parts of the vehicle's limits.
    Every result is in memory of its own: no later call writes into it. Who wants tensors without copies takes
    ``uuvtai.make`` or ``native``.

    Episodes end as ``metadata["autoreset_mode"]`` says. SAME_STEP: an env that ends begins its next episode
    in the same step, its last observation and info are ``info["final_obs"]`` and ``info["final_info"]`` where
    ``info["_final_obs"]``. NEXT_STEP: the step after the last one ignores the action and begins the episode
    with reward 0. DISABLED: the user does, by ``reset(options={"reset_mask": mask})``.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(
        self,
        world: str = "pool",
        num_envs: int = 64,
        *,
        sensors: str | None = None,
        vehicle: str | None = None,
        overrides: dict[str, Any] | None = None,
        device: str = "cpu",
        teacher: str = "bt",
        hold_steps: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        backend: str = "numpy",
        sim: Sim | None = None,
    ) -> None:
        """World to teacher as in ``uuvtai.make``, with its errors; ``sim`` = a simulator that is there
        already, with its own of these.

        ``hold_steps``: control steps (0.02 s) that an action is held for, one step to the user; ``backend``:
        'numpy' or 'torch' results. ValueError for modes and backends that do not exist.
        """
        if backend not in BACKENDS:
            raise ValueError(f"backend {backend!r} does not exist; there are: {', '.join(BACKENDS)}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}  # type: ignore[misc]
        self.backend, self.hold_steps = backend, checked_hold_steps(hold_steps)
        owns_sim = sim is None
        sim = sim or simulator(world, num_envs, sensors, vehicle, overrides, device, teacher)
        self.native = VectorEnv(sim, autoreset=False, owns_sim=owns_sim)
        self.num_envs, self.device = sim.num_envs, sim.device
        self.single_observation_space = observation_space(self.native.observation_table, sim.config)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._ended = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every env, or where ``options["reset_mask"]`` (num_envs,) is true; (obs, info).

        With an int ``seed``, env i begins at episode i of it; with None each goes on with its next episode,
        the first time of a random seed. Raises TypeError or ValueError for other seeds (lists too), options
        and masks.
        """
        rows = self._rows(options)
        obs, info = self.native.reset(episode_seed(self, seed), rows)
        self._ended = self._ended & ~rows
        return self._given(obs), self._info(public_info(info), rows)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Hold ``actions`` (num_envs, 4), NumPy or torch, for ``hold_steps``: (obs, reward, terminated,
        truncated, info).

        info holds arrays (num_envs, ...) with their masks: ``outcome`` (index into ``native.outcomes``),
        ``is_success``, ``episode_return``, ``episode_steps`` (control steps), ``episode_terms`` (sums by
        ``native.reward_terms``), ``seed``, ``episode_number`` and ``teacher_action`` (what the behaviour tree
        would do now). Raises RuntimeError before the first reset, after close, and in mode DISABLED while an
        env that has ended is not reset; ValueError or TypeError for unfit actions.
        """
        self._refuse_ended()
        action = torch.as_tensor(actions, dtype=torch.float32, device=self.device)
        obs, reward, terminated, truncated, info = carry_out(self.native, action, self.hold_steps)
        ended, final = terminated | truncated, {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and bool(ended.any()):
            final = self._final(obs, info, ended)
            obs, info = self.native.reset(mask=ended)
        elif self.autoreset_mode is AutoresetMode.NEXT_STEP and bool(self._ended.any()):
            obs, info = self.native.reset(mask=self._ended)
            terminated, truncated = terminated & ~self._ended, truncated & ~self._ended
        self._ended = (terminated | truncated) & (self.autoreset_mode is not AutoresetMode.SAME_STEP)
        everyone = torch.ones_like(ended)
        results = (self._given(value) for value in (obs, reward, terminated, truncated))
        return *results, self._info(public_info(info), everyone) | final  # type: ignore[return-value]

    def close_extras(self, **_kwargs: Any) -> None:
        """Let go of the simulator."""
        self.native.close()

    def _final(self, obs: torch.Tensor, info: dict[str, torch.Tensor], ended: torch.Tensor) -> dict[str, Any]:
        """Last observation and info of the rows that ended; as objects, None elsewhere, where Gymnasium's own
        NumPy envs do so."""
        last = self._given(obs)
        if self.backend == "numpy":
            rows, last = last, np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(self._given(ended)):
                last[row] = rows[row].copy()
        mask = {"_final_obs": self._given(ended), "_final_info": self._given(ended)}
        return {"final_obs": last, "final_info": self._info(public_info(info), ended), **mask}

    def _info(self, values: dict[str, torch.Tensor], rows: torch.Tensor) -> dict[str, Any]:
        """Every value with the mask of the rows that have it."""
        out = {name: self._given(value) for name, value in values.items()}
        return out | {f"_{name}": self._given(rows) for name in values}

    def _given(self, value: torch.Tensor) -> Any:
        """In the user's kind of array, in memory of its own."""
        return value.clone() if self.backend == "torch" else value.cpu().numpy().copy()

    def _rows(self, options: dict[str, Any] | None) -> torch.Tensor:
        """Rows to reset; TypeError or ValueError for options that do not exist or fit."""
        given = dict(options or {})
        mask = given.pop("reset_mask", None)
        if given:
            raise ValueError(
                f"reset options {sorted(given)} do not exist; there is 'reset_mask', a bool array of shape "
                f"({self.num_envs},)"
            )
        if mask is None:
            return torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        rows = torch.as_tensor(mask, device=self.device)
        if rows.dtype != torch.bool:
            raise TypeError(f"reset_mask must be bool, got {rows.dtype}")
        if rows.shape != (self.num_envs,) or not bool(rows.any()):
            raise ValueError(
                f"reset_mask must have shape ({self.num_envs},) and be true somewhere, got "
                f"{tuple(rows.shape)}"
            )
        return rows

    def _refuse_ended(self) -> None:
        if self.autoreset_mode is AutoresetMode.DISABLED and bool(self._ended.any()):
            rows = ", ".join(map(str, self._ended.nonzero().flatten().tolist()[:8]))
            raise RuntimeError(
                f'step after the end of env {rows}: call reset(options={{"reset_mask": terminated | '
                f"truncated}}) first"
            )


# ---- A picture of one env as it stands: the tank from above, in the colours of the videos.

_MARGINS = (12, 12, 12, 12)  # [px] left, right, top, bottom


def draw_frame(sim: Sim, row: int, width_px: int = 640) -> np.ndarray:
    """(height, width, 3) uint8, red green blue: what the vehicle of this row has mapped, its route and goal,
    and the true obstacles."""
    config = sim.config

    def read(name: str) -> np.ndarray:
        return sim.rows(attrgetter(name)(sim.s), [row])[0]

    scenario = scenario_document(config, describe_scenario(read), "", 0, 0)
    time_s = int(read("clock.step")) * config.episode.control_dt_s
    pos_w, cell_m = read("vehicle.pos_w"), config.mapping.cell_m
    static, dynamic = (
        Layer.of(occupancy(read(layer)), grid_origin(config.world.tank, cell_m), cell_m)
        for layer in ("grid_map.static_occ", "grid_map.dynamic_occ")
    )
    canvas = drawing.map_canvas(scenario["tank"], width_px, _MARGINS)
    drawing.paint_water(canvas, scenario["tank"])
    drawing.paint_layers(canvas, static, dynamic)
    drawing.paint_truth(canvas, scenario, time_s, float(pos_w[2]))
    drawing.paint_walls(canvas, scenario["tank"])
    canvas.line(read("route.way_w")[: int(read("route.n_way"))], drawing.ROUTE, 2)
    canvas.star(scenario["goal"], 12)
    canvas.vehicle([*pos_w, angles_of(*read("vehicle.quat_wb"))[2]], drawing.agent_inks(["bt"])["bt"])
    return canvas.image[:, :, ::-1].copy()


# ---- ``gymnasium.Env`` of one vehicle: ``gymnasium.make("uuvtai/Nav-v0")``.


class UuvEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One vehicle that runs the episodes 0, 1, 2, ... of its seed (of a simulator with n envs: 0, n, 2n,
    ..., in its first row).

    Observation float32 (n_obs,) in raw SI units (``native.observation_table`` names the columns), action
    float32 (4,): surge, sway, heave, yaw rate in parts of the vehicle's limits. Thousands of vehicles step at
    once in ``UuvVectorEnv``, at hundreds of times the speed of as many of these.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        world: str = "pool",
        *,
        sensors: str | None = None,
        vehicle: str | None = None,
        overrides: dict[str, Any] | None = None,
        device: str = "cpu",
        teacher: str = "bt",
        hold_steps: int = 1,
        render_mode: str | None = None,
        sim: Sim | None = None,
    ) -> None:
        """As ``UuvVectorEnv``; ``render_mode`` 'rgb_array': ``render`` draws the pool from above. ValueError
        for other modes."""
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode {render_mode!r} does not exist; there are: None, 'rgb_array'")
        self.render_mode, self.hold_steps = render_mode, checked_hold_steps(hold_steps)
        self.native = VectorEnv(
            sim or simulator(world, 1, sensors, vehicle, overrides, device, teacher),
            autoreset=False,
            owns_sim=sim is None,
        )
        config, n = self.native.config, self.native.num_envs
        fps = round(1 / (config.episode.control_dt_s * hold_steps))
        self.metadata = {**self.metadata, "render_fps": fps}  # type: ignore[misc]
        self.observation_space = observation_space(self.native.observation_table, config)
        self.action_space = action_space()
        self._actions = torch.zeros(n, self.native.num_actions, device=self.native.device)
        self._first = torch.arange(n, device=self.native.device) == 0
        self._begun = self._over = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episode 0 of ``seed``, or, with None, the next one (the first time of a random seed); (obs,
        info). There are no options."""
        if options:
            raise ValueError(f"reset options {sorted(options)} do not exist; there are none")
        obs, info = self.native.reset(episode_seed(self, seed), self._first if self._begun else None)
        self._begun, self._over = True, False
        return self._row(obs), self._info(info)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold ``action`` (4,) for ``hold_steps``: (obs, reward, terminated, truncated, info); info as
        ``UuvVectorEnv.step`` names it.

        Raises RuntimeError before the first reset, after the end of an episode and after close, ValueError
        for unfit actions.
        """
        if self._over:
            raise RuntimeError("step after the end of the episode: call reset() first")
        given = torch.as_tensor(action, dtype=torch.float32)
        if given.shape != self.action_space.shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {tuple(given.shape)}")
        self._actions[0] = given
        obs, reward, terminated, truncated, info = carry_out(self.native, self._actions, self.hold_steps)
        self._over = bool(terminated[0] | truncated[0])
        return self._row(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info(info)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The tank from above: map, true obstacles, route, goal and vehicle, (height, width, 3) uint8; None
        without a render mode."""
        if self.render_mode is None:
            return None
        return draw_frame(self.native.sim, 0)

    def close(self) -> None:
        """Let go of the simulator; may be called again."""
        self.native.close()

    def _info(self, info: dict[str, torch.Tensor]) -> dict[str, Any]:
        out = {
            name: value[0].item() if value.ndim == 1 else self._row(value)
            for name, value in public_info(info).items()
        }
        return out | {"outcome": self.native.outcomes[int(out["outcome"])]}

    @staticmethod
    def _row(value: torch.Tensor) -> np.ndarray:
        """First row in memory of its own."""
        return value[0].cpu().numpy().copy()


ENV_ID = "uuvtai/Nav-v0"
"""for ``gymnasium.make`` and ``gymnasium.make_vec``"""

gymnasium.register(
    ENV_ID,
    entry_point="uuvtai.envs.gymnasium:UuvEnv",
    vector_entry_point="uuvtai.envs.gymnasium:UuvVectorEnv",
)
