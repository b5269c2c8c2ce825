"""Distillation: the policy's mean is drawn towards the behaviour tree's action, more strongly where the world
model is unsure.

The paper's term is lambda_t E ||mu(x) - a_BT||^2 with the squared norm over the four actions. It stands in
the PPO loss, with lambda_t = lambda(share of the run) times the scale s_t of ``Uncertainty``, and again in
separate teacher batches with an Adam of their own. Adam forgets a constant factor of the loss, so in these
batches lambda_t scales the learning rate instead.
"""

from __future__ import annotations

import bisect
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from uuvtai.common.enums import SUCCESS
from uuvtai.config.learning import DistillationConfig, LearningConfig, UncertaintyConfig
from uuvtai.learning.agents import SetAgent
from uuvtai.learning.networks import PlainAdam, Policy, PolicyStep, View
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


class TeacherBatches:
    """Gradient steps on batches of (input, teacher action) beside those of PPO."""

    def __init__(self, policy: Policy, config: DistillationConfig) -> None:
        self.policy, self.config = policy, config
        self.optimiser = PlainAdam(policy.parameters(), lr=config.learning_rate)
        self.skipped = 0
        """steps left out because the gradient was not finite"""

    def update(self, samples: View, strength: float, generator: torch.Generator) -> None:
        """``config.steps`` steps on random batches of samples (M, ...): the policy's inputs and
        ``teacher_action``; those that are not ``valid`` (M,) count as 0.

        ``strength`` is lambda_t; at 0 nothing happens, and nothing is drawn from the (CPU) generator.
        """
        if strength == 0.0:
            return
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.learning_rate * strength
        teacher, valid = samples["teacher_action"], samples["valid"]
        for _ in range(self.config.steps):
            rows = torch.randint(len(valid), (self.config.batch,), generator=generator).to(valid.device)
            self._step({n: samples[n][rows] for n in self.policy.inputs}, teacher[rows], valid[rows])

    def _step(self, view: View, teacher_action: torch.Tensor, valid: torch.Tensor) -> None:
        self.optimiser.zero_grad(
            set_to_none=True
        )  # the critic has no part in this loss: without a gradient Adam passes it over
        mean = self.policy.mean_of(self.policy.prepared(view))
        (valid * imitation_error(mean, teacher_action)).mean().backward()
        gradients = [p.grad for p in self.policy.parameters() if p.grad is not None]
        if bool(torch.isfinite(torch.nn.utils.get_total_norm(gradients))):
            self.optimiser.step()
        else:
            self.skipped += 1
        self.optimiser.zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments and the count of skipped steps."""
        return {"optimiser": self.optimiser.state_dict(), "skipped": self.skipped}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """What ``state_dict`` gave."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.skipped = int(state["skipped"])


class LeafErrors:
    """Imitation error by the leaf of the behaviour tree that acted, summed over a rollout without a wait for
    the device."""

    def __init__(self, names: Sequence[str], device: torch.device) -> None:
        """``names``: of every node of the tree, by its preorder index, as ``info["leaf"]`` counts; equal
        names are one entry."""
        self.names = tuple(names)
        self._error, self._count = (
            torch.zeros(len(names) + 1, dtype=torch.float64, device=device) for _ in range(2)
        )

    def add(self, error: torch.Tensor, leaf: torch.Tensor) -> None:
        """Errors (N,) of samples in which node ``leaf`` (N,) acted; a leaf outside the tree (-1: none acted)
        counts in the total only."""
        node = torch.where((leaf >= 0) & (leaf < len(self.names)), leaf, len(self.names)).long()
        finite = torch.isfinite(error)
        self._error.index_add_(0, node, torch.where(finite, error, 0.0).double())
        self._count.index_add_(0, node, finite.double())

    def take(self) -> dict[str, float]:
        """``distillation/loss`` (over all samples) and ``distillation/leaf/<name>`` of the leaves that acted;
        the sums begin anew."""
        error, count = self._error.tolist(), self._count.tolist()
        found: dict[str, list[float]] = {}
        for name, of_node, n in zip(self.names, error, count[:-1], strict=False):
            if n:
                entry = found.setdefault(name, [0.0, 0.0])
                entry[0], entry[1] = entry[0] + of_node, entry[1] + n
        metrics = {f"distillation/leaf/{name}": total / n for name, (total, n) in sorted(found.items())}
        if sum(count):
            metrics["distillation/loss"] = sum(error) / sum(count)
        self._error.zero_()
        self._count.zero_()
        return metrics


def piecewise_linear(points: Sequence[tuple[float, float]], fraction: float) -> float:
    """Value at ``fraction`` of (fraction, value) ``points``: linear in between, constant outside.

    Two points at the same fraction are a jump, and at the jump itself the later value holds. ValueError for
    no points or points out of order.
    """
    places = [place for place, _ in points]
    if not places or places != sorted(places):
        raise ValueError(
            "a schedule needs at least one (fraction, value) point, fractions not falling, got "
            f"{list(points)}"
        )
    after = bisect.bisect_right(places, fraction)
    if after == 0:
        return float(points[0][1])
    if after == len(points):
        return float(points[-1][1])
    (x0, y0), (x1, y1) = points[after - 1], points[after]
    return y0 + (y1 - y0) * (fraction - x0) / (x1 - x0)


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
        finite = torch.isfinite(sigma)
        if not bool(finite.any()):
            return
        newest = sigma[finite].double().mean()
        rho = self.config.ema
        self.mean.copy_(torch.where(self.seen, (1.0 - rho) * self.mean + rho * newest, newest))
        self.seen.fill_(True)

    @property
    def scale(self) -> float:
        """s_t: factor of the distillation weight, in [1, max_scale]."""
        return min(max(1.0 + self.config.gain * float(self.mean), 1.0), self.config.max_scale)


class Distillation:
    """The loss as a part of a training: its weight, the teacher batches, and what is told of it."""

    def __init__(self, policy: Policy, config: LearningConfig, node_names: Sequence[str]) -> None:
        """``node_names``: of the tree that teaches."""
        self.config, device = config.distillation, policy.log_std.device
        self.uncertainty = Uncertainty(config.uncertainty).to(device)
        self.teacher_batches = TeacherBatches(policy, config.distillation)
        self.leaf_errors = LeafErrors(node_names, device)

    def parts(self) -> dict[str, Any]:
        """What is kept, by name in a checkpoint."""
        return {"teacher_batches": self.teacher_batches, "uncertainty": self.uncertainty}

    def watch(self, step: PolicyStep, view: View) -> None:
        """Note the error of a decision."""
        self.leaf_errors.add(imitation_error(step.mean, view["teacher_action"]), view["leaf"])

    def weigh(self, rollout: Rollout, share: float) -> tuple[float, dict[str, float]]:
        """lambda_t s_t when ``share`` of the run is over, and both for the log."""
        self.uncertainty.update(rollout["uncertainty"].nanmean().nan_to_num()[None])
        weight, scale = piecewise_linear(self.config.schedule, share), self.uncertainty.scale
        return weight * scale, {
            "distillation/lambda": weight,
            "distillation/scale": scale,
            "distillation/lambda_risk": weight * scale,
        }

    def update(self, rollout: Rollout, strength: float, generator: torch.Generator) -> dict[str, float]:
        """Learn from teacher batches, by lambda_t s_t; metrics of the rollout."""
        samples = rollout.flat()
        samples["valid"] = torch.isfinite(samples["reward"]).float()
        self.teacher_batches.update(samples, strength, generator)
        return self.leaf_errors.take()


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


class Sample(NamedTuple):
    """Decisions to imitate."""

    obstacles: torch.Tensor
    """(n, lanes, OBSTACLE_WIDTH)"""
    own: torch.Tensor
    """(n, EGO_COLUMNS)"""
    wish: torch.Tensor
    """(n, 3) what the tree asks for, as the policy would say it"""


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
        self.running = torch.ones(sim.num_envs, dtype=torch.bool)
        """rows whose episode has not ended"""
        self.number = torch.zeros(sim.num_envs, dtype=torch.int64)
        """episode of every row"""
        self.samples: list[Sample] = []
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
            self._keep(due & self.running, tree)
        return said._replace(action=torch.where(self._with_tree[:, None], tree, said.action))

    def _keep(self, kept: torch.Tensor, tree: torch.Tensor) -> None:
        wish = wish_of(tree[kept], self.ego[kept], self.simulator.config.vehicle)
        self.samples.append(Sample(self.obstacles[kept], self.own[kept], wish))


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
        done = f"imitating the tree, wave {wave + 1} of {waves}"
        note(f"{done}: {100 * won:.0f} % arrived in {world}, error {loss:.3f}")
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
