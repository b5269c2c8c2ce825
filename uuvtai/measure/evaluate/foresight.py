"""What a policy's risk head said along evaluated episodes, and what came: reliability, Brier score, missed
accidents, false alarms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from uuvtai.learn.calibration import auroc, brier, expected_calibration_error, reliability
from uuvtai.learn.risk import STRIDE, RiskHead, conformal_threshold
from uuvtai.outcomes import FORESEEABLE
from uuvtai.statistics import wilson_interval

if TYPE_CHECKING:
    from uuvtai.learn.pilot import Pilot
    from uuvtai.measure.episodes.playing import EpisodeResult, Job
    from uuvtai.sim import Sim


class RiskMoments(NamedTuple):
    """Moments of many episodes whose next ``risk.horizon_s`` are known."""

    logit: Tensor
    """(M,) what the head said"""
    event: Tensor
    """(M,) bool: a collision or TTC stop came within the horizon"""
    episode: Tensor
    """(M,) int: number of the episode in the order in which they ended"""

    def of_episodes(self, rest: int, parts: int = 2) -> RiskMoments:
        """Those of every ``parts``-th episode."""
        kept = self.episode % parts == rest
        return RiskMoments(*(column[kept] for column in self))

    def one_per_accident(self) -> Tensor:
        """(number of accidents,) logits, of one dangerous moment each: those of one episode are not
        independent. In the middle of them."""
        logit, episode = self.logit[self.event], self.episode[self.event]
        chosen = [logit[episode == number] for number in episode.unique()]
        return torch.stack([said[len(said) // 2] for said in chosen]) if chosen else logit


class Foresight:
    """Recorder of what the head says at every ``STRIDE``-th step of each episode, counted from its own
    beginning."""

    def __init__(self, head: RiskHead, pilot: Pilot, horizon_steps: int) -> None:
        """``pilot`` drives and asks the head at every step; ``horizon_steps``: control steps of
        ``risk.horizon_s``."""
        self.head, self._pilot, self.horizon_steps = head, pilot, horizon_steps
        self.newest_logits: list[float] = []
        """of the episode that ended last"""
        self._logits: list[Tensor] = []
        """(N,) logits of all rows after every step, as far back as the oldest running episode"""
        self._forgotten = 0
        """steps before them"""
        self._first: dict[int, int] = {}
        """of each row's episode: steps that had been done when it began"""
        self._ended: list[RiskMoments] = []

    def begin(self, sim: Sim, row: int, job: Job) -> None:
        """An episode begins."""
        self._first[row] = self._now

    def step(self, sim: Sim) -> None:
        """Note what the head says of the state that the step led to."""
        self._logits.append(self._pilot.decision.risk_logit.clone())

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """An episode is over: its moments get their labels."""
        steps = self._now - self._first[row]
        own = self._logits[self._first.pop(row) - self._forgotten :][STRIDE - 1 :: STRIDE]
        self.newest_logits = torch.stack([entry[row] for entry in own]).cpu().tolist() if own else []
        self._ended.append(
            moments_of(self.newest_logits, steps, result.outcome, self.horizon_steps, len(self._ended))
        )
        unused = min(self._first.values(), default=self._now) - self._forgotten
        del self._logits[:unused]
        self._forgotten += unused

    def moments(self) -> RiskMoments:
        """All that was noted, by the order in which the episodes ended."""
        return joined(self._ended)

    @property
    def _now(self) -> int:
        return self._forgotten + len(self._logits)


def moments_of(said: list[float], steps: int, outcome: str, horizon_steps: int, number: int) -> RiskMoments:
    """Moments of an episode of so many control steps; ``said``: logits at every ``STRIDE``-th. What would
    have followed a timeout is not known, and the state in which it ended is no moment."""
    to_end = steps - STRIDE * (torch.arange(len(said)) + 1)
    soon = to_end <= horizon_steps
    kept = (to_end > 0) & (~soon | torch.tensor(outcome != "timeout"))
    event = soon & torch.tensor(outcome in FORESEEABLE)
    return RiskMoments(
        torch.tensor(said, dtype=torch.float32)[kept], event[kept], torch.full((int(kept.sum()),), number)
    )


def joined(parts: list[RiskMoments]) -> RiskMoments:
    """Moments of many episodes, in this order."""
    if not parts:
        return RiskMoments(
            torch.zeros(0), torch.zeros(0, dtype=torch.bool), torch.zeros(0, dtype=torch.int64)
        )
    return RiskMoments(*(torch.cat(column) for column in zip(*parts, strict=True)))


def foresight_of(pilot: Pilot, control_dt_s: float) -> Foresight | None:
    """Recorder of this pilot's risk head; None where it has none."""
    return (
        None
        if pilot.risk is None
        else Foresight(pilot.risk, pilot, round(pilot.risk.config.horizon_s / control_dt_s))
    )


def risk_entry(foresight: Foresight | None, moments: RiskMoments | None = None) -> dict[str, Any]:
    """What ``uuv eval --json`` says of a method's risk head beside its results; empty where there is nothing
    to say.

    ``moments``: judged in place of those that this process has seen.
    """
    figures = (
        None
        if foresight is None
        else judged(foresight.head, foresight.moments() if moments is None else moments)
    )
    return {} if figures is None else {"risk": figures}


def fit(head: RiskHead, moments: RiskMoments) -> None:
    """Calibrate the head's probabilities and alarm threshold on these moments. Raises ValueError where
    accidents are too few."""
    threshold_logit = conformal_threshold(moments.one_per_accident(), head.config.miss_rate)
    head.calibrate(moments.logit, moments.event)
    head.set_threshold(threshold_logit)


def judged(head: RiskHead, moments: RiskMoments) -> dict[str, Any] | None:
    """Figures of the head on moments that it was neither trained nor calibrated on; None where nothing or
    everything ended badly.

    Keys: moments, event_rate, brier, brier_base_rate (of always predicting the event rate), ece, auroc,
    reliability (samples, predicted, observed of each bin that holds any), and of the alarm: threshold_logit,
    promised_miss_rate, accidents, missed, missed_ci95, alarm_rate_safe.
    """
    event, count = moments.event, int(moments.event.sum())
    if count in (0, len(event)):
        return None
    probability, config = head.calibrated(moments.logit), head.config
    diagram = reliability(probability, event, config.bins)
    base = count / len(event)
    figures: dict[str, Any] = {
        "moments": len(event),
        "event_rate": base,
        "brier": brier(probability, event),
        "brier_base_rate": base * (1.0 - base),
        "ece": expected_calibration_error(probability, event, config.bins),
        "auroc": auroc(moments.logit, event),
        "reliability": {
            name: [float(v) for v in getattr(diagram, name)] for name in ("samples", "predicted", "observed")
        },
    }
    return figures | _alarm(head, moments)


def _alarm(head: RiskHead, moments: RiskMoments) -> dict[str, Any]:
    if not head.has_threshold:
        return {}
    threshold, dangerous = float(head.threshold), moments.one_per_accident()
    missed = int((dangerous < threshold).sum())
    return {
        "threshold_logit": threshold,
        "promised_miss_rate": head.config.miss_rate,
        "accidents": len(dangerous),
        "missed": missed,
        "missed_ci95": list(wilson_interval(missed, len(dangerous)) or ()),
        "alarm_rate_safe": float((moments.logit[~moments.event] >= threshold).double().mean()),
    }
