"""Is everything here that uuv needs, and does it work? Each check is a small job of the real thing."""

from __future__ import annotations

import importlib
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

from uuvtai.common.errors import UserError
from uuvtai.common.files import whole_file
from uuvtai.console.screen import Screen
from uuvtai.report.tables import Cell, Column, Table


def checks() -> list[dict[str, Any]]:
    """One entry per check: name, ok, detail (what was found, or what is wrong and what to do)."""
    jobs: dict[str, Callable[[], str]] = {
        "python": _python,
        "taichi": _taichi,
        "torch": _torch,
        "ompl": _ompl,
        "opencv": _opencv,
        "video": _video,
        "mcap": _mcap,
        "cuda": _cuda,
        "kernel cache": _cache,
        "machine code": _native,
        "memory": _memory,
        "run folder": _runs,
    }
    return [_done(name, job) for name, job in jobs.items()]


def _done(name: str, job: Callable[[], str]) -> dict[str, Any]:
    try:
        return {"name": name, "ok": True, "detail": job()}
    except Exception as error:  # a check reports whatever goes wrong
        return {"name": name, "ok": False, "detail": f"{type(error).__name__}: {error}"}


def _python() -> str:
    if not (3, 10) <= sys.version_info[:2] <= (3, 13):
        raise RuntimeError(f"{platform.python_version()} is not supported; use CPython 3.10 to 3.13")
    return f"{platform.python_version()} on {platform.platform()}"


def _taichi() -> str:
    import taichi as ti

    from uuvtai.compile.runtime import start_taichi

    runtime = start_taichi("cpu")
    field = ti.field(ti.f32, 16)
    field.fill(2.0)
    if float(field.to_numpy().sum()) != 32.0:
        raise RuntimeError("a kernel gave a wrong sum; reinstall taichi")
    return (
        f"{'.'.join(map(str, ti.__version__))}, {runtime.device}, "
        f"{os.environ.get('UUV_NUM_THREADS', os.cpu_count())} threads"
    )


def _torch() -> str:
    import torch

    if float(torch.ones(4).sum()) != 4.0:
        raise RuntimeError("a tensor gave a wrong sum; reinstall torch")
    return torch.__version__


def _ompl() -> str:
    importlib.import_module("ompl.geometric")
    return "RRT fallback available"


def _opencv() -> str:
    import cv2
    import numpy as np

    if not cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[0]:
        raise RuntimeError("cannot write PNG pictures; reinstall opencv-python-headless")
    return f"{cv2.__version__}, pictures can be drawn"


def _video() -> str:
    import av
    import numpy as np

    from uuvtai.logs.video import check_whole, write_video

    frames = [np.full((64, 64, 3), 80 * i, np.uint8) for i in range(3)]
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (".mp4", ".gif"):
            target = Path(folder) / f"test{suffix}"
            check_whole(target, write_video(target, frames, 10.0, frames, []), target)
    return f"PyAV {av.__version__}, MP4 and GIF can be written"


def _mcap() -> str:
    for name in ("mcap.writer", "zstandard"):
        importlib.import_module(name)
    return "logs can be written"


def _cuda() -> str:
    import torch

    if torch.cuda.is_available():
        return torch.cuda.get_device_name(0)
    return "no CUDA device: everything runs on the CPU"


def _cache() -> str:
    from uuvtai.compile.runtime import cache_folder, stale_locks

    path = cache_folder()
    for lock in stale_locks():
        raise RuntimeError(
            f"{lock} was left by a process that was killed, so every run compiles again; delete this file"
        )
    size = sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) if path.exists() else 0
    return f"{path}, {size / 2**20:.1f} MB (empty = the next run compiles for about a minute)"


def _native() -> str:
    from uuvtai.compile.cache import Store, default_folder
    from uuvtai.compile.codegen import Machine

    store = Store(default_folder())
    Machine(1)
    size = sum(file.lstat().st_size for file in store.files())
    return f"{store.folder}, {size / 2**20:.1f} MB; off with --set runtime.native=false"


def clean() -> int:
    """Delete the kernels' own machine code; how many files."""
    from uuvtai.compile.cache import Store, default_folder

    return Store(default_folder()).clear()


def _memory() -> str:
    from uuvtai.config.loader import load_config
    from uuvtai.sim.setup import free_memory_bytes, memory_bytes

    per_env = memory_bytes(load_config("pool"), 1024) / 1024
    free = free_memory_bytes("cpu")
    room = f"; {free / 2**30:.1f} GiB free, room for about {int(0.9 * free / per_env):,} envs" if free else ""
    return f"{per_env / 1e6:.2f} MB per env in pool{room}"


def _runs() -> str:
    with tempfile.TemporaryFile(dir=Path.cwd()):
        pass
    return f"{Path.cwd() / 'runs'} can be written"


# ---- The examples of the documentation, which are installed beside the package, as a folder of one's own.

_CHECKOUT = Path(__file__).parents[2] / "examples"
_SUFFIXES = (".py", ".yaml", ".xml", ".ipynb", ".parm")


class ExampleError(UserError, OSError):
    """Examples cannot be copied: what, where, why, what to type next."""


def example_files() -> list[Path]:
    """Where they lie: in the checkout, or what the wheel put into ``share/uuvtai/examples``."""
    if (_CHECKOUT / "own_astar.py").is_file():
        found = list(_CHECKOUT.iterdir())
    else:
        installed = metadata.files("uuvtai") or []
        found = [Path(str(f.locate())) for f in installed if f.parts[-3:-1] == ("uuvtai", "examples")]
    return sorted(path for path in found if path.suffix in _SUFFIXES and path.is_file())


def copy_examples(folder: Path) -> list[Path]:
    """Write them into a folder that is new or has none of them; what was written. Raises ExampleError."""
    sources = example_files()
    if not sources:
        raise ExampleError(
            "the examples are not installed here (a wheel brings them); they are in the folder examples of "
            "the source distribution: pip download --no-binary uuvtai --no-deps uuvtai"
        )
    if there := [folder / path.name for path in sources if (folder / path.name).exists()]:
        raise ExampleError(
            f"{there[0]}: is there already, and is kept; name another folder: uuv examples NEW"
        )
    written: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for source in sources:
            with whole_file(folder / source.name) as (file, _):
                file.write(source.read_bytes())
            written.append(folder / source.name)
    except OSError as error:
        for path in written:
            path.unlink(missing_ok=True)
        raise ExampleError(
            f"{folder}: cannot write there ({error.strerror}); name another folder: uuv examples FOLDER"
        ) from error
    return written


# ---- What ``uuv doctor`` found and ``--compile`` compiled, line by line.

_OK, _BAD = Cell("ok", style="green"), Cell("BAD", style="red")
_CHECKS = (
    Column("", left=True, of=lambda check: _OK if check["ok"] else _BAD),
    Column("", left=True, of=lambda check: check["name"]),
    Column("", prose=True, of=lambda check: check["detail"]),
)

_SHAPES = (
    Column("world", left=True, of=lambda shape: shape["world"]),
    Column("sensors", left=True, of=lambda shape: shape["sensors"]),
    Column("envs", of=lambda shape: f"{shape['num_envs']}"),
    Column("compiled", of=lambda shape: f"{shape['compiled']}"),
    Column("found", 1, of=lambda shape: f"{shape['found']}"),
    Column("time [s]", of=lambda shape: f"{shape['seconds']:.1f}"),
)


def show_checks(screen: Screen, found: list[dict[str, Any]]) -> None:
    """One row per check: whether it went well, its name, what was found."""
    screen.table(Table(_CHECKS, found))


def show_shapes(screen: Screen, found: list[dict[str, Any]]) -> None:
    """One row per size: how many kernels were compiled, how many were there."""
    screen.table(Table(_SHAPES, found))
