"""The folder of a run: config, provenance, results and logs; every file is written whole or not at all."""

from __future__ import annotations

import json
import os
import platform
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from uuvtai.common import files, signals
from uuvtai.common.errors import UserError
from uuvtai.common.version import __version__
from uuvtai.config import Config
from uuvtai.config.loader import to_yaml

_RUNS = Path("runs")
_LOCK, _RECORD = ".lock", "run.json"
_MAX_RECORD_BYTES = 8 << 20


class RunFolderError(UserError, RuntimeError):
    """The run folder cannot be made, written or read: what, where, why, what to type next."""


def default_run_dir(preset: str) -> Path:
    """A new folder ``runs/<time>_<preset>``, numbered where the name is taken. Raises RunFolderError."""
    name, number = f"{time.strftime('%Y%m%d-%H%M%S')}_{Path(preset).stem}", 1
    where = "give a place: --run-dir DIR"
    with files.refusing(RunFolderError, f"{_RUNS}: cannot make a folder there", where):
        _RUNS.mkdir(exist_ok=True)
        while True:
            path = _RUNS / (f"{name}-{number}" if number > 1 else name)
            try:
                path.mkdir()
            except FileExistsError:  # another run began in this second
                number += 1
            else:
                return path


_TAKEN = "is already there and not empty; give another --run-dir, or go on with that run by --resume"


def refuse_place(path: Path | None) -> None:
    """Raise RunFolderError at once where a run folder plainly cannot be made, not after minutes of compiling;
    nothing is written.

    None is the default place, whose name is not chosen yet.
    """
    path = path or _RUNS / "new"
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise RunFolderError(f"{path}: {_TAKEN}")
    nearest = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        reason = "Permission denied" if nearest.is_dir() else "Not a directory"
        raise RunFolderError(
            f"{path}: cannot make it in {nearest} ({reason}); give a folder that can be written: --run-dir "
            "DIR"
        )


class RunFolder:
    """Creates ``path`` with config.yaml and run.json and holds it; ``finish`` records how the run ended and
    lets go of it.

    Whoever holds a folder is the only one that writes into it: other processes are refused until this one
    ends, however it ends.
    """

    _lock: Any = None
    _record: dict[str, Any]

    def __init__(self, path: Path, config: Config, seeds: list[int]) -> None:
        """Raises RunFolderError where the folder has content, is held elsewhere, or cannot be written."""
        refuse_place(path)
        self.path = path
        self._started = time.time()
        self._guarded("make", lambda: path.mkdir(parents=True, exist_ok=True))
        self._take()
        self._record = {
            "schema": 1,
            "argv": sys.argv,
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "status": "running",
            "seeds": seeds,
            "versions": versions(),
            "git_sha": git_sha(),
            "hardware": hardware(),
        }
        self.write("config.yaml", to_yaml(config))
        self.write_json(_RECORD, self._record)

    @classmethod
    def held(cls, path: Path, command: str = "uuv", request: str = _RECORD) -> RunFolder:
        """The folder of a run that ended or was killed, held, and nothing read or changed in it yet;
        ``go_on`` comes next.

        ``command``, which makes such folders, is for the message; ``request`` is a file that it leaves there.
        Raises RunFolderError for what is no such folder, for one that another process works in, and for one
        with a link anywhere in it.
        """
        folder = cls.__new__(cls)
        folder.path, folder._started = path, time.time()
        hint = f"give the folder that '{command}' printed"
        if not _is_plain(path / _RECORD):
            raise RunFolderError(f"{path}: is no run folder, it has no plain file {_RECORD}; {hint}")
        folder.hold()
        try:
            folder._guarded("read it", lambda: files.refuse_links_in(path))
            if not _is_plain(path / request):
                raise RunFolderError(f"{path}: has no plain file {request}; {hint}")
            folder._guarded("tidy it", folder._sweep)
        except BaseException:
            folder.release()
            raise
        return folder

    def _sweep(self) -> None:
        """Remove what a kill left half-written; only who holds the folder writes there."""
        for place in self.path.rglob(".*.tmp*"):
            if files.UNFINISHED.fullmatch(place.name) and place.is_file():
                place.unlink()

    def go_on(self, since: dict[str, Any]) -> None:
        """Mark a held run as running again; ``since``: from where. Raises RunFolderError for no record."""
        self._record = self.record()
        resumed = {
            "argv": sys.argv,
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "versions": versions(),
            **since,
        }
        self._record |= {"status": "running", "resumed": [*self._record.get("resumed", []), resumed]}
        self._record.pop("exit", None)
        self.write_json(_RECORD, self._record)

    def settle(self, is_complete: bool) -> None:
        """Of a held folder with nothing left to do: say how its run ended, where a kill kept it from that."""
        record = self.record()
        if record.get("status") == "running":
            ended = ("finished", 0) if is_complete else ("interrupted", signals.exit_code())
            self.write_json(_RECORD, record | dict(zip(("status", "exit"), ended, strict=True)))

    def keep(self, facts: dict[str, Any]) -> None:
        """Add to the run's record. Raises RunFolderError."""
        self._record |= facts
        self.write_json(_RECORD, self._record)

    def record(self) -> dict[str, Any]:
        """As it stands in the folder. Raises RunFolderError for none."""
        file = self.path / _RECORD
        why = "it is no record of a run"
        try:
            record = files.read_json(file, _MAX_RECORD_BYTES, self.path)
        except (files.FileError, OSError) as error:
            record, why = None, str(error)
        if (
            not isinstance(record, dict)
            or not isinstance(record.get("resumed", []), list)
            or type(record.get("wall_s", 0.0)) not in (int, float)
        ):
            raise RunFolderError(
                f"{file}: cannot be read ({why}); give the folder that 'uuv train' printed"
            ) from None
        return record

    def hold(self) -> None:
        """Keep other processes from writing into the run until this one ends. Raises RunFolderError."""
        try:
            import fcntl
        except ImportError:  # not on this system: nothing to hold it by
            return
        if self._lock is None:
            self._guarded("hold it", self._open_lock)
        lock: Any = self._lock
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise RunFolderError(
                f"{self.path}: another process is working in this folder; wait for it, or stop it"
            ) from None

    def release(self) -> None:
        """Let other processes write into the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _open_lock(self) -> None:
        signals.engage()
        self._lock = files.open_to_append(self.path / _LOCK, self.path)

    def _take(self) -> None:
        """Hold a new folder. The lock is its first file: of several that begin here one makes it."""
        self._guarded("hold it", self._make_lock)
        self.hold()
        if any(place.name != _LOCK for place in self.path.iterdir()):
            self.release()
            raise RunFolderError(f"{self.path}: {_TAKEN}")

    def _make_lock(self) -> None:
        signals.engage()
        try:
            self._lock = files.open_new(self.path / _LOCK)
        except FileExistsError:
            raise RunFolderError(
                f"{self.path}: another process has just begun a run there; give another --run-dir"
            ) from None

    def write(self, name: str, text: str) -> Path:
        """Write a text file atomically; RunFolderError names the file and the reason."""
        return self.write_bytes(name, text.encode())

    def write_bytes(self, name: str, content: bytes) -> Path:
        target = self.path / name
        self._guarded(f"write {target}", lambda: files.refuse_links(self.path, target))
        self._guarded(f"write {target}", lambda: write_atomic(target, content))
        return target

    def write_json(self, name: str, document: Any) -> Path:
        """Write a JSON file atomically; NaN is refused."""
        return self.write(name, json.dumps(document, indent=1, allow_nan=False) + "\n")

    def finish(self, status: str, exit_code: int) -> None:
        """Record the end, status 'finished', 'interrupted' or 'failed', and release the folder."""
        wall_s = self._record.get("wall_s", 0.0) + time.time() - self._started
        self._record |= {"status": status, "exit": exit_code, "wall_s": round(wall_s, 3)}
        self.write_json(_RECORD, self._record)
        self.release()

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Record how the work inside ends: finished, interrupted by Ctrl-C, or failed. What compiled code has
        made of an interrupt, an error of another kind, leaves here as an interrupt again."""
        status, code = "failed", 1
        try:
            yield
            status, code = "finished", 0
        except KeyboardInterrupt:
            status, code = "interrupted", signals.exit_code()
            raise
        except Exception as error:
            if not signals.was_received():
                raise
            status, code = "interrupted", signals.exit_code()
            raise signals.Interrupted from error
        finally:
            self.finish(status, code)

    def _guarded(self, what: str, work) -> None:
        where = "give a folder that can be written: --run-dir DIR"
        with files.refusing(RunFolderError, f"{self.path}: cannot {what}", where, ""):
            work()


def write_atomic(target: Path, content: bytes) -> None:
    """Write to a temporary neighbour, flush, rename; after an error nothing is left. Raises OSError."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with files.whole_file(target) as (file, _):
        file.write(content)


def _is_plain(path: Path) -> bool:
    try:
        return stat.S_ISREG(os.lstat(path).st_mode)
    except OSError:
        return False


def versions() -> dict[str, str]:
    found = {"uuvtai": __version__, "python": platform.python_version()}
    compiler = getattr(sys.modules.get("taichi"), "__name__", "taichi")  # or quadrants, in its place
    for name in (compiler, "torch", "numpy", "ompl", "mcap", "opencv-python-headless"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def hardware() -> dict[str, Any]:
    cpu = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        cpu = names[0] if names else cpu
    return {"cpu": cpu, "cores": os.cpu_count(), "system": platform.platform()}


def git_sha() -> str | None:
    """Commit of the source tree this package runs from; None outside a checkout."""
    command = ["git", "-C", str(Path(__file__).resolve().parents[2]), "rev-parse", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None
