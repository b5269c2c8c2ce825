"""ONNX Runtime reports nothing to its makers: off by variable and by call (``test_deploy.py`` watches it)."""

import ast
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from uuvtai.learning.export import graph

ROOT = Path(__file__).parents[2]

WATCHED = """
import os, socket, sys, threading, time
sockets, going = set(), True
TABLES = [f"/proc/self/net/{kind}" for kind in "tcp tcp6 udp udp6 raw raw6 packet netlink".split()]

def is_of_a_network(place):
    number = place[len("socket:["):-1]
    return any(number in open(table).read().split() for table in TABLES if os.path.exists(table))

def seen(event, arguments):
    if event.startswith("socket.") and event != "socket.__new__":
        sockets.add(f"{event} {arguments[1:]}")

def watch():
    while going:
        for name in os.listdir("/proc/self/fd"):
            try:
                place = os.readlink(f"/proc/self/fd/{name}")
            except OSError:
                continue
            if place.startswith("socket:") and is_of_a_network(place):
                sockets.add(place)
        time.sleep(0.02)

sys.addaudithook(seen)
watcher = threading.Thread(target=watch)
watcher.start()
try:
    WORK
finally:
    time.sleep(0.1)
    going = False
    watcher.join()
print("sockets:", sorted(sockets))
print("variable:", os.environ.get("ORT_DISABLE_TELEMETRY"))
print("loaded:", "onnxruntime" in sys.modules)
"""
"""Sockets of Python by its audit events, those of native code by the process's own table of open files. Local
ones are none of them: who asks for a user's name has glibc ask a cache of names by one, for a moment."""


def watched(work, home):
    """Run ``work`` in a process of its own with an empty home and cache; what it printed."""
    for name in ("home", "cache", "state", "tmp"):
        (home / name).mkdir(parents=True, exist_ok=True)
    places = {
        "HOME": home / "home",
        "XDG_CACHE_HOME": home / "cache",
        "XDG_STATE_HOME": home / "state",
        "XDG_DATA_HOME": home / "state",
    }
    environment = {name: value for name, value in os.environ.items() if name != graph.VARIABLE}
    environment |= {name: str(place) for name, place in places.items()} | {
        "TMPDIR": str(home / "tmp"),
        "PYTHONPATH": str(ROOT),
    }
    code = WATCHED.replace("WORK", textwrap.indent(work, "    ").strip())
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=home, env=environment, capture_output=True, text=True, timeout=300,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_watch_sees_a_socket_and_a_file(tmp_path):
    answer = watched(
        "import socket\nkept = socket.create_server(('127.0.0.1', 0))\nopen('left', "
        "'w').close()\ntime.sleep(0.1)",
        tmp_path / "home",
    )
    assert "socket.bind" in answer and "socket:[" in answer
    assert (tmp_path / "home" / "left").exists()


@pytest.mark.parametrize(("family", "is_seen"), [(2, True), (1, False)], ids=["of a network", "local"])
def test_the_watch_sees_a_native_socket_of_a_network(tmp_path, family, is_seen):
    """Opened by the C library, of which no audit event tells."""
    work = (
        "import ctypes\nlibc = ctypes.CDLL(None)\n"
        f"kept = libc.socket({family}, 2, 0)\nassert kept >= 0\n"
        "here = (ctypes.c_uint8 * 16)(2, 0, 0, 0, 127, 0, 0, 1)\n"
        "libc.bind(kept, here, 16)\ntime.sleep(0.1)"
    )
    told = watched(work, tmp_path / "home")
    assert "socket.bind" not in told and ("socket:[" in told) == is_seen, told


def test_the_call_is_made_before_a_session(monkeypatch):
    onnxruntime = pytest.importorskip("onnxruntime", reason="needs the extra uuvtai[export]")
    order = []
    monkeypatch.delenv(graph.VARIABLE, raising=False)
    monkeypatch.setattr(
        onnxruntime, "disable_telemetry_events", lambda: order.append(f"off {os.environ.get(graph.VARIABLE)}")
    )
    monkeypatch.setattr(
        onnxruntime, "InferenceSession", lambda *_arguments, **_words: order.append("session")
    )
    graph.session(b"")
    assert order == ["off 1", "session"]


def test_one_place_imports_onnx_runtime():
    places = []
    for folder in ("uuvtai", "tests", "benchmarks", "examples"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            for node in ast.walk(ast.parse(text)) if "onnxruntime" in text else ():
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                places += (
                    [str(path.relative_to(ROOT))]
                    if any(name.split(".")[0] == "onnxruntime" for name in names)
                    else []
                )
    assert places == ["uuvtai/learning/export/graph.py"]


def test_only_versions_that_were_checked_are_installed():
    """1.29 to 1.32 read the variable, older ones have no telemetry, newer ones must be looked at."""
    wanted = re.findall(r'"(onnxruntime[^"]*)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert wanted == ["onnxruntime>=1.20,<1.33"]


def test_the_library_reads_the_variable():
    onnxruntime = pytest.importorskip("onnxruntime", reason="needs the extra uuvtai[export]")
    libraries = list((Path(onnxruntime.__file__).parent / "capi").glob("*onnxruntime*.so*"))
    content = b"".join(path.read_bytes() for path in libraries)
    assert content, "no library found"
    assert b"mobile.events.data.microsoft.com" not in content or graph.VARIABLE.encode() in content
