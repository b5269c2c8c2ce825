"""LLVM's text of a kernel, as Taichi compiles it."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

from taichi.lang import impl

from uuvtai.files import FileError, open_to_append, read_text
from uuvtai.native.machine import UnfitError

_CLONE_FS = 0x200
"""of Linux's ``unshare``: a thread's current folder is its own"""


_PREFIX, _LOCK = "uuvtai-native-", "lock"
_NEW_S = 60.0
"""a folder of this age may be about to get its lock [s]"""


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
