"""What a simulator carries from one step to the next as NumPy arrays, and back bit for bit: what a resumed
run goes on from.

Taichi keeps the arrays of a simulator in one block of memory (a tree of SNodes), and its nodes tell where in
the block each array lies. So one address is enough, and nothing is compiled: ``Field.to_numpy`` and
``from_numpy`` would compile two kernels for each of some 270 arrays.
"""

from __future__ import annotations

import ctypes
import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from uuvtai.errors import UserError
from uuvtai.state import PACKET

_DTYPE = {
    "f32": "f4",
    "f64": "f8",
    "i8": "i1",
    "u8": "u1",
    "i16": "i2",
    "u16": "u2",
    "i32": "i4",
    "u32": "u4",
    "i64": "i8",
    "u64": "u8",
}

Put = Callable[[Any, np.ndarray], None]
"""Fills a field from an array of its shape (vectors add a last axis) and dtype."""


class CaptureError(UserError, ValueError):
    """A captured state that does not fit: it lacks something, is damaged or belongs to another setting."""


def put_by_kernel(field: Any, values: np.ndarray) -> None:
    """Fill a field wherever it lies; Taichi compiles a kernel for every field."""
    if field.shape == ():
        field[None] = values.item()
    else:
        field.from_numpy(values)


class Memory:
    """The arrays of ``structs`` (a dataclass of them) as they lie in memory. Valid while the simulator lives;
    no kernel may be running."""

    def __init__(self, structs: Any, anchor: Any, address: int, device: torch.device) -> None:
        """``address`` is that of the first element of the field ``anchor``, from which all others are
        found."""
        root = _path(anchor)[-1]
        self.structs, self.device = structs, device
        self.address, self.n_bytes = address - _offset(anchor), root.cell_size_bytes

    def capture(self) -> dict[str, np.ndarray]:
        """Copies of all that a later step depends on, by 'struct.array'. Arrays declared as scratch are left
        out."""
        return {name: view.copy() for name, view in self.views(self.read()).items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Put back what ``capture`` gave; ValueError, with nothing changed, for what does not fit."""
        content = self.read()
        own = self.views(content)
        check_arrays(arrays, own)
        for name, view in own.items():
            np.copyto(view, arrays[name])
        self.write(content)

    def views(self, content: np.ndarray, scratch: bool = False) -> dict[str, np.ndarray]:
        """Every array (``scratch`` too, if asked for) as a view of what ``read`` gave.

        Shapes are those of ``state``, with a last axis for vectors; arrays in lanes are as long as their
        memory, whole packets.
        """
        return {
            f"{struct.name}.{declared.name}": _view(
                self._field(struct.name, declared.name), declared.metadata["lanes"], content
            )
            for struct in dataclasses.fields(self.structs)
            for declared in dataclasses.fields(getattr(self.structs, struct.name))
            if scratch or not declared.metadata["scratch"]
        }

    def _field(self, struct: str, name: str) -> Any:
        return getattr(getattr(self.structs, struct), name)

    def read(self) -> np.ndarray:
        """Bytes (n_bytes,): on the CPU the memory itself, on a GPU a copy."""
        if self.device.type == "cpu":
            return np.ctypeslib.as_array((ctypes.c_uint8 * self.n_bytes).from_address(self.address))
        return self._on_device().cpu().numpy()

    def write(self, content: np.ndarray) -> None:
        """Put back what ``read`` gave and what was changed in it."""
        if self.device.type != "cpu":
            self._on_device().copy_(torch.from_numpy(content))

    def put(self, field: Any, values: np.ndarray) -> None:
        """Fill a field that is not in lanes; ``values`` has its shape (vectors add a last axis) and dtype."""
        if self.device.type == "cpu":
            view = _view(field, False, self.read())
            if values.shape != view.shape or values.dtype != view.dtype:
                raise ValueError(
                    f"the field is {view.dtype} {view.shape}, but got {values.dtype} {values.shape}"
                )
            view[...] = values
        else:
            put_by_kernel(field, values)

    def _on_device(self) -> torch.Tensor:
        interface = {"shape": (self.n_bytes,), "typestr": "|u1", "data": (self.address, False), "version": 3}
        return torch.as_tensor(
            type("Bytes", (), {"__cuda_array_interface__": interface})(), device=self.device
        )


def _path(field: Any) -> list[Any]:
    """Nodes from a field's first component up to the root of its tree."""
    nodes = [field.vars[0].ptr.snode()]
    while nodes[-1].parent is not None:
        nodes.append(nodes[-1].parent)
    return nodes


def _offset(field: Any) -> int:
    """Where the first element lies in the block [bytes]."""
    return sum(node.offset_bytes_in_parent_cell for node in _path(field))


def _view(field: Any, lanes: bool, content: np.ndarray) -> np.ndarray:
    shape, dtype = tuple(field.shape), np.dtype(_DTYPE[str(field.dtype)])
    if lanes:
        shape = (*shape[:-1], PACKET * -(-shape[-1] // PACKET))
    cell = _path(field)[1].cell_size_bytes
    strides = tuple(cell * math.prod(shape[axis + 1 :]) for axis in range(len(shape)))
    if len(field.vars) > 1:
        shape, strides = (*shape, len(field.vars)), (*strides, dtype.itemsize)
    return np.ndarray(shape, dtype, buffer=content, offset=_offset(field), strides=strides)


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
