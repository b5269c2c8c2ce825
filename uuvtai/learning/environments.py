"""Where a policy learns: the simulator, and its surrogate, as ``rollout.Environment``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from uuvtai.common.enums import DECISION_S, HOLD_STEPS, OUTCOMES, RUNNING, SUCCESS, TIMEOUT
from uuvtai.common.errors import SettingError
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.networks import OBSERVATION, ActorCritic, Guard, Policy, View, by_part
from uuvtai.learning.policy_agent import PolicyAgent
from uuvtai.learning.rollout import Environment, Rollout, RolloutSums, Step
from uuvtai.learning.set_networks import MOST_WISH, SetPolicy
from uuvtai.learning.world_model import N_FEATURES, WorldModel

if TYPE_CHECKING:
    from uuvtai.envs.vector_env import VectorEnv
    from uuvtai.surrogate.world import ScenarioBank


class Simulated(Environment):
    """The simulator for a policy on observation vectors. Its view: ``x``, the observation and the world
    model's residual and uncertainty of it (zero without one, and in the first step of an episode);
    ``teacher_action`` (N, 4) and ``leaf`` (N,) of the behavior tree. What is not finite is replaced."""

    def __init__(self, env: VectorEnv, config: LearningConfig) -> None:
        self.env, self.config, self.steps = env, config, config.policy.hold_steps
        self.num_envs, self.device = env.num_envs, env.device
        self.outcomes, self.reward_terms, self.node_names = env.outcomes, env.reward_terms, env.node_names
        self.observation_table = env.observation_table
        self.view: View = {"x": torch.zeros(self.num_envs, env.num_obs + N_FEATURES, device=self.device)}
        self._no_features = self.view["x"][:, env.num_obs :]
        columns = [(c.name, c.slice) for c in self.observation_table]
        self.guard = Guard(columns, self.num_envs, config.train.patience, self.device)

    def make_policy(self, generator: torch.Generator) -> ActorCritic:
        """One that fits the view."""
        return ActorCritic(self.env.num_obs + N_FEATURES, self.config.policy, generator).to(self.device)

    def agent(self, policy: ActorCritic) -> PolicyAgent:
        """The policy driving by its mean."""
        model = self.world_model if self.config.world_model.as_features else None
        return PolicyAgent(policy, model, self.num_envs, self.device)

    def begin(self, policy: Any, world_model: WorldModel | None, generator: torch.Generator) -> None:
        """First episodes. Where ``world_model.as_features`` is false its columns stay zero."""
        self._norm, self.world_model = policy.observation_norm, world_model
        self._arrive(self._no_features, *self.env.reset(self.config.train.seed))

    @torch.no_grad()
    def look_around(self, rollout: Rollout) -> None:
        """Let the behavior tree drive for T steps; keep inputs, actions and endings."""
        sums = RolloutSums(len(self.outcomes), len(self.reward_terms), self.device)
        for t in range(rollout.steps):
            action = self.view["teacher_action"].clone()
            rollout.note(t, {"x": self.view["x"], "action": action})
            rollout.note(t, {"ended": self.step(action, sums).ended})

    @property
    def scenarios(self) -> tuple[Tensor, Tensor]:
        """Seed and number, both (N,), of what every env is in."""
        return self.info["seed"], self.info["episode"]

    def _hold(self, action: Tensor, sums: RolloutSums) -> tuple[Tensor, ...]:
        """Hold a decision for ``steps`` control steps; the tree drives what begins on the way. (Next
        observation; of the episode in which it was made: last observation, reward, terminated, ended)."""
        obs = final = torch.zeros(self.num_envs, self.env.num_obs, device=self.device)
        reward = torch.zeros(self.num_envs, device=self.device)
        terminated = ended = torch.zeros_like(reward, dtype=torch.bool)
        for _ in range(self.steps):
            tree = self.info["teacher_action"].nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
            obs, earned, failed, late, self.info = self.env.step(torch.where(ended[:, None], tree, action))
            newly = failed | late
            sums.count(newly, self.info)
            final = torch.where(ended[:, None], final, self.info["final_obs"])
            reward += torch.where(ended, 0.0, earned)
            terminated, ended = terminated | (failed & ~ended), ended | newly
        return obs, final, reward, terminated, ended

    def step(self, action: Tensor, sums: RolloutSums) -> Step:
        """Hold a decision (N, 4); the reward is NaN for samples with anything bad."""
        obs, final, reward, terminated, ended = self._hold(action, sums)
        reward, is_odd = self.guard.values("reward", reward)
        final, is_unknown = self._cleaned(final, ended)
        features = self._no_features
        if self.world_model is not None:
            features = self.world_model.features(self.view["x"][:, : self.env.num_obs], action, final)
        shown = features if self.config.world_model.as_features else self._no_features
        reward = reward.masked_fill(self._bad | is_odd | is_unknown, math.nan)  # PPO leaves such samples out
        self._arrive(shown.masked_fill(ended[:, None], 0.0), obs, self.info)
        led_to = {"x": torch.cat([final, shown], dim=1)}
        return Step(reward, terminated, ended, led_to, {"uncertainty": features[:, -1]})

    def restore(self, arrays: dict[str, Any]) -> None:
        self._arrive(self._no_features, *self.env.restore(arrays))

    def _arrive(self, features: Tensor, obs: Tensor, info: View) -> None:
        """What the next decision is made by; ``info``: what ``VectorEnv.step`` tells beside ``obs``."""
        self.info = info
        seen, is_unknown = self._cleaned(obs)
        teacher_action, is_odd = self.guard.values("teacher_action", info["teacher_action"])
        x, self._bad = torch.cat([seen, features], dim=1), is_unknown | is_odd
        self.view = {"x": x, "teacher_action": teacher_action, "leaf": info["leaf"]}
        self.carried = {"x": x, "bad": self._bad}  # the world model's columns remember the last step

    def _cleaned(self, obs: Tensor, counted: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The observation, means for what is not finite, and which rows were bad."""
        return self.guard.values(OBSERVATION, obs, self._norm.mean[: self.env.num_obs].float(), counted)


BANK_SEED = 4242  # of the scenarios to learn from; those of evaluations come from ``train.evaluate_seed``


class InSurrogate(Environment):
    """The kinematic surrogate for a policy over a set of obstacles. Its view: ``obstacles`` and ``own``, as
    the vehicle knows them, and ``truth``, for a critic."""

    device, steps = torch.device("cpu"), HOLD_STEPS

    def __init__(self, config: LearningConfig, bank: ScenarioBank | None = None) -> None:
        """Draws scenarios, unless they are given. Raises SettingError, ConfigError for what does not fit."""
        from uuvtai.surrogate.observation import SET_TABLE
        from uuvtai.surrogate.world import Surrogate, draw_bank

        held, dt_s = config.policy.hold_steps, config.episode.control_dt_s
        if held != HOLD_STEPS or abs(held * dt_s - DECISION_S) > 1e-9:
            told = f"the surrogate decides every {DECISION_S} s, after {HOLD_STEPS} control steps"
            raise SettingError(f"policy.hold_steps={held}, episode.control_dt_s={dt_s}: {told}")
        torch.set_flush_denormal(True)
        self.config, self.observation_table, self.num_envs = config, SET_TABLE, config.train.num_envs
        self.scenes = config.train.scenes or (config.world.own_scene,)
        bank = bank or draw_bank(config, self.scenes, BANK_SEED, config.surrogate.scenarios)
        self.env = Surrogate(config, bank, self.num_envs, config.train.seed)
        self.view: View = dict(self.env.view)
        self.guard = Guard((), self.num_envs, config.train.patience, self.device)
        self._returns = torch.zeros(self.num_envs)
        self.carried = {"returns": self._returns}
        self._held_out: ScenarioBank | None = None

    def make_policy(self, generator: torch.Generator) -> SetPolicy:
        return SetPolicy(self.view, self.config, generator)

    def begin(self, policy: Policy, world_model: WorldModel | None, generator: torch.Generator) -> None:
        """First episodes; ``generator`` draws all that follow."""
        self._generator = generator
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        self.env.look()

    def _begin(self, rows: Tensor) -> None:
        found = torch.randint(len(self.env.bank.origin), (self.num_envs,), generator=self._generator)
        self.env.begin(rows, found)

    @property
    def scenarios(self) -> tuple[Tensor, Tensor]:
        return torch.full_like(self.env.scenario, BANK_SEED), self.env.scenario

    def step(self, action: Tensor, sums: RolloutSums) -> Step:
        surrogate, final = self.env, None
        reward, outcome = surrogate.step(action)
        ended, late = outcome != RUNNING, outcome == TIMEOUT
        self._returns += reward
        sums.samples += len(reward)
        if bool(ended.any()):
            sums.outcomes += torch.bincount(outcome[ended], minlength=len(OUTCOMES)).double()
            sums.episode_return += self._returns[ended].double().sum()
            sums.episode_steps += (surrogate.time_s[ended] * (HOLD_STEPS / DECISION_S)).round().double().sum()
            self._returns[ended] = 0.0
            if bool(late.any()):
                surrogate.look()
                final = {name: part.clone() for name, part in self.view.items()}
            self._begin(ended)
        surrogate.look()
        return Step(reward, ended & ~late, ended, final, {})

    @torch.no_grad()
    def evaluate(self, policy: Policy) -> dict[str, float]:
        """``eval/*`` of the policy's mean, on as many new scenarios of each world and scene."""
        from uuvtai.surrogate.world import Surrogate, draw_bank

        train = self.config.train
        each = -(-train.evaluate_episodes // (len(self.config.surrogate.worlds) * len(self.scenes)))
        if self._held_out is None:
            self._held_out = draw_bank(self.config, self.scenes, train.evaluate_seed, each)
        bank, n = self._held_out, len(self._held_out.obstacle)
        surrogate = Surrogate(self.config, bank, n, train.evaluate_seed)
        surrogate.begin(torch.ones(n, dtype=torch.bool), torch.arange(n))
        outcome, time_s = torch.full((n,), RUNNING, dtype=torch.int32), torch.zeros(n)
        while bool((outcome == RUNNING).any()):
            wish = by_part(policy.mean_of, policy.prepared(surrogate.look()))
            _, now = surrogate.step(wish.clamp(-MOST_WISH, MOST_WISH))
            new = (outcome == RUNNING) & (now != RUNNING)
            outcome, time_s = torch.where(new, now, outcome), torch.where(new, surrogate.time_s, time_s)
        won, late = outcome == SUCCESS, outcome == TIMEOUT
        metrics = {
            "eval/success_rate": float(won.float().mean()),
            "eval/collision_rate": float((~won & ~late).float().mean()),
        }
        if bool(won.any()):
            metrics["eval/time_to_success_mean_s"] = float(time_s[won].mean())
        for number, name in enumerate(bank.names):
            metrics[f"eval/success_{name}"] = float(won[bank.origin == number].float().mean())
        return metrics
