"""Calibration figures: hand-computed numbers, oracles of SciPy, invariances, and what they refuse."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from uuvtai.learn import calibration

SAME = 1e-12
"""Float64 arithmetic of a few hundred terms."""

SAMPLING = 0.01
"""Four standard errors of a share of 100,000 samples are 0.0063 at most; of their mean square, 0.018 / 2."""


def test_residual_of_a_variance_of_four():
    mean, log_var = torch.tensor([[1.0, 2.0]]), torch.tensor([[math.log(4.0), 0.0]])
    target = torch.tensor([[3.0, 5.0]])
    z = calibration.standardised_residual(mean, log_var, target)
    np.testing.assert_allclose(z, [[1.0, 3.0]], rtol=1e-7)  # log(4) is a float32 here
    assert calibration.mean_squared_standardised_residual(mean, log_var, target) == pytest.approx(
        5.0, rel=1e-7
    )


def test_true_variance_gives_one_and_nominal_coverage():
    gen = torch.Generator().manual_seed(0)
    log_var = torch.randn(100_000, generator=gen)
    target = torch.exp(0.5 * log_var) * torch.randn(100_000, generator=gen) + 3.0
    mean, levels = torch.full_like(target, 3.0), torch.tensor([0.5, 0.8, 0.9, 0.99])
    assert calibration.mean_squared_standardised_residual(mean, log_var, target) == pytest.approx(
        1.0, abs=2 * SAMPLING
    )
    np.testing.assert_allclose(calibration.coverage(mean, log_var, target, levels), levels, atol=SAMPLING)
    too_sure = calibration.coverage(mean, log_var - math.log(4.0), target, levels)
    inside = [2 * stats.norm.cdf(0.5 * stats.norm.ppf(0.5 + level / 2)) - 1 for level in levels.tolist()]
    np.testing.assert_allclose(too_sure, inside, atol=SAMPLING)


def test_coverage_of_four_residuals():
    zero = torch.zeros(4)
    inside = calibration.coverage(
        zero, zero, torch.tensor([0.5, -0.7, 1.5, 3.0]), torch.tensor([0.5, 0.9])
    )  # |z| < 0.674, 1.645
    assert inside.tolist() == [0.25, 0.75]
    with pytest.raises(ValueError, match="between 0 and 1"):
        calibration.coverage(zero, zero, zero, torch.tensor([0.5, 1.0]))


P = torch.tensor([0.05, 0.15, 0.15, 0.95, 1.0])
Y = torch.tensor([0.0, 0.0, 1.0, 1.0, 1.0])


def test_reliability_brier_and_ece_by_hand():
    diagram = calibration.reliability(P, Y, bins=10)
    assert diagram.samples.tolist() == [1, 2, 2], (
        "seven bins are empty; a probability of 1 belongs to the last"
    )
    np.testing.assert_allclose(diagram.predicted, [0.05, 0.15, 0.975], atol=1e-7)
    np.testing.assert_allclose(diagram.observed, [0.0, 0.5, 1.0], atol=SAME)
    assert calibration.brier(P, Y) == pytest.approx((0.05**2 + 0.15**2 + 0.85**2 + 0.05**2) / 5, abs=1e-7)
    assert calibration.expected_calibration_error(P, Y, bins=10) == pytest.approx(
        (0.05 + 2 * 0.35 + 2 * 0.025) / 5, abs=1e-7
    )


def test_base_rate_is_calibrated_and_has_its_own_brier():
    y = torch.tensor([1.0] * 3 + [0.0] * 7)
    p = torch.full((10,), 0.3, dtype=torch.float64)
    assert calibration.expected_calibration_error(p, y, bins=10) == pytest.approx(0.0, abs=SAME)
    assert calibration.brier(p, y) == pytest.approx(0.3 * 0.7, abs=SAME)


def test_ranks_share_ties():
    assert calibration.average_rank(torch.tensor([3.0, 1.0, 3.0, 7.0, 1.0])).tolist() == [
        3.5,
        1.5,
        3.5,
        5.0,
        1.5,
    ]


def test_auroc_by_hand():
    event = torch.tensor([0, 0, 1, 1])
    assert calibration.auroc(torch.tensor([0.1, 0.2, 0.3, 0.4]), event) == 1.0
    assert calibration.auroc(torch.tensor([0.1, 0.4, 0.35, 0.8]), event) == 0.75
    assert calibration.auroc(torch.zeros(4), event) == 0.5


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.integers(-5, 5), st.booleans()), min_size=2, max_size=40))
def test_rank_statistics_agree_with_scipy(pairs):
    score = torch.tensor([float(a) for a, _ in pairs])
    event = torch.tensor([float(b) for _, b in pairs])
    if event.unique().numel() < 2:
        return
    u = stats.mannwhitneyu(score[event == 1], score[event == 0]).statistic
    assert calibration.auroc(score, event) == pytest.approx(
        u / (event.sum().item() * (1 - event).sum().item()), abs=SAME
    )
    if score.unique().numel() > 1:
        assert calibration.spearman(score, event) == pytest.approx(
            stats.spearmanr(score, event).statistic, abs=1e-9
        )
        assert calibration.spearman(torch.exp(score), event) == pytest.approx(
            calibration.spearman(score, event), abs=SAME
        )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: calibration.brier(torch.tensor([1.2]), torch.tensor([1])), r"\[0, 1\]"),
        (lambda: calibration.brier(torch.tensor([math.nan]), torch.tensor([1])), r"\[0, 1\]"),
        (lambda: calibration.brier(torch.tensor([0.2]), torch.tensor([2])), "events must be 0 or 1"),
        (lambda: calibration.brier(torch.tensor([0.2, 0.3]), torch.tensor([1])), "pair up"),
        (lambda: calibration.brier(torch.zeros(0), torch.zeros(0)), "no samples"),
        (
            lambda: calibration.auroc(torch.tensor([0.2, 0.3]), torch.tensor([1, 1])),
            "2 events and 0 non-events",
        ),
        (lambda: calibration.spearman(torch.tensor([1.0, 1.0]), torch.tensor([1.0, 2.0])), "constant"),
    ],
)
def test_what_is_not_defined_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
