"""Distillation: the policy's mean is drawn towards the behavior tree's action, more strongly where the world
model is unsure (docs/learning.md). The paper's term, lambda_t s_t E ||mu(x) - a_BT||^2, stands in PPO's loss
and in teacher batches with an Adam of their own, which forgets a constant factor: it scales their rate."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from uuvtai.common.enums import SUCCESS
from uuvtai.config.learning import LearningConfig, UncertaintyConfig
from uuvtai.learning.agents import SetAgent
from uuvtai.learning.networks import AdamLearner, Policy
from uuvtai.learning.parameter_search import run_search_episodes, simulator_of
from uuvtai.learning.policy_agent import AgentDecision
from uuvtai.learning.rollout import Rollout
from uuvtai.learning.set_networks import NUM_WISHES, SetActor

if TYPE_CHECKING:
    from uuvtai.config import VehicleConfig
    from uuvtai.sim.setup import Scene
    from uuvtai.sim.sim import Sim


def imitation_error(mean: Tensor, teacher_action: Tensor) -> Tensor:
    """||mean - teacher_action||^2 (...,) of every sample, in squared parts of the vehicle's limits."""
    return (mean - teacher_action).square().sum(dim=-1)


def leaf_errors(names: Sequence[str], error: Tensor, leaf: Tensor) -> dict[str, float]:
    """``distillation/loss``, the mean of finite imitation errors (n,), and ``distillation/leaf/<name>``, that
    of samples in which a node of this name acted: ``leaf`` (n,) counts the nodes of ``names``, -1 is none."""
    finite, node = torch.isfinite(error), torch.arange(len(names), device=leaf.device)
    metrics = {}
    for name in sorted(set(names)):
        nodes = node[[own == name for own in names]]
        metrics[f"distillation/leaf/{name}"] = error[finite & torch.isin(leaf, nodes)].double().mean()
    metrics["distillation/loss"] = error[finite].double().mean()
    return {name: float(mean) for name, mean in metrics.items() if not mean.isnan()}


def piecewise_linear(points: Sequence[tuple[float, float]], fraction: float) -> float:
    """Value at ``fraction`` of (fraction, value) ``points``: constant outside; at a jump the later holds."""
    return float(np.interp(fraction, *np.transpose(points)))


class Uncertainty(nn.Module):
    """Exponential moving average of the uncertainty and the distillation scale s_t: sigma_bar <- (1 - rho)
    sigma_bar + rho sigma_t, s_t = clip(1 + alpha sigma_bar, 1, s_max). It begins at the first value seen."""

    def __init__(self, config: UncertaintyConfig) -> None:
        super().__init__()
        self.config = config
        self.mean = nn.Buffer(torch.zeros((), dtype=torch.float64))
        self.seen = nn.Buffer(torch.zeros((), dtype=torch.bool))

    @torch.no_grad()
    def update(self, sigma: Tensor) -> None:
        """Take in the finite uncertainties of a batch, any shape; a batch of none changes nothing."""
        newest = torch.where(torch.isfinite(sigma), sigma, math.nan).nanmean().double()
        if bool(newest.isnan()):
            return
        rho = self.config.ema
        self.mean.copy_(torch.where(self.seen, (1.0 - rho) * self.mean + rho * newest, newest))
        self.seen.fill_(True)

    @property
    def scale(self) -> float:
        """s_t: factor of the distillation weight, in [1, max_scale]."""
        return min(max(1.0 + self.config.gain * float(self.mean), 1.0), self.config.max_scale)


class Distillation(AdamLearner):
    """Weight of the loss, gradient steps on teacher batches, and metrics."""

    def __init__(self, policy: Policy, config: LearningConfig, node_names: Sequence[str]) -> None:
        super().__init__(policy.parameters(), lr=config.distillation.learning_rate)
        self.policy, self.config, self.node_names = policy, config.distillation, node_names
        self.uncertainty = Uncertainty(config.uncertainty).to(policy.log_std.device)

    def weigh(self, rollout: Rollout, share: float) -> tuple[float, dict[str, float]]:
        """lambda_t s_t when ``share`` of the run is over, and both for the log."""
        self.uncertainty.update(rollout["uncertainty"])
        weight, scale = piecewise_linear(self.config.schedule, share), self.uncertainty.scale
        return weight * scale, {
            "distillation/lambda": weight,
            "distillation/scale": scale,
            "distillation/lambda_risk": weight * scale,
        }

    def update(self, rollout: Rollout, strength: float, generator: torch.Generator) -> dict[str, float]:
        """Learn from random batches of a rollout, by ``strength`` = lambda_t s_t; at 0 nothing is drawn.
        Samples without a finite reward count as 0. Metrics of the rollout."""
        samples, config = rollout.flat(), self.config
        teacher, valid = samples["teacher_action"], torch.isfinite(samples["reward"]).float()
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * strength
        for _ in range(config.steps if strength else 0):
            rows = torch.randint(len(valid), (config.batch,), generator=generator).to(valid.device)
            inputs = self.policy.prepared({name: samples[name][rows] for name in self.policy.inputs})
            # the critic has no part in this loss: without a gradient Adam passes it over
            self.step((valid[rows] * imitation_error(self.policy.mean_of(inputs), teacher[rows])).mean())
        error = imitation_error(samples["mean"], teacher)
        return leaf_errors(self.node_names, error, samples["leaf"])


# ------------------------------------------------------------------------------------------------------------
# Warm start of a policy over a set of obstacles by DAgger (Ross, Gordon & Bagnell 2011): whoever drives, the
# actor's mean is fitted to what the tree would do. The tree drives first, then the student more and more.


WAVE_EPISODES = 256  # episodes of a wave, at most ``train.num_envs``
PASSES, LAST_PASSES = 2, 6  # through all samples after a wave, and after the last one
MINIBATCH, RATE = 512, 1e-3
SEED = 7_000_003  # added to ``train.seed`` for episodes and draws of the warm start


def wish_of(command: Tensor, ego: Tensor, vehicle_cfg: VehicleConfig) -> Tensor:
    """(n, 3) wishes for the velocity of commands (n, 4) of vehicles: ``motion.wished_velocity`` backwards."""
    from uuvtai.surrogate.arrays import At

    fastest = (vehicle_cfg.max_surge_m_s**2 + vehicle_cfg.max_sway_m_s**2) ** 0.5
    surge, sway = vehicle_cfg.max_surge_m_s * command[:, 0], vehicle_cfg.max_sway_m_s * command[:, 1]
    c, s = ego[:, At.YAW].cos(), ego[:, At.YAW].sin()
    level = torch.stack([c * surge - s * sway, s * surge + c * sway], dim=1)
    return torch.cat([ego[:, At.FLIP : At.FLIP + 2] * level / fastest, command[:, 2:3]], dim=1)


class Student(SetAgent):
    """Drives with the tree, drawn anew for every decision, and keeps what the tree says of each."""

    def __init__(self, actor: SetActor, sim: Sim, config: LearningConfig, generator: torch.Generator) -> None:
        super().__init__(actor, sim, config)
        self.simulator, self._generator = sim, generator
        self.tree_share = 1.0  # chance that the tree drives, beta of DAgger
        self.samples: list[tuple[Tensor, ...]] = []
        """obstacles, own columns and (n, 3) the tree's wish of n decisions"""
        self._with_tree = torch.ones(sim.num_envs, dtype=torch.bool)

    @torch.no_grad()
    def decide(self, obs: Tensor) -> AgentDecision:
        due = self._age % self._hold == 0
        said = super().decide(obs)
        tree = self.simulator.action
        if bool(due.any()):
            draw = torch.rand(len(due), generator=self._generator)
            self._with_tree = torch.where(due, draw < self.tree_share, self._with_tree)
            kept = due & (torch.from_numpy(self.simulator.rows(self.simulator.s.clock.running)) == 1)
            wish = wish_of(tree[kept], self.ego[kept], self.simulator.config.vehicle)
            self.samples.append((self.obstacles[kept], self.own[kept], wish))
        return said._replace(action=torch.where(self._with_tree[:, None], tree, said.action))


def imitate(
    actor: SetActor, config: LearningConfig, scenes: tuple[Scene, ...], note: Callable[[str], None]
) -> dict[str, float]:
    """Waves of DAgger, each told to ``note``; metrics."""
    sims: dict[str, Sim] = {}
    began = time.perf_counter()
    waves, rows = config.surrogate.warm_start_waves, min(WAVE_EPISODES, config.train.num_envs)
    few = config.model_copy(update={"train": config.train.model_copy(update={"num_envs": rows})})
    seed = config.train.seed + SEED
    generator = torch.Generator().manual_seed(seed)
    learner = AdamLearner(actor.net.parameters(), lr=RATE)
    places = [(world, scene) for scene in scenes for world in config.surrogate.worlds]
    samples: list[tuple[Tensor, ...]] = []
    won = loss = 0.0
    for wave in range(waves):
        world, scene = places[wave % len(places)]
        if world not in sims:
            sims[world] = simulator_of(few, world, scenes)
        student = Student(actor, sims[world], config, generator)
        student.tree_share = 1.0 - wave / max(1, waves - 1)
        outcome, _ = run_search_episodes(sims[world], student, scene, seed, wave * rows, rows)
        won = float((outcome == SUCCESS).float().mean())
        samples = [tuple(torch.cat(parts) for parts in zip(*samples, *student.samples, strict=True))]
        passes = LAST_PASSES if wave == waves - 1 else PASSES
        loss = regress(actor, learner, samples[0], passes, generator)
        done = f"imitating the tree, wave {wave + 1} of {waves}"
        note(f"{done}: {100 * won:.0f} % arrived in {world}, error {loss:.3f}")
    return {
        "warm_start/loss": loss,
        "warm_start/success_rate_last_wave": won,
        "warm_start/decisions": float(len(samples[0][-1])),
        "warm_start/seconds": time.perf_counter() - began,
    }


def regress(
    actor: SetActor, learner: AdamLearner, sample: tuple[Tensor, ...], passes: int, generator: torch.Generator
) -> float:
    """Fit the actor's mean to the wishes of a sample; mean squared error of the last pass."""
    obstacles, own, wish = sample
    errors: list[float] = []
    for _ in range(passes):
        errors = []
        for index in torch.randperm(len(wish), generator=generator).split(MINIBATCH):
            loss = imitation_error(actor(obstacles[index], own[index]), wish[index]).mean()
            learner.step(loss, 1.0)
            errors.append(float(loss.detach()) / NUM_WISHES)
    return sum(errors) / len(errors)
