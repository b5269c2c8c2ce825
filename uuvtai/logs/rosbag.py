"""Logs as ROS 2 bags (``rosbag2`` with MCAP storage), without ROS."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from uuvtai.common.files import refuse_output, refusing, whole_folder
from uuvtai.config.loader import ConfigError, parsed_yaml
from uuvtai.logs.container import whole_log
from uuvtai.logs.encode import LogError, unlike_schema
from uuvtai.logs.reader import LogHead, read_head, read_messages
from uuvtai.logs.ros2 import SOURCES, WRITTEN, RosMessages, Setup, ros_messages


def to_rosbag2(path: Path, out: Path) -> int:
    """Write the log ``path`` as a bag, the new folder ``out``; how many messages. Raises LogError, also where
    ``out`` exists, and then nothing is left."""
    path, out, ros = Path(path), Path(out), RosMessages()
    if not out.is_dir():
        refuse_output(out, [path], True)
    if out.exists():
        raise LogError(f"{out}: is already there, and a bag is a new folder; give a new --out DIR")
    head = read_head(path)
    setup = _setup(path, head)
    unwritten = refusing(LogError, f"{out}: cannot write", "choose another place with --out")
    with unlike_schema(path), unwritten, whole_folder(out) as staging:
        return _write_bag(path, head, setup, ros, staging, out.name)


def _setup(path: Path, head: LogHead) -> Setup:
    try:
        given = parsed_yaml(head.attachments.get("config.yaml", b"{}").decode(), f"{path}: config.yaml")
        return Setup.of(given)
    except (ConfigError, ValueError, TypeError, AttributeError) as error:
        raise LogError(
            f"{path}: its config.yaml cannot be read ({error}); convert a log that uuv eval --record wrote"
        ) from None


def _write_bag(path: Path, head: LogHead, setup: Setup, ros: RosMessages, folder: Path, name: str) -> int:
    with whole_log(folder / f"{name}.mcap", "ros2") as file:
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
