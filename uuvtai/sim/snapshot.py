"""What a simulator carries from one step to the next as NumPy arrays, and back bit for bit: what a resumed
run goes on from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from uuvtai.common.errors import UserError
from uuvtai.compile.memory import Memory


class CaptureError(UserError, ValueError):
    """A captured state that does not fit: it lacks something, is damaged or belongs to another setting."""


def capture(memory: Memory) -> dict[str, np.ndarray]:
    """Copies of all that a later step depends on, by 'struct.array'. Arrays declared as scratch are left
    out."""
    return {name: view.copy() for name, view in memory.views(memory.read()).items()}


def restore(memory: Memory, arrays: Mapping[str, np.ndarray]) -> None:
    """Put back what ``capture`` gave; CaptureError, with nothing changed, for what does not fit."""
    content = memory.read()
    own = memory.views(content)
    check_arrays(arrays, own)
    for name, view in own.items():
        np.copyto(view, arrays[name])
    memory.write(content)


def check_arrays(given: Mapping[str, np.ndarray], wanted: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError unless both hold arrays of the same names, shapes and dtypes."""
    advice = (
        "give what capture() returned in an environment of the same version, config, tree and number of envs"
    )
    if missing := sorted(set(wanted) - set(given)):
        raise CaptureError(f"the captured state lacks {_listed(missing)}; {advice}")
    if unknown := sorted(set(given) - set(wanted)):
        raise CaptureError(
            f"the captured state holds {_listed(unknown)}, which this version does not know; {advice}"
        )
    for name, array in wanted.items():
        got = given[name]
        if not isinstance(got, np.ndarray) or got.shape != array.shape or got.dtype != array.dtype:
            found = f"{got.dtype} {got.shape}" if isinstance(got, np.ndarray) else f"a {type(got).__name__}"
            raise CaptureError(
                f"the captured array {name!r} is {found}, but {array.dtype} {array.shape} is needed; {advice}"
            )


def _listed(names: list[str]) -> str:
    return ", ".join(map(repr, names[:4])) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def check_setting(given: Any, wanted: str) -> None:
    """Raise ValueError unless ``given``, JSON as bytes, says the same as ``wanted``; the message names what
    differs."""
    if given is None:
        raise CaptureError("the captured state lacks 'setting': it comes from no capture()")
    try:
        before, now = json.loads(bytes(given)), json.loads(wanted)
    except (TypeError, ValueError):
        raise CaptureError(
            "the captured state's 'setting' cannot be read: the file is damaged; use an older one"
        ) from None
    if differing := _differences(before, now):
        listed = "; ".join(differing[:4]) + (f" and {len(differing) - 4} more" if len(differing) > 4 else "")
        raise CaptureError(
            f"the captured state is of another setting: {listed}. Make the environment with the config that "
            "was captured"
        )


def _differences(before: Any, now: Any, key: str = "") -> list[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        pairs = [
            (f"{key}.{name}".strip("."), before.get(name), now.get(name))
            for name in sorted(before.keys() | now.keys())
        ]
        return [line for name, a, b in pairs for line in _differences(a, b, name)]
    return [] if before == now else [f"{key} was {before}, is {now}"]
