"""Cheap launches do what Taichi's own do, with whatever is passed."""

import numpy as np
import pytest
import taichi as ti
import torch

from uuvtai.compile.launch import quick_launch
from uuvtai.compile.runtime import start_taichi
from uuvtai.kernels.core.stage import Const, In

N = 4


@quick_launch
@ti.kernel
def add_scaled(
    field: In[ti.Field],
    scale: Const[float],
    out: ti.types.ndarray(),
    shift: float,
    count: int,  # type: ignore[valid-type]
):
    """out += scale * field + shift + count."""
    for i in range(N):
        out[i] += scale * field[i] + shift + count


@pytest.fixture(scope="module")
def fields():
    start_taichi("cpu")
    made = [ti.field(ti.f32, N) for _ in range(2)]
    made[0].from_numpy(np.arange(N, dtype=np.float32))
    made[1].fill(100.0)
    return made


@pytest.mark.parametrize("new", [torch.zeros, lambda n: np.zeros(n, np.float32)], ids=["torch", "numpy"])
def test_each_launch_works_on_what_it_is_given(fields, new):
    """The same objects again, then another field, constant, array, number one by one, then the first."""
    first, other = new(N), new(N)
    ramp = np.arange(N)
    for turn in range(1, 4):
        add_scaled(fields[0], 2.0, first, 0.5, 3)
        np.testing.assert_array_equal(np.asarray(first), turn * (2 * ramp + 3.5))
    for field, scale, shift, count, expected in (
        (fields[1], 2.0, 0.5, 3, np.full(N, 203.5)),
        (fields[0], 3.0, 0.5, 3, 3 * ramp + 3.5),
        (fields[0], 2.0, 0.25, 3, 2 * ramp + 3.25),
        (fields[0], 2.0, 0.5, 7, 2 * ramp + 7.5),
        (fields[0], 2.0, 0.5, 3, 2 * ramp + 3.5),
    ):
        other[:] = 0
        for _ in range(2):
            add_scaled(field, scale, other, shift, count)
        np.testing.assert_array_equal(np.asarray(other), 2 * expected)


def test_many_short_lived_tensors_are_served_and_not_hoarded(fields):
    for turn in range(200):
        out = torch.full((N,), float(turn))
        add_scaled(fields[1], 1.0, out, 0.0, 0)
        assert (out == 100.0 + turn).all()


def test_wrong_arguments_are_still_refused(fields):
    out = torch.zeros(N)
    add_scaled(fields[0], 1.0, out, 0.0, 0)
    with pytest.raises(Exception, match="missing"):
        add_scaled(fields[0], 1.0, out, 0.0)  # pyright: ignore[reportCallIssue]
    with pytest.raises(Exception, match="type"):
        add_scaled(fields[0], 1.0, out, "far", 0)  # pyright: ignore[reportArgumentType]
