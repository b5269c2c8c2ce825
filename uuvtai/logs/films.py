"""A film of recorded episodes, one or several at once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from uuvtai.logs.overview import overview
from uuvtai.logs.video import Progress, video


def film(
    paths: Sequence[Path],
    out: Path,
    width_px: int | None = None,
    fps: float | None = None,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Of one log ``video.video``, of several ``overview.overview``; arguments and errors as theirs."""
    if len(paths) == 1:
        return video(paths[0], out, width_px, fps, speed, progress)
    return overview(paths, out, width_px, fps, speed, progress)
