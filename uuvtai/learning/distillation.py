"""Distillation: the policy's mean is drawn towards the behaviour tree's action, more strongly where the world
model is unsure.

The paper's term is lambda_t E ||mu(x) - a_BT||^2 with the squared norm over the four actions. It stands in
the PPO loss, with lambda_t = lambda(share of the run) times the scale s_t of ``Uncertainty``, and again in
separate teacher batches with an Adam of their own. Adam forgets a constant factor of the loss, so in these
batches lambda_t scales the learning rate instead.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from uuvtai.common.errors import SettingError
from uuvtai.config.learning import DistillationConfig, UncertaintyConfig
from uuvtai.learning.networks import PlainAdam

MAX_WEIGHT_RATIO = 4.0
"""a sample counts at most this many times the mean signal, and at least its inverse, before the weights' mean
is made one"""


def imitation_error(mean: torch.Tensor, teacher_action: torch.Tensor) -> torch.Tensor:
    """||mean - teacher_action||^2 of every sample: (..., 4) and (..., 4) to (...,), in squared parts of the
    vehicle's limits."""
    return (mean - teacher_action).square().sum(dim=-1)


def distillation_loss(mean: torch.Tensor, teacher_action: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Weighted mean of the imitation error, a scalar: means (B, 4), teacher actions (B, 4), weights (B,) of
    mean one."""
    return (weight * imitation_error(mean, teacher_action)).mean()


def sample_weight(signal: torch.Tensor) -> torch.Tensor:
    """Weight of every sample in proportion to a signal >= 0 of any shape: mean one, bounded.

    Weights differ by at most ``MAX_WEIGHT_RATIO`` squared; a sample whose signal is not finite counts as an
    average one; where the signal is zero everywhere all weights are one.
    """
    known = torch.isfinite(signal)
    mean = torch.where(known, signal, 0.0).sum() / known.sum().clamp(min=1)
    ratio = torch.where(known & (mean > 0), signal / mean.clamp(min=torch.finfo(signal.dtype).tiny), 1.0)
    ratio = ratio.clamp(1.0 / MAX_WEIGHT_RATIO, MAX_WEIGHT_RATIO)
    return ratio / ratio.mean()


Weighting = Literal["none", "uncertainty"]


def check_weighting(kind: Weighting, has_world_model: bool) -> None:
    """Raise ValueError for a ``distillation.weighting`` whose signal this run does not have."""
    if kind == "uncertainty" and not has_world_model:
        raise SettingError(
            "distillation.weighting=uncertainty needs the world model: set world_model.enabled=true, or "
            "distillation.weighting=none"
        )


def weights_of(kind: Weighting, uncertainty: torch.Tensor) -> torch.Tensor:
    """Weights by ``distillation.weighting``, of the shape of the uncertainties."""
    return sample_weight(uncertainty) if kind == "uncertainty" else torch.ones_like(uncertainty)


class TeacherBatches:
    """Gradient steps on batches of (input, teacher action) beside those of PPO."""

    def __init__(self, policy: nn.Module, config: DistillationConfig) -> None:
        """``policy.distribution(x)`` gives the means."""
        self.policy, self.config = policy, config
        self.optimiser = PlainAdam(policy.parameters(), lr=config.learning_rate)
        self.skipped = 0
        """steps left out because the gradient was not finite"""

    def update(
        self,
        x: torch.Tensor,
        teacher_action: torch.Tensor,
        weight: torch.Tensor,
        strength: float,
        generator: torch.Generator,
    ) -> None:
        """``config.steps`` steps on random batches of the rows of x (M, n_in), teacher_action (M, 4), weight
        (M,).

        ``strength`` is lambda_t; at 0 nothing happens, and nothing is drawn from the (CPU) generator.
        """
        if strength == 0.0:
            return
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.learning_rate * strength
        for _ in range(self.config.steps):
            rows = torch.randint(len(x), (self.config.batch,), generator=generator).to(x.device)
            self._step(x[rows], teacher_action[rows], weight[rows])

    def _step(self, x: torch.Tensor, teacher_action: torch.Tensor, weight: torch.Tensor) -> None:
        self.optimiser.zero_grad(
            set_to_none=True
        )  # the critic has no part in this loss: without a gradient Adam passes it over
        mean = self.policy.distribution(x)[0]  # type: ignore[operator]
        distillation_loss(mean, teacher_action, weight).backward()
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
