"""A run or a checkpoint, found and exported; the stack of a log."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from uuvtai.deploy.export import Export, export
from uuvtai.measure.episodes.methods import find_policy, policy_name


def export_run(
    run: str, out: Path | None, evaluations: list[Path], note: Callable[[str], None], force: bool
) -> Export:
    """Export to ``out`` or runs/NAME_export. Raises as ``find_policy`` and ``deploy.export.export``."""
    checkpoint = find_policy(run, note)
    name = policy_name(run, checkpoint)
    return export(checkpoint, name, out or Path("runs") / f"{name}_export", evaluations, note, force)


def export_log(log: Path, out: Path, machines: Sequence[str]) -> dict[str, Any]:
    """Export the stack of a log of ``uuv eval --record``, with its messages as a check. Raises as
    ``read_feed`` and ``aboard.stack_folder.export_stack``."""
    from uuvtai.aboard.stack_folder import export_stack
    from uuvtai.measure.replay.log_feed import read_feed

    feed = read_feed(log)
    dt_s = feed.config.episode.control_dt_s
    arrivals = [(max(0, math.ceil(each.time_s / dt_s - 0.5)), each.message) for each in feed.arrivals]
    return export_stack(feed.config, feed.tree, feed.mission, arrivals, out, machines)
