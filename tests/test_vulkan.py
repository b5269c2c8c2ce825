"""Vulkan is no device of ours. What Taichi 1.7.4 does there is kept here, because the rehearsal of GPUs came
by: ``compute_clearance`` works, and why scenarios lose bodies. Skipped where there is no Vulkan."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import test_clearance, vulkan_run
from uuvtai.native import gpu_shape

ROOT = Path(__file__).parent.parent


def run(what, folder, shape="cpu"):
    """What ``vulkan_run`` found, or its last words."""
    out = folder / f"{what}.npy"
    done = subprocess.run(
        [sys.executable, "-m", "tests.vulkan_run", what, str(out)],
        env=os.environ | {gpu_shape.VARIABLE: shape, "PYTHONPATH": str(ROOT)},
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode == vulkan_run.NO_VULKAN:
        pytest.skip("no Vulkan here (Debian: mesa-vulkan-drivers)")
    return np.load(out) if out.exists() else done.stdout + done.stderr


@pytest.mark.parametrize("shape", ["cpu", "gpu"])
def test_the_clearance_has_the_same_bits_on_vulkan(tmp_path, shape):
    ours = test_clearance.Stage().compute(test_clearance.maps_of(3))
    np.testing.assert_array_equal(run("clearance", tmp_path, shape), np.stack(ours))


def test_taichi_counts_leading_zeros_wrongly_there_or_not_at_all(tmp_path):
    """Once this fails, ``bits.has_clz`` can go."""
    true = [32 - (number & 0xFFFFFFFF).bit_length() for number in vulkan_run.NUMBERS]
    assert run("zeros", tmp_path).tolist() != true
    assert "stype" in run("wide", tmp_path)


def test_loops_end_too_early_there_which_is_why_scenarios_lose_bodies(tmp_path):
    """``draw_moving_bodies`` is such a loop: for each body, draw until a path fits. A long one ends too."""
    nested, long = run("loops", tmp_path)
    assert nested.min() < vulkan_run.TURNS
    assert long.min() < vulkan_run.MANY
