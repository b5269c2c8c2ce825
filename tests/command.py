"""A command of ``uuv`` in the process of the test, and the environment of processes that are not counted."""

import os

import pytest

from uuvtai.cli import main


def run_cli(*arguments):
    """Its exit code."""
    with pytest.raises(SystemExit) as left:
        main([str(argument) for argument in arguments])
    return left.value.code


def uuv(capfd, *arguments):
    """(exit code, stdout, stderr)"""
    code = run_cli(*arguments)
    return code, *capfd.readouterr()


def uncounted(**more):
    """The environment of a process that coverage does not count, for other tests run the same code: to be
    counted costs each process 0.3 s, as much as many take."""
    return {name: value for name, value in os.environ.items() if not name.startswith("COV")} | more
