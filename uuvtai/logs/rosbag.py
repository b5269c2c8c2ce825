"""Logs as ROS 2 bags (``rosbag2`` with MCAP storage) and bags as logs, without ROS."""

from __future__ import annotations

import contextlib
import json
from array import array
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from shlex import quote
from typing import Any

import yaml
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from uuvtai.common.errors import ODD
from uuvtai.common.files import refuse_output, whole_folder
from uuvtai.config.loader import ConfigError, parsed_yaml
from uuvtai.logs.container import MAX_MESSAGE, McapFile
from uuvtai.logs.encode import LogError
from uuvtai.logs.reader import LogHead, read_head, read_messages, records
from uuvtai.logs.ros2 import NAMES, READ, SOURCES, WRITTEN, Reader, RosMessages, Setup, ros_messages


def converted(file: Path, out: Path | None, source: str, force: bool) -> tuple[Path, int, list[str]]:
    """A log as a bag or a bag as a log: (what was written, how many messages, what was left out). Raises
    LogError, FileError."""
    if source == "rosbag2":
        target = out or file.with_name(f"{file.stem}.log.mcap")
        return target, *from_rosbag2(file, target, force)
    target = out or file.with_name(f"{file.stem}_rosbag2")
    return target, to_rosbag2(file, target, force), []


def to_rosbag2(path: Path, out: Path, force: bool = False) -> int:
    """Write the log ``path`` as a bag, the new folder ``out``; how many messages. Raises LogError, and then
    nothing is left.

    Raises LogError or FileError where ``out`` exists: ``force`` replaces no folder.
    """
    path, out, ros = Path(path), Path(out), RosMessages()
    if out.is_dir():
        raise LogError(f"{out}: a bag is a new folder, which --force does not replace; give a new --out DIR")
    refuse_output(out, [path], False)
    head = read_head(path)
    setup = _setup(path, head)
    with _as_log_error(path, out), whole_folder(out) as staging:
        return _write_bag(path, head, setup, ros, staging, out.name)


def from_rosbag2(path: Path, out: Path, force: bool = False) -> tuple[int, list[str]]:
    """Write the bag ``path``, a folder or its .mcap file, as the log ``out``; how many messages, and notes:
    which were left out, for they are odd, and which are dated by the log, for their stamps are of another
    clock. Those that are not in ``READ`` are left out in silence. Raises LogError, and then nothing is left;
    FileError as ``refuse_output``."""
    ros, file = RosMessages(), _bag_file(Path(path))
    out = Path(out)
    refuse_output(out, [file], force)
    head = read_head(file)
    setup = _setup(file, head)
    with _as_log_error(file, out):
        out.parent.mkdir(parents=True, exist_ok=True)
        log = McapFile(out)
        try:
            reading = _Reading(ros, setup, log)
            count = reading.run(file, head)
            if not count and reading.odd:
                raise ValueError(next(iter(reading.why.values())))
            if not count:
                raise LogError(f"{file}: none of the messages that can be read; it needs {', '.join(READ)}")
            log.finish()
        except BaseException:
            log.discard()
            raise
    return count, [
        *(f"{topic}: left out {n} odd, the first: {reading.why[topic]}" for topic, n in reading.odd.items()),
        *(
            f"{topic}: {n} with stamps of another clock than the bag's, dated by when they were logged"
            for topic, n in (+reading.foreign).items()
        ),
    ]


@contextlib.contextmanager
def _as_log_error(path: Path, out: Path) -> Iterator[None]:
    try:
        yield
    except ODD as error:
        raise LogError(
            f"{path}: a message is not as its schema says ({str(error)[:200]!r}); see what is in it: uuv "
            f"log info {path}"
        ) from None
    except OSError as error:
        raise LogError(f"{out}: cannot write ({error.strerror}); choose another place with --out") from None


def _setup(path: Path, head: LogHead) -> Setup:
    try:
        given = parsed_yaml(head.attachments.get("config.yaml", b"{}").decode(), f"{path}: config.yaml")
        return Setup.of(given)
    except (ConfigError, ValueError, TypeError, AttributeError) as error:
        raise LogError(
            f"{path}: its config.yaml cannot be read ({error}); convert a log that uuv eval --record wrote"
        ) from None


def _bag_file(path: Path) -> Path:
    """The one .mcap of a bag."""
    if not path.is_dir():
        return path
    found = sorted(entry for entry in path.iterdir() if {".mcap", ".db3"} & set(entry.suffixes))
    if len(found) == 1 and found[0].suffix == ".mcap":
        return found[0]
    if not found:
        raise LogError(f"{path}: holds 0 .mcap files; name the folder of a bag, or its file")
    if any(".db3" in entry.suffixes for entry in found):
        what = "is a bag in SQLite, and only MCAP is read"
    elif any(entry.suffix != ".mcap" for entry in found):
        what = f"holds {found[0].name}, which is compressed as a whole and not read"
    else:
        what = f"is a bag of {len(found)} parts, and one file is read at a time"
    raise LogError(
        f"{path}: {what}; first: rosbags-convert --src {quote(str(path))} --dst NEW --dst-storage mcap"
    )


# -------------------------------------------------------------------------------------------------- writing


def _write_bag(path: Path, head: LogHead, setup: Setup, ros: RosMessages, folder: Path, name: str) -> int:
    file = McapFile(folder / f"{name}.mcap", profile="ros2")
    try:
        for key, entries in head.metadata.items():
            file.add_metadata(key, entries)
        for key, data in head.attachments.items():
            file.add_attachment(key, "application/octet-stream", data)
        kinds = dict.fromkeys(WRITTEN.values())
        schemas = {kind: file.add_schema(kind, "ros2msg", ros.definition(kind)) for kind in kinds}
        qos = {"offered_qos_profiles": ""}
        channels = {
            topic: file.add_channel(topic, schemas[kind], "cdr", qos) for topic, kind in WRITTEN.items()
        }
        counts: Counter[str] = Counter()
        times = [0]
        for time_ns, step in _steps(path):
            for topic, message in ros_messages(ros, setup, time_ns, step):
                file.add_message(channels[topic], time_ns, ros.packed(message))
                counts[topic] += 1
            times = [times[0] if sum(counts.values()) else time_ns, time_ns]
        described = _description(f"{name}.mcap", counts, times[-1] - times[0], times[0])
        file.add_metadata("rosbag2", {"serialized_metadata": yaml.safe_dump(described)})
        file.finish()
    except BaseException:
        file.discard()
        raise
    text = yaml.safe_dump({"rosbag2_bagfile_information": described}, sort_keys=False)
    (folder / "metadata.yaml").write_text(text, encoding="utf-8")
    return sum(counts.values())


def _steps(path: Path) -> Iterator[tuple[int, dict[str, dict[str, Any]]]]:
    """(time [ns], messages by topic) of each control step."""
    now, step = None, {}
    for message in read_messages(path, SOURCES):
        time_ns = round(message.time_s * 1e9)
        if now is not None and time_ns != now:
            yield now, step
            step = {}
        now = time_ns
        step[message.topic] = message.data
    if now is not None:
        yield now, step


def _description(file: str, counts: Counter[str], duration_ns: int, start_ns: int) -> dict[str, Any]:
    """metadata.yaml of version 5, which Humble and all later ones read."""
    span = {
        "duration": {"nanoseconds": duration_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
        "message_count": sum(counts.values()),
    }
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": "",
            },
            "message_count": counts[topic],
        }
        for topic, kind in WRITTEN.items()
    ]
    return {
        "version": 5,
        "storage_identifier": "mcap",
        "relative_file_paths": [file],
        **span,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file, **span}],
    }


# -------------------------------------------------------------------------------------------------- reading


class _Reading:
    """A bag's messages on their way into a log; times count from the earliest of those that are read."""

    def __init__(self, ros: RosMessages, setup: Setup, file: McapFile) -> None:
        self._ros, self._setup, self._log = ros, setup, file
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._made: dict[int, int] = {}
        self._known: dict[str, int] = {}
        self._span_ns = 0, 0
        self._topics: set[str] = set()
        self.odd: Counter[str] = Counter()
        """messages of a topic that were left out"""
        self.why: dict[str, str] = {}
        """and what was wrong with the first"""
        self.foreign: Counter[str] = Counter()
        """messages of a topic that were dated by the log"""

    def run(self, file: Path, head: LogHead) -> int:
        """All of it; how many messages."""
        count = 0
        for name, entries in head.metadata.items():
            if name != "rosbag2":
                self._log.add_metadata(name, entries)
        for name, data in head.attachments.items():
            self._log.add_attachment(name, "application/octet-stream", data)
        times_ns = array("Q", self._look(file))
        self._span_ns = (min(times_ns), max(times_ns)) if times_ns else (0, 0)
        self._topics = {channel.topic for channel in self._channels.values()}
        for record in records(file):
            if isinstance(record, Message):
                count += self._put(record)
        return count

    def _look(self, file: Path) -> Iterator[int]:
        """Log times of the messages that are read; notes schemas and channels."""
        for record in records(file):
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
            elif isinstance(record, Message):
                if self._kind(record) in READ:
                    yield record.log_time
            else:
                assert isinstance(record, Attachment | Metadata)

    def _kind(self, record: Message) -> str:
        """Name of a message's schema, '' = it is none of ROS 2's."""
        channel = self._channels.get(record.channel_id)
        schema = None if channel is None else self._schemas.get(channel.schema_id)
        return schema.name if channel and schema and channel.message_encoding == "cdr" else ""

    def _put(self, record: Message) -> bool:
        if (kind := self._kind(record)) not in READ:
            return False
        channel = self._channels[record.channel_id]
        topic, reading = NAMES.get(channel.topic, channel.topic), READ[kind]
        if topic in self._topics:  # the bag has it beside: names stay apart
            topic = channel.topic
        if channel.id not in self._made:
            title = reading.schema["title"]
            if title not in self._known:
                self._known[title] = self._log.add_schema(
                    title, "jsonschema", json.dumps(reading.schema).encode()
                )
            self._made[channel.id] = self._log.add_channel(topic, self._known[title])
        try:
            reader = Reader(topic, self._setup, self._span_ns, record.log_time)
            data = reading.read(reader, self._ros.unpacked(record.data, kind))
            if len(data) > MAX_MESSAGE:
                raise ValueError(f"{len(data):,} bytes, more than a log's message may have")
        except ODD as error:
            self.odd[channel.topic] += 1
            reason = str(error) if isinstance(error, ValueError) else repr(error)
            self.why.setdefault(channel.topic, reason.partition(": {")[0][:200])
            return False
        self.foreign[channel.topic] += reader.is_foreign
        self._log.add_message(self._made[channel.id], record.log_time - self._span_ns[0], data)
        return True
