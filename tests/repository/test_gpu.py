"""CPU and CUDA run the same kernels: the same states within float tolerance, as many successes. Skipped where
there is no CUDA device.

Each device gets a process of its own, because a process has one Taichi runtime.
"""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from uuvtai.common.statistics import mcnemar_p

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]

POSITION_TOLERANCE_M = 1e-3
"""200 steps of float32 with differently rounded sin, cos and fused multiply-adds; the vehicle moves about 2 m
in them."""

STATE_PROGRAM = """
import sys, numpy as np, torch
from uuvtai.config.loader import load_config
from uuvtai.sim.sim import Sim
from uuvtai.sim.behavior_tree import read_tree
sim = Sim(load_config("pool", "clean"), 64, read_tree("straight"), sys.argv[1])
ones = torch.ones(64, dtype=torch.int32, device=sim.device)
sim.reset(ones, 0 * ones, torch.arange(64, dtype=torch.int32, device=sim.device))
action = torch.tensor([0.5, 0.2, 0.1, 0.3], device=sim.device).repeat(64, 1)
for _ in range(200):
    sim.step(action)
ship = sim.s.vehicle
np.savez(sys.argv[2], pos=sim.rows(ship.pos_w), quat=sim.rows(ship.quat_wb), vel=sim.rows(ship.vel_b))
"""


def state_after_200_steps(device, folder):
    target = folder / f"{device}.npz"
    subprocess.run([sys.executable, "-c", STATE_PROGRAM, device, str(target)], check=True)
    return np.load(target)


def successes(device, folder):
    command = [
        sys.executable, "-m", "uuvtai", "eval", "--agent", "bt", "--episodes", "256", "--num-envs", "256",
        "--device", device,
        "--run-dir", str(folder / f"run_{device}"), "--json",
    ]  # fmt: skip
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [d["outcome"] == "success" for d in json.loads(done.stdout)["agents"][0]["episodes_detail"]]


def test_states_agree_after_200_steps(tmp_path):
    cpu, cuda = (state_after_200_steps(device, tmp_path) for device in ("cpu", "cuda"))
    for name in ("pos", "quat", "vel"):
        np.testing.assert_allclose(cuda[name], cpu[name], atol=POSITION_TOLERANCE_M, err_msg=name)


def test_as_many_of_256_episodes_succeed(tmp_path):
    """Episode by episode: rounding decides some of them otherwise, to both sides as often."""
    pairs = list(zip(successes("cuda", tmp_path), successes("cpu", tmp_path), strict=True))
    only = [sum(pair == won for pair in pairs) for won in ((True, False), (False, True))]
    assert mcnemar_p(*only) > 0.01 and sum(only) < 26, only
