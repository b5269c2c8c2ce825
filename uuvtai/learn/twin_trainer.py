"""PPO in the kinematic twin: what ``learn/run.py`` drives where ``twin.enabled``."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.errors import SettingError
from uuvtai.learn.bfloat16 import in_bfloat16
from uuvtai.learn.optimiser import PlainAdam
from uuvtai.learn.policy import log_prob
from uuvtai.learn.ppo import ADAM_EPS, adapted_rate, gae
from uuvtai.learn.rollout_sums import Recent, RolloutSums
from uuvtai.learn.set_losses import SetLosses, by_part
from uuvtai.learn.set_policy import MOST_WISH, NUM_WISHES, SetActor, SetCritic
from uuvtai.learn.side_by_side import side_by_side, torch_threads_rest
from uuvtai.learn.warm_start import imitate
from uuvtai.outcomes import OUTCOMES, RUNNING, SUCCESS, TIMEOUT

if TYPE_CHECKING:
    from uuvtai.twin.scenario_bank import ScenarioBank
    from uuvtai.twin.twin_world import Twin

BANK_SEED = 4242
"""of the scenarios to learn from; those of evaluations come from ``train.evaluate_seed``"""
FASTEST_RATE = 2e-3
"""most that the KL-adaptive rate may be"""
CRITIC_RATE = 1e-3
DECAY_FROM = 0.5
"""share of the run from which the learning rate falls to a tenth"""
HOLD_STEPS, DECISION_S = 5, 0.1
"""of the twin (``uuvtai/twin/kinematics.py``), which this file does not import"""


class TwinTrainer:
    """Everything that training in the twin carries from one iteration to the next."""

    def __init__(self, config: LearningConfig, bank: ScenarioBank | None = None) -> None:
        """Draws the scenarios, unless they are given. Raises ConfigError for a world that is none, or has
        another tank."""
        from uuvtai.twin.observer import SET_TABLE
        from uuvtai.twin.scenario_bank import draw_bank
        from uuvtai.twin.set_codes import BODY_WIDTH, EGO_COLUMNS
        from uuvtai.twin.twin_arrays import TRUTH_WIDTH
        from uuvtai.twin.twin_world import Twin

        _refuse_what_the_twin_lacks(config)
        self.config = config
        self.observation_table = SET_TABLE
        torch.set_flush_denormal(True)
        self.generator = torch.Generator().manual_seed(config.train.seed)
        self._scenes = scenes = config.train.scenes or (config.world.own_scene,)
        bank = bank or draw_bank(config, scenes, BANK_SEED, config.twin.scenarios)
        self.twin = Twin(config, bank, config.train.num_envs, config.train.seed)
        self.actor = SetActor(BODY_WIDTH, EGO_COLUMNS, config, self.generator)
        self.critic = SetCritic(BODY_WIDTH, EGO_COLUMNS, TRUTH_WIDTH, config, self.generator)
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
        self._allocate(
            config.ppo.rollout_steps,
            config.train.num_envs,
            self.twin.view.bodies.shape[1],
            BODY_WIDTH,
            EGO_COLUMNS,
        )
        self.twin.begin(torch.ones(config.train.num_envs, dtype=torch.bool), self._next_scenarios())
        self.twin.look()

    def _allocate(self, steps: int, envs: int, lanes: int, n_body: int, n_own: int) -> None:
        kind = torch.bfloat16 if in_bfloat16(self.config.ppo, "cpu") else torch.float32
        n_truth = self.twin.view.truth.shape[2]
        self._bodies, self._truth = (
            torch.zeros(steps, envs, lanes, width, dtype=kind) for width in (n_body, n_truth)
        )
        self._own, self._action = (torch.zeros(steps, envs, width) for width in (n_own, NUM_WISHES))
        self._log_prob, self._value, self._reward = (torch.zeros(steps, envs) for _ in range(3))
        self._next_value = torch.zeros(steps, envs)
        self._terminated, self._ended = (torch.zeros(steps, envs, dtype=torch.bool) for _ in range(2))

    def _imitate(self) -> dict[str, float]:
        """Learn from the tree first, where ``twin.warm_start_waves`` says so; metrics."""
        if self.iteration > 0 or not self.config.twin.warm_start_waves:
            return {}
        return imitate(self.actor, self.config, self._scenes)

    def iterate(self) -> dict[str, float]:
        """A rollout and what is learned from it; metrics by their names in metrics.jsonl."""
        warmed = self._imitate()
        with torch_threads_rest():
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
        return torch.randint(self.twin.num_scenarios, (self.twin.num_envs,), generator=self.generator)

    @torch.no_grad()
    def _collect(self) -> RolloutSums:
        twin, view = self.twin, self.twin.view
        sums = RolloutSums.zeros(len(OUTCOMES), 0, torch.device("cpu"))
        for t in range(len(self._reward)):
            self._bodies[t], self._own[t], self._truth[t] = view
            mean, self._value[t] = side_by_side(
                functools.partial(by_part, self.actor, view.bodies, view.own, config=self.config),
                functools.partial(by_part, self.critic, *view, config=self.config),
            )
            noise = torch.randn(mean.shape, generator=self.generator)
            action = torch.addcmul(mean, noise, self.actor.log_std.exp())
            self._action[t], self._log_prob[t] = action, log_prob(action, mean, self.actor.log_std)
            reward, outcome = twin.step(action)
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
                    twin.look()
                    after = self.critic(view.bodies[late], view.own[late], view.truth[late])
                twin.begin(ended, self._next_scenarios())
            else:
                late, after = ended, None
            self._late = (late.clone(), after)
            twin.look()
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
        sums.episode_steps += (self.twin.time_s[ended] / DECISION_S).round().double().sum()
        self._returns[ended] = 0.0

    # ------------------------------------------------------------------------------------------- an iteration

    def _learn(self) -> dict[str, float]:
        config = self.config.ppo
        advantage, target = gae(
            self._reward,
            self._value,
            self._next_value,
            self._terminated,
            self._ended,
            config.gamma,
            config.gae_lambda,
        )
        rows = [part.flatten(0, 1) for part in (self._bodies, self._own, self._truth, self._action)]
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
        same number of each world and scene, in the twin."""
        from uuvtai.twin.scenario_bank import draw_bank
        from uuvtai.twin.twin_world import Twin

        train = self.config.train
        each = -(-train.evaluate_episodes // (len(self.config.twin.worlds) * len(self._scenes)))
        if self._held_out is None:
            self._held_out = draw_bank(self.config, self._scenes, train.evaluate_seed, each)
        bank = self._held_out
        outcome, time_s = play_once(Twin(self.config, bank, len(bank.body), train.evaluate_seed), self.actor)
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
            "env": self.twin.capture(),
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
        self.twin.restore(state["env"])


def _copied(net: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in net.state_dict().items()}


def _refuse_what_the_twin_lacks(config: LearningConfig) -> None:
    """Raise SettingError for parts of a training that the twin does not have, and sizes that do not fit."""
    for name, is_on in (
        ("policy.residual", config.policy.residual),
        ("world_model.enabled", config.world_model.enabled),
    ):
        if is_on:
            raise SettingError(f"{name}: the twin has none; set {name}=false, or twin.enabled=false")
    held, dt_s = config.policy.hold_steps, config.episode.control_dt_s
    if held != HOLD_STEPS or abs(held * dt_s - DECISION_S) > 1e-9:
        raise SettingError(
            f"policy.hold_steps={held}, episode.control_dt_s={dt_s}: the twin decides every {DECISION_S} s, "
            f"after {HOLD_STEPS} control steps"
        )
    samples = config.ppo.rollout_steps * config.train.num_envs
    if config.ppo.minibatches > samples:
        raise SettingError(
            f"ppo.minibatches={config.ppo.minibatches}, but a rollout has only {samples} samples: raise "
            "ppo.rollout_steps or train.num_envs"
        )


@torch.no_grad()
def play_once(twin: Twin, actor: SetActor) -> tuple[torch.Tensor, torch.Tensor]:
    """(outcome code, time [s]), both (N,), of scenario i in env i, driven by the mean."""
    every = torch.ones(twin.num_envs, dtype=torch.bool)
    twin.begin(every, torch.arange(twin.num_envs))
    outcome, time_s = torch.zeros(twin.num_envs, dtype=torch.int32), torch.zeros(twin.num_envs)
    while bool((outcome == RUNNING).any()):
        view = twin.look()
        _, now = twin.step(by_part(actor, view.bodies, view.own).clamp(-MOST_WISH, MOST_WISH))
        new = (outcome == RUNNING) & (now != RUNNING)
        outcome, time_s = torch.where(new, now, outcome), torch.where(new, twin.time_s, time_s)
    return outcome, time_s


def _rates(name: str, outcome: torch.Tensor, time_s: torch.Tensor) -> dict[str, float]:
    won, late = outcome == SUCCESS, outcome == TIMEOUT
    rates = {
        f"{name}/success_rate": float(won.float().mean()),
        f"{name}/collision_rate": float((~won & ~late).float().mean()),
    }
    return rates | ({f"{name}/time_to_success_mean_s": float(time_s[won].mean())} if bool(won.any()) else {})
