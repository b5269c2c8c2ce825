"""From LLVM's text to running machine code, by llvmlite, and the little of Taichi's runtime that kernels
touch."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import gc
import hashlib
import itertools
import os
import re
import shutil
import stat
import sys
import tempfile
import time
import warnings
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import taichi as ti
import torch
from taichi.lang import impl

from uuvtai.common.files import FileError, open_to_append, read_text
from uuvtai.compile import cache
from uuvtai.compile.launch import Launch, NativeLaunch, Sum, TaichiLaunch, given, native, worked_out, written
from uuvtai.compile.memory import Memory
from uuvtai.compile.runtime import Companion

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
_FETCH = re.compile(r"(%[\w.]+) = atomicrmw or (i\d+\*) (%[\w.]+), i\d+ 0 seq_cst.*")
_PREFETCH = r"\1 = bitcast \2 \3 to i8*\n  call void @llvm.prefetch.p0i8(i8* \1, i32 1, i32 3, i32 1)"
_BLOCK = re.compile(
    r"(i32 @llvm\.smax\.i32\(i32 %[\w.]+, i32 )512(\)\n +%[\w.]+ = mul[ a-z]* i32 %[\w.]+, %2\n)"
)
"""items of a block, where Taichi works them out for a loop: at least 512"""
_FIXED = re.compile(
    r"(= load %struct\.LLVMRuntime[\w.]*\*, .*"
    r"|= getelementptr inbounds %struct\.LLVMRuntime.*, i32 7, i64 \d+\n +%[\w.]+ = load i8\*, .*)"
)
"""loads of what no kernel changes: the address of the runtime, and in it that of a tree of fields"""
_DECLARED = "\ndeclare void @llvm.prefetch.p0i8(i8* nocapture readonly, i32, i32, i32)\n!9999 = !{}\n"
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
            module = self.llvm.parse_assembly(completed(text))
            module.verify()
        except RuntimeError as error:
            raise UnfitError(f"LLVM: {error}") from error
        return emitted(module, self._target())

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


def completed(text: str) -> str:
    """A kernel's text with what Taichi cannot say: prefetches (``kernels.core.stage.fetch``), blocks of any
    size (``loop_end`` there), and that trees of fields do not move."""
    text = _BLOCK.sub(r"\g<1>1\2", _FETCH.sub(_PREFETCH, text))
    return _FIXED.sub(r"\1, !invariant.load !9999", text) + _DECLARED


def emitted(module: Any, target: Any) -> bytes:
    """Machine code of a module. Taichi loads the address of a tree before each access, as any store might
    have changed it: the passes merge these loads, two of five of all."""
    passes = _llvm().create_module_pass_manager()
    passes.add_gvn_pass()
    passes.add_cfg_simplification_pass()
    passes.run(module)
    return target.emit_object(module)


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


# ------------------------------------------------------------------------------------------------------------
# LLVM's text of a kernel, as Taichi compiles it.


_CLONE_FS = 0x200  # of Linux's ``unshare``: a thread's current folder is its own


_PREFIX, _LOCK = "uuvtai-native-", "lock"
_NEW_S = 60.0  # a folder of this age may be about to get its lock [s]


class Compiler:
    """A thread of its own whose current folder is a temporary one: there Taichi writes the text."""

    def __init__(self) -> None:
        """Raises UnfitError where threads cannot have folders of their own."""
        _sweep()
        self._folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
        self._lock = _locked(self._folder)
        self._thread = ThreadPoolExecutor(1, "uuvtai-native")
        try:
            self._wait(self._thread.submit(_enter, self._folder))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the thread and delete its folder."""
        self._thread.shutdown()
        if self._lock is not None:
            self._lock.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def compiled(self, kernel: Any) -> tuple[Any, str]:
        """What Taichi launches, and its LLVM text. ``kernel`` is Taichi's own, front end done. Raises
        UnfitError."""
        program: Any = impl.get_runtime().prog
        with _told(program.config()):
            capabilities = program.get_device_caps()
            work = self._thread.submit(program.compile_kernel, program.config(), capabilities, kernel)
            found = self._wait(work)
        files = sorted(self._folder.glob("*.ll"))
        text = read_text(files[0]) if len(files) == 1 else ""
        for file in files:
            file.unlink()
        if not text:
            raise UnfitError(f"Taichi wrote {len(files)} texts for a kernel")
        return found, text

    def beside(self, function: Callable[[str], bytes], text: str) -> Callable[[], bytes]:
        """Start this in the thread; what waits for its result."""
        work = self._thread.submit(function, text)
        return lambda: self._wait(work)

    @staticmethod
    def _wait(work: Future) -> Any:
        """Its result. Ctrl+C is heard when it is done: Taichi must not be left in the middle."""
        interrupted = None
        while not work.done():
            try:
                work.exception()
            except KeyboardInterrupt as interrupt:
                interrupted = interrupt
        if interrupted:
            raise interrupted
        return work.result()


def _sweep() -> None:
    """Delete the folders of processes that were killed: nobody holds their locks any more."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError, FileError):
            found = folder.lstat()
            if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid():
                is_new = time.time() - found.st_mtime < _NEW_S and not (folder / _LOCK).exists()
                lock = None if is_new else _locked(folder)
                if lock is not None:
                    shutil.rmtree(folder, ignore_errors=True)
                    lock.close()


def _locked(folder: Path) -> BinaryIO | None:
    """The lock of a folder, to be kept open; None where another process has it. Raises OSError, FileError."""
    import fcntl

    lock = open_to_append(folder / _LOCK, folder)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        return None
    return lock


def _enter(folder: Path) -> None:
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.unshare(_CLONE_FS):
            raise UnfitError(f"unshare: {os.strerror(ctypes.get_errno())}")
    except AttributeError as error:
        raise UnfitError("threads cannot have a current folder of their own here") from error
    os.chdir(folder)


@contextlib.contextmanager
def _told(config: Any) -> Iterator[None]:
    """Taichi writes down the kernels that it compiles meanwhile, and does not look for them in its own cache,
    which does not hold them as text."""
    before = config.offline_cache
    config.offline_cache, config.print_kernel_llvm_ir_optimized = False, True
    try:
        yield
    finally:
        config.offline_cache, config.print_kernel_llvm_ir_optimized = before, False


# ------------------------------------------------------------------------------------------------------------
# Where a kernel's machine code comes from: the store, or Taichi, whose result it is compared with once.


@dataclass(frozen=True)
class Owner:
    """What a bundle's kernels need to know of its simulator."""

    memory: Memory
    runtime: Any
    recipe: Callable[[], bytes] | None
    """what another process can build the same simulator by (``other_end``)"""


class Native:
    """One per process."""

    def __init__(self) -> None:
        """Raises UnfitError or StoreError where nothing can be launched or kept here."""
        if sys.platform != "linux":
            raise UnfitError("own machine code is for Linux so far")
        if tuple(ti.__version__) != (1, 7, 4):
            raise UnfitError(f"Taichi {'.'.join(map(str, ti.__version__))} is not 1.7.4")
        self.store = cache.Store(cache.default_folder())
        self.machine = Machine(int(os.environ.get("UUV_NUM_THREADS") or os.cpu_count() or 1))
        program: Any = impl.get_runtime().prog
        told = program.config()
        passes = f"{told.advanced_optimization} {told.cfg_optimization} {told.fast_math} {told.default_fp}"
        self.surroundings = [*self.machine.surroundings(), *map(str, ti.__version__), passes]
        self.adopted: weakref.WeakKeyDictionary[Any, Owner] = weakref.WeakKeyDictionary()
        self.compiler: Compiler | None = None
        self.companion = Companion()
        self.found, self.made, self.refused = 0, 0, 0
        self._times: Counter[Any] = Counter()

    def adopt(
        self,
        bundles: Iterable[Any],
        memory: Memory,
        recipe: Callable[[], bytes] | None = None,
        alone: bool = False,
    ) -> None:
        """Launch kernels on these bundles, whose arrays are those of ``memory``; ``alone``: in the calling
        thread."""
        owner = Owner(memory, self.machine.runtime(memory.address, alone), recipe)
        for bundle in bundles:
            self.adopted[bundle] = owner

    def first(self, kernel: Any, arguments: tuple) -> Launch | None:
        """Launch with arguments that were not seen before; None where this is nothing for us."""
        owner = self.adopted.get(arguments[0]) if arguments else None
        if owner is None or not all(_is_plain(value) for value in arguments[1:]):
            return None
        try:
            key, tree = cache.key_of(kernel, arguments, self.surroundings), owner.memory.tree
            kept = (
                self.store.get(cache.key_with(key, names, arguments[0], tree))
                for names in self.store.names(key)
            )
            code = next(filter(None, kept), None)
            if code is None:
                return self._make(key, kernel, arguments, owner)
            launch = self._launch(code, kernel, arguments, owner)
        except (UnfitError, cache.KeyNameError, cache.StoreError) as error:
            self._tell(kernel, error)
            return None
        launch.again()
        self.found += 1
        return launch

    def _make(self, key: str, kernel: Any, arguments: tuple, owner: Owner) -> Launch:
        """Compile, launch both codes, keep ours if it did what Taichi's did."""
        if self.compiler is None:
            self.compiler = Compiler()
            atexit.register(self.compiler.close)
            atexit.register(self.companion.close)
            self.store.bound()
        if owner.recipe:
            self.companion.ask(owner.recipe())
        made, names, table = self._read(kernel, arguments)
        compiled, text = self.compiler.compiled(made)
        tasks = tasks_in(text)
        work = self.compiler.beside(self.machine.object_of, text)
        taichi = TaichiLaunch(kernel, arguments, (made, compiled), _values(kernel, arguments, table))
        state = Written(arguments, owner.memory)
        taichi.again()
        try:
            code = cache.MachineCode(tasks, work(), table)
            ours = self._launch(code, kernel, arguments, owner)
        except UnfitError as error:
            self._tell(kernel, error)
            return taichi
        if not state.is_same_after(ours):
            self._tell(kernel, UnfitError("its own machine code gives another result"))
            return taichi
        self.made += 1
        try:
            self.store.put(cache.key_with(key, names, arguments[0], owner.memory.tree), code)
            self.store.put_names(key, names)
        except cache.StoreError as error:
            self._tell(kernel, error, "its machine code is not kept")
        return ours

    def _read(self, kernel: Any, arguments: tuple) -> tuple[Any, list[str], list[Sum]]:
        """What Taichi makes of a kernel's source, what of the config this depends on, and the numbers that
        are its arguments."""
        instance = kernel.mapper.lookup(arguments)[0]
        kernel.compiled_kernels.pop((kernel.func, instance, kernel.autodiff_mode), None)  # not read by us
        self._times[kernel.func] += 1
        with cache.noted(arguments[0], self._times[kernel.func]) as (names, numbers), _uncollected():
            made = kernel.compiled_kernels.pop(kernel.ensure_compiled(*arguments))
        return made, sorted(names), numbers.table

    def _launch(self, code: cache.MachineCode, kernel: Any, arguments: tuple, owner: Owner) -> NativeLaunch:
        tasks = self.machine.tasks_of(code.machine, code.tasks)
        values = _values(kernel, arguments, code.numbers)
        return NativeLaunch(self.machine, owner.runtime, tasks, arguments, values)

    def _tell(self, kernel: Any, error: Exception, effect: str = "Taichi launches it") -> None:
        """One line for the first kernel; the others are counted."""
        self.refused += 1
        if self.refused == 1:
            warnings.warn(f"{kernel.func.__name__}: {error}; {effect}", RuntimeWarning, stacklevel=2)


def adopt(
    bundles: Iterable[Any], memory: Memory, recipe: Callable[[], bytes] | None = None, alone: bool = False
) -> None:
    """Launch kernels on these bundles by machine code of their own from now on, where this machine allows it;
    one line says why where it does not. ``recipe``: what a second process compiles the same by, where much is
    to be compiled; ``alone``: in the calling thread, without waking others."""
    try:
        if not native:
            native.append(Native())
        native[0].adopt(bundles, memory, recipe, alone)
    except (UnfitError, cache.StoreError) as error:
        warnings.warn(f"{error}; Taichi launches all kernels", RuntimeWarning, stacklevel=2)


def _values(kernel: Any, arguments: tuple, table: list[Sum]) -> list[tuple[Any, Any]]:
    """What a kernel is told at a launch: its own numbers and tensors, then those of the config."""
    numbers = (worked_out(told, lambda name: cache.value_of(arguments[0], name)) for told in table)
    return given(kernel, arguments) + [(float, number) for number in numbers]


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Look for no garbage meanwhile: Taichi makes trees of a kernel's source, which end with it."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def _is_plain(value: Any) -> bool:
    return isinstance(value, int | float) or (
        isinstance(value, torch.Tensor) and value.device.type == "cpu" and value.is_contiguous()
    )


class Written:
    """Everything that a kernel writes, as it is before its first launch."""

    def __init__(self, arguments: tuple, memory: Memory) -> None:
        tensors = [value.numpy() for value in arguments[1:] if isinstance(value, torch.Tensor)]
        structs = written(arguments[0])
        self._all = [a for s in structs for a in memory.arrays(s)] + tensors
        self._kept = [a for s in structs for a in memory.arrays(s, scratch=False)] + tensors
        self._before = [array.copy() for array in self._all]

    def is_same_after(self, ours: Launch) -> bool:
        """When Taichi's code has run: whether ours, from the same state, gives every byte that another kernel
        may read. What Taichi's code has done stands."""
        after = [array.copy() for array in self._all]
        wanted = [array.tobytes() for array in self._kept]
        _put(self._all, self._before)
        ours.again()
        is_same = all(array.tobytes() == bits for array, bits in zip(self._kept, wanted, strict=True))
        if not is_same:
            _put(self._all, after)
        return is_same


def _put(arrays: list[np.ndarray], values: list[np.ndarray]) -> None:
    for array, value in zip(arrays, values, strict=True):
        array[...] = value
