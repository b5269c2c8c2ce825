"""The trainer: an environment, a policy and losses. ``Trainer.iterate`` is the page to read first."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from typing import Any

import torch

from uuvtai.common.errors import SettingError
from uuvtai.config.learning import LearningConfig
from uuvtai.learning.checkpoint import Checkpoint
from uuvtai.learning.distillation import Distillation, imitate
from uuvtai.learning.environments import InSurrogate, Simulated
from uuvtai.learning.networks import fast_products
from uuvtai.learning.policy_agent import network
from uuvtai.learning.ppo import Ppo
from uuvtai.learning.rollout import Recent, Rollout, collect
from uuvtai.learning.world_model import N_TARGET, WorldModel, WorldModelLearner


class Trainer:
    """Everything that training carries from one iteration to the next. All that is random draws from one CPU
    generator: equal states, configs and libraries give equal runs on a CPU, bit for bit."""

    note: Callable[[str], None] = print
    """told how far the warm start is"""

    def __init__(self, env: Simulated | InSurrogate, config: LearningConfig) -> None:
        """Begins the episodes of ``env``. ValueError for settings that do not fit each other."""
        samples = config.ppo.rollout_steps * env.num_envs
        self._samples = samples * env.steps  # env-steps of one rollout
        if config.ppo.minibatches > samples:
            told = f"a rollout has only {samples} samples: raise ppo.rollout_steps or train.num_envs"
            raise SettingError(f"ppo.minibatches={config.ppo.minibatches}, but {told}")
        self.env, self.config, self.observation_table = env, config, env.observation_table
        self.generator = torch.Generator().manual_seed(config.train.seed)
        self.policy = env.make_policy(self.generator)
        self.distillation = Distillation(self.policy, config, env.node_names) if env.node_names else None
        self.rollout = Rollout(config.ppo.rollout_steps)
        self.ppo = Ppo(self.policy, config.ppo)
        world, self.world_model, self.world_learner = config.world_model, None, None
        if world.enabled and "x" not in env.view:
            raise SettingError("world_model.enabled: a policy over a set of obstacles has none; turn it off")
        if world.enabled:
            widths = {c.name: c.slice.stop - c.slice.start for c in env.observation_table}
            names = [f"{name}_{i}" for name, width in widths.items() for i in range(width)]
            self.world_model = WorldModel(len(names), world, self.generator).to(env.device)
            self.world_learner = WorldModelLearner(self.world_model, world, names[:N_TARGET])
        self.recent = Recent(env.outcomes, env.reward_terms)
        self.iteration = self.env_steps = 0
        self._is_started = False
        env.begin(self.policy, self.world_model, self.generator)

    @fast_products()
    def iterate(self) -> dict[str, float]:
        """One iteration; its metrics. Rollout, all statistics standing still; running uncertainty; PPO (value
        statistics, minibatches, observation statistics); teacher batches; world model. Before the first one
        the behavior tree shows what it does. TrainingError after too many bad iterations in a row."""
        shown = self._begin() if self.iteration == 0 else {}
        sums, times = collect(self.env, self.policy, self.rollout, self.generator)
        began = time.perf_counter()
        metrics = shown | self._learn(self.iteration / self.config.train.iterations)
        times |= {"time/learn_s": time.perf_counter() - began}
        self.iteration += 1
        self.env_steps += self._samples
        metrics |= self.env.guard.take() | times | self.recent.add(sums)
        self.env.guard.check(self.iteration, metrics, self.env.scenarios)
        found = {"env_steps": float(self.env_steps), "env_steps_per_s": self._samples / sum(times.values())}
        decisions = {name.replace("env_steps", "decisions"): n / self.env.steps for name, n in found.items()}
        return metrics | {f"time/{name}": n for name, n in (found | decisions).items()}

    def start(self, found: Checkpoint) -> None:
        """Begin with the policy of another run, and its world model where both have one; the behavior tree
        then teaches nothing at the beginning. Raises CheckpointError for networks that do not fit."""
        parts = {"policy": self.policy.parts()["policy"], "world_model": self.world_model}
        for name, part in parts.items():
            if part is not None and (name == "policy" or name in found.model()):
                network(found, name, lambda part=part: part).train()
        self._is_started = True

    def evaluate(self) -> dict[str, float]:
        """``eval/*`` of the policy as it is, in the surrogate."""
        assert isinstance(self.env, InSurrogate)
        return self.env.evaluate(self.policy)

    def state(self) -> dict[str, Any]:
        """Copy of all that the next iterations depend on, nested; what ``checkpoint.save`` takes."""
        counters = {"iteration": self.iteration, "env_steps": self.env_steps}
        return {name: copy.deepcopy(part.state_dict()) for name, part in self._parts().items()} | {
            "generator": self.generator.get_state(),
            "recent": list(self.recent.rows),
            "counters": counters | {"bad_in_a_row": self.env.guard.bad_in_a_row},
            "env": self.env.env.capture(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on bit for bit on a CPU. ValueError, with nothing changed, for the state of another env."""
        self.env.restore(state["env"])
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self.generator.set_state(state["generator"])
        self.recent.rows = [list(row) for row in state["recent"]]
        counters = state["counters"]
        self.iteration, self.env_steps = int(counters["iteration"]), int(counters["env_steps"])
        self.env.guard.bad_in_a_row = int(counters["bad_in_a_row"])

    def _parts(self) -> dict[str, Any]:
        """Everything with a state of its own, by its name in a checkpoint."""
        parts = {"world_model": self.world_model, "world_learner": self.world_learner, "ppo": self.ppo}
        parts |= {"collector": self.env}
        if self.distillation:
            parts |= {"teacher_batches": self.distillation, "uncertainty": self.distillation.uncertainty}
        return {n: part for n, part in (self.policy.parts() | parts).items() if part is not None}

    def _begin(self) -> dict[str, float]:
        """Statistics begin with what the behavior tree meets: unscaled networks would learn in vain."""
        if isinstance(self.env, InSurrogate):
            is_taught = self.config.surrogate.warm_start_waves > 0 and not self._is_started
            return imitate(self.policy.actor, self.config, self.env.scenes, self.note) if is_taught else {}
        self.env.look_around(self.rollout)
        self.env_steps += self._samples
        self._learn_world()
        if self.world_model is not None and self.config.world_model.as_features:
            self.world_model.fill_in(*(self.rollout[name] for name in ("x", "action", "ended")))
        if not self._is_started:
            self.policy.observe(self.rollout)
        return {}

    def _learn(self, share: float) -> dict[str, float]:
        if self.distillation is None:
            return self.ppo.update(self.rollout, self.generator, share=share)
        strength, metrics = self.distillation.weigh(self.rollout, share)
        metrics |= self.ppo.update(self.rollout, self.generator, strength, share)
        metrics |= self.distillation.update(self.rollout, strength, self.generator)
        return metrics | self._learn_world()

    def _learn_world(self) -> dict[str, float]:
        """From all transitions within the rollout that do not end an episode."""
        if self.world_learner is None:
            return {}
        rollout = self.rollout
        obs, valid = rollout["x"][..., : self.world_learner.model.n_obs], ~rollout["ended"][:-1]
        return self.world_learner.update(obs[:-1], rollout["action"][:-1], obs[1:], valid, self.generator)
