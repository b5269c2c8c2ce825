"""Compile the kernels of the tests' small simulator once, for every process that will need them, and those
that other tests need besides: ``python -m tests.warm``.

Test processes that run side by side would each compile them. ``bootstrap.py test`` runs this while packages
of the tests are installed, so it needs none of them.
"""

import os
import sys

import torch

from tests.small_sim import SmallSim, sim_with_one_beam
from uuvtai.native.gpu_shape import VARIABLE, asked_shape
from uuvtai.runtime import start_taichi

STEPS = 6
"""one depth image and one decision of the tree are among them"""


def main() -> None:
    """The small simulator with its own sensors, and with those that have no errors (``test_log_alone``); one
    with a mechanical sonar (``test_ping360``); then the first one in the shape for a GPU (``test_cuda``)."""
    start_taichi("cpu")
    play(SmallSim())
    if asked_shape() == "cpu":
        play(SmallSim("clean"))
        play_alone(sim_with_one_beam())
        os.execve(sys.executable, [sys.executable, "-m", "tests.warm"], os.environ | {VARIABLE: "gpu"})


def play(small: SmallSim) -> None:
    """Begin two episodes, step, begin another, with observations asked for."""
    small.sim.observe()
    small.begin([0, 1])
    for _ in range(STEPS):
        small.sim.step()
    small.begin([2])


def play_alone(sim) -> None:
    """Begin an episode of one vehicle, and step."""
    one = torch.ones(1, dtype=torch.int32)
    sim.reset(one, one, one)
    for _ in range(STEPS):
        sim.step()


if __name__ == "__main__":
    main()
