"""From logs to files: the vehicle as YAML, predicted against measured as a picture beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uuvtai.config import VehicleConfig
from uuvtai.files import refuse_output
from uuvtai.identify.ardusub_log import ENDINGS, read_ardusub
from uuvtai.identify.drive_log import Drive, DriveError, read_drives
from uuvtai.identify.identified import identified, vehicle_yaml


def identify(
    files: Sequence[Path],
    vehicle_cfg: VehicleConfig,
    base: str,
    known: str,
    truth: bool,
    out: Path,
    force: bool = False,
) -> dict[str, Any]:
    """Write ``out`` (YAML that extends ``base``) and its picture; the document of ``uuv identify --json``.
    ``vehicle_cfg`` is that of ``base``. Raises DriveError, FileError, LogError, OSError."""
    picture = out.with_suffix(".png")
    if not out.parent.is_dir():
        raise DriveError(f"{out.parent}: is no folder; give --out a name in a folder that is there")
    for path in (out, picture):
        refuse_output(path, files, force)
    drives = [drive for file in files for drive in _drives(file, vehicle_cfg, truth)]
    found = identified(drives, vehicle_cfg, known)
    from uuvtai.identify.prediction_figure import prediction_png

    picture_bytes = prediction_png(found)
    out.write_text(vehicle_yaml(found, base, files), encoding="utf-8")
    picture.write_bytes(picture_bytes)
    return {**found.document, "files": [str(file) for file in files], "vehicle": str(out)}


def _drives(file: Path, vehicle_cfg: VehicleConfig, truth: bool) -> list[Drive]:
    if file.suffix.lower() in ENDINGS:
        if truth:
            raise DriveError(f"{file}: a log of ArduSub's holds no truth; leave --truth out")
        return read_ardusub(file, vehicle_cfg)
    return read_drives(file, truth)
