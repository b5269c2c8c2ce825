"""PPO in the kinematic surrogate: what ``learning/runner.py`` drives where ``surrogate.enabled``."""

from __future__ import annotations

import contextlib
import functools
import math
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch

from uuvtai.common.enums import OUTCOMES, RUNNING, SUCCESS, TIMEOUT
from uuvtai.common.errors import SettingError
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.agents import SetAgent
from uuvtai.learning.networks import PlainAdam, fast_products, in_bfloat16, log_prob
from uuvtai.learning.parameter_search import run_search_episodes, simulator_of
from uuvtai.learning.policy_agent import AgentDecision
from uuvtai.learning.ppo import ADAM_EPS, adapted_rate, approximate_kl, gae, surrogate_loss
from uuvtai.learning.rollout import Recent, RolloutSums
from uuvtai.learning.set_networks import MOST_WISH, NUM_WISHES, SetActor, SetCritic

if TYPE_CHECKING:
    from uuvtai.config import VehicleConfig
    from uuvtai.sim.setup import Scene
    from uuvtai.sim.sim import Sim
    from uuvtai.surrogate.world import ScenarioBank, Surrogate


# ------------------------------------------------------------------------------------------------------------
# Warm start of a policy over a set of obstacles: imitation of the behaviour tree in the simulator.
#
# DAgger (Ross, Gordon & Bagnell 2011, AISTATS): whoever drives, the tree says what it would do, and the
# actor's
# mean is fitted to all that was said so far. The tree drives in the first wave, the student more and more.


WAVE_EPISODES = 256
"""episodes of a wave, at most ``train.num_envs``"""
PASSES, LAST_PASSES = 2, 6
"""through all samples after a wave, and after the last one"""
MINIBATCH, RATE = 512, 1e-3
SEED = 7_000_003
"""added to ``train.seed`` for episodes and draws of the warm start"""


class Sample(NamedTuple):
    """Decisions to imitate."""

    obstacles: torch.Tensor
    """(n, lanes, OBSTACLE_WIDTH)"""
    own: torch.Tensor
    """(n, EGO_COLUMNS)"""
    wish: torch.Tensor
    """(n, 3) what the tree asks for, as the policy would say it"""


def wish_of_command(
    command: torch.Tensor, yaw: torch.Tensor, flip: torch.Tensor, vehicle_cfg: VehicleConfig
) -> torch.Tensor:
    """(n, 3) wishes whose velocity is that of commands (n, 4) at headings (n,) [rad]; ``flip`` (n, 2): signs
    of the mirrored world. The inverse of ``hull_rule.py:wished_velocity``; the yaw rate is left out."""
    fastest = (vehicle_cfg.max_surge_m_s**2 + vehicle_cfg.max_sway_m_s**2) ** 0.5
    surge, sway = vehicle_cfg.max_surge_m_s * command[:, 0], vehicle_cfg.max_sway_m_s * command[:, 1]
    c, s = yaw.cos(), yaw.sin()
    level = torch.stack([c * surge - s * sway, s * surge + c * sway], dim=1)
    return torch.cat([flip * level / fastest, command[:, 2:3]], dim=1)


class Student(SetAgent):
    """Drives with the tree, drawn anew for every decision, and keeps what the tree says of each."""

    def __init__(self, actor: SetActor, sim: Sim, config: LearningConfig, generator: torch.Generator) -> None:
        super().__init__(actor, sim, config.policy.hold_steps, config.surrogate.vertical_gap_m)
        self.simulator, self._generator = sim, generator
        self.tree_share = 1.0
        """chance that the tree drives, beta of DAgger"""
        self.running = torch.ones(sim.num_envs, dtype=torch.bool)
        """rows whose episode has not ended"""
        self.number = torch.zeros(sim.num_envs, dtype=torch.int64)
        """episode of every row"""
        self.samples: list[Sample] = []
        self._with_tree = torch.ones(sim.num_envs, dtype=torch.bool)

    @torch.no_grad()
    def decide(self, obs: torch.Tensor) -> AgentDecision:
        """Command for all rows, the tree's or the student's."""
        due = self._due()
        said = super().decide(obs)
        tree = self.simulator.action
        if bool(due.any()):
            draw = torch.rand(len(due), generator=self._generator)
            self._with_tree = torch.where(due, draw < self.tree_share, self._with_tree)
            self._keep(due & self.running, tree)
        return said._replace(action=torch.where(self._with_tree[:, None], tree, said.action))

    def _keep(self, kept: torch.Tensor, tree: torch.Tensor) -> None:
        from uuvtai.surrogate.arrays import AT_FLIP, AT_YAW

        ego = self._ego[kept]
        wish = wish_of_command(
            tree[kept], ego[:, AT_YAW], ego[:, AT_FLIP : AT_FLIP + 2], self.simulator.config.vehicle
        )
        self.samples.append(Sample(self.obstacles[kept], self.own[kept], wish))


def imitate(
    actor: SetActor, config: LearningConfig, scenes: tuple[Scene, ...], sims: dict[str, Sim] | None = None
) -> dict[str, float]:
    """``surrogate.warm_start_waves`` waves of DAgger; the actor's mean is then close to the tree. What was
    spent, as metrics. ``sims``: simulators of worlds that are there already."""
    began, sims = time.perf_counter(), dict(sims or {})
    waves, rows = config.surrogate.warm_start_waves, min(WAVE_EPISODES, config.train.num_envs)
    few = config.model_copy(update={"train": config.train.model_copy(update={"num_envs": rows})})
    seed = config.train.seed + SEED
    generator = torch.Generator().manual_seed(seed)
    optimiser = PlainAdam(list(actor.net.parameters()), lr=RATE)
    places = [(world, scene) for scene in scenes for world in config.surrogate.worlds]
    samples, won, loss = [], 0.0, 0.0
    for wave in range(waves):
        world, scene = places[wave % len(places)]
        if world not in sims:
            sims[world] = simulator_of(few, world, scenes)
        student = Student(actor, sims[world], config, generator)
        student.tree_share = 1.0 - wave / max(1, waves - 1)
        outcome, _ = run_search_episodes(student, scene, seed, wave * rows, rows)
        samples += student.samples
        won = float((outcome == SUCCESS).float().mean())
        joined = Sample(*(torch.cat(parts) for parts in zip(*samples, strict=True)))
        samples = [joined]
        passes = LAST_PASSES if wave == waves - 1 else PASSES
        loss = regress(actor, optimiser, joined, passes, generator)
    return {
        "warm_start/loss": loss,
        "warm_start/success_rate_last_wave": won,
        "warm_start/decisions": float(len(samples[0].wish)),
        "warm_start/seconds": time.perf_counter() - began,
    }


def regress(
    actor: SetActor, optimiser: torch.optim.Optimizer, sample: Sample, passes: int, generator: torch.Generator
) -> float:
    """Fit the actor's mean to the wishes; mean squared error of the last pass (``passes`` at least 1)."""
    errors: list[float] = []
    for _ in range(passes):
        errors = []
        for index in torch.randperm(len(sample.wish), generator=generator).split(MINIBATCH):
            mean = actor(sample.obstacles[index], sample.own[index])
            loss = (mean - sample.wish[index]).square().sum(dim=-1).mean()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(actor.net.parameters(), 1.0)
            optimiser.step()
            errors.append(float(loss.detach()) / NUM_WISHES)
    return sum(errors) / len(errors)


# ------------------------------------------------------------------------------------------------------------
# Pieces of a training's work on all cores. Networks over a few thousand rows are too small for torch's own
# threads, which wait for each other at every product; here each thread takes whole pieces.


_T = TypeVar("_T")


_threads: ContextVar[int] = ContextVar("threads")
"""for pieces, while torch's own rest"""


@contextlib.contextmanager
def torch_threads_rest() -> Iterator[None]:
    """Between the pieces torch computes on one thread: its own take ten times as long for a step of Adam on
    networks of this size as one does alone."""
    threads = torch.get_num_threads()
    token = _threads.set(threads)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _threads.reset(token)


def side_by_side(*pieces: Callable[[], _T]) -> list[_T]:
    """What each piece gives, in their order. Threads have no part in any result: a piece runs on one."""
    pool = _pool(_threads.get(None) or torch.get_num_threads())
    if pool is None:
        return [piece() for piece in pieces]
    return [begun.result() for begun in [pool.submit(piece) for piece in pieces]]


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor | None:
    return None if threads == 1 else ThreadPoolExecutor(threads, "uuvtai-learn", _begin)


def _begin() -> None:
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)


# ------------------------------------------------------------------------------------------------------------
# Gradients of PPO's losses for a policy over a set of obstacles, by pieces that several cores can take.


CACHE_ROWS = 2048
"""rows in one pass through the networks: nine obstacles each"""


class Piece(NamedTuple):
    """What some rows of a minibatch of ``count`` rows add to it."""

    gradients: tuple[torch.Tensor, ...]
    sums: torch.Tensor
    """(4,) policy loss, value loss, KL, share clipped"""


class SetLosses:
    """Of one minibatch: clipped surrogate for the actor, value error for the critic."""

    def __init__(self, config: LearningConfig, actor: SetActor, critic: SetCritic) -> None:
        self._config, self._actor, self._critic = config, actor, critic

    def backward(self, rows: list[torch.Tensor], index: torch.Tensor) -> torch.Tensor:
        """Fill the parameters' gradients; (4,) sums as in ``Piece``.

        ``rows``: obstacles, own, truth, action, log probability, advantage, target; ``index`` (M,) chooses
        the minibatch. Pieces are added up in their order, so that the number of threads changes no bit.
        """
        count = len(index)
        some = side_by_side(*(functools.partial(_chosen, rows, part) for part in index.split(CACHE_ROWS)))
        pieces: list[Callable[[], Piece]] = [
            functools.partial(of, samples, count)
            for samples in some
            for of in (self._of_actor, self._of_critic)
        ]
        found = side_by_side(*pieces)
        _add_up(self._critic, [piece.gradients for piece in found[1::2]])
        _add_up(self._actor, [piece.gradients for piece in found[::2]])
        sums = torch.zeros(4)
        for of_actor, of_critic in zip(found[::2], found[1::2], strict=True):
            sums += of_actor.sums + of_critic.sums
        return sums

    def _of_actor(self, samples: list[torch.Tensor], count: int) -> Piece:
        obstacles, own, _, action, before, advantage, _ = samples
        clip = self._config.ppo.clip
        with coarse(self._config):
            mean = self._actor(obstacles, own)
        log_ratio = log_prob(action, mean.float(), self._actor.log_std) - before
        policy_loss = surrogate_loss(log_ratio, advantage, clip).sum() / count
        gradients = torch.autograd.grad(policy_loss, list(self._actor.parameters()))
        with torch.no_grad():
            kl = approximate_kl(log_ratio).sum() / count
            clipped = ((log_ratio.exp() - 1.0).abs() > clip).sum() / count
            return Piece(gradients, torch.stack([policy_loss, torch.zeros(()), kl, clipped]))

    def _of_critic(self, samples: list[torch.Tensor], count: int) -> Piece:
        obstacles, own, truth, *_, target = samples
        with coarse(self._config):
            value = self._critic(obstacles, own, truth)
        value_loss = (value.float() - target).square().sum() / count
        loss = self._config.ppo.value_weight * value_loss
        gradients = torch.autograd.grad(loss, list(self._critic.parameters()))
        sums = torch.zeros(4)
        sums[1] = value_loss.detach()
        return Piece(gradients, sums)


def _chosen(rows: list[torch.Tensor], index: torch.Tensor) -> list[torch.Tensor]:
    """These samples, next to each other: both networks read them."""
    return [part[index] for part in rows]


def coarse(config: LearningConfig) -> torch.autocast:
    """Products in bfloat16 where ``ppo.bfloat16`` says so and the CPU can."""
    return torch.autocast("cpu", torch.bfloat16, enabled=in_bfloat16(config.ppo, "cpu"))


def _add_up(net: torch.nn.Module, pieces: list[tuple[torch.Tensor, ...]]) -> None:
    for parameter, *gradients in zip(net.parameters(), *pieces, strict=True):
        parameter.grad = functools.reduce(torch.add, gradients)


def by_part(net: torch.nn.Module, *parts: torch.Tensor, config: LearningConfig | None = None) -> torch.Tensor:
    """What a network says of many rows, ``CACHE_ROWS`` at a time; nothing of it can be learnt from. As
    coarsely as it learns where a config is given."""
    with torch.no_grad(), coarse(config) if config else contextlib.nullcontext():
        rows = zip(*(part.split(CACHE_ROWS) for part in parts), strict=True)
        return torch.cat([net(*some).float() for some in rows])


# ------------------------------------------------------------------------------------------------------------


BANK_SEED = 4242
"""of the scenarios to learn from; those of evaluations come from ``train.evaluate_seed``"""
FASTEST_RATE = 2e-3
"""most that the KL-adaptive rate may be"""
CRITIC_RATE = 1e-3
DECAY_FROM = 0.5
"""share of the run from which the learning rate falls to a tenth"""
HOLD_STEPS, DECISION_S = 5, 0.1
"""of the surrogate (``uuvtai/surrogate/motion.py``), which this file does not import"""


class SurrogateTrainer:
    """Everything that training in the surrogate carries from one iteration to the next."""

    def __init__(self, config: LearningConfig, bank: ScenarioBank | None = None) -> None:
        """Draws the scenarios, unless they are given. Raises ConfigError for a world that is none, or has
        another tank."""
        from uuvtai.common.enums import EGO_COLUMNS, OBSTACLE_WIDTH
        from uuvtai.surrogate.arrays import TRUTH_WIDTH
        from uuvtai.surrogate.observation import SET_TABLE
        from uuvtai.surrogate.world import Surrogate, draw_bank

        _refuse_what_the_surrogate_lacks(config)
        self.config = config
        self.observation_table = SET_TABLE
        torch.set_flush_denormal(True)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        self._scenes = scenes = config.train.scenes or (config.world.own_scene,)
        bank = bank or draw_bank(config, scenes, BANK_SEED, config.surrogate.scenarios)
        self.surrogate = Surrogate(config, bank, config.train.num_envs, config.train.seed)
        self.actor = SetActor(OBSTACLE_WIDTH, EGO_COLUMNS, config, self.generator)
        self.critic = SetCritic(OBSTACLE_WIDTH, EGO_COLUMNS, TRUTH_WIDTH, config, self.generator)
        self.rate = torch.tensor(config.ppo.learning_rate)
        self.optimiser = PlainAdam(
            [
                {"params": list(self.actor.parameters()), "lr": config.ppo.learning_rate},
                {"params": list(self.critic.parameters()), "lr": CRITIC_RATE},
            ],
            eps=ADAM_EPS,
            fused=True,
        )
        self.recent = Recent(OUTCOMES, ())
        self.iteration = self.env_steps = 0
        self._returns = torch.zeros(config.train.num_envs)
        self._held_out: ScenarioBank | None = None
        lanes = self.surrogate.view.obstacles.shape[1]
        self._allocate(config.ppo.rollout_steps, config.train.num_envs, lanes, OBSTACLE_WIDTH, EGO_COLUMNS)
        self.surrogate.begin(torch.ones(config.train.num_envs, dtype=torch.bool), self._next_scenarios())
        self.surrogate.look()

    def _allocate(self, steps: int, envs: int, lanes: int, n_obstacle: int, n_own: int) -> None:
        kind = torch.bfloat16 if in_bfloat16(self.config.ppo, "cpu") else torch.float32
        n_truth = self.surrogate.view.truth.shape[2]
        self._obstacles, self._truth = (
            torch.zeros(steps, envs, lanes, width, dtype=kind) for width in (n_obstacle, n_truth)
        )
        self._own, self._action = (torch.zeros(steps, envs, width) for width in (n_own, NUM_WISHES))
        self._log_prob, self._value, self._reward = (torch.zeros(steps, envs) for _ in range(3))
        self._next_value = torch.zeros(steps, envs)
        self._terminated, self._ended = (torch.zeros(steps, envs, dtype=torch.bool) for _ in range(2))

    def _imitate(self) -> dict[str, float]:
        """Learn from the tree first, where ``surrogate.warm_start_waves`` says so; metrics."""
        if self.iteration > 0 or not self.config.surrogate.warm_start_waves:
            return {}
        return imitate(self.actor, self.config, self._scenes)

    def iterate(self) -> dict[str, float]:
        """A rollout and what is learned from it; metrics by their names in metrics.jsonl."""
        warmed = self._imitate()
        with torch_threads_rest(), fast_products():
            began = time.perf_counter()
            sums = self._collect()
            between = time.perf_counter()
            metrics = self._learn() | self.recent.add(sums)
            learn_s = time.perf_counter() - between
        self.iteration += 1
        samples = self._reward.numel()
        self.env_steps += samples
        return (
            warmed
            | metrics
            | {
                "time/simulate_s": between - began,
                "time/infer_s": 0.0,
                "time/learn_s": learn_s,
                "time/env_steps_per_s": samples / (between - began + learn_s),
                "time/env_steps": float(self.env_steps),
            }
        )

    # ---------------------------------------------------------------------------------------------- a rollout

    def _next_scenarios(self) -> torch.Tensor:
        """(N,) numbers of scenarios, any."""
        return torch.randint(
            self.surrogate.num_scenarios, (self.surrogate.num_envs,), generator=self.generator
        )

    @torch.no_grad()
    def _collect(self) -> RolloutSums:
        surrogate, view = self.surrogate, self.surrogate.view
        sums = RolloutSums.zeros(len(OUTCOMES), 0, torch.device("cpu"))
        for t in range(len(self._reward)):
            self._obstacles[t], self._own[t], self._truth[t] = view
            mean, self._value[t] = side_by_side(
                functools.partial(by_part, self.actor, view.obstacles, view.own, config=self.config),
                functools.partial(by_part, self.critic, *view, config=self.config),
            )
            noise = torch.randn(mean.shape, generator=self.generator)
            action = torch.addcmul(mean, noise, self.actor.log_std.exp())
            self._action[t], self._log_prob[t] = action, log_prob(action, mean, self.actor.log_std)
            reward, outcome = surrogate.step(action)
            ended = outcome != RUNNING
            self._reward[t], self._ended[t] = reward, ended
            self._terminated[t] = ended & (outcome != TIMEOUT)
            self._returns += reward
            if t:
                self._next_value[t - 1] = self._value[t]
            if bool(ended.any()):
                self._count_ended(sums, outcome, ended)
                late = outcome == TIMEOUT
                after = None
                if bool(late.any()):
                    surrogate.look()
                    after = self.critic(view.obstacles[late], view.own[late], view.truth[late])
                surrogate.begin(ended, self._next_scenarios())
            else:
                late, after = ended, None
            self._late = (late.clone(), after)
            surrogate.look()
            self._bootstrap(t)
        last = by_part(self.critic, *view, config=self.config)
        self._next_value[-1] = torch.where(self._ended[-1], self._next_value[-1], last)
        sums.samples += self._reward.numel()
        return sums

    def _bootstrap(self, t: int) -> None:
        """After a timeout the return goes on by the value of where it led to: as part of the reward, for the
        next value is another episode's."""
        late, after = self._late
        if after is not None:
            self._reward[t, late] += self.config.ppo.gamma * after
        self._terminated[t] |= self._ended[t]

    def _count_ended(self, sums: RolloutSums, outcome: torch.Tensor, ended: torch.Tensor) -> None:
        sums.outcomes += torch.bincount(outcome[ended], minlength=len(OUTCOMES)).double()
        sums.episode_return += self._returns[ended].double().sum()
        sums.episode_steps += (self.surrogate.time_s[ended] / DECISION_S).round().double().sum()
        self._returns[ended] = 0.0

    # ------------------------------------------------------------------------------------------- an iteration

    def _learn(self) -> dict[str, float]:
        config = self.config.ppo
        advantage, target = gae(
            self._reward, self._value, self._next_value, self._terminated, self._ended, config.gamma,
            config.gae_lambda,
        )  # fmt: skip
        rows = [part.flatten(0, 1) for part in (self._obstacles, self._own, self._truth, self._action)]
        flat = [
            part.flatten()
            for part in (self._log_prob, (advantage - advantage.mean()) / (advantage.std() + 1e-6), target)
        ]
        size = -(-len(flat[0]) // config.minibatches)
        sums = torch.zeros(4)
        for _ in range(config.epochs):
            for index in torch.randperm(len(flat[0]), generator=self.generator).split(size):
                sums += self._minibatch([*rows, *flat], index)
        policy_loss, value_loss, kl, clipped = (sums / (config.epochs * config.minibatches)).tolist()
        if config.target_kl > 0:
            self.rate = adapted_rate(self.rate, torch.tensor(kl), config.target_kl).clamp(max=FASTEST_RATE)
        share = self.iteration / self.config.train.iterations
        fade = max(0.1, min(1.0, (1.0 - share) / (1.0 - DECAY_FROM)))
        self.optimiser.param_groups[0]["lr"] = float(self.rate) * fade
        spread = target.var()
        return {
            "train/policy_loss": policy_loss,
            "train/value_loss": value_loss,
            "train/approx_kl": kl,
            "train/clip_fraction": clipped,
            "train/learning_rate": float(self.rate) * fade,
            "train/std": float(self.actor.log_std.detach().exp().mean()),
            "train/explained_variance": float(1.0 - (target - self._value).var() / spread),
        }

    def _minibatch(self, rows: list[torch.Tensor], index: torch.Tensor) -> torch.Tensor:
        """One step of both networks by the samples of ``index``; (policy loss, value loss, KL, share
        clipped)."""
        config = self.config.ppo
        self.optimiser.zero_grad(set_to_none=True)
        sums = SetLosses(self.config, self.actor, self.critic).backward(rows, index)
        torch.nn.utils.clip_grad_norm_(self.actor.parameters(), config.max_grad_norm)
        torch.nn.utils.clip_grad_norm_(self.critic.parameters(), config.max_grad_norm)
        self.optimiser.step()
        with torch.no_grad():
            self.actor.log_std.clamp_(math.log(self.config.policy.min_std), 0.0)
        return sums

    # --------------------------------------------------------------------------------------------- evaluation

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """``eval/*`` of the policy as it is, without exploration, on scenarios that it never learnt from, the
        same number of each world and scene, in the surrogate."""
        from uuvtai.surrogate.world import Surrogate, draw_bank

        train = self.config.train
        each = -(-train.evaluate_episodes // (len(self.config.surrogate.worlds) * len(self._scenes)))
        if self._held_out is None:
            self._held_out = draw_bank(self.config, self._scenes, train.evaluate_seed, each)
        bank = self._held_out
        outcome, time_s = run_once(
            Surrogate(self.config, bank, len(bank.obstacle), train.evaluate_seed), self.actor
        )
        metrics = _rates("eval", outcome, time_s)
        for number, name in enumerate(bank.names):
            rows = bank.origin == number
            metrics[f"eval/success_{name}"] = float((outcome[rows] == SUCCESS).float().mean())
        return metrics

    # ------------------------------------------------------------------------------------------------- resume

    def state(self) -> dict[str, Any]:
        """All that the next iterations depend on. What drives, the actor, is the part ``policy``."""
        return {
            "policy": _copied(self.actor),
            "critic": _copied(self.critic),
            "optimiser": self.optimiser.state_dict(),
            "rate": self.rate.clone(),
            "generator": self.generator.get_state(),
            "recent": list(self.recent.rows),
            "returns": self._returns.clone(),
            "counters": {"iteration": self.iteration, "env_steps": self.env_steps},
            "env": self.surrogate.capture(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self.actor.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.rate = state["rate"].clone()
        self.generator.set_state(state["generator"])
        self.recent.rows = [list(row) for row in state["recent"]]
        self._returns.copy_(state["returns"])
        self.iteration, self.env_steps = (int(state["counters"][n]) for n in ("iteration", "env_steps"))
        self.surrogate.restore(state["env"])


def _copied(net: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in net.state_dict().items()}


def _refuse_what_the_surrogate_lacks(config: LearningConfig) -> None:
    """Raise SettingError for parts of a training that the surrogate does not have, and sizes that do not
    fit."""
    if config.world_model.enabled:
        raise SettingError("world_model.enabled: the surrogate has none; turn it off, or surrogate.enabled")
    held, dt_s = config.policy.hold_steps, config.episode.control_dt_s
    if held != HOLD_STEPS or abs(held * dt_s - DECISION_S) > 1e-9:
        raise SettingError(
            f"policy.hold_steps={held}, episode.control_dt_s={dt_s}: the surrogate decides every "
            f"{DECISION_S} s, after {HOLD_STEPS} control steps"
        )
    samples = config.ppo.rollout_steps * config.train.num_envs
    if config.ppo.minibatches > samples:
        raise SettingError(
            f"ppo.minibatches={config.ppo.minibatches}, but a rollout has only {samples} samples: raise "
            "ppo.rollout_steps or train.num_envs"
        )


@torch.no_grad()
def run_once(surrogate: Surrogate, actor: SetActor) -> tuple[torch.Tensor, torch.Tensor]:
    """(outcome code, time [s]), both (N,), of scenario i in env i, driven by the mean."""
    every = torch.ones(surrogate.num_envs, dtype=torch.bool)
    surrogate.begin(every, torch.arange(surrogate.num_envs))
    outcome, time_s = torch.zeros(surrogate.num_envs, dtype=torch.int32), torch.zeros(surrogate.num_envs)
    while bool((outcome == RUNNING).any()):
        view = surrogate.look()
        _, now = surrogate.step(by_part(actor, view.obstacles, view.own).clamp(-MOST_WISH, MOST_WISH))
        new = (outcome == RUNNING) & (now != RUNNING)
        outcome, time_s = torch.where(new, now, outcome), torch.where(new, surrogate.time_s, time_s)
    return outcome, time_s


def _rates(name: str, outcome: torch.Tensor, time_s: torch.Tensor) -> dict[str, float]:
    won, late = outcome == SUCCESS, outcome == TIMEOUT
    rates = {
        f"{name}/success_rate": float(won.float().mean()),
        f"{name}/collision_rate": float((~won & ~late).float().mean()),
    }
    return rates | ({f"{name}/time_to_success_mean_s": float(time_s[won].mean())} if bool(won.any()) else {})
