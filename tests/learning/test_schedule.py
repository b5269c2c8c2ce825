"""Piecewise-linear schedules on hand-computed numbers, the paper's among them."""

import pytest

from uuvtai.config.learning import DistillationConfig
from uuvtai.learning.distillation import piecewise_linear


@pytest.mark.parametrize(
    ("fraction", "value"),
    [(-1.0, 2.0), (0.0, 2.0), (0.25, 3.0), (0.5, 4.0), (0.75, 3.0), (1.0, 2.0), (5.0, 2.0)],
)
def test_linear_in_between_constant_outside(fraction, value):
    assert piecewise_linear([(0.0, 2.0), (0.5, 4.0), (1.0, 2.0)], fraction) == value


def test_two_points_at_one_place_are_a_jump_to_the_later_value():
    points = [(0.0, 1.0), (0.5, 1.0), (0.5, 0.2), (1.0, 0.2)]
    assert [piecewise_linear(points, f) for f in (0.0, 0.499999, 0.5, 0.7, 1.0)] == [1.0, 1.0, 0.2, 0.2, 0.2]
    assert piecewise_linear([(0.0, 1.0), (0.0, 3.0)], 0.0) == 3.0


def test_one_point_is_a_constant():
    assert [piecewise_linear([(0.3, 0.2)], f) for f in (0.0, 0.3, 1.0)] == [0.2] * 3


@pytest.mark.parametrize(
    ("iteration", "value"), [(0, 1.0), (799, 1.0), (800, 0.2), (1200, 0.1), (1600, 0.0), (1700, 0.0)]
)
def test_the_paper_s_schedule(iteration, value):
    """lambda_t: 1 until 800, then 0.2 down to 0 at 1600, which a run of 1200 iterations never reaches."""
    assert piecewise_linear(DistillationConfig().schedule, iteration / 1200) == pytest.approx(
        value, abs=1e-12
    )


@pytest.mark.parametrize("points", [[], [(1.0, 0.0), (0.5, 1.0)]])
def test_nonsense_is_refused(points):
    with pytest.raises(ValueError, match="at least one"):
        piecewise_linear(points, 0.5)
