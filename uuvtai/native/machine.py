"""From LLVM's text to running machine code, by llvmlite, and the little of Taichi's runtime that kernels
touch."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import itertools
import re
from pathlib import Path
from typing import Any

RUNTIME_TYPE = (
    "{ %struct.PreallocatedMemoryChunk, %struct.PreallocatedMemoryChunk, i8* (i8*, i64, i64)*, void (i8*)*, "
    "void (i8*, ...)*, i32 (i8*, i64, i8*, %struct.__va_list_tag*)*, i8*, [512 x i8*], [512 x i64], i8*, "
    "void (i8*, i32, i32, i8*, void (i8*, i32, i32)*)*, [1024 x %struct.ListManager*], "
    "[1024 x %struct.NodeManager*], [1024 x i8*], i8*, "
)
"""begin of the type ``LLVMRuntime`` of Taichi 1.7: the offsets below belong to it"""
_ROOTS, _POOL, _PARALLEL_FOR, _TEMPORARIES = 88, 8280, 8288, 32872
_RUNTIME_BYTES, _TEMPORARY_BYTES = 1 << 16, 1 << 20
_TREES = 512

_LAUNCHER = """
%job = type { i8*, void (i8*, i32, i32)*, i32, i32 }
%context = type { i8*, i8*, i32, i64* }
declare void @GOMP_parallel(void (i8*)*, i8*, i32, i32)
declare i32 @omp_get_thread_num()

; one thread's part of a loop: it takes the next block until there is none
define void @uuv_work(i8* %p) {
entry:
  %job = bitcast i8* %p to %job*
  %at.context = getelementptr %job, %job* %job, i32 0, i32 0
  %at.body = getelementptr %job, %job* %job, i32 0, i32 1
  %at.count = getelementptr %job, %job* %job, i32 0, i32 2
  %next = getelementptr %job, %job* %job, i32 0, i32 3
  %context = load i8*, i8** %at.context
  %body = load void (i8*, i32, i32)*, void (i8*, i32, i32)** %at.body
  %count = load i32, i32* %at.count
  %thread = call i32 @omp_get_thread_num()
  br label %take
take:
  %i = atomicrmw add i32* %next, i32 1 seq_cst
  %more = icmp slt i32 %i, %count
  br i1 %more, label %do, label %done
do:
  call void %body(i8* %context, i32 %thread, i32 %i)
  br label %take
done:
  ret void
}

; what kernels call for a parallel loop; the pool's first number is how many threads there are
define void @uuv_parallel_for(i8* %pool, i32 %count, i32 %wanted, i8* %context, void (i8*, i32, i32)* %body) {
entry:
  %job = alloca %job
  %at.threads = bitcast i8* %pool to i32*
  %threads = load i32, i32* %at.threads
  %one = icmp sle i32 %threads, 1
  %few = icmp sle i32 %count, 1
  %alone = or i1 %one, %few
  br i1 %alone, label %next, label %share
next:
  %i = phi i32 [ 0, %entry ], [ %i.next, %do ]
  %more = icmp slt i32 %i, %count
  br i1 %more, label %do, label %done
do:
  call void %body(i8* %context, i32 0, i32 %i)
  %i.next = add i32 %i, 1
  br label %next
share:
  %at.context = getelementptr %job, %job* %job, i32 0, i32 0
  %at.body = getelementptr %job, %job* %job, i32 0, i32 1
  %at.count = getelementptr %job, %job* %job, i32 0, i32 2
  %at.next = getelementptr %job, %job* %job, i32 0, i32 3
  store i8* %context, i8** %at.context
  store void (i8*, i32, i32)* %body, void (i8*, i32, i32)** %at.body
  store i32 %count, i32* %at.count
  store i32 0, i32* %at.next
  %p = bitcast %job* %job to i8*
  call void @GOMP_parallel(void (i8*)* @uuv_work, i8* %p, i32 %threads, i32 0)
  br label %done
done:
  ret void
}

; kernels one after another
%entry = type { void (%context*)**, i32, i8*, i8* }
define void @uuv_launch_row(%entry* %entries, i32 %count) {
entry:
  br label %next
next:
  %i = phi i32 [ 0, %entry ], [ %i.next, %do ]
  %more = icmp slt i32 %i, %count
  br i1 %more, label %do, label %done
do:
  %at.tasks = getelementptr %entry, %entry* %entries, i32 %i, i32 0
  %at.count = getelementptr %entry, %entry* %entries, i32 %i, i32 1
  %at.arguments = getelementptr %entry, %entry* %entries, i32 %i, i32 2
  %at.runtime = getelementptr %entry, %entry* %entries, i32 %i, i32 3
  %tasks = load void (%context*)**, void (%context*)*** %at.tasks
  %tasks.count = load i32, i32* %at.count
  %arguments = load i8*, i8** %at.arguments
  %runtime = load i8*, i8** %at.runtime
  call void @uuv_launch(void (%context*)** %tasks, i32 %tasks.count, i8* %arguments, i8* %runtime)
  %i.next = add i32 %i, 1
  br label %next
done:
  ret void
}

; the tasks of a kernel, one after another
define void @uuv_launch(void (%context*)** %tasks, i32 %count, i8* %arguments, i8* %runtime) {
entry:
  %context = alloca %context
  %result = alloca [64 x i64]
  %at.arguments = getelementptr %context, %context* %context, i32 0, i32 0
  %at.runtime = getelementptr %context, %context* %context, i32 0, i32 1
  %at.thread = getelementptr %context, %context* %context, i32 0, i32 2
  %at.result = getelementptr %context, %context* %context, i32 0, i32 3
  %first = getelementptr [64 x i64], [64 x i64]* %result, i32 0, i32 0
  store i8* %arguments, i8** %at.arguments
  store i8* %runtime, i8** %at.runtime
  store i32 0, i32* %at.thread
  store i64* %first, i64** %at.result
  br label %next
next:
  %i = phi i32 [ 0, %entry ], [ %i.next, %do ]
  %more = icmp slt i32 %i, %count
  br i1 %more, label %do, label %done
do:
  %at.task = getelementptr void (%context*)*, void (%context*)** %tasks, i32 %i
  %task = load void (%context*)*, void (%context*)** %at.task
  call void %task(%context* %context)
  %i.next = add i32 %i, 1
  br label %next
done:
  ret void
}
"""

_TASK = re.compile(
    r"^define (?:dso_local )?void @([\w.]+_kernel_(\d+)\w*)\(%struct\.RuntimeContext[\w.]*\* ", re.M
)
_SUFFIX = re.compile(r"(%struct\.\w+?)\.\d+\b")


class UnfitError(Exception):
    """This Taichi, this machine or this code cannot be launched here; Taichi launches its own."""


class Machine:
    """Compiles for this processor, and launches. One per process."""

    def __init__(self, threads: int) -> None:
        """Raises UnfitError where llvmlite, its LLVM or torch's OpenMP does not fit."""
        self.llvm = _llvm()
        self.symbols = {
            name: ctypes.cast(getattr(_openmp(), name), ctypes.c_void_p).value or 0
            for name in ("GOMP_parallel", "omp_get_thread_num")
        }
        """addresses of what code may call beside the process's own functions, by name"""
        # JITLink: code and its constants in one piece of memory. Code finds them by distances of 32 bits, and
        # LLVM's older linker puts them wherever a gap is, which in a large process may be farther away
        self._linker = self.llvm.create_lljit_compiler(
            self._target(), use_jit_link=True, suppress_errors=True
        )
        self._loaded: dict[bytes, Any] = {}
        self._number = itertools.count()
        self._pool, self._alone = ctypes.c_int32(threads), ctypes.c_int32(1)
        self._temporaries = ctypes.create_string_buffer(_TEMPORARY_BYTES)
        names = ["uuv_launch", "uuv_launch_row", "uuv_parallel_for"]
        launcher, in_a_row, self._parallel_for = self.tasks_of(self.object_of(_LAUNCHER), names)
        address = ctypes.c_void_p
        self.launch = ctypes.CFUNCTYPE(None, address, ctypes.c_int32, address, address)(launcher)
        self.launch_row = ctypes.CFUNCTYPE(None, address, ctypes.c_int32)(in_a_row)

    def runtime(self, root: int, alone: bool = False) -> Any:
        """What kernels take for Taichi's runtime: a buffer, to be kept while they may be launched. Every tree
        of fields in it begins at the address ``root``: the same code serves whichever tree the arrays are.
        ``alone``: loops run in the calling thread, for batches that are not worth waking another one."""
        block = ctypes.create_string_buffer(_RUNTIME_BYTES)
        for offset in range(_ROOTS, _ROOTS + 8 * _TREES, 8):
            _set(block, offset, root)
        _set(block, _POOL, ctypes.addressof(self._alone if alone else self._pool))
        _set(block, _PARALLEL_FOR, self._parallel_for)
        _set(block, _TEMPORARIES, ctypes.addressof(self._temporaries))
        return block

    def object_of(self, text: str) -> bytes:
        """Machine code of a module of LLVM's text. Raises UnfitError where it is not understood."""
        try:
            module = self.llvm.parse_assembly(text)
            module.verify()
        except RuntimeError as error:
            raise UnfitError(f"LLVM: {error}") from error
        return self._target().emit_object(module)

    def tasks_of(self, code: bytes, names: list[str]) -> list[int]:
        """Addresses of the functions of an object, which is loaded. Raises UnfitError."""
        digest = hashlib.sha256(code).digest()
        if digest not in self._loaded:
            self._loaded[digest] = self._linked(code, names)
        loaded = self._loaded[digest]
        return [loaded[name] for name in names]

    def _linked(self, code: bytes, names: list[str]) -> Any:
        """An object in memory, from which it never goes again."""
        library = self.llvm.JITLibraryBuilder().add_object_img(code).add_current_process()
        for name, address in self.symbols.items():
            library.import_symbol(name, address)
        for name in names:
            library.export_symbol(name)
        try:
            return library.link(self._linker, f"object {next(self._number)}")
        except RuntimeError as error:
            raise UnfitError(f"LLVM: {error}") from error

    def _target(self) -> Any:
        features = self.llvm.get_host_cpu_features().flatten()
        return self.llvm.Target.from_default_triple().create_target_machine(
            cpu=self.llvm.get_host_cpu_name(), features=features, opt=3, reloc="pic", codemodel="default"
        )

    def surroundings(self) -> list[str]:
        """Compiler and processor that the code is made by and for."""
        import llvmlite

        features = self.llvm.get_host_cpu_features().flatten()
        return [llvmlite.__version__, self.llvm.get_default_triple(), self.llvm.get_host_cpu_name(), features]


def runtime_layout() -> dict[str, int]:
    """Sizes and offsets [bytes] of what ``Machine.runtime`` fills, for who fills it elsewhere."""
    return {
        "bytes": _RUNTIME_BYTES, "roots": _ROOTS, "trees": _TREES, "pool": _POOL,
        "parallel_for": _PARALLEL_FOR, "temporaries": _TEMPORARIES, "temporary_bytes": _TEMPORARY_BYTES,
    }  # fmt: skip


def tasks_in(text: str) -> list[str]:
    """Names of a kernel's tasks in their order. Raises UnfitError where the runtime is another one than the
    offsets here belong to."""
    declared = next((line for line in text.splitlines() if line.startswith("%struct.LLVMRuntime")), "")
    if not _SUFFIX.sub(r"\1", declared).partition(" = type ")[2].startswith(RUNTIME_TYPE):
        raise UnfitError("Taichi's runtime has another layout")
    found = sorted(((int(number), name) for name, number in _TASK.findall(text)))
    if [number for number, _ in found] != list(range(len(found))) or not found:
        raise UnfitError("a kernel's tasks cannot be told apart")
    return [name for _, name in found]


def _set(block: Any, offset: int, address: int) -> None:
    ctypes.c_uint64.from_buffer(block, offset).value = address


@functools.cache
def _llvm() -> Any:
    try:
        import llvmlite.binding as llvm
    except ImportError as error:
        raise UnfitError(f"llvmlite cannot be imported ({error})") from error
    if llvm.llvm_version_info[0] != 15:
        raise UnfitError(f"llvmlite is built on LLVM {llvm.llvm_version_info[0]}, Taichi on 15")
    llvm.initialize()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@functools.cache
def _openmp() -> ctypes.CDLL:
    """torch's threads: a pool that is there already. Raises UnfitError."""
    import torch

    folder = Path(torch.__file__).parent
    for path in [*folder.glob("lib/libgomp*"), *folder.parent.glob("torch.libs/libgomp*")]:
        return ctypes.CDLL(str(path))
    raise UnfitError("torch brings no libgomp")
