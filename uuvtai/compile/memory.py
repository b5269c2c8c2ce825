"""Where a simulator's arrays lie in memory, and views of them.

Taichi keeps them in one block (a tree of SNodes), and its nodes tell where in the block each array lies. So
one address is enough, and nothing is compiled: ``Field.to_numpy`` and ``from_numpy`` would compile two
kernels for each of some 270 arrays.
"""

import ctypes
import dataclasses
import math
import mmap
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti
from taichi.lang import impl

from uuvtai.state import PACKET

if TYPE_CHECKING:
    import torch

_MADV_DONTNEED, _MADV_HUGEPAGE = 4, 14
"""of Linux: private memory reads as zero afterwards; pages of 2 MiB from the next touch on"""
Put = Callable[[Any, np.ndarray], None]
"""Fills a field from an array of its shape (vectors add a last axis) and dtype."""


def put_by_kernel(field: Any, values: np.ndarray) -> None:
    """Fill a field wherever it lies; Taichi compiles a kernel for every field."""
    if field.shape == ():
        field[None] = values.item()
    else:
        field.from_numpy(values)


@ti.kernel
def _tell(field: ti.template(), out: ti.types.ndarray(dtype=ti.i64, ndim=1)):  # type: ignore[valid-type]
    """out[0] = address in memory of the first element of a field of any rank."""
    out[0] = ti.cast(ti.get_addr(field, ti.Vector([0 for _ in ti.static(range(len(field.shape)))])), ti.i64)


def address_of(field: ti.Field, device: "torch.device") -> int:
    """Address of a field's first element, when all kernels are done."""
    import torch

    address = torch.zeros(1, dtype=torch.int64, device=device)
    _tell(field, address)
    ti.sync()
    return int(address[0])


class HostFields:
    """Fields as NumPy sees them in the host's memory, without torch and with one kernel for each tree of
    fields, wherever they were declared. CPU only."""

    def __init__(self) -> None:
        self._blocks: dict[int, np.ndarray] = {}
        self._seen: dict[int, tuple[Any, np.ndarray | None]] = {}

    def view(self, field: Any) -> np.ndarray | None:
        """The field's memory as an array, vectors with a last axis; None where it is not in one piece."""
        known = self._seen.get(id(field))
        if known is None:  # the field is kept with its view, for an identity may be given again
            impl.get_runtime().materialize()
            known = self._seen[id(field)] = field, self._found(field)
        return known[1]

    def _found(self, field: Any) -> np.ndarray | None:
        first, last = (field.vars[i].ptr.snode() for i in (0, -1))
        apart = last.offset_bytes_in_parent_cell - first.offset_bytes_in_parent_cell
        together = apart == (len(field.vars) - 1) * int(str(field.dtype)[1:]) // 8
        if field.shape == () or not together or getattr(field, "m", 1) != 1:
            return None
        tree = first.get_snode_tree_id()
        if tree not in self._blocks:
            out = np.zeros(1, np.int64)
            _tell(field, out)
            size = _path(field)[-1].cell_size_bytes
            begin = int(out[0]) - _offset(field)
            self._blocks[tree] = np.ctypeslib.as_array((ctypes.c_uint8 * size).from_address(begin))
        return _view(field, False, self._blocks[tree])


class Memory:
    """The arrays of ``structs`` (a dataclass of them) as they lie in memory. Valid while the simulator lives;
    no kernel may be running."""

    def __init__(self, structs: Any, anchor: Any, address: int, device: "torch.device") -> None:
        """``address`` is that of the first element of the field ``anchor``, from which all others are
        found."""
        root = _path(anchor)[-1]
        self.structs, self.device, self.tree = structs, device, root.get_snode_tree_id()
        self.address, self.n_bytes = address - _offset(anchor), root.cell_size_bytes
        self._looked_at: dict[int, tuple[Any, np.ndarray]] = {}
        self._words: torch.Tensor | None = None

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

    def arrays(self, struct: Any, scratch: bool = True) -> list[np.ndarray]:
        """The arrays of one struct as they lie in memory. CPU only."""
        return [
            _view(getattr(struct, declared.name), declared.metadata["lanes"], self.read())
            for declared in dataclasses.fields(struct)
            if scratch or not declared.metadata["scratch"]
        ]

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
            import torch

            self._on_device().copy_(torch.from_numpy(content))

    def clear(self) -> None:
        """All zero, as new; the system gets the pages back where it takes them."""
        if self.device.type != "cpu":
            self._on_device().zero_()
            return
        content = self.read()
        begin, count = self._advise(_MADV_DONTNEED)
        content[:begin], content[begin + count :] = 0, 0

    def in_huge_pages(self) -> "Memory":
        """This memory, all zero, in huge pages where the system has them (Linux, CPU): a step touches lines
        all over it, and its small pages are more than the TLB holds."""
        if self.device.type == "cpu" and self._advise(_MADV_HUGEPAGE)[1]:
            self.clear()
        return self

    def _advise(self, what: int) -> tuple[int, int]:
        """(first byte, count) of the whole pages for which the system took the advice."""
        begin = -self.address % mmap.PAGESIZE
        count = max(0, (self.n_bytes - begin) // mmap.PAGESIZE) * mmap.PAGESIZE
        if sys.platform == "linux" and count:
            advise = ctypes.CDLL(None).madvise
            advise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
            if advise(self.address + begin, count, what) == 0:
                return begin, count
        return begin, 0

    def rows(self, field: Any, rows: list[int] | slice) -> np.ndarray:
        """Copy of these rows of a field, shape (len(rows), ...), vectors with a last axis. CPU
        only, where a kernel is done when its launch returns.

        Nothing is compiled and nothing launched, so that a step can be looked at as often as one likes.
        """
        view = self.live(field)
        return view[rows].copy() if isinstance(rows, slice) else view[np.asarray(rows, np.intp)]

    def live(self, field: Any) -> np.ndarray:
        """A field as it lies in memory, shape of ``state``, vectors with a last axis. CPU only."""
        known = self._looked_at.get(id(field))
        if known is None:  # the field is kept with its view, for an identity may be given again
            known = self._looked_at[id(field)] = field, _view(field, False, self.read())
        return known[1]

    def number(self, field: Any) -> int:
        """The one number of a field without axes. On a GPU one wait; Taichi would launch a kernel and wait
        twice."""
        return int(self.live(field) if self.device.type == "cpu" else self.tensor(field))

    def tensor(self, field: Any) -> "torch.Tensor":
        """A field of int32 as the device's own memory, shape of ``state``: nothing is copied, and torch sees
        what kernels launched before have written."""
        import torch

        if self._words is None:
            self._words = self._on_device()[: self.n_bytes // 4 * 4].view(torch.int32)
        shape, strides = _layout(field, False)
        return self._words.as_strided(shape, [step // 4 for step in strides], _offset(field) // 4)

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

    def _on_device(self) -> "torch.Tensor":
        import torch

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


def _layout(field: Any, lanes: bool) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Shape and strides [bytes] of a field's first components."""
    shape = tuple(field.shape)
    if lanes:
        shape = (*shape[:-1], PACKET * -(-shape[-1] // PACKET))
    cell = _path(field)[1].cell_size_bytes
    return shape, tuple(cell * math.prod(shape[axis + 1 :]) for axis in range(len(shape)))


def numpy_type(field: Any) -> np.dtype:
    """NumPy's name of a field's type."""
    kind, bits = str(field.dtype)[0], int(str(field.dtype)[1:])
    return np.dtype(f"{kind}{bits // 8}")


def _view(field: Any, lanes: bool, content: np.ndarray) -> np.ndarray:
    dtype = numpy_type(field)
    shape, strides = _layout(field, lanes)
    if len(field.vars) > 1:
        shape, strides = (*shape, len(field.vars)), (*strides, dtype.itemsize)
    return np.ndarray(shape, dtype, buffer=content, offset=_offset(field), strides=strides)
