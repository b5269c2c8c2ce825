"""The trainer: one iteration after the other, a rollout and what is learned from it. ``Trainer.iterate`` is
the page to read first."""

from __future__ import annotations

import copy
import time
from typing import TYPE_CHECKING, Any

import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.learning.distillation import (
    TeacherBatches,
    Uncertainty,
    check_weighting,
    piecewise_linear,
    weights_of,
)
from uuvtai.learning.networks import PREFIX, ActorCritic, Guard, fast_products
from uuvtai.learning.ppo import Ppo
from uuvtai.learning.rollout import N_FEATURES, Collector, Recent, Rollout
from uuvtai.learning.world_model import N_TARGET, WorldModel, WorldModelLearner

if TYPE_CHECKING:
    from uuvtai.envs.vector_env import VectorEnv


class Trainer:
    """Everything that training carries from one iteration to the next.

    All that is random draws from one CPU generator: equal states, configs and libraries give equal runs on a
    CPU, bit for bit.
    """

    def __init__(self, env: VectorEnv, config: LearningConfig) -> None:
        """Resets ``env``. ValueError for settings that do not fit each other."""
        check_weighting(config.distillation.weighting, config.world_model.enabled)
        self.env, self.config, self.observation_table = env, config, env.observation_table
        self.generator = torch.Generator().manual_seed(config.train.seed)
        n_in, device = env.num_obs + N_FEATURES, env.device
        self.policy = ActorCritic(n_in, config.policy, self.generator).to(device)
        self.uncertainty = Uncertainty(config.uncertainty).to(device)
        self.rollout = Rollout(config.ppo.rollout_steps, env.num_envs, n_in, device)
        self.guard = Guard(
            [(c.name, c.slice) for c in env.observation_table], env.num_envs, config.train.patience, device
        )
        self.ppo = Ppo(self.policy, config.ppo)
        self.teacher_batches = TeacherBatches(self.policy, config.distillation)
        world = config.world_model
        self.world_model = (
            WorldModel(env.num_obs, world, self.generator).to(device) if world.enabled else None
        )
        names = [f"{c.name}_{i}" for c in env.observation_table for i in range(c.slice.stop - c.slice.start)]
        self.world_learner = self.world_model and WorldModelLearner(self.world_model, world, names[:N_TARGET])
        self.collector = Collector(
            env, self.policy, self.world_model, self.rollout, self.guard, self.generator, world.as_features
        )
        self.recent = Recent(env.outcomes, env.reward_terms)
        self.iteration = self.env_steps = 0
        self.collector.begin(*env.reset(config.train.seed))

    def iterate(self) -> dict[str, float]:
        """One iteration; its metrics by their names in metrics.jsonl.

        Order: rollout, all statistics standing still; running uncertainty; PPO with the distillation term
        (value statistics before its minibatches, observation statistics after them); teacher batches; world
        model. Before the first iteration the behaviour tree drives for one rollout, which only the
        statistics see. TrainingError after too many bad iterations in a row.
        """
        if self.iteration == 0:
            self._look_around()
        sums = self.collector.collect()
        began = time.perf_counter()
        with fast_products():
            metrics = self._learn(self.iteration / self.config.train.iterations)
        learn_s = time.perf_counter() - began
        self.iteration += 1
        self.env_steps += self._samples
        metrics |= self.guard.take() | self._times(learn_s) | self.recent.add(sums)
        self._judge(metrics)
        return metrics | {"time/env_steps": float(self.env_steps)}

    # ------------------------------------------------------------------------------------------------- resume

    def state(self) -> dict[str, Any]:
        """Copy of all that the next iterations depend on, nested; what ``checkpoint.save`` takes."""
        return {name: copy.deepcopy(part.state_dict()) for name, part in self._parts().items()} | {
            "generator": self.generator.get_state(),
            "recent": list(self.recent.rows),
            "counters": {
                "iteration": self.iteration,
                "env_steps": self.env_steps,
                "bad_in_a_row": self.guard.bad_in_a_row,
            },
            "env": self.env.capture(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave, bit for bit on a CPU. ValueError, with nothing changed, for the
        state of another env."""
        obs, info = self.env.restore(state["env"])
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self.generator.set_state(state["generator"])
        self.collector.resume(obs, info)
        self.recent.rows = [list(row) for row in state["recent"]]
        counters = state["counters"]
        self.iteration, self.env_steps, self.guard.bad_in_a_row = (
            int(counters[n]) for n in ("iteration", "env_steps", "bad_in_a_row")
        )

    def _parts(self) -> dict[str, Any]:
        """Everything with a state of its own, by its name in a checkpoint."""
        parts = {
            "policy": self.policy,
            "world_model": self.world_model,
            "ppo": self.ppo,
            "teacher_batches": self.teacher_batches,
            "world_learner": self.world_learner,
            "uncertainty": self.uncertainty,
            "collector": self.collector,
        }
        return {name: part for name, part in parts.items() if part is not None}

    # ------------------------------------------------------------------------------------------- an iteration

    def _learn(self, share: float) -> dict[str, float]:
        """Everything that learns from the rollout; ``share`` of the run is over."""
        strength, metrics = self._strength(share)
        rollout, config = self.rollout, self.config.distillation
        rollout.weight.copy_(weights_of(config.weighting, self.collector.uncertainty))
        surrogate = self.iteration >= config.critic_warmup_iterations
        metrics |= self.ppo.update(rollout, strength, surrogate, self.generator)
        metrics |= self.collector.leaf_errors.take()
        kept = torch.where(torch.isfinite(rollout.reward), rollout.weight, 0.0)
        self.teacher_batches.update(
            rollout.flat("x"), rollout.flat("teacher_action"), kept.flatten(), strength, self.generator
        )
        return metrics | self._learn_world()

    def _look_around(self) -> None:
        """Statistics begin with what the behaviour tree meets: networks that begin unscaled learn from their
        first rollout in vain."""
        self.collector.look_around()
        self._learn_world()
        self.collector.fill_model_features()
        self.ppo.observe(self.rollout.x)
        self.env_steps += self._samples

    def _learn_world(self) -> dict[str, float]:
        """World model, from all transitions within the rollout that do not end an episode."""
        if self.world_learner is None:
            return {}
        obs, valid = self.rollout.x[..., : self.env.num_obs], ~self.rollout.ended[:-1]
        return self.world_learner.update(obs[:-1], self.rollout.action[:-1], obs[1:], self.generator, valid)

    def _strength(self, share: float) -> tuple[float, dict[str, float]]:
        """lambda_t s_t, and both for the log."""
        mean = self.collector.uncertainty.nanmean().nan_to_num()[None]
        self.uncertainty.update(mean)
        weight, scale = piecewise_linear(self.config.distillation.schedule, share), self.uncertainty.scale
        return weight * scale, {
            "distillation/lambda": weight,
            "distillation/scale": scale,
            "distillation/lambda_risk": weight * scale,
        }

    def _times(self, learn_s: float) -> dict[str, float]:
        simulate_s, infer_s = self.collector.simulate_s, self.collector.infer_s
        rate = self._samples / (simulate_s + infer_s + learn_s)
        return {
            "time/simulate_s": simulate_s,
            "time/infer_s": infer_s,
            "time/learn_s": learn_s,
            "time/env_steps_per_s": rate,
        }

    def _judge(self, metrics: dict[str, float]) -> None:
        """Tell the guard what was bad in this iteration."""
        complaints = [
            f"{int(v)} values of {name.removeprefix(PREFIX)} not finite"
            for name, v in metrics.items()
            if name.startswith(PREFIX)
        ]
        skipped = metrics["train/skipped_updates"]
        if skipped:
            complaints.append(f"{int(skipped)} updates left out because loss or gradient was not finite")
        self.guard.check(
            self.iteration, complaints, self.collector.info["seed"], self.collector.info["episode"]
        )

    @property
    def _samples(self) -> int:
        """Env-steps of one rollout."""
        return self.rollout.steps * self.collector.hold.steps * self.env.num_envs
