"""The one kind of error that is meant for whoever typed the command; everything else is a bug of ours."""

from __future__ import annotations


class UserError(Exception):
    """A refusal: what is wrong, where, why, and what to type next. The command line prints it as one message and ends with exit code 2."""
