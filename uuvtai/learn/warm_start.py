"""Warm start of a policy over a set of bodies: imitation of the behaviour tree in the simulator.

DAgger (Ross, Gordon & Bagnell 2011, AISTATS): whoever drives, the tree says what it would do, and the actor's
mean is fitted to all that was said so far. The tree drives in the first wave, the student more and more.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.learn.episode_waves import play_episodes
from uuvtai.learn.optimiser import PlainAdam
from uuvtai.learn.pilot import PilotDecision
from uuvtai.learn.set_pilot import SetPilot
from uuvtai.learn.set_policy import NUM_WISHES, SetActor
from uuvtai.learn.world_sims import simulator_of
from uuvtai.outcomes import SUCCESS

if TYPE_CHECKING:
    from uuvtai.config import VehicleConfig
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim

WAVE_EPISODES = 256
"""episodes of a wave, at most ``train.num_envs``"""
PASSES, LAST_PASSES = 2, 6
"""through all samples after a wave, and after the last one"""
MINIBATCH, RATE = 512, 1e-3
SEED = 7_000_003
"""added to ``train.seed`` for episodes and draws of the warm start"""


class Sample(NamedTuple):
    """Decisions to imitate."""

    bodies: torch.Tensor
    """(n, lanes, BODY_WIDTH)"""
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


class Student(SetPilot):
    """Drives with the tree, drawn anew for every decision, and keeps what the tree says of each."""

    def __init__(self, actor: SetActor, sim: Sim, config: LearningConfig, generator: torch.Generator) -> None:
        super().__init__(actor, sim, config.policy.hold_steps, config.twin.vertical_gap_m)
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
    def decide(self, obs: torch.Tensor) -> PilotDecision:
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
        from uuvtai.twin.twin_arrays import AT_FLIP, AT_YAW

        ego = self._ego[kept]
        wish = wish_of_command(
            tree[kept], ego[:, AT_YAW], ego[:, AT_FLIP : AT_FLIP + 2], self.simulator.config.vehicle
        )
        self.samples.append(Sample(self.bodies[kept], self.own[kept], wish))


def imitate(
    actor: SetActor, config: LearningConfig, scenes: tuple[Scene, ...], sims: dict[str, Sim] | None = None
) -> dict[str, float]:
    """``twin.warm_start_waves`` waves of DAgger; the actor's mean is then close to the tree. What was spent,
    as metrics. ``sims``: simulators of worlds that are there already."""
    began, sims = time.perf_counter(), dict(sims or {})
    waves, rows = config.twin.warm_start_waves, min(WAVE_EPISODES, config.train.num_envs)
    few = config.model_copy(update={"train": config.train.model_copy(update={"num_envs": rows})})
    seed = config.train.seed + SEED
    generator = torch.Generator().manual_seed(seed)
    optimiser = PlainAdam(list(actor.net.parameters()), lr=RATE)
    places = [(world, scene) for scene in scenes for world in config.twin.worlds]
    samples, won, loss = [], 0.0, 0.0
    for wave in range(waves):
        world, scene = places[wave % len(places)]
        if world not in sims:
            sims[world] = simulator_of(few, world, scenes)
        student = Student(actor, sims[world], config, generator)
        student.tree_share = 1.0 - wave / max(1, waves - 1)
        outcome, _ = play_episodes(student, scene, seed, wave * rows, rows)
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
            mean = actor(sample.bodies[index], sample.own[index])
            loss = (mean - sample.wish[index]).square().sum(dim=-1).mean()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(actor.net.parameters(), 1.0)
            optimiser.step()
            errors.append(float(loss.detach()) / NUM_WISHES)
    return sum(errors) / len(errors)
