"""The one kind of error that is meant for whoever typed the command; everything else is a bug of ours."""

from __future__ import annotations


class UserError(Exception):
    """A refusal: what is wrong, where, why, what to type next. The command prints it, exit code 2."""


class SettingError(UserError, ValueError):
    """A value that was typed, or that stands in a config, cannot be used."""


class DivergenceError(UserError, FloatingPointError):
    """The vehicle's motion cannot be integrated: numbers that are no numbers came out."""


class SizeError(UserError, MemoryError):
    """What was asked for does not fit the memory or any array."""


class DeviceError(UserError, RuntimeError):
    """The device that was asked for is not here or cannot be had."""


class OwnCodeError(UserError, RuntimeError):
    """A plugin that the user brought has failed; its ``__cause__`` is what was raised in her code."""


ODD = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""what reading data of another shape than expected can raise"""
