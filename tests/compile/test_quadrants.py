"""One switch puts Quadrants in Taichi's place (``benchmarks/quadrants.py`` compares them)."""

import os
import subprocess
import sys

import pytest


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
