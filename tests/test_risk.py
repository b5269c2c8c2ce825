"""Risk head: labels, waiting for them, learning, isotonic calibration, conformal threshold, resume and bad
input."""

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize

from uuvtai.config.learning import RiskConfig
from uuvtai.learn.calibration import auroc, expected_calibration_error
from uuvtai.learn.risk import (
    STRIDE,
    RiskHead,
    RiskLearner,
    RiskMemory,
    conformal_threshold,
    isotonic,
    label_events,
)

N_IN, DT_S = 6, 0.02
SMALL = RiskConfig(hidden=(16,), batch=512, steps=4, learning_rate=3e-3, horizon_s=0.2)
HORIZON = 10
"""control steps of ``SMALL``"""

SAMPLING = 0.03
"""ECE of a calibrated forecast of 20,000 samples in 10 bins stays below four standard errors of a bin's
frequency, 4 x 0.011 / 2."""


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def columns(text):
    """(T, 1) bool from a row of 0 and 1."""
    return torch.tensor([[c == "1"] for c in text])


def labels_of(failed, ended, censored, horizon):
    found = label_events(columns(failed), columns(ended), columns(censored), horizon)
    return "".join(
        "?" if not k else str(int(e)) for e, k in zip(found.event[:, 0], found.known[:, 0], strict=True)
    )


# ----------------------------------------------------------------------------------------------------- labels


@pytest.mark.parametrize(
    ("failed", "ended", "censored", "expected"),
    [
        ("00000100", "00000100", "00000000", "000111??"),  # a failure in step 5: the three steps up to it
        ("00000000", "00000100", "00000000", "000000??"),  # a success: nothing can happen any more
        ("00000000", "00000100", "00000100", "000?????"),  # a timeout: what would have come is not known
        ("00000000", "00000000", "00000000", "000000??"),  # the rollout stops
        ("01000010", "01000010", "00000000", "1100111?"),  # two episodes
    ],
)
def test_labels_by_hand(failed, ended, censored, expected):
    assert labels_of(failed, ended, censored, 3) == expected


@settings(deadline=None, max_examples=50)
@given(st.lists(st.sampled_from("..........fst"), min_size=12, max_size=60), st.integers(1, 8))
def test_memory_returns_every_moment_once_with_the_label_of_the_whole_record(record, horizon):
    """In rollouts of 6 steps: the same labels as from one long rollout, for every moment whose horizon has
    been seen."""
    record = record[: len(record) // 6 * 6]
    failed, ended, censored = (torch.tensor([[c in kinds] for c in record]) for kinds in ("f", "fst", "t"))
    whole = label_events(failed, ended, censored, horizon)
    memory, got = RiskMemory(horizon), {}
    for first in range(0, len(record), 6):
        rows = slice(first, first + 6)
        x = torch.arange(first, first + 6.0)[:, None, None]
        moment, event = memory.add(x, failed[rows], ended[rows], censored[rows])
        for place, label in zip(moment.flatten().tolist(), event.tolist(), strict=True):
            assert int(place) not in got
            got[int(place)] = label
    moments = [t for first in range(0, len(record), 6) for t in range(first, first + 6, STRIDE)]
    seen = [t for t in moments if len(record) - t >= horizon and whole.known[t, 0]]
    assert got == {t: bool(whole.event[t, 0]) for t in seen}
    assert memory.ends.shape[1] < horizon + 6, "what is decided is forgotten"


def test_a_horizon_of_no_step_is_refused():
    with pytest.raises(ValueError, match=r"raise risk\.horizon_s"):
        RiskLearner(RiskHead(N_IN, SMALL, generator()), SMALL, control_dt_s=1.0)


# --------------------------------------------------------------------------------------------------- learning


def rollout(seed=0, steps=40, n_env=64):
    """x, failed, ended, censored: an env fails HORIZON / 2 steps after column 0 was 2, which it is at
    random."""
    gen = generator(seed)
    x = torch.randn(steps, n_env, N_IN, generator=gen)
    warned = torch.rand(steps, n_env, generator=gen) < 0.02
    x[..., 0] = 2.0 * warned
    failed = torch.zeros(steps, n_env, dtype=torch.bool)
    failed[HORIZON // 2 :] = warned[: -HORIZON // 2]
    for later in range(HORIZON // 2):  # the warning stands until the failure
        x[later:, :, 0] = torch.maximum(x[later:, :, 0], 2.0 * warned[: steps - later])
    return x, failed, failed, torch.zeros_like(failed)


def learned(updates, seed=0):
    draws = generator(seed)
    head = RiskHead(N_IN, SMALL, draws)
    learner, metrics = RiskLearner(head, SMALL, DT_S), {}
    for number in range(updates):
        metrics = learner.update(*rollout(number), draws)
    return head, learner, metrics


def test_it_learns_what_comes_before_a_failure():
    head, _, metrics = learned(40)
    x, failed, ended, censored = rollout(999)
    labels = label_events(failed, ended, censored, HORIZON)
    p, y = head(x)[labels.known], labels.event[labels.known]
    assert auroc(p, y) > 0.7 and p.dtype == torch.float32
    assert 0 < metrics["risk/brier"] < metrics["risk/event_rate"] * (1 - metrics["risk/event_rate"])
    assert metrics["risk/ece"] < 0.2


def test_resume_is_bit_exact():
    head, learner, _ = learned(3)
    again = RiskHead(N_IN, SMALL, generator(5))
    resumed = RiskLearner(again, SMALL, DT_S)
    again.load_state_dict(head.state_dict())
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    for one in (learner, resumed):
        draws = generator(11)
        for number in (3, 4):
            one.update(*rollout(number), draws)
    for mine, theirs in zip(head.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(mine, theirs)


def test_only_the_handed_generator_is_drawn_from():
    before = torch.get_rng_state()
    first, _, _ = learned(2)
    assert torch.equal(torch.get_rng_state(), before)
    x = rollout()[0]
    assert torch.equal(first(x), learned(2)[0](x)) and not torch.equal(first(x), learned(2, seed=1)[0](x))


def test_nan_is_left_out_and_no_label_changes_nothing():
    head, learner, _ = learned(2)
    before = [p.clone() for p in head.parameters()]
    x, *ends = rollout(7)
    learner.memory = RiskMemory(HORIZON)
    metrics = learner.update(x * math.nan, *ends, generator())
    assert metrics == {"risk/skipped_updates": SMALL.steps}
    metrics = learner.update(
        x[:1], *(part[:1] for part in ends), generator()
    )  # one step more: few decided, all of them NaN
    assert metrics == {"risk/skipped_updates": SMALL.steps}
    assert all(torch.equal(a, b) for a, b in zip(before, head.parameters(), strict=True))
    assert torch.isfinite(head(x)).all()


# ------------------------------------------------------------------------------------------------ calibration


def test_pool_adjacent_violators_by_hand():
    score, value = isotonic(torch.tensor([1.0, 2.0, 3.0, 4.0, 4.0]), torch.tensor([0.0, 1.0, 0.0, 1.0, 0.0]))
    assert score.tolist() == [1.0, 2.0, 3.0, 4.0] and value.tolist() == [0.0, 0.5, 0.5, 0.5]


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 9), st.booleans()), min_size=1, max_size=40))
def test_isotonic_regression_agrees_with_scipy(pairs):
    """SciPy's takes one value per score: ours has merged equal scores before."""
    score, event = (torch.tensor([float(pair[i]) for pair in pairs]) for i in (0, 1))
    distinct, value = isotonic(score, event)
    weight = np.array([(score == s).sum().item() for s in distinct])
    mean = np.array([event[score == s].mean().item() for s in distinct])
    np.testing.assert_allclose(
        value, optimize.isotonic_regression(mean, weights=weight).x, atol=1e-6
    )  # means are float32 here


def test_calibration_repairs_a_logit_that_is_far_too_sure():
    """True probabilities are those of a third of the logit: uncalibrated far off, calibrated on other samples
    close."""
    head = RiskHead(N_IN, SMALL, generator())
    logit = 3.0 * torch.randn(40_000, generator=generator(1))
    event = torch.rand(40_000, generator=generator(2)) < torch.sigmoid(logit / 3.0)
    held_out, fresh = slice(0, 20_000), slice(20_000, None)
    assert expected_calibration_error(head.calibrated(logit[fresh]), event[fresh], 10) > 4 * SAMPLING
    head.calibrate(logit[held_out], event[held_out])
    assert expected_calibration_error(head.calibrated(logit[fresh]), event[fresh], 10) < SAMPLING
    assert (head.table.diff() >= 0).all()
    with pytest.raises(ValueError, match="0 events among 3 moments"):
        head.calibrate(torch.zeros(3), torch.zeros(3))


def test_table_is_the_logistic_function_at_birth_and_constant_beyond_its_ends():
    head = RiskHead(N_IN, SMALL, generator())
    logit = torch.tensor([-50.0, -12.0, -0.55, 0.0, 3.3, 12.0, 50.0], dtype=torch.float64)
    np.testing.assert_allclose(
        head.calibrated(logit), torch.sigmoid(logit.clamp(-12, 12)), atol=2e-4
    )  # linear over 0.1 of a logit


# -------------------------------------------------------------------------------------------------- conformal


def test_threshold_is_the_score_of_the_finite_sample_rank():
    scores = torch.arange(1.0, 20.0)  # n = 19: the ceil(20 x 0.9) = 18th largest is 2
    assert conformal_threshold(scores, 0.1) == 2.0
    assert conformal_threshold(scores, 0.05) == 1.0
    with pytest.raises(
        ValueError, match=r"19 dangerous moments are too few for a miss rate of 0\.04: it takes 24"
    ):
        conformal_threshold(scores, 0.04)
    with pytest.raises(ValueError, match="finite"):
        conformal_threshold(torch.full((19,), math.nan), 0.1)


@pytest.mark.parametrize("miss_rate", [0.05, 0.2])
def test_share_of_misses_among_new_moments_is_what_was_promised(miss_rate):
    """Over many draws of 40 held-out and 100 new moments: expected misses are floor((n + 1) miss) / (n +
    1)."""
    gen, missed = generator(3), []
    for _ in range(400):
        held_out, new = torch.randn(40, generator=gen).exp(), torch.randn(100, generator=gen).exp()
        missed.append((new < conformal_threshold(held_out, miss_rate)).float().mean().item())
    promised = math.floor(41 * miss_rate + 1e-9) / 41
    assert promised <= miss_rate
    assert np.mean(missed) == pytest.approx(promised, abs=4 * np.std(missed) / math.sqrt(len(missed)))
    assert np.mean(missed) < miss_rate * 1.1


def test_memory_of_a_small_rollout_waits():
    """Nothing is decided before the horizon has been seen, and the input that waits is a copy."""
    memory = RiskMemory(HORIZON)
    x = torch.ones(4, 2, N_IN)
    none = torch.zeros(4, 2, dtype=torch.bool)
    moment, event = memory.add(x, none, none, none)
    assert moment.shape == (0, N_IN) and event.shape == (0,)
    x.zero_()
    memory.add(x, none, none, none)
    moment, event = memory.add(x, none, none, none)
    assert moment.tolist() == [[1.0] * N_IN] * 2 and not event.any()
    assert STRIDE >= 4, "each of these rollouts holds one moment"
