"""Processes side by side: every result once, lost ones again, and an end with their parent."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import uuvtai
from tests import worker_work
from uuvtai.common.processes import EngineError, LocalEngine


def test_local_workers_give_every_result_once():
    assert sorted(LocalEngine(2).run(worker_work.square, [3, 1, 2])) == [(0, 9), (1, 1), (2, 4)]


def test_a_script_that_starts_workers_runs_once(tmp_path):
    """Notebooks and first scripts have no ``if __name__ == "__main__"``."""
    (script := tmp_path / "mine.py").write_text(
        "from uuvtai.common.processes import LocalEngine\n"
        "print('begun', list(LocalEngine().run(abs, [-2])))\n"
    )
    ran = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=100, check=False)
    assert (ran.stdout, ran.stderr, ran.returncode) == ("begun [(0, 2)]\n", "", 0)


def test_a_lost_worker_costs_its_task_once_more(tmp_path):
    assert list(LocalEngine(1).run(worker_work.fall_once, [str(tmp_path / "a"), str(tmp_path / "b")])) == [
        (0, "a"),
        (1, "b"),
    ]


def test_what_only_waited_is_not_counted_as_lost(tmp_path):
    """The first tasks kill their worker once each; the last, which waits, must not use up its attempts."""
    places = [str(tmp_path / name) for name in "abcde"]
    assert sorted(LocalEngine(1).run(worker_work.fall_once, places)) == list(enumerate("abcde"))


@pytest.mark.parametrize(("work", "item", "error", "says"), [
    (worker_work.always_fall, 1, EngineError, "lost its worker 3 times"),
    (worker_work.square, -2, ValueError, "-2 is negative"),  # not tried again
])  # fmt: skip
def test_workers_that_keep_dying_and_errors_of_the_work_end_it(work, item, error, says):
    with pytest.raises(error, match=says):
        list(LocalEngine(1).run(work, [item]))


def _start_waiting(place):
    list(LocalEngine(1).run(worker_work.tell_and_wait, [place]))


def test_workers_end_with_a_parent_that_was_killed(tmp_path):
    place = tmp_path / "pid"
    parent = multiprocessing.get_context("spawn").Process(target=_start_waiting, args=(str(place),))
    parent.start()
    worker = _pid_in(place)
    os.kill(parent.pid, signal.SIGKILL)
    parent.join()
    assert _gone(worker), "a worker without a parent would fill the machine for ever"


def _pid_in(place, patience_s=60.0):
    for _ in range(int(patience_s / 0.05)):
        if place.exists() and place.read_text():
            return int(place.read_text())
        time.sleep(0.05)
    raise AssertionError("the worker never began")


def _gone(pid, patience_s=30.0):
    for _ in range(int(patience_s / 0.05)):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


# ------------------------------------------------------------------------------------------------ interrupted

_SIGNALLED_WHILE_ONE_STARTS = """
import os, signal, sys
from multiprocessing import util
from uuvtai.common import signals
from uuvtai.common.processes import LocalEngine

spawn, sent = util.spawnv_passfds, []

def spawn_and_tell(path, args, fds):
    pid = spawn(path, args, fds)
    if not sent and any("--multiprocessing-fork" in str(arg) for arg in args):
        sent.append(pid)
        os.kill(os.getpid(), signal.{name})
    return pid

if __name__ == "__main__":
    util.spawnv_passfds = spawn_and_tell
    signals.install()
    try:
        list(LocalEngine(2).run(abs, [-1, -2]))
    except KeyboardInterrupt:
        sys.exit(signals.exit_code())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_comes_while_a_process_starts_leaves_no_traceback(tmp_path, number):
    """Between its start and the word of what it is to do: it would read the end of a pipe."""
    program = tmp_path / "program.py"
    program.write_text(_SIGNALLED_WHILE_ONE_STARTS.format(name=number.name))
    environment = os.environ | {"PYTHONPATH": str(Path(uuvtai.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, str(program)], capture_output=True, text=True, timeout=120, env=environment,
        check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (128 + number, "")
