"""The second process of a cold start: it compiles what the first one will look for, and never outlives it."""

import os
import signal
import subprocess
import sys
import time
from io import BytesIO, TextIOWrapper
from pathlib import Path

import pytest

from uuvtai.compile.cache import key_of, key_with
from uuvtai.compile.launch import native
from uuvtai.compile.runtime import Companion, compilers
from uuvtai.config import Config
from uuvtai.config.loader import load_training
from uuvtai.envs.warm_up import calls_of, main, understood, wake
from uuvtai.sim.sim import Sim

MANY = 40
"""kernels that a reset and a step have at the least"""


@pytest.fixture(scope="module")
def another(small):
    """The small simulator built once more: nothing of it has been launched."""
    return Sim(small.config, small.N, small.trees["bt"])


def test_a_training_s_simulator_is_asked_for_too(another, monkeypatch):
    """Its config has sections that no simulator knows."""
    config = load_training("smoke")
    monkeypatch.setattr(another, "config", config)
    read, num_envs = understood(another._recipe())
    assert num_envs == another.num_envs
    assert vars(read) == {name: getattr(config, name) for name in Config.model_fields}


def test_rows_that_fill_up_a_size_sleep(another, monkeypatch):
    """Kernels would write beyond the ends of the batch's tensors."""
    monkeypatch.setattr(another, "num_envs", another.num_envs - 2)
    wake(another)
    for clock in (another.s.clock.active, another.s.clock.running):
        assert clock.to_numpy().tolist() == [1] * another.num_envs + [0] * 2


def test_it_knows_every_launch_and_makes_none(another):
    kept = list(native)
    calls = calls_of(another)
    assert len(calls) >= MANY and native == kept
    names = [kernel.func.__name__ for kernel, _ in calls]
    assert names[:2] == ["begin_episodes", "generate_scenarios"] and "tick_tree" in names
    assert not another.s.clock.step.to_numpy().any() and not another.s.episode.key.to_numpy().any()


def test_its_keys_are_those_that_the_first_process_looks_for(small, another):
    small.begin([0, 1])
    small.sim.step()
    store = native[0].store
    looked_for = {"generate_scenarios", "update_map", "follow_obstacles", "plan_evasion", "compute_reward"}
    for kernel, arguments in calls_of(another):
        if kernel.func.__name__ in looked_for:
            key, tree = key_of(kernel, arguments, native[0].surroundings), another.memory().tree
            assert any(store.get(key_with(key, names, arguments[0], tree)) for names in store.names(key))
            looked_for.remove(kernel.func.__name__)
    assert not looked_for


def test_it_ends_when_its_pipe_closes(monkeypatch):
    monkeypatch.setattr(sys, "stdin", TextIOWrapper(BytesIO()))
    assert main() is None


SLEEPER = """
import os, sys, pathlib
sys.stdin.buffer.read(8)
pathlib.Path(os.environ["TOLD"]).write_text(str(os.getpid()))
sys.stdin.buffer.read()
"""
ASKER = """
import os, pathlib, time
from uuvtai.compile import runtime as companion
companion.PROGRAM = "sleeper"
one = companion.Companion()
one.ask(b"recipe")
one.ask(b"another while it is busy")
assert one.is_busy()
while not (told := pathlib.Path(os.environ["TOLD"])).exists() or not told.read_text():
    time.sleep(0.01)
print("up", flush=True)
time.sleep(600)
"""


def test_killing_who_asked_ends_it(tmp_path):
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    told = tmp_path / "told"
    environment = os.environ | {
        "TOLD": str(told),
        "UUV_COMPILERS": "2",
        "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]),
    }
    with subprocess.Popen([sys.executable, "-c", ASKER], env=environment, stdout=subprocess.PIPE) as asker:
        assert asker.stdout and asker.stdout.readline() == b"up\n"
        asker.send_signal(signal.SIGKILL)
    number = int(told.read_text())
    for _ in range(1000):
        if not _runs(number):
            return
        time.sleep(0.01)
    raise AssertionError("the second process outlives the first")


def _runs(number):
    try:
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_one_core_has_one_compiler(monkeypatch):
    monkeypatch.delenv("UUV_COMPILERS", raising=False)
    monkeypatch.setenv("UUV_NUM_THREADS", "1")
    assert compilers() == 1
    one = Companion()
    one.ask(b"recipe")
    assert not one.is_busy()
    monkeypatch.setenv("UUV_NUM_THREADS", "8")
    assert compilers() == 2
    monkeypatch.setenv("UUV_COMPILERS", "1")
    assert compilers() == 1
