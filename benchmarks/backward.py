"""Seconds of a whole PPO update by autograd, beside the same update with back-propagation written by hand
(`peers/passes.py`), in turns from one minibatch to the next.

Sizes are those of `uuv train residual`: 1,024 envs x 64 steps, its networks, epochs and minibatches; the
rollout is random numbers. The hand-written passes were ours until autograd over blocks of rows was as fast.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import numpy as np
import torch

from benchmarks.common import Job, Row
from benchmarks.peers.passes import Passes
from uuvtai.kernels.planning.features import observation_width
from uuvtai.learn.collect import N_FEATURES
from uuvtai.learn.policy import NUM_ACTIONS, ActorCritic
from uuvtai.learn.ppo import _SUMS, CACHE_ROWS, Minibatch, Ppo
from uuvtai.learn.rollout import Rollout
from uuvtai.loader import load_training

THREADS = 1
FLOORS = {False: 1 / 1.03, True: 1.0}
"""at least this ratio, by ``ppo.bfloat16``: autograd may cost 3 % more in float32, nothing in bfloat16"""
ROUNDS = 12
"""updates of each side"""
_DISTILL_WEIGHT = 0.5


class PpoByHand(Ppo):
    """PPO whose gradients are those of ``Passes``: one pass through each network per block of rows."""

    _passes: tuple[Passes, Passes] | None = None

    def _add_gradients(
        self,
        batch: Minibatch,
        count: torch.Tensor,
        distill_weight: float,
        surrogate: bool,
        sums: torch.Tensor,
    ) -> None:
        if self._passes is None:
            dtype = torch.bfloat16 if self.config.bfloat16 else torch.float32
            rows = max(CACHE_ROWS, len(batch.valid))
            self._passes = (
                Passes(self.policy.actor, rows, dtype),
                Passes(self.policy.critic, rows, dtype),
            )
        (actor, critic), acting = self._passes, surrogate or distill_weight != 0.0
        if critic.layers[0].weight.grad is None:  # a new minibatch
            critic.begin()
            if acting:
                actor.begin()
        value = critic.forward(batch.normalised).requires_grad_()
        out = actor.forward(batch.normalised).requires_grad_() if acting else batch.action
        self._loss(batch, value, out, count, distill_weight, surrogate, sums).backward()
        for passes, output in ((critic, value), (actor, out)):
            if output.grad is not None:
                passes.backward(batch.normalised, output.grad)


def filled_rollout(steps: int, num_envs: int, n_in: int) -> Rollout:
    """A rollout of random numbers, always the same ones."""
    rollout, generator = Rollout(steps, num_envs, n_in), torch.Generator().manual_seed(0)
    for name in ("x", "action", "teacher_action", "log_prob", "value", "reward", "next_value"):
        getattr(rollout, name).normal_(generator=generator)
    rollout.log_prob.sub_(5.0)  # about what the first policy's actions have
    rollout.weight.fill_(1.0)
    return rollout


def measure(job: Job) -> list[Row]:
    """A row for either width of the products."""
    num_envs, rounds = (8, 2) if job.quick else (1024, ROUNDS)
    config = load_training("residual", {"train.num_envs": num_envs})
    n_in = observation_width(config.features) + N_FEATURES
    rollout = filled_rollout(config.ppo.rollout_steps, num_envs, n_in)
    rows = []
    for bfloat16 in FLOORS:
        ppo = config.ppo.model_copy(update={"bfloat16": bfloat16})
        sides = []
        for kind in (Ppo, PpoByHand):
            generator = torch.Generator().manual_seed(0)
            sides.append(kind(ActorCritic(n_in, config.policy, slice(NUM_ACTIONS), generator), ppo))
        job.say(f"{'bfloat16' if bfloat16 else 'float32'}: {rounds} rounds")
        rows.append(_row(sides, rollout, bfloat16, rounds, job.quick))
    return rows


def _row(sides: list[Ppo], rollout: Rollout, bfloat16: bool, rounds: int, quick: bool) -> Row:
    for side in sides:
        side.update(rollout, _DISTILL_WEIGHT)  # allocates
    seconds = np.array([_seconds(sides, rollout, first=number % 2) for number in range(rounds)])
    ours, by_hand = (float(np.median(seconds[:, side], axis=0).sum()) for side in (0, 1))
    ratios = np.sort((seconds[:, 1] / seconds[:, 0])[:, 1:-1].ravel())
    spread = 0.98 * math.sqrt(len(ratios))  # ranks around the median: a 95 % interval of it
    low, high = (
        ratios[round(float(np.clip(len(ratios) / 2 + s * spread, 0, len(ratios) - 1)))] for s in (-1, 1)
    )
    config, samples = sides[0].config, len(rollout.flat("value"))
    return Row(
        what=f"PPO update, {samples:,} samples, {'bfloat16' if bfloat16 else 'float32'} products",
        ours=ours,
        unit="s CPU",
        peer=by_hand,
        peer_name="by hand",
        less_is_better=True,
        floor=None if quick else FLOORS[bfloat16],
        floor_on="ratio",
        note=f"median of {len(ratios)} pairs of minibatches {np.median(ratios):.3f} x, "
        f"95 % {low:.3f} to {high:.3f}; {config.epochs} epochs, one core",
        details={
            "seconds": seconds.round(5).tolist(),
            "quartiles": np.quantile(ratios, (0.25, 0.75)).tolist(),
        },
    )


def _seconds(sides: list[Ppo], rollout: Rollout, first: int) -> list[list[float]]:
    """[side][piece] CPU time of one update of both sides, in turns piece by piece; who begins changes too."""
    pieces, out = [_pieces(side, rollout) for side in sides], [[], []]
    for number in range(2 + sides[0].config.epochs * sides[0].config.minibatches):
        for side in (0, 1) if (number + first) % 2 else (1, 0):
            begun = time.process_time()
            next(pieces[side])
            out[side].append(time.process_time() - begun)
    return out


def _pieces(ppo: Ppo, rollout: Rollout) -> Iterator[None]:
    """``Ppo.update`` with a halt after the preparation, after each minibatch and after the statistics."""
    batch, _ = ppo._prepared(rollout)
    sums = torch.zeros(len(_SUMS), dtype=torch.float64)
    yield
    for _ in range(ppo.config.epochs):
        for minibatch in ppo._minibatches(batch, None):
            ppo._learn(minibatch, _DISTILL_WEIGHT, surrogate=True, sums=sums)
            yield
    ppo.observe(rollout.x)
    yield
