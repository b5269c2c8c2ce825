"""SIGINT and SIGTERM: heard from the first line on, without a traceback, and nothing half-written stays."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import uuvtai
from tests.small_sim import SmallSim
from uuvtai.common import signals
from uuvtai.logs.export import repair

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(uuvtai.__file__).parents[1])}
BOTH = [signal.SIGINT, signal.SIGTERM]


def started(folder, *arguments, program=None, environment=ENVIRONMENT):
    """A command whose handlers are in place: what Python does before its first line is not ours."""
    command = [sys.executable, "-c", program] if program else [sys.executable, "-m", "uuvtai", *arguments]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment
    )
    wait_for(lambda: process.poll() is not None or catches(process.pid, signal.SIGTERM), 60, every_s=0.001)
    return process


def wait_for(is_so, patience_s, every_s=0.05):
    deadline = time.monotonic() + patience_s
    while not is_so() and time.monotonic() < deadline:
        time.sleep(every_s)


def catches(pid, number):
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


def ended(process, number):
    """(exit code, stderr); an end without any message by us is checked by the caller."""
    _, err = process.communicate(timeout=120)
    assert "Traceback" not in err and "a bug of ours" not in err, err
    if process.returncode == 128 + number:
        assert err.splitlines()[-1] == "interrupted"
    return process.returncode, err


_SWALLOWED = """
import os, signal
from uuvtai.common import signals
signals.install()
signals.engage()
try:
    os.kill(os.getpid(), signal.{name})
    for _ in range(1000):
        pass
except BaseException:
    pass
assert signals.was_received()
with signals.StopEvent() as pressed:
    print(pressed.is_set())
"""


@pytest.mark.parametrize("number", BOTH)
def test_a_signal_whose_exception_was_swallowed_still_stops_a_training(tmp_path, number):
    """Else a training would go on to its end, and whoever waits for it would wait as long."""
    process = started(tmp_path, program=_SWALLOWED.format(name=number.name))
    out, err = process.communicate(timeout=60)
    assert (out.strip(), process.returncode) == ("True", 0), err


_WITHIN_A_WRITE = """
import os, signal, sys
from pathlib import Path
from mcap import writer
from uuvtai.common import signals
from uuvtai.logs import container

signals.install()
signals.engage()
calls, compress = [], writer.zstandard.compress

def signalling(data):
    calls.append(len(data))
    if len(calls) == {call}:
        os.kill(os.getpid(), signal.SIGINT)
    return compress(data)

writer.zstandard.compress = signalling
file = container.McapFile(Path("cut.mcap"))
channel = file.add_channel("/numbers", 0)
written = 0
try:
    while True:
        file.add_message(channel, written, os.urandom(100))
        written += 1
        file.settle()
except signals.Interrupted:
    file.leave()
    print(written)
"""


@pytest.mark.parametrize("call", [1, 150])
def test_a_signal_within_a_write_loses_no_message(tmp_path, call):
    """The first chunk, and a later one."""
    out, err = started(tmp_path, program=_WITHIN_A_WRITE.format(call=call)).communicate(timeout=60)
    (part,) = tmp_path.glob("cut.mcap.*.part")
    assert repair(part).messages == int(out) > 0, err


BEGUN = [
    "eval --episodes 4 --run-dir run", "train smoke --run-dir run", "simulate --seconds 1",
    "sweep --grid D=0,3 --run-dir run", "profile", "export nowhere --out out", "doctor",
    "reproduce --run-dir run",
]  # fmt: skip


@pytest.mark.parametrize(("line", "number"), list(zip(BEGUN, BOTH * 4, strict=True)))
def test_a_command_that_begins_ends_at_once_and_leaves_nothing(tmp_path, line, number):
    """Both signals in turn: one handler hears them."""
    process = started(tmp_path, *line.split())
    time.sleep(random.Random(line).uniform(0.0, 0.6))
    process.send_signal(number)
    code, err = ended(process, number)
    assert code in (128 + number, 0, 2), err
    assert not [
        path
        for path in tmp_path.rglob("*")
        if path.is_file() and (path.suffix in (".tmp", ".part") or ".partial" in path.name)
    ]


@pytest.mark.parametrize("number", BOTH)
def test_while_nothing_is_kept_it_ends_in_the_middle_of_an_import(tmp_path, number):
    program = "from uuvtai.common import signals; signals.install(); import slow"
    (tmp_path / "slow.py").write_text(
        "import time\ntry:\n    time.sleep(30)\nexcept BaseException:\n    pass\nprint('went on')\n"
    )
    process = started(tmp_path, program=program)
    time.sleep(0.2)
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (128 + number, "", "interrupted\n")


KEEPS = """
import os, sys, time
from uuvtai.common import signals
from uuvtai.common.exits import guarded
signals.install(); signals.end_at_second(); signals.engage()
def work():
    try:
        {work}
    finally:
        print("tidied up", flush=True)
sys.exit(guarded(work))
"""


@pytest.mark.parametrize("number", BOTH)
@pytest.mark.parametrize(
    "work",
    [
        "time.sleep(30)",
        "import slow",  # not in the middle of an import, which makes other errors of it, but behind it
        "import collecting",  # an exception in a finaliser is lost
        "int('x') if not time.sleep(30) else 0",
    ],
)
def test_what_is_kept_is_tidied_up(tmp_path, number, work):
    (tmp_path / "slow.py").write_text(
        "import time\ntry:\n    time.sleep(0.5)\nexcept BaseException:\n    print('swallowed')\n    raise "
        "ImportError\n"
    )
    (tmp_path / "collecting.py").write_text(
        "import time\nclass Slow:\n    def __del__(self):\n        time.sleep(0.5)\nSlow()\n"
    )
    process = started(
        tmp_path, program=KEEPS.format(work=work + ("" if "sleep" in work else "; time.sleep(30)"))
    )
    time.sleep(0.2)
    process.send_signal(number)
    code, err = ended(process, number)
    assert (code, err) == (128 + number, "interrupted\n")


@pytest.mark.parametrize("number", BOTH)
def test_the_second_one_does_not_wait_for_compiled_code(tmp_path, number):
    """A sleep in C that holds the interpreter, as Taichi's compiler does."""
    work = (
        "import ctypes; print('now', flush=True); ctypes.PyDLL(None).sleep(20); "
        "[ctypes.PyDLL(None).sleep(20) for _ in range(3)]"
    )
    process = started(tmp_path, program=KEEPS.format(work=work))
    assert process.stdout.readline() == "now\n"
    time.sleep(0.3)
    begun = time.monotonic()
    # PyDLL's sleep ends with any signal that has a handler; this one has none
    process.send_signal(signal.SIGWINCH)
    for _ in range(2):
        process.send_signal(number)
        time.sleep(0.1)
    process.communicate(timeout=60)
    assert process.returncode in (-number, 128 + number)
    assert time.monotonic() - begun < 10


def test_an_ignored_signal_stays_ignored(tmp_path):
    """nohup, and a shell's background."""
    program = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n" + KEEPS.format(
        work="time.sleep(0.5)"
    )
    process = started(tmp_path, program=program)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "tidied up\n", "")


def test_a_signal_at_the_very_end_does_not_change_the_exit_code(tmp_path):
    program = "import time\nfrom uuvtai.common import signals\n"
    program += "signals.install(); signals.finish(3); time.sleep(30)"
    process = started(tmp_path, program=program)
    time.sleep(0.3)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (3, "")


@pytest.mark.parametrize("number", BOTH)
def test_nor_one_while_python_tidies_up_its_modules(tmp_path, number):
    """The interpreter gives the signals back to the system before that."""
    program = (
        "import sys, time\nfrom uuvtai.common import signals\nsignals.install(); signals.end_at_second(); "
        "signals.finish(0)\n"
    )
    program += (
        "class Slow:\n    def __del__(self, sleep=time.sleep):\n        print('now', flush=True); "
        "sleep(0.5)\nslow = Slow()"
    )
    process = started(tmp_path, program=program)
    assert process.stdout.readline() == "now\n"
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")


def test_nobody_is_told_by_a_library(tmp_path):
    """Importing the package installs nothing: that is the command line's affair."""
    program = (
        "import signal; before = signal.getsignal(2), signal.getsignal(15)\nimport uuvtai, "
        "uuvtai.cli, "
        "uuvtai.common.signals\n"
    )
    program += "assert before == (signal.getsignal(2), signal.getsignal(15))"
    subprocess.run([sys.executable, "-c", program], env=ENVIRONMENT, check=True)
    assert not signals.was_received() and signals.exit_code() == 130


def test_sigterm_ends_a_training_as_ctrl_c_does(tmp_path):
    process = started(tmp_path, *SmallSim.TRAIN, "--iterations", "5000", "--run-dir", "run")
    metrics = tmp_path / "run/metrics.jsonl"
    wait_for(lambda: process.poll() is not None or (metrics.exists() and metrics.stat().st_size), 400)
    process.send_signal(signal.SIGTERM)
    code, err = ended(process, signal.SIGTERM)
    assert code == 143 and "saved; go on with: uuv train --resume run --iterations 5000" in err
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert (record["status"], record["exit"]) == ("interrupted", 143)
    assert any((tmp_path / "run/checkpoints").glob("step_*"))


def test_the_workers_of_a_sweep_end_with_it(tmp_path):
    grid = ["--grid", "D=0,3,6,9", "--grid", "v=0.5,1.5", "--agent", "bt", "--episodes", "64"]
    where = ["--workers", "2", "--run-dir", "run", "--device", "cpu", *SmallSim.OPTIONS[:2]]
    process = started(tmp_path, "sweep", *grid, *where)
    children = two_children_of(process)  # a worker and a resource tracker
    os.kill(process.pid, signal.SIGTERM)
    code, err = ended(process, signal.SIGTERM)
    assert code == 143 and "go on with: uuv sweep --resume run" in err
    assert not left_of(children)
    held = subprocess.run(["sh", "-c", "flock --nonblock run/.lock true"], cwd=tmp_path, check=False)
    assert held.returncode in (0, 127), "the lock is free"


def test_ctrl_c_ends_what_compiles_side_by_side(tmp_path):
    """A terminal sends it to every process of the command."""
    command = [sys.executable, "-m", "uuvtai", "doctor", "--compile", "--workers", "2", *SmallSim.OPTIONS[:4]]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=ENVIRONMENT, start_new_session=True
    )
    children = two_children_of(process)
    os.killpg(process.pid, signal.SIGINT)
    code, err = ended(process, signal.SIGINT)
    assert code == 130 and err.splitlines()[-1] == "interrupted"
    assert not left_of(children)


def left_of(children):
    """Those that have not ended after a while."""

    def left():
        return [child for child in children if Path(f"/proc/{child}").exists()]

    wait_for(lambda: not left(), 20)
    return left()


def two_children_of(process):
    wait_for(lambda: len(children_of(process.pid)) >= 2, 120)
    children = children_of(process.pid)
    assert len(children) >= 2
    return children


def children_of(pid):
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(status.parent.name))
    return found
