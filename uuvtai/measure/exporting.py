"""A run, a checkpoint or a shipped policy, found by name and exported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from uuvtai.deploy.export import Export, export
from uuvtai.measure.episodes.methods import find_policy, policy_name


def export_run(
    run: str, out: Path | None, evaluations: list[Path], note: Callable[[str], None], force: bool
) -> Export:
    """Export to ``out`` or runs/NAME_export. Raises as ``find_policy`` and ``deploy.export.export``."""
    checkpoint = find_policy(run, note)
    name = policy_name(run, checkpoint)
    return export(checkpoint, name, out or Path("runs") / f"{name}_export", evaluations, note, force)
