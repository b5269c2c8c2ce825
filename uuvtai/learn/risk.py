"""Risk head: calibrated probability that the episode ends in a collision or TTC stop within
``risk.horizon_s``, from the policy's input.

Goes beyond the paper, which says that its uncertainty is no collision probability. Labels come from rollouts;
moments whose future the rollouts do not show (yet) have none. Probabilities are calibrated on held-out
episodes, and split conformal prediction gives the alarm threshold whose share of missed dangerous moments is
bounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as fn
from torch import Tensor, nn

from uuvtai.config.learning import RiskConfig
from uuvtai.errors import SettingError
from uuvtai.learn.calibration import brier, expected_calibration_error
from uuvtai.learn.guard import guarded_step
from uuvtai.learn.mlp import mlp
from uuvtai.learn.normalise import Moments, RunningNorm, moments_of
from uuvtai.learn.optimiser import PlainAdam

STRIDE = 5
"""control steps between the moments that are learned from: neighbours in time are nearly the same sample"""
MAX_LOGIT = 12.0
"""logits of the calibration table lie within +- this"""
NO_THRESHOLD = 1e9
"""a finite number that no logit reaches: networks with anything that is not finite are refused"""
N_KNOT = 241
"""knots of the calibration table: one per 0.1 of the logit"""
_ROUNDING = 1e-9
"""of a number of samples times a rate"""

Reduce = Callable[[list[Tensor]], None]
Gather = Callable[[Moments], Moments]


class RiskHead(nn.Module):
    """Logit of the event by a small network on the normalised input, and a monotonic table from logit to
    calibrated probability."""

    table: Tensor
    """(N_KNOT,) float64 calibrated probability at logits from -12 to 12; the logistic function until
    ``calibrate``"""
    threshold: Tensor
    """logit from which on to raise an alarm; ``NO_THRESHOLD`` until ``set_threshold``"""

    def __init__(self, n_in: int, config: RiskConfig, generator: torch.Generator) -> None:
        """``n_in`` columns of the policy's input; initial weights come from the CPU ``generator``."""
        super().__init__()
        self.n_in, self.config = n_in, config
        self.observation_norm = RunningNorm(n_in)
        self.net = mlp((n_in, *config.hidden, 1), "elu", generator, 0.01)
        self.register_buffer("table", torch.sigmoid(_knots()))
        self.register_buffer("threshold", torch.tensor(NO_THRESHOLD, dtype=torch.float64))

    def logit(self, x: Tensor) -> Tensor:
        """(...,) uncalibrated logit of inputs (..., n_in)."""
        return self.net(self.observation_norm(x)).squeeze(-1)

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        """(...,) calibrated probability, float32, of inputs (..., n_in)."""
        return self.calibrated(self.logit(x)).float()

    def calibrated(self, logit: Tensor) -> Tensor:
        """(...,) probability, float64: the table between its knots, its ends beyond them."""
        place = (logit.double().clamp(-MAX_LOGIT, MAX_LOGIT) + MAX_LOGIT) * ((N_KNOT - 1) / (2.0 * MAX_LOGIT))
        low = place.floor().clamp(max=N_KNOT - 2).long()
        return torch.lerp(self.table[low], self.table[low + 1], place - low)

    @torch.no_grad()
    def calibrate(self, logit: Tensor, event: Tensor) -> None:
        """Fit the table to held-out logits (n,) and events (n,) by isotonic regression. Raises ValueError
        where one outcome is missing."""
        _require_both(event)
        score, value = isotonic(logit.double(), event.double())
        self.table.copy_(interpolated(_knots().to(score.device), score, value))

    @property
    def has_threshold(self) -> bool:
        """Whether an alarm threshold is known."""
        return float(self.threshold) < NO_THRESHOLD

    def set_threshold(self, logit: float) -> None:
        """Raise an alarm from this logit on."""
        self.threshold.fill_(logit)


def _knots() -> Tensor:
    return torch.linspace(-MAX_LOGIT, MAX_LOGIT, N_KNOT, dtype=torch.float64)


# ----------------------------------------------------------------------------------------------------- labels


class Labels(NamedTuple):
    """Whether the event comes within the horizon."""

    event: Tensor
    """(T, N) bool; false where not known"""
    known: Tensor
    """(T, N) bool"""


def label_events(failed: Tensor, ended: Tensor, censored: Tensor, horizon_steps: int) -> Labels:
    """Labels of the moments before each step of a rollout; all tensors (T, N) bool.

    An event is an ending with ``failed`` (collision or TTC stop) in this step or one of the next
    ``horizon_steps`` - 1. Not known: the rollout stops before, or the episode was cut off (``censored``: its
    time was over) before the horizon.
    """
    labels = Labels(torch.zeros_like(ended), torch.zeros_like(ended))
    steps, num_envs = ended.shape
    to_end = torch.full((num_envs,), steps + horizon_steps, device=ended.device)
    fails, cut = (torch.zeros(num_envs, dtype=torch.bool, device=ended.device) for _ in range(2))
    for t in reversed(range(steps)):
        to_end = torch.where(ended[t], 0, to_end + 1)
        fails, cut = torch.where(ended[t], failed[t], fails), torch.where(ended[t], censored[t], cut)
        soon = to_end < horizon_steps
        labels.event[t] = soon & fails
        labels.known[t] = torch.where(
            soon, fails | ~cut, torch.tensor(steps - t >= horizon_steps, device=ended.device)
        )
    return labels


class RiskMemory:
    """Recent moments that wait for their label: the horizon may be longer than a rollout, whose end must not
    choose what is learned."""

    def __init__(self, horizon_steps: int, stride: int = STRIDE) -> None:
        """``horizon_steps``: steps of a rollout that make up the horizon; ``stride``: steps between the
        moments."""
        if horizon_steps < 1:
            raise SettingError(
                f"the risk horizon must be at least one step of a rollout, got {horizon_steps}: raise "
                "risk.horizon_s"
            )
        self.horizon_steps, self.stride = horizon_steps, stride
        self.x: list[Tensor] = []
        """(N, n_in) inputs of the moments that wait, oldest first"""
        self.places: list[int] = []
        """their steps, counted from the first step of ``ends``"""
        self.ends = torch.zeros(3, 0, 0, dtype=torch.bool)
        """(3, T, N) failed, ended, censored of the steps since the oldest moment"""

    def add(self, x: Tensor, failed: Tensor, ended: Tensor, censored: Tensor) -> tuple[Tensor, Tensor]:
        """Take in a rollout: x (T, N, n_in), others (T, N); returns (x (M, n_in), event (M,)) of the moments
        that are decided now.

        Every ``stride``-th step of a rollout is a moment; each is returned once, when all of its horizon has
        been seen.
        """
        new = torch.stack([failed, ended, censored])
        before = self.ends.shape[1]
        self.ends = torch.cat([self.ends, new], dim=1) if before else new
        for t in range(0, x.shape[0], self.stride):
            self.x.append(x[t].clone())
            self.places.append(before + t)
        return self._decided()

    def _decided(self) -> tuple[Tensor, Tensor]:
        failed, ended, censored = self.ends
        labels = label_events(failed, ended, censored, self.horizon_steps)
        total = self.ends.shape[1]
        count = sum(total - place >= self.horizon_steps for place in self.places)
        if count == 0:
            return self.x[0][:0], labels.event[0, :0]
        done, self.x = self.x[:count], self.x[count:]
        at, self.places = torch.tensor(self.places[:count], device=self.ends.device), self.places[count:]
        known = labels.known[at]
        self._forget(self.places[0] if self.places else total)
        return torch.stack(done)[known], labels.event[at][known]

    def _forget(self, steps: int) -> None:
        self.ends = self.ends[:, steps:].clone()
        self.places = [place - steps for place in self.places]

    def state_dict(self) -> dict[str, Any]:
        """Everything that waits."""
        return {"x": list(self.x), "places": list(self.places), "ends": self.ends}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """What ``state_dict`` gave."""
        self.x, self.places = (
            [x.to(state["ends"].device) for x in state["x"]],
            [int(place) for place in state["places"]],
        )
        self.ends = state["ends"].clone()


# --------------------------------------------------------------------------------------------------- learning


class RiskLearner:
    """Adam on the cross-entropy of labelled moments, with a guard against NaN."""

    def __init__(
        self,
        head: RiskHead,
        config: RiskConfig,
        control_dt_s: float,
        reduce: Reduce | None = None,
        gather: Gather | None = None,
        hold_steps: int = 1,
    ) -> None:
        """``control_dt_s``: length of a control step, ``hold_steps`` of which are a step of a rollout;
        ``reduce`` averages gradients over the processes, ``gather`` unites moments.
        """
        self.head, self.config, self.reduce, self.gather = head, config, reduce, gather
        self.memory = RiskMemory(
            round(config.horizon_s / (control_dt_s * hold_steps)), max(1, STRIDE // hold_steps)
        )
        self.optimiser = PlainAdam(head.parameters(), lr=config.learning_rate, fused=True)
        self.skipped = 0
        """steps left out because the gradient was not finite, or zero for want of labels"""

    def update(
        self, x: Tensor, failed: Tensor, ended: Tensor, censored: Tensor, generator: torch.Generator
    ) -> dict[str, float]:
        """``config.steps`` gradient steps on the moments that a rollout decides: x (T, N, n_in), others (T,
        N) bool.

        ``failed``: the step ended in a collision or TTC stop, ``censored``: in a timeout. Moments that are
        not finite are left out. Returns metrics by their names in metrics.jsonl: those of the probabilities
        before anything was learned from these moments.
        """
        moment, event = self.memory.add(x, failed, ended, censored)
        good = torch.isfinite(moment).all(dim=1)
        moment, event = moment[good], event[good]
        metrics = self._judged(moment, event)
        moments = moments_of(moment)
        self.head.observation_norm.merge(self.gather(moments) if self.gather else moments)
        skipped = self.skipped
        for _ in range(self.config.steps):
            self._learn(moment, event, generator)
        return metrics | {"risk/skipped_updates": float(self.skipped - skipped)}

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments, what waits for its label and the counter; the head keeps its own."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "memory": self.memory.state_dict(),
            "skipped": self.skipped,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """What ``state_dict`` gave."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.memory.load_state_dict(state["memory"])
        self.skipped = int(state["skipped"])

    def _judged(self, moment: Tensor, event: Tensor) -> dict[str, float]:
        if not len(event):
            return {}
        probability = self.head(moment)
        return {
            "risk/brier": brier(probability, event),
            "risk/ece": expected_calibration_error(probability, event, self.config.bins),
            "risk/event_rate": float(event.double().mean()),
        }

    def _learn(self, moment: Tensor, event: Tensor, generator: torch.Generator) -> None:
        """One step; without labels the gradient is zero, so that all processes take part in the reduction."""
        rows = (
            torch.randint(len(event), (self.config.batch,), generator=generator).to(event.device)
            if len(event)
            else slice(0)
        )
        logit = self.head.logit(moment[rows])
        loss = (
            fn.binary_cross_entropy_with_logits(logit, event[rows].float(), reduction="sum")
            / self.config.batch
        )
        self.skipped += not guarded_step(loss, self.head, self.optimiser, self.reduce)


# ------------------------------------------------------------------------------------------------ calibration


def isotonic(score: Tensor, event: Tensor) -> tuple[Tensor, Tensor]:
    """Isotonic regression of events on scores by pool-adjacent-violators (Barlow 1972): (distinct scores,
    fitted values), float64.

    Scores ascend, values do not fall, their squared error is least.
    """
    distinct, inverse, weight = torch.unique(score.double(), return_inverse=True, return_counts=True)
    total = torch.zeros_like(distinct).index_add_(0, inverse, event.double())
    blocks: list[list[float]] = []  # mean, weight, number of distinct scores
    for mean, w in zip((total / weight).tolist(), weight.double().tolist(), strict=True):
        blocks.append([mean, w, 1])
        while len(blocks) > 1 and blocks[-2][0] >= blocks[-1][0]:
            (m1, w1, n1), (m2, w2, n2) = blocks[-2], blocks[-1]
            blocks[-2:] = [[(m1 * w1 + m2 * w2) / (w1 + w2), w1 + w2, n1 + n2]]
    value = [mean for mean, _, n in blocks for _ in range(int(n))]
    return distinct, torch.tensor(value, dtype=torch.float64, device=distinct.device)


def interpolated(at: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Piecewise linear y(x) at points ``at``, constant outside; x ascending, 1-D float64."""
    if len(x) == 1:
        return y.expand_as(at).clone()
    right = torch.searchsorted(x, at).clamp(1, len(x) - 1)
    left = right - 1
    share = ((at - x[left]) / (x[right] - x[left])).clamp(0.0, 1.0)
    return torch.lerp(y[left], y[right], share)


def conformal_threshold(scores: Tensor, miss_rate: float) -> float:
    """Alarm threshold from the scores (n,) of held-out dangerous moments: a new one scores below it with
    probability <= ``miss_rate``.

    Split conformal prediction: the ceil((n + 1) (1 - miss_rate))-th largest score (Vovk 2005; Angelopoulos
    and Bates 2021). It holds for moments that are exchangeable with the held-out ones, so take one per
    episode: those of one episode are not independent. Raises ValueError for scores that are too few for the
    rate.
    """
    n = scores.numel()
    rank = n + 1 - math.floor((n + 1) * miss_rate + _ROUNDING)
    if rank > n:
        least = math.ceil(1.0 / miss_rate - _ROUNDING) - 1
        raise ValueError(
            f"{n} dangerous moments are too few for a miss rate of {miss_rate:g}: it takes {least}; evaluate "
            "more episodes"
        )
    if not bool(torch.isfinite(scores).all()):
        raise ValueError("scores of dangerous moments must be finite")
    return float(scores.flatten().sort(descending=True).values[rank - 1])


def _require_both(event: Tensor) -> None:
    count = int(event.sum())
    if count in (0, event.numel()):
        raise ValueError(
            f"calibration needs both outcomes: {count} events among {event.numel()} moments; evaluate more "
            "episodes"
        )
