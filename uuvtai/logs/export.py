"""Logs as files for other tools: JSON lines, CSV or NumPy arrays per topic, and the attachments."""

from __future__ import annotations

import base64
import csv
import itertools
import json
import os
import re
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uuvtai.logs.errors import LogError
from uuvtai.logs.reader import info, read_head, read_messages

FORMATS = ("jsonl", "csv", "npz")
_PNG_HEAD = struct.Struct(">8s4x4sII")
"""signature, first chunk's name, width, height"""
_MAX_PIXELS = 1 << 24
"""of a depth image: a thousand times the camera's, and far below what a small file can claim"""


def export(path: Path, out_dir: Path, topics: Collection[str] | None = None, fmt: str = "jsonl") -> list[Path]:
    """Write each topic's messages and the attachments below ``out_dir``; the files' paths.

    ``jsonl``: one message a line with its time under ``t``. ``csv``: a column for every number (grids and images are left out). ``npz``:
    arrays with the message as first axis; grids as ``value`` (n, row, col), depth images as ``depth_mm``. All files appear at once or none
    does. Raises LogError.
    """
    path, out_dir = Path(path), Path(out_dir)
    if fmt not in FORMATS:
        raise LogError(f"--format {fmt}: choose one of {', '.join(FORMATS)}")
    known = [entry["topic"] for entry in info(path)["topics"] if entry["messages"]]
    if missing := [topic for topic in topics or () if topic not in known]:
        raise LogError(f"{path}: no messages on {', '.join(missing)}; it has {', '.join(known)}")
    wanted = list(topics or known)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".export-", dir=out_dir))
        try:
            _write_attachments(path, staging)
            {"jsonl": _write_jsonl, "csv": _write_csv, "npz": _write_npz}[fmt](path, staging, wanted)
            return [_moved(file, out_dir) for file in sorted(staging.iterdir())]
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    except (KeyError, TypeError, ValueError, StopIteration) as error:
        raise LogError(f"{path}: a message is not as its schema says ({error!r}); see what is in it with: uuv log info {path}") from error
    except OSError as error:
        raise LogError(f"{out_dir}: cannot write the export ({error.strerror}); choose another folder with --out DIR") from error


def _moved(file: Path, folder: Path) -> Path:
    os.replace(file, folder / file.name)
    return folder / file.name


def file_name(name: str) -> str:
    """A plain file name from a topic or an attachment's name, which may be anything: no folders, no hidden files."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", name.replace("\\", "/").strip("/")).lstrip(".")
    return plain[:100] or "unnamed"


def _fresh(folder: Path, name: str) -> Path:
    """A path that no other export of this run has taken: two topics may give the same plain name."""
    stem, dot, ending = name.rpartition(".")
    tries = (f"{stem}{dot}{ending}" if n == 1 else f"{stem}_{n}{dot}{ending}" for n in itertools.count(1))
    path = next(folder / name for name in tries if not (folder / name).exists())
    path.touch()
    return path


def _write_attachments(path: Path, folder: Path) -> None:
    head = read_head(path)
    for name, data in head.attachments.items():
        _fresh(folder, file_name(name.replace("\\", "/").rsplit("/", 1)[-1])).write_bytes(data)
    _fresh(folder, "metadata.json").write_text(json.dumps(head.metadata, indent=1) + "\n")


def _write_jsonl(path: Path, folder: Path, topics: list[str]) -> None:
    files = {topic: _fresh(folder, f"{file_name(topic)}.jsonl").open("w") for topic in topics}
    try:
        for message in read_messages(path, topics):
            files[message.topic].write(json.dumps({"t": message.time_s, **message.data}, separators=(",", ":")) + "\n")
    finally:
        for file in files.values():
            file.close()


def _write_csv(path: Path, folder: Path, topics: list[str]) -> None:
    """Columns are those of all messages of the topic: the widest list decides; what a message lacks stays empty."""
    for topic in topics:
        rows = [{"t": message.time_s, **flattened(message.data)} for message in read_messages(path, [topic])]
        columns = list(dict.fromkeys(name for row in rows for name in row))
        with _fresh(folder, f"{file_name(topic)}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(rows)


def _write_npz(path: Path, folder: Path, topics: list[str]) -> None:
    for topic in topics:
        rows = [{"t": message.time_s, **_arrays(message.data)} for message in read_messages(path, [topic])]
        names = [name for name in rows[0] if all(name in row for row in rows)]
        stacked = {name: np.array([row[name] for row in rows]) for name in names if len({np.shape(row[name]) for row in rows}) == 1}
        numeric = {name.replace("/", "_"): values for name, values in stacked.items() if values.dtype.kind in "biufU"}
        # not np.savez: its own parameter names would collide with fields such as "file"
        with zipfile.ZipFile(_fresh(folder, f"{file_name(topic)}.npz"), "w", zipfile.ZIP_DEFLATED) as archive:
            for name, values in numeric.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, values, allow_pickle=False)


def flattened(value: Any, name: str = "") -> dict[str, Any]:
    """Dotted names to plain values; packed bytes are left out."""
    if isinstance(value, dict):
        items = {f"{name}.{key}" if name else key: inner for key, inner in value.items() if key != "data"}
        return {key: leaf for inner_name, inner in items.items() for key, leaf in flattened(inner, inner_name).items()}
    if isinstance(value, list):
        return {key: leaf for i, inner in enumerate(value) for key, leaf in flattened(inner, f"{name}.{i}").items()}
    return {name: value}


def _arrays(data: dict[str, Any]) -> dict[str, Any]:
    """One message's arrays: lists of numbers as they are, grids and images unpacked, null as NaN."""
    if "cell_stride" in data:
        origin = data["pose"]["position"]
        return {"value": grid_values(data), "origin_m": [origin["x"], origin["y"]], "cell_m": data["cell_size"]["x"]}
    if data.get("format") == "png":
        return {"depth_mm": depth_image(data)}
    found: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, dict):
            found |= {f"{key}.{inner}": leaf for inner, leaf in _arrays(value).items()}
        elif not isinstance(value, list) or all(isinstance(item, int | float) for item in value):
            found[key] = np.nan if value is None else value
    return found


def grid_values(data: dict[str, Any]) -> np.ndarray:
    """``value`` of a foxglove.Grid as an array (row, col)."""
    cells = base64.b64decode(data["data"])
    offset = next(entry["offset"] for entry in data["fields"] if entry["name"] == "value")
    packed = np.frombuffer(cells, np.uint8).reshape(-1, data["column_count"], data["cell_stride"])
    return packed[..., offset : offset + 4].copy().view("<f4")[..., 0]


def depth_image(data: dict[str, Any]) -> np.ndarray:
    """Depth image of a foxglove.CompressedImage [mm], uint16 (row, col)."""
    png = base64.b64decode(data["data"])
    signature, name, width, height = _PNG_HEAD.unpack_from(png.ljust(_PNG_HEAD.size, b"\0"))
    if signature != b"\x89PNG\r\n\x1a\n" or name != b"IHDR":
        raise LogError("a depth image of the log cannot be decoded: it is not a PNG")
    if width * height > _MAX_PIXELS:
        raise LogError(f"a depth image of the log claims {width} x {height} pixels: no camera of ours has so many")
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise LogError("a depth image of the log cannot be decoded: it is damaged")
    return image
