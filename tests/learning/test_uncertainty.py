"""Running uncertainty and its scale, on hand-computed numbers."""

import math

import pytest
import torch

from uuvtai.config.learning import UncertaintyConfig
from uuvtai.learning.distillation import Uncertainty


def after(config, *batches):
    uncertainty = Uncertainty(config)
    for batch in batches:
        uncertainty.update(torch.tensor(batch))
    return uncertainty


def test_mean_follows_the_papers_recursion_from_the_first_value_on():
    config = UncertaintyConfig(ema=0.25)
    assert float(after(config, [0.2, 0.6]).mean) == pytest.approx(0.4)
    assert float(after(config, [0.2, 0.6], [0.8]).mean) == pytest.approx(0.75 * 0.4 + 0.25 * 0.8)


@pytest.mark.parametrize(("sigma", "scale"), [(0.0, 1.0), (0.5, 1.4), (1.25, 2.0), (40.0, 2.0)])
def test_scale_is_one_plus_gain_times_mean_and_capped(sigma, scale):
    assert after(UncertaintyConfig(gain=0.8, max_scale=2.0), [sigma]).scale == pytest.approx(scale)


def test_no_gain_and_no_batch_leave_the_distillation_alone():
    assert after(UncertaintyConfig(gain=0.0), [3.0]).scale == 1.0
    assert after(UncertaintyConfig()).scale == 1.0


def test_values_that_are_not_finite_do_not_enter():
    assert float(after(UncertaintyConfig(), [0.5, math.nan, math.inf]).mean) == 0.5
    assert float(after(UncertaintyConfig(), [0.5], [math.nan]).mean) == 0.5


def test_state_is_complete():
    config = UncertaintyConfig(ema=0.25)
    first = after(config, [0.3])
    second = Uncertainty(config)
    second.load_state_dict(first.state_dict())
    for uncertainty in (first, second):
        uncertainty.update(torch.tensor([0.9]))
    assert torch.equal(first.mean, second.mean)
