"""One switch puts Quadrants in Taichi's place; without it nothing of it is there."""

import importlib.util
import os
import subprocess
import sys

import pytest

DRIVEN = """
import sys, uuvtai, taichi
from uuvtai.compile.launch import native
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config
from uuvtai.logs.run_folder import versions
from uuvtai.sim.plant import Plant
plant = Plant(Config(), start_taichi(), 4)
plant.reset()
for _ in range(3):
    plant.step([[0.5, -0.2, 0.1, 1.0]] * 4)
print(plant.read(plant.vehicle.vel_b).tobytes().hex(), len(native))
print(taichi.__name__, "quadrants" in sys.modules, *{"taichi", "quadrants"} & versions().keys())
"""


def run(program, compiler):
    told, environment = [sys.executable, "-c", program], {**os.environ, "UUV_COMPILER": compiler}
    return subprocess.run(told, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("program", "compiler", "said"),
    [
        ("import uuvtai, taichi", "numba", "UUV_COMPILER='numba': must be taichi or quadrants"),
        ("import sys; sys.modules['quadrants'] = None; import uuvtai, taichi", "quadrants", "pip install"),
        ("import taichi, uuvtai", "quadrants", "import uuvtai before it"),
    ],
)
def test_what_cannot_be_had_is_refused_with_what_to_do(program, compiler, said):
    done = run(program, compiler)
    assert done.returncode == 1 and said in done.stderr.splitlines()[-1]


def test_taichi_is_taichi_and_quadrants_gives_the_same_bits():
    ours = run(DRIVEN, "").stdout.split()
    assert ours[1:] == ["0", "taichi", "False", "taichi"]
    if importlib.util.find_spec("quadrants") is None:
        pytest.skip("no Quadrants here")
    theirs = run(DRIVEN, "quadrants").stdout.split()
    assert theirs == [ours[0], "1", "quadrants", "True", "quadrants"]
