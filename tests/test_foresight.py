"""What a risk head said along episodes and what came, against hand-made episodes."""

from types import SimpleNamespace

import pytest
import torch

from uuvtai.config.learning import RiskConfig
from uuvtai.learn.risk import NO_THRESHOLD, STRIDE, RiskHead
from uuvtai.measure.episodes.playing import Job, Recorders
from uuvtai.measure.evaluate.foresight import (
    Foresight,
    RiskMoments,
    fit,
    foresight_of,
    judged,
    moments_of,
    risk_entry,
)

HORIZON = 20


class Rows:
    """Rows whose head says 1000 row + control step."""

    def __init__(self, n_row):
        self.head = RiskHead(3, RiskConfig(), torch.Generator())
        self.decision, self.now, self.n_row = None, 0, n_row
        self.foresight = Foresight(self.head, self, HORIZON)
        self.recorders = Recorders([None, self.foresight])

    def begin(self, row):
        self.recorders.begin(None, row, Job(0, row))

    def run(self, steps):
        for _ in range(steps):
            self.now += 1
            self.decision = SimpleNamespace(risk_logit=1000.0 * torch.arange(self.n_row) + self.now)
            self.recorders.step(None)

    def end(self, row, outcome):
        self.recorders.end(None, row, SimpleNamespace(outcome=outcome))

    def events(self, episode):
        """{control step: event} of one episode's moments."""
        m = self.foresight.moments()
        kept = m.episode == episode
        return dict(zip((m.logit[kept] % 1000).int().tolist(), m.event[kept].tolist(), strict=True))


def test_moments_of_an_accident_are_dangerous_within_the_horizon_only():
    rows = Rows(2)
    rows.begin(0)
    rows.run(43)
    rows.end(0, "ttc")
    assert rows.events(0) == {
        5: False,
        10: False,
        15: False,
        20: False,
        25: True,
        30: True,
        35: True,
        40: True,
    }


def test_the_state_in_which_it_ended_is_no_moment():
    rows = Rows(1)
    rows.begin(0)
    rows.run(4 * STRIDE)
    rows.end(0, "collision")
    assert sorted(rows.events(0)) == [5, 10, 15]


def test_what_follows_a_timeout_is_not_known_and_a_success_is_safe():
    rows = Rows(2)
    rows.begin(0)
    rows.begin(1)
    rows.run(42)
    rows.end(0, "timeout")
    rows.end(1, "success")
    assert rows.events(0) == {5: False, 10: False, 15: False, 20: False}
    assert rows.events(1) == dict.fromkeys(range(5, 45, 5), False)


def test_a_row_s_next_episode_begins_anew():
    rows = Rows(2)
    rows.begin(1)
    rows.run(12)
    rows.end(1, "success")
    rows.begin(1)
    rows.run(12)
    rows.end(1, "collision")
    assert rows.events(0) == {5: False, 10: False}
    assert rows.events(1) == {17: True, 22: True}, "counted from its own beginning"
    logits = rows.foresight.moments().logit
    assert ((logits >= 1000) & (logits < 2000)).all(), "of its own row"


def test_an_episode_too_short_for_a_moment_is_counted_all_the_same():
    rows = Rows(1)
    rows.begin(0)
    rows.run(2)
    rows.end(0, "collision")
    assert len(rows.foresight.moments().logit) == 0
    assert risk_entry(rows.foresight) == {}
    rows.begin(0)
    rows.run(6)
    rows.end(0, "collision")
    assert rows.foresight.moments().episode.tolist() == [1]


def test_one_moment_stands_for_an_accident():
    m = RiskMoments(
        torch.tensor([1.0, 2.0, 3.0, 4.0, 9.0]),
        torch.tensor([0, 1, 1, 1, 1]).bool(),
        torch.tensor([0, 0, 0, 0, 7]),
    )
    assert m.one_per_accident().tolist() == [3.0, 9.0]
    assert m.of_episodes(1).logit.tolist() == [9.0]


def sample(n, seed):
    """Episodes of one moment each whose event has probability sigmoid(logit / 2): the head is twice too
    sure."""
    generator = torch.Generator().manual_seed(seed)
    logit = 4.0 * torch.randn(n, generator=generator)
    return RiskMoments(
        logit, torch.rand(n, generator=generator) < torch.sigmoid(0.5 * logit), torch.arange(n)
    )


def test_calibration_holds_on_moments_that_it_has_not_seen():
    head = RiskHead(3, RiskConfig(miss_rate=0.1), torch.Generator())
    before = judged(head, sample(20_000, 2))
    assert "missed" not in before, "no alarm without a threshold"
    assert head.threshold == NO_THRESHOLD
    fit(head, sample(20_000, 1))
    after = judged(head, sample(20_000, 2))
    assert before["ece"] > 0.08 > 0.03 > after["ece"]
    assert after["brier"] < before["brier"] < after["brier_base_rate"]
    assert after["accidents"] == int(sample(20_000, 2).event.sum())
    assert after["missed"] / after["accidents"] == pytest.approx(0.1, abs=0.02)
    assert after["missed_ci95"][0] < 0.1 < after["missed_ci95"][1] + 0.02
    alarms = sample(20_000, 2)
    assert after["alarm_rate_safe"] == pytest.approx(
        float((alarms.logit[~alarms.event] >= head.threshold).double().mean())
    )
    assert sum(after["reliability"]["samples"]) == 20_000


def test_too_few_accidents_change_nothing():
    head = RiskHead(3, RiskConfig(miss_rate=0.05), torch.Generator())
    table = head.table.clone()
    with pytest.raises(ValueError, match="too few"):
        fit(head, RiskMoments(torch.zeros(20), torch.arange(20) < 5, torch.arange(20)))
    assert torch.equal(head.table, table) and not head.has_threshold
    assert judged(head, RiskMoments(torch.zeros(9), torch.zeros(9).bool(), torch.arange(9))) is None


def test_a_pilot_without_a_head_is_not_asked():
    assert foresight_of(SimpleNamespace(risk=None), 0.02) is None
    assert risk_entry(None) == {}


def test_what_was_said_does_not_depend_on_when_the_episode_began():
    """An evaluation that goes on plays an episode beside others than before."""
    said = []
    for late in (0, 3):
        rows = Rows(1)
        rows.begin(0)
        rows.run(late)
        rows.begin(0)
        rows.run(17)
        rows.end(0, "success")
        said.append([value - late for value in rows.foresight.newest_logits])
    assert said == [[5.0, 10.0, 15.0]] * 2


def test_moments_of_what_was_kept_are_those_that_were_seen():
    rows = Rows(2)
    rows.begin(0)
    rows.begin(1)
    rows.run(43)
    rows.end(1, "ttc")
    kept = moments_of(rows.foresight.newest_logits, 43, "ttc", HORIZON, 0)
    assert all(torch.equal(a, b) for a, b in zip(kept, rows.foresight.moments(), strict=True))
