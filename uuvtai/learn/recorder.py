"""The record of a run: ``metrics.jsonl``, one object an iteration, and the same as TensorBoard events under
the usual names."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from uuvtai.files import FileError, open_to_append, parsed_json, read_lines, truncate

METRICS, EVENTS = "metrics.jsonl", "tensorboard"


class MetricsRecorder:
    """Writes what every iteration gave; each line is on its way to the disk before ``write`` returns.

    A resumed run goes on behind the iteration of its checkpoint: what came later is cut off, and TensorBoard
    is told to forget it.
    """

    def __init__(self, run: Path, iteration: int = 0) -> None:
        """``iteration``: how many are done already. Raises OSError, and FileError for what is no plain file
        of the run."""
        from torch.utils.tensorboard import SummaryWriter  # takes a second to import

        _cut(run, iteration)
        self._file = open_to_append(run / METRICS, run)
        _await_next_name(run / EVENTS)
        self._events = SummaryWriter(str(run / EVENTS), purge_step=iteration + 1 if iteration else None)

    def write(self, iteration: int, metrics: Mapping[str, float]) -> None:
        """Record an iteration, counted from 1. What is not finite becomes null, and no event."""
        row = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
        self._file.write(json.dumps({"iteration": iteration, **row}, allow_nan=False).encode() + b"\n")
        self._file.flush()
        for name, value in row.items():
            if value is not None:
                self._events.add_scalar(name, value, iteration)
        self._events.flush()

    def close(self) -> None:
        """Flush and close both."""
        self._file.close()
        self._events.close()


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Every whole line of a run's ``metrics.jsonl``; a last line that was cut off is left out. Raises
    OSError, FileError."""
    return list(_whole_rows(run))


def _whole_rows(run: Path) -> Iterator[dict[str, Any]]:
    for line in read_lines(run / METRICS, folder=run):
        if (row := _row(line)) is None:
            return
        yield row


def _cut(run: Path, iteration: int) -> None:
    """Shorten the file to the whole lines of iterations up to this one."""
    file, kept = run / METRICS, 0
    if not file.exists():
        return
    for line in read_lines(file, folder=run):
        row = _row(line)
        if row is None or row["iteration"] > iteration:
            break
        kept += len(line)
    truncate(file, kept, run)


def _await_next_name(folder: Path) -> None:
    """TensorBoard reads files in the order of their names, which begin with the second in which they were
    opened, and within one second as text: what goes on must not come before what it goes on from."""
    now = time.time()
    if any(folder.glob(f"events.out.tfevents.{int(now):010d}.*")):
        time.sleep(int(now) + 1 - now)


def _row(line: bytes) -> dict[str, Any] | None:
    """The object of a line; None where the line was cut off."""
    try:
        row = parsed_json(line, METRICS)
    except FileError:
        return None
    return (
        row
        if line[-1:] == b"\n" and isinstance(row, dict) and isinstance(row.get("iteration"), int)
        else None
    )
