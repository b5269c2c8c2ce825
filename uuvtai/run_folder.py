"""The folder of a run: config, provenance, results and logs; every file is written whole or not at all."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from uuvtai import __version__, signals
from uuvtai.config import Config
from uuvtai.errors import UserError
from uuvtai.loader import to_yaml

_WRITTEN_IN_PLACE = (".lock", "metrics.jsonl")
"""files that a resumed run opens for writing; others are replaced as a whole"""


class RunFolderError(UserError, RuntimeError):
    """The run folder cannot be made, written or read: what, where, why, what to type next."""


def default_run_dir(preset: str) -> Path:
    """``runs/<time>_<preset>``."""
    return Path("runs") / f"{time.strftime('%Y%m%d-%H%M%S')}_{Path(preset).stem}"


def refuse_place(path: Path) -> None:
    """Raise RunFolderError at once where a run folder plainly cannot be made, not after minutes of compiling; nothing is written."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise RunFolderError(f"{path}: is already there and not empty; give another --run-dir or remove it")
    nearest = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        reason = "Permission denied" if nearest.is_dir() else "Not a directory"
        raise RunFolderError(f"{path}: cannot make it in {nearest} ({reason}); give a folder that can be written: --run-dir DIR")


class RunFolder:
    """Creates ``path`` with config.yaml and run.json; ``finish`` records how the run ended."""

    _lock: Any = None

    def __init__(self, path: Path, config: Config, seeds: list[int]) -> None:
        """Raises RunFolderError where the folder exists with content or cannot be written."""
        refuse_place(path)
        self.path = path
        self._started = time.time()
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
        self._guarded("make", lambda: path.mkdir(parents=True, exist_ok=True))
        self.write("config.yaml", to_yaml(config))
        self.write_json("run.json", self._record)

    @classmethod
    def reopen(cls, path: Path, since: dict[str, Any]) -> RunFolder:
        """Hold and go on with a run that ended or was killed; ``since`` says from where. Raises RunFolderError."""
        folder = cls.__new__(cls)
        folder.path, folder._started = path, time.time()
        for name in _WRITTEN_IN_PLACE:
            if (path / name).is_symlink():
                raise RunFolderError(
                    f"{path / name}: is a link; a run folder holds plain files, and what a link leads to is not ours to write"
                )
        folder.hold()
        try:
            folder._record = json.loads((path / "run.json").read_text(encoding="utf-8"))
            resumed = {"argv": sys.argv, "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "versions": versions(), **since}
            folder._record |= {"status": "running", "resumed": [*folder._record.get("resumed", []), resumed]}
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise RunFolderError(f"{path / 'run.json'}: cannot be read ({error}); give the folder that 'uuv train' printed") from None
        folder._record.pop("exit", None)
        folder.write_json("run.json", folder._record)
        return folder

    def hold(self) -> None:
        """Keep other processes from writing into the same run until this one ends. Raises RunFolderError where one does."""
        try:
            import fcntl
        except ImportError:  # not on this system: nothing to hold it by
            return
        self._guarded("hold it", self._open_lock)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunFolderError(f"{self.path}: another process is working in this folder; wait for it, or stop it") from None

    def _open_lock(self) -> None:
        signals.engage()
        self._lock = (self.path / ".lock").open("w")

    def write(self, name: str, text: str) -> Path:
        """Write a text file atomically; RunFolderError names the file and the reason."""
        target = self.path / name
        self._guarded(f"write {target}", lambda: write_atomic(target, text.encode()))
        return target

    def write_json(self, name: str, document: Any) -> Path:
        """Write a JSON file atomically; NaN is refused."""
        return self.write(name, json.dumps(document, indent=1, allow_nan=False) + "\n")

    def finish(self, status: str, exit_code: int) -> None:
        """Record the end: status 'finished', 'interrupted' or 'failed'."""
        wall_s = self._record.get("wall_s", 0.0) + time.time() - self._started
        self._record |= {"status": status, "exit": exit_code, "wall_s": round(wall_s, 3)}
        self.write_json("run.json", self._record)

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Record how the work inside ends: finished, interrupted by Ctrl-C, or failed."""
        status, code = "failed", 1
        try:
            yield
            status, code = "finished", 0
        except KeyboardInterrupt:
            status, code = "interrupted", signals.exit_code()
            raise
        finally:
            self.finish(status, code)

    def _guarded(self, what: str, work) -> None:
        try:
            work()
        except OSError as error:
            raise RunFolderError(
                f"{self.path}: cannot {what} ({error.strerror}); give a folder that can be written: --run-dir DIR"
            ) from None


def write_atomic(target: Path, content: bytes) -> None:
    """Write to a temporary neighbour, flush it to disk, rename; on any error nothing is left behind."""
    signals.engage()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def versions() -> dict[str, str]:
    """Versions of what computes the results."""
    found = {"uuvtai": __version__, "python": platform.python_version()}
    for name in ("taichi", "torch", "numpy", "ompl", "mcap", "opencv-python-headless"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def hardware() -> dict[str, Any]:
    """The machine, as far as it tells."""
    cpu = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        cpu = names[0] if names else cpu
    return {"cpu": cpu, "cores": os.cpu_count(), "system": platform.platform()}


def git_sha() -> str | None:
    """Commit of the source tree this package runs from; None outside a checkout."""
    here = Path(__file__).resolve().parent.parent
    try:
        done = subprocess.run(["git", "-C", str(here), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None
