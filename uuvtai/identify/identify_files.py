"""From logs to files: the vehicle as YAML, predicted against measured as a picture beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.config import VehicleConfig
from uuvtai.files import refuse_output, whole_file
from uuvtai.identify.ardusub_log import ENDINGS, read_ardusub
from uuvtai.identify.drive_log import Drive, DriveError, read_drives
from uuvtai.identify.identified import Identified, identified, vehicle_yaml
from uuvtai.identify.motion_model import AXES
from uuvtai.report.figures import Line, curves
from uuvtai.report.ink import png


def identify(
    files: Sequence[Path],
    vehicle_cfg: VehicleConfig,
    base: str,
    known: str,
    truth: bool,
    out: Path,
    force: bool = False,
    system: int | None = None,
) -> dict[str, Any]:
    """Write ``out`` (YAML that extends ``base``) and its picture; the document of ``uuv identify --json``.
    ``vehicle_cfg`` is that of ``base``; ``system``: as of ``read_ardusub``. Raises DriveError, FileError,
    LogError, OSError."""
    picture = out.with_suffix(".png")
    if not out.parent.is_dir():
        raise DriveError(f"{out.parent}: is no folder; give --out a name in a folder that is there")
    for path in (out, picture):
        refuse_output(path, files, force)
    notes: list[str] = []
    drives = [drive for file in files for drive in _drives(file, vehicle_cfg, truth, system, notes.append)]
    found = identified(drives, vehicle_cfg, known)
    picture_bytes = prediction_png(found)
    for path, content in ((out, vehicle_yaml(found, base, files).encode()), (picture, picture_bytes)):
        with whole_file(path) as (file, _):
            file.write(content)
    warnings = [*found.document["warnings"], *notes]
    return {
        **found.document,
        "warnings": warnings,
        "files": [str(file) for file in files],
        "vehicle": str(out),
    }


def _drives(
    file: Path, vehicle_cfg: VehicleConfig, truth: bool, system: int | None, note: Callable[[str], None]
) -> list[Drive]:
    if file.suffix.lower() in ENDINGS:
        if truth:
            raise DriveError(f"{file}: a log of ArduSub's holds no truth; leave --truth out")
        return read_ardusub(file, vehicle_cfg, system, note)
    return read_drives(file, truth)


_SHOWN_S = 30.0


def prediction_png(found: Identified) -> bytes:
    """Measured speeds and those of the fitted vehicle, driven by the same rotor speeds, over the first half
    minute. The prediction begins anew with each stretch of the fit."""
    steps = found.measured.shape[1] - 1
    count = max(1, round(_SHOWN_S / (steps * found.dt_s)))
    time_s = np.arange(min(count, len(found.measured)) * steps) * found.dt_s
    panels = []
    for i, axis in enumerate(AXES):
        measured, predicted = (
            speeds[:count, :steps, i].ravel() for speeds in (found.measured, found.predicted)
        )
        seen = ~np.isnan(measured)
        lines = [
            Line("measured", time_s[seen].tolist(), measured[seen].tolist()),
            Line("predicted", time_s.tolist(), predicted.tolist()),
        ]
        panels.append(curves(lines, f"{axis} [{'rad/s' if axis == 'yaw' else 'm/s'}]", "time [s]"))
    return png(panels)
