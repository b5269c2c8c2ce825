"""Fixtures shared by the tests. Taichi is started once per session; structs are allocated per module."""

import pytest


@pytest.fixture(scope="session", autouse=True)
def taichi_runtime():
    """One CPU runtime with exact floating point for the whole session."""
    from uuvtai.runtime import start_taichi

    start_taichi("cpu")
