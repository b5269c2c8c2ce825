"""Logs as files for other tools: JSON lines, CSV or NumPy arrays per topic, and the attachments."""

from __future__ import annotations

import contextlib
import csv
import itertools
import json
import re
import struct
import zipfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from uuvtai.common.files import refuse_output, refusing, whole_folder
from uuvtai.logs.container import McapFile, whole_log
from uuvtai.logs.encode import LogError, unlike_schema
from uuvtai.logs.reader import DAMAGE, MAX_RECORD, info, opened, read_head, read_messages, records
from uuvtai.logs.topics.perception import grid_values
from uuvtai.logs.topics.sensors import logged_image

FORMATS = ("json", "csv", "npz")
ATTACHMENTS = "attachments"  # folder within an export
MAX_COLUMNS, MAX_CELLS = 20_000, 50_000_000
"""of a topic as CSV, and of all topics together: what is written grows with the widest message"""
MAX_ARRAYS = 256 << 20  # [bytes] arrays of one export, which wait in memory
_OVERHEAD = 64  # [bytes] an array or a number takes beyond its values
_RESERVED = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
"""names that open a device on some systems"""
_MAX_NAME = 100


def export(path: Path, out_dir: Path, topics: Collection[str] | None = None, fmt: str = "json") -> list[Path]:
    """Write each topic's messages into the new or empty folder ``out_dir`` and the attachments below it; the
    files' paths.

    ``json``: NAME.jsonl, one message a line with its time under ``t``. ``csv``: a column for every number
    (grids and images are left out). ``npz``: arrays with the message as first axis; grids as ``value`` (n,
    row, col), depth images as ``depth_mm``. The folder appears whole or not at all. Raises LogError, and
    FileError where ``out_dir`` is anything but a folder.
    """
    path, out_dir = Path(path), Path(out_dir)
    if fmt not in FORMATS:
        raise LogError(f"--format {fmt}: choose one of {', '.join(FORMATS)}")
    _refuse_place(out_dir)
    known = [entry["topic"] for entry in info(path)["topics"] if entry["messages"]]
    if missing := [topic for topic in topics or () if topic not in known]:
        raise LogError(f"{path}: no messages on {', '.join(missing)}; it has {', '.join(known)}")
    wanted = list(dict.fromkeys(topics or known))
    other = "choose another folder with --out DIR"
    unwritten = refusing(LogError, f"{out_dir}: cannot write the export", other)
    odd = unlike_schema(path, struct.error, csv.Error, cv2.error)
    with odd, unwritten, whole_folder(out_dir) as staging:
        names = _Names(staging)
        _write_attachments(path, staging, names)
        {"json": _write_jsonl, "csv": _write_csv, "npz": _write_npz}[fmt](path, wanted, names)
    return sorted(file for file in out_dir.rglob("*") if file.is_file())


def _refuse_place(out: Path) -> None:
    """Raise LogError or FileError for a place that is taken: a log's names must not meet anybody's files."""
    if out.is_symlink() or not out.is_dir():
        refuse_output(out, [], force=None)
    elif any(out.iterdir()):
        raise LogError(f"{out}: is a folder that is not empty; give a new or an empty one with --out DIR")


def file_name(name: str) -> str:
    """A plain file name from any topic's or attachment's name: no folders, hidden files, options, devices."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", name.replace("\\", "/").strip("/"))
    plain = plain.lstrip(".-")[:_MAX_NAME].rstrip(".")
    return f"_{plain}" if _RESERVED.fullmatch(plain) else plain or "unnamed"


class _Names:
    """Paths below a folder, none given twice, also where a and A are one file or topics give one name."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._taken: set[str] = set()

    def fresh(self, name: str) -> Path:
        stem, dot, ending = name.rpartition(".") if "." in name else (name, "", "")
        tries = (name if n == 1 else f"{stem}_{n}{dot}{ending}" for n in itertools.count(1))
        found = next(name for name in tries if name.casefold() not in self._taken)
        self._taken.add(found.casefold())
        return self.folder / found


def _write_attachments(path: Path, folder: Path, names: _Names) -> None:
    head = read_head(path)
    names.fresh("metadata.json").write_text(json.dumps(head.metadata, indent=1) + "\n", encoding="utf-8")
    if not head.attachments:
        return
    inner = _Names(folder / ATTACHMENTS)
    inner.folder.mkdir()
    for name, data in head.attachments.items():
        inner.fresh(file_name(name.replace("\\", "/").rsplit("/", 1)[-1])).write_bytes(data)


@contextlib.contextmanager
def _files(topics: list[str], ending: str, names: _Names) -> Iterator[dict[str, TextIO]]:
    """One open file a topic."""
    with contextlib.ExitStack() as stack:
        yield {
            topic: stack.enter_context(
                names.fresh(f"{file_name(topic)}.{ending}").open("w", encoding="utf-8", newline="")
            )
            for topic in topics
        }


def _write_jsonl(path: Path, topics: list[str], names: _Names) -> None:
    with _files(topics, "jsonl", names) as files:
        for message in read_messages(path, topics):
            line = json.dumps({"t": message.time_s, **message.data}, separators=(",", ":"))
            files[message.topic].write(f"{line}\n")


def _write_csv(path: Path, topics: list[str], names: _Names) -> None:
    """Columns are those of all messages: the widest list decides; what a message lacks stays empty."""
    columns: dict[str, dict[str, None]] = {topic: {} for topic in topics}
    counts = dict.fromkeys(topics, 0)
    for message in read_messages(path, topics):
        found = columns[message.topic]
        found.update(dict.fromkeys(("t", *flattened(message.data))))
        counts[message.topic] += 1
        if len(found) > MAX_COLUMNS:
            raise LogError(
                f"{path}: {message.topic} has more than {MAX_COLUMNS:,} columns; use --format json"
            )
    if sum(counts[topic] * len(columns[topic]) for topic in topics) > MAX_CELLS:
        raise LogError(
            f"{path}: makes more than {MAX_CELLS:,} cells; use --format json, or fewer topics with --topic"
        )
    with _files(topics, "csv", names) as files:
        writers = {
            topic: csv.DictWriter(files[topic], list(columns[topic]), lineterminator="\n") for topic in topics
        }
        for writer in writers.values():
            writer.writeheader()
        for message in read_messages(path, topics):
            writers[message.topic].writerow({"t": message.time_s, **flattened(message.data)})


def _write_npz(path: Path, topics: list[str], names: _Names) -> None:
    rows: dict[str, list[dict[str, np.ndarray]]] = {topic: [] for topic in topics}
    size = 0
    for message in read_messages(path, topics):
        values = {"t": message.time_s, **_arrays(message.data)}
        row = {name: np.asarray(value) for name, value in values.items()}
        size += sum(array.nbytes + _OVERHEAD for array in row.values())
        if size > MAX_ARRAYS:
            raise LogError(
                f"{path}: has arrays of more than {MAX_ARRAYS >> 20} MiB; use --format json, or fewer topics "
                "with --topic"
            )
        rows[message.topic].append(row)
    for topic in topics:
        # not np.savez: its own parameter names would collide with fields such as "file"
        with zipfile.ZipFile(names.fresh(f"{file_name(topic)}.npz"), "w", zipfile.ZIP_DEFLATED) as archive:
            members = _Names(Path())
            for name, values in _stacked(rows.pop(topic)):
                plain = re.sub(r"[^\w .-]", "_", name)[:_MAX_NAME].lstrip(".") or "unnamed"
                with archive.open(members.fresh(f"{plain}.npy").name, "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, values, allow_pickle=False)


def _stacked(rows: list[dict[str, np.ndarray]]) -> Iterator[tuple[str, np.ndarray]]:
    """(field, values by message) of fields that all messages have in one shape, as numbers or words."""
    for name in rows[0]:
        if all(name in row for row in rows) and len({row[name].shape for row in rows}) == 1:
            values = np.array([row[name] for row in rows])
            if values.dtype.kind in "biufU":
                yield name, values


def flattened(value: Any, name: str = "") -> dict[str, Any]:
    """Dotted names to plain values; packed bytes are left out."""
    if isinstance(value, dict):
        items = {f"{name}.{key}" if name else key: inner for key, inner in value.items() if key != "data"}
    elif isinstance(value, list):
        items = {f"{name}.{i}": inner for i, inner in enumerate(value)}
    else:
        return {name: value}
    return {key: leaf for where, inner in items.items() for key, leaf in flattened(inner, where).items()}


def _arrays(data: dict[str, Any]) -> dict[str, Any]:
    """One message's arrays: lists of numbers as they are, grids and images unpacked, null as NaN."""
    if "cell_stride" in data:
        origin = data["pose"]["position"]
        place = {"origin_m": [origin["x"], origin["y"]], "cell_m": data["cell_size"]["x"]}
        return {"value": grid_values(data), **place}
    if data.get("format") == "png":
        return {"intensity" if data["frame_id"] == "sonar" else "depth_mm": logged_image(data)}
    found: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, dict):
            found |= {f"{key}.{inner}": leaf for inner, leaf in _arrays(value).items()}
        elif not isinstance(value, list) or all(isinstance(item, int | float) for item in value):
            found[key] = np.nan if value is None else value
    return found


# ---- Make a readable log of one whose writing was cut off or that was damaged later.


@dataclass(frozen=True)
class Repair:
    path: Path
    messages: int
    last_time_s: float
    complete: bool  # nothing was wrong with the file
    damages: tuple[str, ...]  # what was wrong, with the byte


_PART = re.compile(r"(\.[0-9a-f]{8})?\.part$")  # what an unfinished recording's name ends in, today or before
MAX_DAMAGES = 100  # that are told one by one


def repair(path: Path, out: Path | None = None, force: bool = False) -> Repair:
    """Write every message that can still be read to ``out``, with indexes and summary; the input is never
    changed.

    Default for ``out``: NAME.repaired.mcap. The new file says in its metadata ``uuv.repair`` what was found.
    Raises LogError, also where nothing at all can be recovered, and FileError where ``out`` is the input, or
    exists and ``force`` is not set.
    """
    path = Path(path)
    stem = _PART.sub("", path.name).removesuffix(".mcap")
    out = path.with_name(f"{stem}.repaired.mcap") if out is None else Path(out)
    declared = _declared(path)
    refuse_output(out, [path], force)
    where = "choose another place with --out FILE"
    with refusing(LogError, f"{out}: cannot write the repaired log", where):
        return _copied(path, declared, out)


def _copied(path: Path, declared: list[Any], out: Path) -> Repair:
    damages: list[str] = []
    with whole_log(out) as file:
        copy = _Copy(file)
        for record in itertools.chain(declared, records(path, damages=damages)):
            copy.add(record)
        if not copy.messages:
            reason = damages[0] if damages else "it holds no messages"
            raise LogError(
                f"{path}: nothing can be recovered: {reason}; record the episode again with uuv eval --record"
            )
        more = len(damages) - MAX_DAMAGES
        listed = damages[:MAX_DAMAGES] + ([f"and {more} more"] if more > 0 else [])
        if listed:
            file.add_metadata("uuv.repair", {"messages": str(copy.messages), "damages": json.dumps(listed)})
    return Repair(out, copy.messages, copy.last_ns / 1e9, not listed, tuple(listed))


def _declared(path: Path) -> list[Any]:
    """Schemas and channels outside of chunks: the summary repeats those of the chunk that may be damaged."""
    found: list[Any] = []
    with opened(path) as file, contextlib.suppress(*DAMAGE):
        for record in StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD).records:
            if isinstance(record, Schema | Channel):
                found.append(record)
    return found


class _Copy:
    """Records on their way into a new file, where their ids may be others."""

    def __init__(self, file: McapFile) -> None:
        self.file = file
        self.messages, self.last_ns = 0, 0
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def add(self, record: Any) -> None:
        if isinstance(record, Metadata):
            self.file.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self.file.add_attachment(record.name, record.media_type, record.data)
        elif isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self.file.add_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            schema = self._schemas.get(record.schema_id, 0)
            self._channels[record.id] = self.file.add_channel(
                record.topic, schema, record.message_encoding, record.metadata
            )
        elif isinstance(record, Message) and record.channel_id in self._channels:
            channel = self._channels[record.channel_id]
            self.file.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            self.messages += 1
            self.last_ns = max(self.last_ns, record.log_time)
