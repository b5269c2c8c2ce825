"""Distillation: the policy's mean is drawn towards the behaviour tree's action, more strongly where the world
model is unsure.

The paper's term is lambda_t E ||mu(x) - a_BT||^2 with the squared norm over the four actions. It stands in
the PPO loss, with lambda_t = lambda(share of the run) times the scale s_t of ``Uncertainty``, and again in
separate teacher batches with an Adam of their own. Adam forgets a constant factor of the loss, so in these
batches lambda_t scales the learning rate instead.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

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


def imitation_error(mean: torch.Tensor, teacher_action: torch.Tensor) -> torch.Tensor:
    """||mean - teacher_action||^2 of every sample: (..., 4) and (..., 4) to (...,), in squared parts of the
    vehicle's limits."""
    return (mean - teacher_action).square().sum(dim=-1)


def leaf_errors(names: Sequence[str], error: torch.Tensor, leaf: torch.Tensor) -> dict[str, float]:
    """``distillation/loss``, the mean of imitation errors (n,), and ``distillation/leaf/<name>``, that of the
    samples in which a leaf of this name acted. What is not finite is left out.

    ``names``: of every node of the tree, by its preorder index, as ``leaf`` (n,) counts; equal names are one
    entry. A leaf outside the tree (-1: none acted) counts in ``distillation/loss`` only.
    """
    finite, node = torch.isfinite(error), torch.arange(len(names), device=leaf.device)
    metrics = {}
    for name in sorted(set(names)):
        nodes = node[[own == name for own in names]]
        metrics[f"distillation/leaf/{name}"] = error[finite & torch.isin(leaf, nodes)].double().mean()
    metrics["distillation/loss"] = error[finite].double().mean()
    return {name: float(mean) for name, mean in metrics.items() if not mean.isnan()}


def piecewise_linear(points: Sequence[tuple[float, float]], fraction: float) -> float:
    """Value at ``fraction`` of (fraction, value) ``points``: linear in between, constant outside. Two points
    at the same fraction are a jump, and at the jump itself the later value holds."""
    return float(np.interp(fraction, *np.transpose(points)))


class Uncertainty(nn.Module):
    """Exponential moving average of the batch's uncertainty proxy and the distillation scale s_t.

    sigma_bar <- (1 - rho) sigma_bar + rho sigma_t, s_t = clip(1 + alpha sigma_bar, 1, s_max). sigma_bar
    begins at the first value that is seen, not at zero, which would take some 1 / rho iterations to wear off.
    """

    mean: Tensor
    seen: Tensor

    def __init__(self, config: UncertaintyConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros((), dtype=torch.float64))
        self.register_buffer("seen", torch.zeros((), dtype=torch.bool))

    @torch.no_grad()
    def update(self, sigma: Tensor) -> None:
        """Take in the uncertainty of a batch, any shape; values that are not finite are left out, a batch of
        none changes nothing."""
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
    """The loss as a part of a training: its weight, gradient steps on batches of (input, teacher action)
    beside those of PPO, and what is told of it."""

    def __init__(self, policy: Policy, config: LearningConfig, node_names: Sequence[str]) -> None:
        """``node_names``: of the tree that teaches."""
        super().__init__(policy.parameters(), lr=config.distillation.learning_rate)
        self.policy, self.config, self.node_names = policy, config.distillation, node_names
        self.uncertainty = Uncertainty(config.uncertainty).to(policy.log_std.device)

    def parts(self) -> dict[str, Any]:
        """What is kept, by name in a checkpoint."""
        return {"teacher_batches": self, "uncertainty": self.uncertainty}

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
        """Learn from random batches of a rollout, by ``strength`` = lambda_t s_t; at 0 nothing happens, and
        nothing is drawn from the (CPU) generator. Samples without a finite reward count as 0. Metrics of the
        rollout."""
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
# Warm start of a policy over a set of obstacles: imitation of the behavior tree in the simulator.
#
# DAgger (Ross, Gordon & Bagnell 2011, AISTATS): whoever drives, the tree says what it would do, and the
# actor's mean is fitted to all that was said so far. The tree drives in the first wave, the student more and
# more.


WAVE_EPISODES = 256
"""episodes of a wave, at most ``train.num_envs``"""
PASSES, LAST_PASSES = 2, 6
"""through all samples after a wave, and after the last one"""
MINIBATCH, RATE = 512, 1e-3
SEED = 7_000_003
"""added to ``train.seed`` for episodes and draws of the warm start"""


def wish_of(command: torch.Tensor, ego: torch.Tensor, vehicle_cfg: VehicleConfig) -> torch.Tensor:
    """(n, 3) wishes whose velocity is that of commands (n, 4) of vehicles (n, EGO_WIDTH); the yaw rate is
    left out. The inverse of ``motion.wished_velocity``."""
    from uuvtai.surrogate.arrays import At

    fastest = (vehicle_cfg.max_surge_m_s**2 + vehicle_cfg.max_sway_m_s**2) ** 0.5
    surge, sway = vehicle_cfg.max_surge_m_s * command[:, 0], vehicle_cfg.max_sway_m_s * command[:, 1]
    c, s = ego[:, At.YAW].cos(), ego[:, At.YAW].sin()
    level = torch.stack([c * surge - s * sway, s * surge + c * sway], dim=1)
    return torch.cat([ego[:, At.FLIP : At.FLIP + 2] * level / fastest, command[:, 2:3]], dim=1)


class Student(SetAgent):
    """Drives with the tree, drawn anew for every decision, and keeps what the tree says of each."""

    def __init__(self, actor: SetActor, sim: Sim, config: LearningConfig, generator: torch.Generator) -> None:
        super().__init__(actor, sim, config.policy.hold_steps, config.surrogate.vertical_gap_m)
        self.simulator, self._generator = sim, generator
        self.tree_share = 1.0
        """chance that the tree drives, beta of DAgger"""
        self.samples: list[tuple[torch.Tensor, ...]] = []
        """decisions to imitate: obstacles (n, lanes, OBSTACLE_WIDTH), own (n, EGO_COLUMNS), and (n, 3) what
        the tree asks for, as the policy would say it"""
        self._with_tree = torch.ones(sim.num_envs, dtype=torch.bool)

    @torch.no_grad()
    def decide(self, obs: torch.Tensor) -> AgentDecision:
        """Command for all rows, the tree's or the student's."""
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
    actor: SetActor,
    config: LearningConfig,
    scenes: tuple[Scene, ...],
    note: Callable[[str], None],
    sims: dict[str, Sim] | None = None,
) -> dict[str, float]:
    """``surrogate.warm_start_waves`` waves of DAgger, each told to ``note``; the actor's mean is then close
    to the tree. What was spent, as metrics. ``sims``: simulators of worlds that are there already."""
    began, sims = time.perf_counter(), dict(sims or {})
    waves, rows = config.surrogate.warm_start_waves, min(WAVE_EPISODES, config.train.num_envs)
    few = config.model_copy(update={"train": config.train.model_copy(update={"num_envs": rows})})
    seed = config.train.seed + SEED
    generator = torch.Generator().manual_seed(seed)
    learner = AdamLearner(actor.net.parameters(), lr=RATE)
    places = [(world, scene) for scene in scenes for world in config.surrogate.worlds]
    samples: list[tuple[torch.Tensor, ...]] = []
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
    actor: SetActor,
    learner: AdamLearner,
    sample: tuple[torch.Tensor, ...],
    passes: int,
    generator: torch.Generator,
) -> float:
    """Fit the actor's mean to the wishes of a ``Student``'s sample; mean squared error of the last pass
    (``passes`` at least 1)."""
    obstacles, own, wish = sample
    errors: list[float] = []
    for _ in range(passes):
        errors = []
        for index in torch.randperm(len(wish), generator=generator).split(MINIBATCH):
            loss = imitation_error(actor(obstacles[index], own[index]), wish[index]).mean()
            learner.step(loss, 1.0)
            errors.append(float(loss.detach()) / NUM_WISHES)
    return sum(errors) / len(errors)
