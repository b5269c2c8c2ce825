"""The one rule for other people's clocks."""

import math

import pytest

from uuvtai.common.clocks import SEVERAL, SourceClock, stamp_of

NONE, INF = None, math.inf
WRAP_MS, WRAP_US = 2**32 / 1e3, 2**32 / 1e6


def dated(rows, wrap_s=INF):
    clock = SourceClock()
    return [clock.measured_s(sent, come, wrap_s) for sent, come in rows], clock


def even(sent_s, come_s, count=100, step_s=0.1):
    return [(sent_s + step_s * k, come_s + step_s * k) for k in range(count)]


@pytest.mark.parametrize(
    "stamps", [[0.0], [NONE], [math.nan], [math.inf], [77.0], [77.0, 0.0], [9.0, 8.0, 7.0]]
)
def test_stamps_that_tell_nothing_are_dated_by_arrival(stamps):
    comes = [0.1 * k for k in range(60)]
    falling = stamps[0] == 9.0
    sent = [900.0 - k for k in range(60)] if falling else [stamps[k % len(stamps)] for k in range(60)]
    assert dated(list(zip(sent, comes, strict=True)))[0] == comes


def test_a_clock_of_whole_seconds_and_one_that_stops():
    rows = [(100.0 + k // 10, 0.1 * k) for k in range(100)]
    found, _ = dated(rows)
    ages = [come - time for (_, come), time in zip(rows, found, strict=True)]
    assert max(ages) <= 0.1 * SEVERAL and min(ages) >= 0
    found, _ = dated([*even(5.0, 0.0), *[(14.9, 10.0 + 0.1 * k) for k in range(20)]])
    assert found[-1] == 11.9


@pytest.mark.parametrize("late_s", [0.3, 0.9, 1.1, 1.2, 3.0, 60.0])
def test_a_late_message_is_known_to_be_old(late_s):
    before, now_s = even(500.0, 10.0, 1000), 109.95
    found, clock = dated([*before, (599.95 - late_s, now_s), (600.0, 110.0)])
    assert found[-2] == pytest.approx(now_s - late_s, abs=2e-3)
    assert found[-1] == pytest.approx(110.0, abs=2e-3)
    assert clock.restarts == 0


def test_several_late_ones_of_one_moment_are_late():
    found, clock = dated([*even(500.0, 10.0), *[(505.0 + 0.1 * k, 20.0) for k in range(40)]])
    assert found[-1] == pytest.approx(18.9, abs=2e-3) and clock.restarts == 0


def test_every_other_message_twice_and_late_is_no_restart():
    rows = [
        row for k in range(100) for row in ((500.0 + 0.1 * k, 0.1 * k), (498.0 + 0.1 * k, 0.1 * k + 0.05))
    ]
    found, clock = dated(rows)
    assert clock.restarts == 0
    assert found[-2] == pytest.approx(9.9, abs=2e-3) and found[-1] == pytest.approx(7.9, abs=2e-3)


@pytest.mark.parametrize("begin_s", [0.2, 3.0, 480.0])
def test_a_clock_that_begins_anew(begin_s):
    found, clock = dated([*even(500.0, 10.0), *even(begin_s, 30.0, 10)])
    assert found[100] < 20.0, "one from the past is late"
    assert found[100 + SEVERAL - 1 :] == pytest.approx([30.4, 30.5, 30.6, 30.7, 30.8, 30.9])
    assert clock.restarts == 1 and clock.sent_s == pytest.approx(begin_s + 0.9)


def test_a_stranger_from_the_future_is_dated_now_and_makes_nothing_old():
    found, clock = dated([*even(500.0, 10.0), (9000.0, 20.0), *even(510.1, 20.1)])
    assert found[100:102] == pytest.approx([20.0, 20.1], abs=1e-3) and clock.restarts == 0
    found, _ = dated([*even(500.0, 10.0), *even(9000.0, 20.0), (9010.0, 30.4)])
    assert found[-1] == pytest.approx(30.0, abs=2e-3), "a clock that was set"


@pytest.mark.parametrize("wrap_s", [WRAP_MS, WRAP_US])
@pytest.mark.parametrize("silent_s", [0.0, 60.0])
def test_a_counter_that_runs_over_goes_on(wrap_s, silent_s):
    begun = wrap_s - 5.0
    rows = [((begun + t) % wrap_s, t) for t in (0.1 * k + silent_s * (k > 40) for k in range(200))]
    found, clock = dated(rows, wrap_s)
    assert found == pytest.approx([come for _, come in rows], abs=1e-3)
    assert clock.restarts == 0 and clock.sent_s == pytest.approx(begun + rows[-1][1], abs=1e-3)
    late, clock = dated([*rows, ((begun + rows[-1][1] - 2.0) % wrap_s, rows[-1][1] + 0.05)], wrap_s)
    assert late[-1] == pytest.approx(rows[-1][1] - 2.0, abs=2e-3)


def test_delay_is_what_comes_on_top_of_the_least():
    found, _ = dated([(500.0, 10.0), (501.0, 11.3), (501.1, 12.1)])
    assert found == pytest.approx([10.0, 11.0, 11.1], abs=1e-3)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"time_boot_ms": 1500}, (1.5, WRAP_MS)),
        ({"time_usec": 1500000}, (1.5, WRAP_US)),
        ({"x": 1}, (NONE, INF)),
    ],
)
def test_what_a_message_says_of_its_time(fields, told):
    assert stamp_of(fields) == told
