"""SIGINT and SIGTERM at random moments of every command: does it end as it should, without a
traceback, half a file or an inconsistent folder?"""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.common import Job, Row
from benchmarks.signals import Bench

LONGEST_S = 7200


def measure(job: Job) -> list[Row]:
    """Violations of each kind; a violation is shown as it is found."""
    with tempfile.TemporaryDirectory() as folder:
        return Bench(Path(folder), job).signalled(12 if job.quick else 100)
