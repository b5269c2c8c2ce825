"""Finished episodes of an evaluation, on disk as soon as each is over: what an interrupted ``uuv eval`` need
not play again."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uuvtai.files import open_to_append, read_bytes, refuse_links, truncate
from uuvtai.measure.episodes.playing import EpisodeObserver, EpisodeResult, Job
from uuvtai.run_folder import RunFolderError

if TYPE_CHECKING:
    from uuvtai.sim import Sim

FILE = "eval/episodes.jsonl"

_SYNC_S = 1.0
"""a kill of the process loses nothing that was flushed; against a failing machine the disk is asked this
often"""

_COUNTS = ("replans", "planned_by", "fallbacks")
_PLAIN = (
    "seed",
    "episode",
    "outcome",
    "time_s",
    "episode_return",
    "min_clearance_m",
    "path_length_m",
    *_COUNTS,
)


class Finished(NamedTuple):
    """An episode that is over."""

    result: EpisodeResult
    wall_s: float
    """time that its method had taken by then"""


class _Line(BaseModel):
    """A line of the file, checked."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    method: str
    seed: int
    episode: int = Field(ge=0)
    outcome: Literal["success", "collision", "ttc", "out_of_tank", "timeout"]
    time_s: float = Field(ge=0)
    episode_return: float
    min_clearance_m: float
    path_length_m: float
    replans: dict[str, int]
    planned_by: dict[str, int]
    fallbacks: dict[str, int]
    ticks: list[int]
    acted: list[int]
    wall_s: float = Field(ge=0)

    def finished(self) -> Finished:
        plain: dict[str, Any] = {name: getattr(self, name) for name in _PLAIN}
        counts: dict[str, Any] = {
            name: np.array(getattr(self, name), dtype=np.int32) for name in ("ticks", "acted")
        }
        return Finished(EpisodeResult(**plain, **counts), self.wall_s)


class Ledger:
    """The file ``eval/episodes.jsonl`` of a run folder that this process holds. Raises RunFolderError,
    FileError."""

    def __init__(self, folder: Path) -> None:
        """Reads what is there; a last line that a kill cut off is removed."""
        self._path, self._synced = folder / FILE, time.monotonic()
        refuse_links(folder, self._path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._found: dict[str, dict[Job, Finished]] = {}
        if self._path.exists():
            truncate(self._path, self._read(folder), folder)
        self._file = open_to_append(self._path, folder)

    def finished(self, method: str) -> dict[Job, Finished]:
        """A method's episodes that are over."""
        return self._found.setdefault(method, {})

    def add(self, method: str, finished: Finished) -> None:
        """Write an episode down."""
        result = finished.result
        row: dict[str, Any] = {"method": method} | {name: getattr(result, name) for name in _PLAIN}
        row |= {name: getattr(result, name).tolist() for name in ("ticks", "acted")}
        row |= {"wall_s": round(finished.wall_s, 3)}
        self._file.write(json.dumps(row, allow_nan=False, separators=(",", ":")).encode() + b"\n")
        self._file.flush()
        if time.monotonic() - self._synced >= _SYNC_S:
            os.fsync(self._file.fileno())
            self._synced = time.monotonic()
        self.finished(method)[Job(result.seed, result.episode)] = finished

    def close(self) -> None:
        """See all of it on the disk."""
        if not self._file.closed:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()

    def _read(self, folder: Path) -> int:
        """Length of the whole lines [bytes], which are taken in."""
        kept = 0
        for number, line in enumerate(read_bytes(self._path, folder=folder).splitlines(keepends=True), 1):
            if not line.endswith(b"\n"):
                break
            try:
                found = _Line.model_validate_json(line)
            except ValidationError as error:
                reason = error.errors()[0]["msg"]
                raise RunFolderError(
                    f"{self._path}, line {number}: is no finished episode ({reason}); take that line out"
                ) from None
            self.finished(found.method)[Job(found.seed, found.episode)] = found.finished()
            kept += len(line)
        return kept


class LedgerWriter(EpisodeObserver):
    """Recorder that writes a method's episodes into the ledger as they end; behind those whose work an
    episode needs to be whole."""

    def __init__(self, ledger: Ledger, method: str) -> None:
        self._ledger, self._method = ledger, method
        self.before_s = max((found.wall_s for found in ledger.finished(method).values()), default=0.0)
        self._begun = time.perf_counter()

    @property
    def wall_s(self) -> float:
        """Time that the method has taken, that of earlier processes included."""
        return self.before_s + time.perf_counter() - self._begun

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """Keep the episode."""
        self._ledger.add(self._method, Finished(result, self.wall_s))
