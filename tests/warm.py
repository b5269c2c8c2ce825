"""Compile the kernels of the tests' small simulator once, for every process that will need them: ``python -m
tests.warm``.

Taichi writes what it has compiled when a process ends; test processes that run side by side would each
compile everything.
"""

from tests.conftest import SmallSim
from uuvtai.runtime import start_taichi

STEPS = 6
"""one depth image and one decision of the tree are among them"""


def main() -> None:
    """Begin two episodes, step, begin another, with observations asked for."""
    start_taichi("cpu")
    small = SmallSim()
    small.sim.observe()
    small.begin([0, 1])
    for _ in range(STEPS):
        small.sim.step()
    small.begin([2])


if __name__ == "__main__":
    main()
