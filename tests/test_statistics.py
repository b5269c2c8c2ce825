"""Hand-computed intervals and times."""

import pytest

from uuvtai.measure.statistics import mean, rate, time_to_success_s, wilson_interval


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    # Newcombe 1998, table I (method 3, Wilson without continuity correction)
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


def test_tts_of_the_papers_first_row():
    # Table main: 22.84 s at 0.20 gives 114.2 s, the one row that adds up
    assert time_to_success_s(22.84, 0.20) == pytest.approx(114.2)
