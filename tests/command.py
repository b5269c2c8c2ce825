"""A command of ``uuv`` in the process of the test."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from uuvtai.cli import main


def run_cli(*arguments):
    """Its exit code."""
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    return left.value.code


def uuv(capfd, *arguments):
    """(exit code, stdout, stderr)"""
    return run_cli(*arguments), *capfd.readouterr()


class Quiet:
    """Watches, keeps what it was told, and says nothing."""

    def __init__(self):
        self.answer = []

    def note(self, text):
        self.answer.append(text)

    def __getattr__(self, _name):
        return lambda *_arguments, **_words: None


def read_by_viewer(log):
    """What a log holds by @mcap/core with its decompressor, ajv and the official Foxglove schemas."""
    folder, node = Path(__file__).parent / "js", shutil.which("node")
    if node is None or not (folder / "node_modules").is_dir():
        pytest.skip("needs node and `npm ci` in tests/js (bootstrap.py does it)")
    command = [node, "read_log.mjs", str(log)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
