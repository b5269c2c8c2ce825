"""Our PPO beside Stable-Baselines3's on Pendulum-v1: same hyperparameters, same environments, several
seeds."""

from __future__ import annotations

import math
import statistics
import time

import torch

from benchmarks.common import Job, Row

THREADS = 1
_SEEDS, _ENVS, _STEPS, _ROLLOUTS, _EPISODES_PER_ENV = 6, 8, 128, 80, 5
_MINIBATCHES, _EPOCHS, _RATE, _GAMMA, _LAMBDA, _CLIP, _VALUE, _NORM = 8, 10, 1e-3, 0.9, 0.95, 0.2, 0.5, 0.5
_HIDDEN = (64, 64)
_UNSEEN = 1000
"""seed of the episodes that are judged"""
_NOISE = 2.0
"""standard errors of the difference of the seeds' means within which two learners count as equal"""


def measure(job: Job) -> list[Row]:
    """Cost of an episode (minus the return) after training, mean over the seeds, and the time to train."""
    seeds, rollouts, episodes = (2, 1, 1) if job.quick else (_SEEDS, _ROLLOUTS, _EPISODES_PER_ENV)
    cost: dict[str, list[float]] = {"ours": [], "peer": []}
    seconds: dict[str, list[float]] = {"ours": [], "peer": []}
    for seed in range(seeds):
        for name, train in (("ours", _ours), ("peer", _theirs)):
            begun = time.process_time()
            act = train(seed, rollouts)
            seconds[name].append(time.process_time() - begun)
            cost[name].append(_cost(act, episodes))
            job.say(f"seed {seed} {name}: {cost[name][-1]:.1f}")
    means = {name: statistics.mean(values) for name, values in cost.items()}
    errors = {name: statistics.stdev(values) / math.sqrt(seeds) for name, values in cost.items()}
    apart = abs(means["ours"] - means["peer"]) / math.hypot(errors["ours"], errors["peer"])
    untrained = _cost(lambda observation: torch.zeros(len(observation), 1).numpy(), episodes)
    steps = rollouts * _ENVS * _STEPS
    details = {
        "cost_by_seed": cost,
        "standard_error": errors,
        "env_steps": steps,
        "cost_without_torque": untrained,
    }
    note = (
        f"{seeds} seeds, standard errors {errors['ours']:.0f} and {errors['peer']:.0f}; no torque: "
        f"{untrained:.0f}"
    )
    what = f"cost of an episode after {steps:,} steps"
    return [
        Row(
            what,
            means["ours"],
            "minus return",
            means["peer"],
            "SB3",
            True,
            note=note,
            details=details,
        ),
        Row("difference, in its standard errors", apart, "", less_is_better=True, floor=_NOISE),
        Row(
            "CPU time of a training step, collecting and learning",
            1e6 * statistics.mean(seconds["ours"]) / steps,
            "us/env-step",
            1e6 * statistics.mean(seconds["peer"]) / steps,
            "SB3",
            less_is_better=True,
        ),
    ]


def _envs(seed: int):
    from stable_baselines3.common.env_util import make_vec_env

    return make_vec_env("Pendulum-v1", n_envs=_ENVS, seed=seed)


def _cost(act, episodes: int) -> float:
    """Minus the mean return of this many episodes in each env (Pendulum's last 200 steps) with actions
    ``act(observation)``."""
    envs = _envs(_UNSEEN)
    observation, total = envs.reset(), 0.0
    for _ in range(episodes * 200):
        observation, reward, _, _ = envs.step(act(observation))
        total -= float(reward.sum())
    return total / (episodes * _ENVS)


def _theirs(seed: int, rollouts: int):
    from stable_baselines3 import PPO

    model = PPO(
        "MlpPolicy", _envs(seed), seed=seed, device="cpu", n_steps=_STEPS,
        batch_size=_ENVS * _STEPS // _MINIBATCHES, n_epochs=_EPOCHS,
        learning_rate=_RATE, gamma=_GAMMA, gae_lambda=_LAMBDA, clip_range=_CLIP, ent_coef=0.0, vf_coef=_VALUE,
        max_grad_norm=_NORM,
        policy_kwargs={"net_arch": list(_HIDDEN), "activation_fn": torch.nn.Tanh},
    )  # fmt: skip
    model.learn(rollouts * _ENVS * _STEPS)
    return lambda observation: model.predict(observation, deterministic=True)[0]


def _ours(seed: int, rollouts: int):
    from uuvtai.config.learning import PolicyConfig, PpoConfig
    from uuvtai.learn.policy import ActorCritic
    from uuvtai.learn.ppo import Ppo
    from uuvtai.learn.rollout import Rollout

    generator = torch.Generator().manual_seed(seed)
    policy = ActorCritic(
        3,
        PolicyConfig(hidden=_HIDDEN, activation="tanh", initial_std=1.0, min_std=1e-3),
        None,
        generator,
        num_actions=1,
    )
    config = PpoConfig(
        rollout_steps=_STEPS, learning_rate=_RATE, epochs=_EPOCHS, minibatches=_MINIBATCHES, clip=_CLIP,
        gamma=_GAMMA, gae_lambda=_LAMBDA,
        entropy_weight=0.0, value_weight=_VALUE, max_grad_norm=_NORM, shuffle=True,
        normalise_observations=False, normalise_values=False,
    )  # fmt: skip
    ppo, rollout = Ppo(policy, config), Rollout(_STEPS, _ENVS, 3, num_actions=1)
    envs = _envs(seed)
    x = torch.from_numpy(envs.reset())
    for _ in range(rollouts):
        x = _collected(policy, rollout, envs, x, generator)
        ppo.update(rollout, generator=generator)

    def act(observation):
        with torch.no_grad():
            return policy.distribution(torch.from_numpy(observation))[0].clamp(-2.0, 2.0).numpy()

    return act


def _collected(policy, rollout, envs, x: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Fill the rollout from inputs x on; returns those after its last step. Pendulum never terminates: every
    ending is a timeout."""
    from uuvtai.learn.rollout import final_value

    rollout.clear()
    never, idle = torch.zeros(_ENVS, dtype=torch.bool), torch.zeros(_ENVS, 1)
    for _ in range(rollout.steps):
        step = policy.act(x, generator)
        observation, reward, ended, infos = envs.step(step.action.clamp(-2.0, 2.0).numpy())
        after = torch.from_numpy(observation)
        final = torch.stack(
            [
                torch.from_numpy(info.get("terminal_observation", row))
                for info, row in zip(infos, observation, strict=True)
            ]
        )
        over = torch.from_numpy(ended)
        rollout.add(
            x, step, torch.from_numpy(reward), never, over, final_value(policy, final, never, over), idle
        )
        x = after
    rollout.close(policy.value(x).detach())
    return x
