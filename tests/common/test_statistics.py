"""Hand-computed intervals and times."""

import numpy as np
import pytest

from uuvtai.common.statistics import (
    binomial_p,
    bootstrap_interval,
    design_effect,
    fisher_p,
    holm_adjusted,
    mcnemar_p,
    mean,
    rate,
    student95,
    student_p,
    time_to_success_s,
    wilson_interval,
)
from uuvtai.evaluation.results import paired


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0000, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_matches_published_table(k, n, low, high):
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=5e-5)


def test_wilson_ends_are_exact_and_symmetric():
    low, high = wilson_interval(20, 20)
    assert high == 1.0
    assert low == pytest.approx(1 - wilson_interval(0, 20)[1])


def test_no_trials_is_none_not_nan():
    assert wilson_interval(0, 0) is None
    assert rate(0, 0) is None
    assert mean([]) is None
    assert time_to_success_s(None, None) is None
    assert time_to_success_s(10.0, 0.0) is None


@pytest.mark.parametrize(("k", "n"), [(-1, 3), (4, 3)])
def test_impossible_counts_are_refused(k, n):
    with pytest.raises(ValueError, match="k must lie"):
        wilson_interval(k, n)


@pytest.mark.parametrize(
    ("won", "trials", "effect"),
    [
        ([1, 0, 1, 1], [1, 1, 1, 1], 1.0),  # clusters of one: the usual interval, to the last bit
        ([0, 4, 4, 0] * 8, [4] * 32, 32 / 31 * 4 * (2.0395 / 1.96) ** 2),  # all or none: a cluster is a trial
        ([2, 2] * 20, [4, 4] * 20, (2.0227 / 1.96) ** 2),  # more alike than chance: never less than 1
        ([4] * 30, [4] * 30, 4.0),  # all of them: nothing says how far they go together
        ([0] * 30, [4] * 30, 4.0),
        ([3], [5], 5.0),  # one cluster is one trial
        ([], [], 1.0),
    ],
)
def test_design_effect_by_hand(won, trials, effect):
    """Student's quantiles from a table: 2.0395 for 31 degrees of freedom, 2.0227 for 39."""
    assert design_effect(won, trials) == pytest.approx(effect, rel=1e-3)


def episodes_of_a_grid(rng, n_cell, n_episode, rate, correlation):
    """(n_cell, n_episode) bool: how hard an episode is counts in all cells (beta-binomial)."""
    hard = np.full(n_episode, rate)
    if correlation:
        scale = 1 / correlation - 1
        hard = rng.beta(rate * scale, (1 - rate) * scale, n_episode)
    return rng.random((n_cell, n_episode)) < hard


@pytest.mark.parametrize("n_episode", [8, 64])
@pytest.mark.parametrize(("rate_", "correlation"), [(0.95, 0.0), (0.95, 0.12), (0.8, 0.2), (0.6, 0.05)])
def test_intervals_over_a_grid_cover_the_rate_as_often_as_they_say(rate_, correlation, n_episode):
    rng, covered, naive, n = np.random.default_rng(5), 0, 0, 400
    for _ in range(n):
        won = episodes_of_a_grid(rng, 32, n_episode, rate_, correlation).sum(axis=0)
        effect, k, trials = design_effect(list(won), [32] * n_episode), int(won.sum()), 32 * n_episode
        low, high = wilson_interval(k / effect, trials / effect)
        covered += low <= rate_ <= high
        low, high = wilson_interval(k, trials)
        naive += low <= rate_ <= high
    assert 0.91 <= covered / n <= 0.995, "95 % nominal; 400 trials have an error of 1.1 %"
    assert correlation < 0.1 or naive / n < 0.75, "cells taken for independent cover far less"


def test_where_episodes_do_not_go_together_the_interval_is_the_usual_one():
    rng, widths = np.random.default_rng(6), []
    for _ in range(100):
        won = episodes_of_a_grid(rng, 32, 200, 0.9, 0.0).sum(axis=0)
        widths.append(design_effect(list(won), [32] * 200) ** 0.5)
    assert 1.0 <= np.mean(widths) < 1.06


def test_tts_of_the_papers_first_row():
    # Table main: 22.84 s at 0.20 gives 114.2 s, the one row that adds up
    assert time_to_success_s(22.84, 0.20) == pytest.approx(114.2)


def test_mcnemar_by_hand():
    # 10 discordant pairs, 2 : 8: 2 (1 + 10 + 45) / 1024
    assert mcnemar_p(2, 8) == mcnemar_p(8, 2) == pytest.approx(2 * 56 / 1024)
    assert mcnemar_p(0, 0) == 1.0
    assert mcnemar_p(5, 5) == 1.0
    assert mcnemar_p(0, 6) == pytest.approx(2 / 64)
    assert mcnemar_p(3000, 3000) == 1.0
    # more pairs than a float has powers of two for; the normal approximation with its correction: z = 2.731
    assert mcnemar_p(601, 509) == pytest.approx(0.00631, rel=0.02)
    with pytest.raises(ValueError, match="not be negative"):
        mcnemar_p(-1, 3)


def test_binomial_by_hand():
    # 10 throws of a coin, 8 heads: 2 (45 + 10 + 1) / 1024
    assert [binomial_p(8, 10, 0.5), binomial_p(2, 10, 0.5)] == pytest.approx([2 * 56 / 1024] * 2)
    assert binomial_p(0, 20, 0.011) == 1.0, "twice (1 - 0.011)^20 is beyond 1"
    assert binomial_p(0, 1000, 0.011) == pytest.approx(2 * 0.989**1000)
    assert binomial_p(0, 0, 0.3) == 1.0
    for k, n, p in ((3, 2, 0.5), (-1, 2, 0.5), (1, 2, 0.0)):
        with pytest.raises(ValueError, match="want 0 <= k"):
            binomial_p(k, n, p)


def test_fisher_by_hand():
    # the lady tasting tea: 3 of 4 cups right, tables 1, 16, 36, 16, 1 of 70
    assert fisher_p(3, 4, 1, 4) == fisher_p(1, 4, 3, 4) == pytest.approx(34 / 70)
    assert fisher_p(4, 4, 0, 4) == pytest.approx(2 / 70)
    assert fisher_p(2, 4, 2, 4) == pytest.approx(1.0)
    assert fisher_p(0, 0, 5, 10) == 1.0
    with pytest.raises(ValueError, match="5/4"):
        fisher_p(5, 4, 1, 4)


def test_fisher_and_binomial_agree_with_scipy():
    stats = pytest.importorskip("scipy.stats")
    assert fisher_p(138, 200, 17, 200) == pytest.approx(
        stats.fisher_exact([[138, 62], [17, 183]]).pvalue, rel=1e-6
    )
    assert fisher_p(28, 32, 38, 40) == pytest.approx(stats.fisher_exact([[28, 4], [38, 2]]).pvalue, rel=1e-6)
    for k, n, p in ((49, 2048, 0.011), (1976, 2048, 0.828), (4, 512, 0.011)):
        tails = stats.binom.cdf(k, n, p), stats.binom.sf(k - 1, n, p)
        assert binomial_p(k, n, p) == pytest.approx(min(1.0, 2 * min(tails)), rel=1e-6)


def test_students_t_of_a_table_and_of_scipy():
    assert [student95(freedom) for freedom in (1, 4, 30)] == pytest.approx([12.706, 2.776, 2.042], abs=1e-3)
    assert student_p(0.0, 3.0) == 1.0 and student_p(-2.0, 3.0) == student_p(2.0, 3.0)
    stats = pytest.importorskip("scipy.stats")
    for t, freedom in ((0.3, 1.0), (2.1, 4.7), (9.0, 7.6), (25.0, 4.0), (1.96, 999.0), (6.0, 999.0)):
        assert student_p(t, freedom) == pytest.approx(2 * stats.t.sf(t, freedom), rel=1e-3)


def test_bootstrap_interval_of_known_samples():
    assert bootstrap_interval([3.0]) is None
    assert bootstrap_interval([2.5] * 7) == (2.5, 2.5)
    values = list(np.random.default_rng(0).normal(10.0, 2.0, 400))
    low, high = bootstrap_interval(values)
    half = 1.96 * np.std(values) / 20  # the normal approximation, good for 400 samples
    assert (low, high) == pytest.approx((np.mean(values) - half, np.mean(values) + half), abs=0.1 * half)
    assert bootstrap_interval(values) == (low, high)


def test_bootstrap_interval_covers_the_mean_as_often_as_it_says():
    rng, covered = np.random.default_rng(1), 0
    for _ in range(100):
        low, high = bootstrap_interval(list(rng.normal(0.0, 1.0, 40)), resamples=300)
        covered += low <= 0.0 <= high
    assert 0.87 <= covered / 100 <= 0.99, (
        "95 % nominal, a little less for 40 samples; 100 trials have an error of 2.2 %"
    )


def test_holm_by_hand():
    assert holm_adjusted([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm_adjusted([0.9, 0.8]) == pytest.approx([1.0, 1.0])
    assert holm_adjusted([]) == []


def _method(name, outcomes, times):
    return {
        "name": name,
        "episodes_detail": [
            {"seed": 1, "episode": i, "outcome": o, "time_s": t}
            for i, (o, t) in enumerate(zip(outcomes, times, strict=True))
        ],
    }


def test_pairs_count_who_alone_arrives_and_compare_times_where_both_do():
    a = _method("a", ["success", "success", "ttc", "success"], [10.0, 12.0, 3.0, 9.0])
    b = _method("b", ["success", "collision", "success", "success"], [11.0, 5.0, 8.0, 12.0])
    (row,) = paired([a, b])
    assert (row["a"], row["b"], row["both"], row["only_a"], row["only_b"]) == ("a", "b", 2, 1, 1)
    assert row["mcnemar_p"] == 1.0
    assert row["time_difference_mean_s"] == pytest.approx((10 - 11 + 9 - 12) / 2)
    (row,) = paired([a, _method("c", ["ttc", "success", "ttc", "ttc"], [1.0, 11.0, 1.0, 1.0])])
    assert (row["both"], row["only_a"], row["only_b"]) == (1, 2, 0)
    assert (row["time_a_mean_s"], row["time_b_mean_s"], row["mcnemar_p"]) == (12.0, 11.0, 0.5)
    assert len(paired([a, b, a])) == 3
    assert paired([a]) == []
