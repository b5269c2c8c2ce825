"""A command of ``uuv`` in the process of the test."""

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
