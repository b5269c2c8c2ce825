"""Compile the kernels of the tests' small simulator once, for every process that will need them:
``python -m tests.warm``; and those of one vehicle with a mechanical sonar: ``python -m tests.warm one``.

Test processes that run side by side would each compile them. ``bootstrap.py test`` runs this while packages
of the tests are installed, so it needs none of them.
"""

import gc
import sys

import torch

from tests.small_sim import SmallSim, sim_with_one_beam
from uuvtai.compile.runtime import start_taichi

STEPS = 6
"""one depth image and one decision of the tree are among them"""


def main(what: str) -> None:
    """The small simulator with and without sensor errors; or the one vehicle (``one``)."""
    gc.disable()  # building kernels makes millions of objects, few of them garbage
    start_taichi("cpu")
    if what == "one":
        sim, one = sim_with_one_beam(), torch.ones(1, dtype=torch.int32)
        sim.reset(one, one, one)
        step(sim)
    else:
        play(SmallSim())
        play(SmallSim("clean"))


def play(small: SmallSim) -> None:
    """Begin two episodes, step, begin another, with observations asked for."""
    small.sim.observe()
    small.begin([0, 1])
    step(small.sim)
    small.begin([2])


def step(sim) -> None:
    for _ in range(STEPS):
        sim.step()


if __name__ == "__main__":
    main(" ".join(sys.argv[1:]))
