"""Where a policy learns: the simulator, and its kinematic surrogate, behind one interface
(``rollout.Environment``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from uuvtai.common.enums import EGO_COLUMNS, N_OBSTACLE, OBSTACLE_WIDTH, OUTCOMES, RUNNING, SUCCESS, TIMEOUT
from uuvtai.common.errors import SettingError
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.agents import SetAgent
from uuvtai.learning.distillation import imitate, wish_of
from uuvtai.learning.networks import NUM_ACTIONS, OBSERVATION, ActorCritic, Guard, Policy, View, by_part
from uuvtai.learning.policy_agent import PolicyAgent
from uuvtai.learning.rollout import Environment, Rollout, RolloutSums, Step
from uuvtai.learning.set_networks import MOST_WISH, NUM_WISHES, SetPolicy
from uuvtai.learning.world_model import N_FEATURES, WorldModel

if TYPE_CHECKING:
    from uuvtai.envs.vector_env import VectorEnv
    from uuvtai.surrogate.world import ScenarioBank, Surrogate


# ------------------------------------------------------------------------------------------------------------
# A decision held for several control steps (frame skip): to the learner they are one transition.


Info = dict[str, torch.Tensor]
"""what ``VectorEnv.step`` tells beside the observation"""
Watch = Callable[[torch.Tensor, Info], None]
"""called after every control step with the rows (N,) whose episode ended in it, and its info"""


class HeldResult(NamedTuple):
    """What came of a decision, all (N, ...); rows whose episode ended on the way tell of that episode,
    ``obs`` and ``info`` of the next."""

    obs: torch.Tensor
    """observation of the next decision"""
    final_obs: torch.Tensor
    """observation that the decision led to"""
    reward: torch.Tensor
    """sum over the steps"""
    terminated: torch.Tensor
    ended: torch.Tensor
    outcome: torch.Tensor
    """int64 index of how the episode ended; without meaning where it went on"""
    info: Info
    """of the last control step"""


class Hold:
    """Drives the envs through ``steps`` control steps by one action.

    An episode that begins on the way is driven by the behaviour tree until the next decision.
    """

    def __init__(self, env: VectorEnv, steps: int) -> None:
        self._env, self.steps = env, steps

    def drive(self, action: torch.Tensor, watch: Watch | None = None) -> HeldResult:
        """Carry out ``action`` (N, 4)."""
        end = self._step(action)
        if watch:
            watch(end.ended, end.info)
        if self.steps == 1:
            return end
        end = end._replace(
            final_obs=end.final_obs.clone(), reward=end.reward.clone(), terminated=end.terminated.clone()
        )
        for _ in range(self.steps - 1):
            newest = end.info["teacher_action"].nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
            step = self._step(torch.where(end.ended[:, None], newest, action))
            if watch:
                watch(step.ended, step.info)
            end = _joined(end, step)
        return end

    def _step(self, action: torch.Tensor) -> HeldResult:
        obs, reward, terminated, truncated, info = self._env.step(action)
        return HeldResult(
            obs, info["final_obs"], reward, terminated, terminated | truncated, info["outcome"].long(), info
        )


def _joined(first: HeldResult, then: HeldResult) -> HeldResult:
    """One stretch after the other; rows that ended in the first keep what it told."""
    on = ~first.ended
    return HeldResult(
        obs=then.obs,
        final_obs=torch.where(on[:, None], then.final_obs, first.final_obs),
        reward=torch.where(on, first.reward + then.reward, first.reward),
        terminated=first.terminated | (on & then.terminated),
        ended=first.ended | (on & then.ended),
        outcome=torch.where(on, then.outcome, first.outcome),
        info=then.info,
    )


# ------------------------------------------------------------------------------------------------------------


class Simulated(Environment):
    """The simulator for a policy on observation vectors. Its view: ``x``, the observation and the world
    model's residual and uncertainty of it (zero without one, and in the first step of an episode);
    ``teacher_action`` (N, 4) and ``leaf`` (N,) of the behavior tree. What is not finite is replaced."""

    def __init__(self, env: VectorEnv, config: LearningConfig) -> None:
        """Call ``begin`` before anything else."""
        self.env, self.config = env, config
        self.num_envs, self.device = env.num_envs, env.device
        self.outcomes, self.reward_terms, self.node_names = env.outcomes, env.reward_terms, env.node_names
        self.observation_table = env.observation_table
        self.hold = Hold(env, config.policy.hold_steps)
        self.steps = self.hold.steps
        n, n_in, device = self.num_envs, env.num_obs + N_FEATURES, self.device
        self.view: View = {
            "x": torch.zeros(n, n_in, device=device),
            "teacher_action": torch.zeros(n, NUM_ACTIONS, device=device),
            "leaf": torch.zeros(n, dtype=torch.int32, device=device),
        }
        self.guard = Guard(
            [(c.name, c.slice) for c in self.observation_table], n, config.train.patience, device
        )
        self.world_model: WorldModel | None = None
        self._final, self._reward = torch.zeros(n, n_in, device=device), torch.zeros(n, device=device)
        self._bad = torch.zeros(n, dtype=torch.bool, device=device)
        self._features = torch.zeros(n, N_FEATURES, device=device)

    def make_policy(self, generator: torch.Generator) -> ActorCritic:
        """As in ``Environment``."""
        return ActorCritic(self.view["x"].shape[1], self.config.policy, generator).to(self.device)

    def agent(self, policy: ActorCritic) -> PolicyAgent:
        """The policy driving by its mean."""
        model = self.world_model if self.config.world_model.as_features else None
        return PolicyAgent(policy, model, self.num_envs, self.device)

    def begin(self, policy: ActorCritic, world_model: WorldModel | None, generator: torch.Generator) -> None:
        """First episodes. Values that are not finite count as the policy's mean; the world model's columns
        stay zero where ``world_model.as_features`` says so, but its uncertainty is told all the same."""
        self._norm, self.world_model = policy.observation_norm, world_model
        self._arrive(*self.env.reset(self.config.train.seed))

    @torch.no_grad()
    def look_around(self, rollout: Rollout) -> bool:
        """Let the behavior tree drive for T steps and keep inputs, actions and endings: what the statistics
        begin with."""
        for t in range(rollout.steps):
            action = self.view["teacher_action"].clone()
            rollout.note(t, {"x": self.view["x"], "action": action})
            rollout.note(t, {"ended": self.step(action, None).ended})
        return True

    @torch.no_grad()
    def fill_model_features(self, rollout: Rollout) -> None:
        """Fill in the world-model columns of what ``look_around`` saw, by what the model has learned from
        it."""
        if self.world_model is None or not self.config.world_model.as_features:
            return
        x, n = rollout["x"], self.env.num_obs
        for t in range(1, len(x)):
            found = self.world_model.features(x[t - 1, :, :n], rollout["action"][t - 1], x[t, :, :n])
            x[t, :, n:] = torch.where(rollout["ended"][t - 1, :, None], 0.0, found)

    @property
    def scenarios(self) -> tuple[torch.Tensor, torch.Tensor]:
        """As in ``Environment``."""
        return self.info["seed"], self.info["episode"]

    def step(self, action: torch.Tensor, sums: RolloutSums | None) -> Step:
        """Hold a decision (N, 4); the reward is NaN for samples with anything bad."""
        end = self.hold.drive(action, None if sums is None else sums.count)
        self._bad |= self.guard.values("reward", end.reward, self._reward)
        self._bad |= self._cleaned(end.final_obs, self._final, end.ended)
        if self.world_model is not None:
            n = self.env.num_obs
            self._features = self.world_model.features(self.view["x"][:, :n], action, self._final[:, :n])
            if self.config.world_model.as_features:
                self._final[:, n:] = self._features
        self._reward.masked_fill_(self._bad, math.nan)  # PPO leaves such samples out
        self.view["x"].copy_(self._final).masked_fill_(end.ended[:, None], 0.0)
        self._arrive(end.obs, end.info)
        told = {"uncertainty": self._features[:, -1]}
        return Step(self._reward, end.terminated, end.ended, {"x": self._final}, told)

    def capture(self) -> dict[str, Any]:
        """As in ``Environment``."""
        return self.env.capture()

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The present input: its world-model columns remember the last step."""
        return {"x": self.view["x"].clone(), "bad": self._bad.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """As in ``Environment``."""
        self.view["x"].copy_(state["x"])
        self._bad.copy_(state["bad"])

    def restore(self, arrays: dict[str, Any]) -> None:
        """As in ``Environment``."""
        self._arrive(*self.env.restore(arrays))

    def _arrive(self, obs: torch.Tensor, info: Info) -> None:
        """The observation of the next decision, and what the tree would do now: the next step overwrites
        it."""
        self.info = info
        self._bad.copy_(self._cleaned(obs, self.view["x"]))
        self._bad |= self.guard.values("teacher_action", info["teacher_action"], self.view["teacher_action"])
        self.view["leaf"].copy_(info["leaf"])

    def _cleaned(
        self, obs: torch.Tensor, x: torch.Tensor, counted: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Write the observation into an input, the column's mean in place of what is not finite; which rows
        were bad."""
        n = self.env.num_obs
        return self.guard.values(OBSERVATION, obs, x[:, :n], self._norm.mean[:n].float(), counted)


class SimulatedSet(Environment):
    """The simulator for a policy over a set of obstacles. Its view: ``obstacles`` and ``own``, as the vehicle
    knows them, no ``truth``, and what the tree would wish. An env whose episode ends rests until the next
    decision."""

    def __init__(self, env: VectorEnv, config: LearningConfig) -> None:
        """``env`` resets nothing by itself."""
        self.env, self.config = env, config
        self.num_envs, self.device, self.node_names = env.num_envs, env.device, env.node_names
        self.outcomes, self.reward_terms = env.outcomes, env.reward_terms
        self.observation_table, self.steps = set_table(), config.policy.hold_steps
        n = self.num_envs
        self.guard = Guard((), n, config.train.patience, self.device)
        widths = {"obstacles": (N_OBSTACLE, OBSTACLE_WIDTH), "own": (EGO_COLUMNS,), "truth": (N_OBSTACLE, 0)}
        self.view = {name: torch.zeros(n, *width, device=self.device) for name, width in widths.items()}
        self.view["teacher_action"] = torch.zeros(n, NUM_WISHES, device=self.device)
        self.view["leaf"] = torch.zeros(n, dtype=torch.int32, device=self.device)
        self._reward = torch.zeros(n, device=self.device)

    def make_policy(self, generator: torch.Generator) -> SetPolicy:
        """As in ``Environment``."""
        return SetPolicy(self.view, self.config, generator).to(self.device)

    def agent(self, policy: SetPolicy) -> SetAgent:
        """The policy driving by its mean."""
        gap_m = self.config.surrogate.vertical_gap_m
        return SetAgent(policy.actor, self.env.sim, self.steps, gap_m)

    def begin(self, policy: SetPolicy, world_model: WorldModel | None, generator: torch.Generator) -> None:
        """As in ``Environment``."""
        self._hull = self.agent(policy)
        _, self.info = self.env.reset(self.config.train.seed)
        self._look()

    def step(self, action: torch.Tensor, sums: RolloutSums | None) -> Step:
        """Hold a wish (N, 3)."""
        hull, done = self._hull, torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        hull.wish.copy_(action.clamp(-MOST_WISH, MOST_WISH))
        reward, terminated = torch.zeros_like(self._reward), done
        for _ in range(self.steps):
            _, earned, failed, late, self.info = self.env.step(hull.command())
            hull.advance()
            ended = (failed | late) & ~done
            if sums is not None:
                sums.count(ended, self.info)
            reward += torch.where(done, 0.0, earned)
            terminated, done = terminated | (ended & failed), done | ended
        bad = self.guard.values("reward", reward, self._reward)
        self._reward.masked_fill_(bad, math.nan)
        self._look()
        final = None
        if bool(done.any()):
            final = {name: part.clone() for name, part in self.view.items()}
            _, self.info = self.env.reset(mask=done)
            hull.reset(done)
            self._look()
        return Step(self._reward, terminated, done, final, {"uncertainty": torch.zeros_like(reward)})

    @property
    def scenarios(self) -> tuple[torch.Tensor, torch.Tensor]:
        """As in ``Environment``."""
        return self.info["seed"], self.info["episode"]

    def capture(self) -> dict[str, Any]:
        """As in ``Environment``."""
        return self.env.capture()

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The present view, and what was carried out last."""
        return {name: part.clone() for name, part in (self.view | self._hull.memory()).items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """As in ``Environment``."""
        for name, part in (self.view | self._hull.memory()).items():
            part.copy_(state[name])

    def restore(self, arrays: dict[str, Any]) -> None:
        """As in ``Environment``."""
        _, self.info = self.env.restore(arrays)

    def _look(self) -> None:
        self._hull.look()
        ego, view = self._hull.ego, self.view
        view["obstacles"].copy_(self._hull.obstacles)
        view["own"].copy_(self._hull.own)
        view["leaf"].copy_(self.info["leaf"])
        command = self.info["teacher_action"].nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        view["teacher_action"].copy_(wish_of(command, ego, self.env.config.vehicle))


# ------------------------------------------------------------------------------------------------------------


BANK_SEED = 4242
"""of the scenarios to learn from; those of evaluations come from ``train.evaluate_seed``"""
HOLD_STEPS, DECISION_S = 5, 0.1
"""of the surrogate (``uuvtai/surrogate/motion.py``), which is not imported before it is used"""


class InSurrogate(Environment):
    """The kinematic surrogate for a policy over a set of obstacles. Its view: ``obstacles`` and ``own``, as
    the vehicle knows them, and ``truth``, for a critic."""

    device, steps = torch.device("cpu"), HOLD_STEPS

    def __init__(self, config: LearningConfig, bank: ScenarioBank | None = None) -> None:
        """Draws the scenarios, unless they are given. Raises ConfigError for a world that is none, or has
        another tank."""
        from uuvtai.surrogate.world import Surrogate, draw_bank

        _refuse_what_the_surrogate_lacks(config)
        torch.set_flush_denormal(True)
        self.config, self.observation_table, self.num_envs = config, set_table(), config.train.num_envs
        self.scenes = config.train.scenes or (config.world.own_scene,)
        bank = bank or draw_bank(config, self.scenes, BANK_SEED, config.surrogate.scenarios)
        self.surrogate = Surrogate(config, bank, self.num_envs, config.train.seed)
        self.view: View = self.surrogate.view._asdict()
        if not config.ppo.critic_sees_truth:
            self.view["truth"] = self.view["truth"][..., :0]
        self.guard = Guard((), self.num_envs, config.train.patience, self.device)
        self._returns = torch.zeros(self.num_envs)
        self._held_out: ScenarioBank | None = None

    def make_policy(self, generator: torch.Generator) -> SetPolicy:
        """As in ``Environment``."""
        return SetPolicy(self.view, self.config, generator)

    def begin(self, policy: Policy, world_model: WorldModel | None, generator: torch.Generator) -> None:
        """First scenarios; ``generator`` draws all that follow."""
        self._generator = generator
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        self.surrogate.look()

    def _begin(self, rows: torch.Tensor) -> None:
        found = torch.randint(self.surrogate.num_scenarios, (self.num_envs,), generator=self._generator)
        self.surrogate.begin(rows, found)

    def warm_start(self, policy: SetPolicy, note: Callable[[str], None]) -> dict[str, float]:
        """Learn from the tree first, where ``surrogate.warm_start_waves`` says so; metrics."""
        waves = self.config.surrogate.warm_start_waves
        return imitate(policy.actor, self.config, self.scenes, note) if waves else {}

    @property
    def scenarios(self) -> tuple[torch.Tensor, torch.Tensor]:
        """As in ``Environment``."""
        return torch.full_like(self.surrogate.scenario, BANK_SEED), self.surrogate.scenario

    def step(self, action: torch.Tensor, sums: RolloutSums | None) -> Step:
        """Carry out a decision (N, 3)."""
        assert sums is not None
        surrogate, final = self.surrogate, None
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

    def capture(self) -> dict[str, Any]:
        """As in ``Environment``."""
        return self.surrogate.capture()

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Returns of the episodes so far."""
        return {"returns": self._returns.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """As in ``Environment``."""
        self._returns.copy_(state["returns"])

    def restore(self, arrays: dict[str, Any]) -> None:
        """As in ``Environment``."""
        self.surrogate.restore(arrays)

    @torch.no_grad()
    def evaluate(self, policy: Policy) -> dict[str, float]:
        """``eval/*`` of the policy as it is, without exploration, on scenarios that it never learnt from, the
        same number of each world and scene, in the surrogate."""
        from uuvtai.surrogate.world import Surrogate, draw_bank

        train = self.config.train
        each = -(-train.evaluate_episodes // (len(self.config.surrogate.worlds) * len(self.scenes)))
        if self._held_out is None:
            self._held_out = draw_bank(self.config, self.scenes, train.evaluate_seed, each)
        bank = self._held_out
        outcome, time_s = run_once(
            Surrogate(self.config, bank, len(bank.obstacle), train.evaluate_seed), policy
        )
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


def set_table() -> tuple[Any, ...]:
    """The observation of a policy over a set of obstacles."""
    from uuvtai.surrogate.observation import SET_TABLE

    return SET_TABLE


def _refuse_what_the_surrogate_lacks(config: LearningConfig) -> None:
    """Raise SettingError for settings that the surrogate does not have."""
    if config.encoder != "set":
        raise SettingError(
            f"policy.encoder={config.encoder}: the surrogate knows a set of obstacles and no observation "
            "vectors; learn in the simulator: surrogate.enabled=false"
        )
    held, dt_s = config.policy.hold_steps, config.episode.control_dt_s
    if held != HOLD_STEPS or abs(held * dt_s - DECISION_S) > 1e-9:
        raise SettingError(
            f"policy.hold_steps={held}, episode.control_dt_s={dt_s}: the surrogate decides every "
            f"{DECISION_S} s, after {HOLD_STEPS} control steps"
        )


@torch.no_grad()
def run_once(surrogate: Surrogate, policy: Policy) -> tuple[torch.Tensor, torch.Tensor]:
    """(outcome code, time [s]), both (N,), of scenario i in env i, driven by the mean."""
    every = torch.ones(surrogate.num_envs, dtype=torch.bool)
    surrogate.begin(every, torch.arange(surrogate.num_envs))
    outcome, time_s = torch.zeros(surrogate.num_envs, dtype=torch.int32), torch.zeros(surrogate.num_envs)
    while bool((outcome == RUNNING).any()):
        view = surrogate.look()._asdict()
        _, now = surrogate.step(by_part(policy.mean_of, policy.prepared(view)).clamp(-MOST_WISH, MOST_WISH))
        new = (outcome == RUNNING) & (now != RUNNING)
        outcome, time_s = torch.where(new, now, outcome), torch.where(new, surrogate.time_s, time_s)
    return outcome, time_s
