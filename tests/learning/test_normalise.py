"""Running statistics: merging is exact, rows that are not finite leave no trace, scaling is undone."""

import math

import pytest
import torch

from uuvtai.learning.networks import MIN_STD, Moments, RunningNorm, combined, moments_of

EXACT = 1e-12
"""relative; float64 sums in another order"""
FLOAT32 = 1e-5
"""relative; a subtraction and a multiplication in float32, undone again"""


@pytest.fixture
def samples():
    generator = torch.Generator().manual_seed(1)
    return torch.randn(5000, 3, generator=generator) * torch.tensor([1.0, 50.0, 0.2]) + torch.tensor(
        [0.0, 1000.0, -7.0]
    )


def assert_moments(found, rows):
    rows = rows.double()
    assert float(found.n) == len(rows)
    assert torch.allclose(found.mean, rows.mean(0), rtol=EXACT, atol=0)
    assert torch.allclose(found.m2, (rows - rows.mean(0)).square().sum(0), rtol=EXACT, atol=0)


def test_moments_by_hand():
    found = moments_of(torch.tensor([[1.0, 5.0], [3.0, 5.0], [8.0, 5.0]]))
    assert found.mean.tolist() == [4.0, 5.0]
    assert found.m2.tolist() == [26.0, 0.0]
    assert float(found.n) == 3


@pytest.mark.parametrize("cut", [0, 1, 2047, 2048, 4999, 5000])
def test_parts_merge_to_the_whole(samples, cut):
    assert_moments(combined(moments_of(samples[:cut]), moments_of(samples[cut:])), samples)


def test_batches_of_any_shape_and_size_merge_to_the_whole(samples):
    norm = RunningNorm(3)
    norm.update(samples[:4000].view(40, 100, 3))
    for part in samples[4000:].split(7):
        norm.update(part)
    assert_moments(Moments(norm.mean, norm.m2, norm.count), samples)
    assert torch.allclose(norm.std(), samples.double().std(0, correction=0), rtol=EXACT)


def test_nothing_plus_nothing_is_nothing():
    found = combined(moments_of(torch.zeros(0, 2)), moments_of(torch.full((1, 2), math.nan)))
    assert float(found.n) == 0
    assert torch.equal(found.mean, torch.zeros(2, dtype=torch.float64))


def test_rows_that_are_not_finite_leave_no_trace(samples):
    spoilt = samples.clone()
    spoilt[10, 1], spoilt[20, 0], spoilt[30] = math.nan, math.inf, -math.inf
    kept = torch.ones(len(samples), dtype=torch.bool)
    kept[[10, 20, 30]] = False
    assert_moments(moments_of(spoilt), samples[kept])


def test_before_the_first_sample_nothing_changes():
    x = torch.tensor([[-300.0, 0.5]])
    assert torch.equal(RunningNorm(2)(x), x)


def test_scaling_and_its_inverse(samples):
    norm = RunningNorm(3)
    norm.update(samples)
    y = norm(samples)
    assert y.dtype == torch.float32
    # float32 holds 1000 +- 50 to 6e-5
    assert torch.allclose(y.double().mean(0), torch.zeros(3, dtype=torch.float64), atol=1e-3)
    assert torch.allclose(y.std(0, correction=0), torch.ones(3), atol=1e-3)
    assert torch.allclose(norm.inverse(y), samples, rtol=FLOAT32, atol=FLOAT32)


def test_values_are_clipped_and_what_is_no_number_becomes_the_mean(samples):
    norm = RunningNorm(3, clip=2.0)
    norm.update(samples)
    y = norm(torch.tensor([[100.0, math.nan, -math.inf], [-math.inf, math.inf, -7.0]]))
    assert y[0].tolist() == [2.0, 0.0, -2.0]
    assert y[1, :2].tolist() == [-2.0, 2.0]


def test_a_constant_column_does_not_become_noise():
    norm = RunningNorm(1)
    norm.update(torch.full((100, 1), 3.0))
    assert float(norm.std()) == MIN_STD
    assert float(norm(torch.tensor([[3.001]]))) == pytest.approx(0.1, rel=1e-3)


def test_statistics_travel_in_the_state_dict(samples):
    norm, other = RunningNorm(3), RunningNorm(3)
    norm.update(samples)
    other.load_state_dict(norm.state_dict())
    assert torch.equal(other(samples), norm(samples))
    assert all(value.dtype == torch.float64 for value in norm.state_dict().values())
