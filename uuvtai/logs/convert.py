"""A recorded log with Foxglove's messages as protobuf, for viewers that do not read JSON, such as Rerun.

Topics with a ``foxglove.*`` schema keep their names and become protobuf; ``uuv.*`` topics, metadata and
attachments are carried over as they are. What Rerun cannot draw is added in a form that it can:
``clouds.py``. Needs the extra ``uuvtai[viz]``.
"""

from __future__ import annotations

import datetime
import importlib
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Message, Metadata, Schema

from uuvtai.config import Config
from uuvtai.files import refuse_output
from uuvtai.loader import ConfigError, parsed_yaml
from uuvtai.logs.clouds import occupied_cells, sonar_returns, waypoints
from uuvtai.logs.container import McapFile
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.reader import read_head, records, refuse_converted
from uuvtai.logs.topics import TOPICS

EXTRA = "uuvtai[viz]"
"""extra that brings the protobuf schemas"""
_PACKAGES = ("google.protobuf", "foxglove_schemas_protobuf", "mcap_protobuf")

_CONVERTED = frozenset(
    topic.schema["title"]
    for topic in TOPICS
    if not callable(topic.schema) and topic.schema["title"].startswith("foxglove.")
)
"""schemas that become protobuf; nothing is imported by a name that a file gives"""

Make = Callable[[dict[str, Any], int, float], dict[str, Any]]
"""another message from one, its time [ns] and the value from which on a cell is occupied"""

ADDED: dict[str, tuple[str, str, Make]] = {
    "/map/static": ("/map/static/cells", "PointCloud", occupied_cells),
    "/map/dynamic": ("/map/dynamic/cells", "PointCloud", occupied_cells),
    "/sonar/scan": ("/sonar/points", "PointCloud", sonar_returns),
    "/plan/info": ("/plan/waypoints", "PosesInFrame", waypoints),
}
"""topic: (topic made of it, foxglove schema, how)"""


def convert(path: Path, out: Path, force: bool = False) -> int:
    """Write ``path`` with protobuf messages to the new file ``out``; how many messages. Raises LogError, and
    then nothing is left.

    Raises FileError where ``out`` is the input, or exists and ``force`` is not set.
    """
    path, out = Path(path), Path(out)
    _require_packages()
    refuse_output(out, [path], force)
    occupied = _occupied(path)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return _converted(path, McapFile(out), occupied)
    except (
        KeyError,
        TypeError,
        ValueError,
        IndexError,
        AttributeError,
        OverflowError,
        RecursionError,
    ) as error:
        raise LogError(
            f"{path}: a message is not as its schema says ({error!r}); see what is in it with: uuv log info "
            f"{path}"
        ) from None
    except OSError as error:
        raise LogError(
            f"{out}: cannot write ({error.strerror}); choose another place with --out FILE"
        ) from None


def _converted(path: Path, file: McapFile, occupied: float) -> int:
    """Fill and finish the new file; on any error nothing of it is left."""
    copy = _Conversion(path, file, occupied)
    try:
        for record in records(path):
            copy.add(record)
        file.finish()
    except BaseException:
        file.discard()
        raise
    return copy.messages


def _require_packages() -> None:
    for name in _PACKAGES:
        try:
            found = importlib.util.find_spec(name)
        except ModuleNotFoundError:
            found = None
        if found is None:
            raise LogError(f"uuv log convert needs {name.split('.')[0]}: pip install '{EXTRA}'")


def _occupied(path: Path) -> float:
    """Value from which on the run's map counts a cell as occupied."""
    default = Config().mapping.occupied
    text = read_head(path).attachments.get("config.yaml", b"{}")
    try:
        config = parsed_yaml(text.decode(), f"{path}: config.yaml")
        return float(config.get("mapping", {}).get("occupied", default))
    except (ConfigError, ValueError, TypeError, AttributeError) as error:
        raise LogError(
            f"{path}: its config.yaml cannot be read ({error}); convert a log that uuv eval --record wrote"
        ) from None


class _Conversion:
    """Records on their way into a new file."""

    def __init__(self, path: Path, file: McapFile, occupied: float) -> None:
        self._path, self.file, self.messages = path, file, 0
        self._occupied = occupied
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._carried: dict[int, int] = {}
        """channel of the new file by that of the old one"""
        self._added: dict[int, tuple[int, type, Make]] = {}
        self._schema_ids: dict[str, int] = {}

    def add(self, record: Any) -> None:
        """Take in the next record. Raises what a message unlike its schema raises."""
        if isinstance(record, Metadata):
            self.file.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self.file.add_attachment(record.name, record.media_type, record.data)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel) and record.id not in self._channels:
            self._declare(record)
        elif isinstance(record, Message):
            self._put(record)

    def _declare(self, channel: Channel) -> None:
        refuse_converted(self._path, channel)
        self._channels[channel.id] = channel
        schema = self._schemas.get(channel.schema_id)
        if self._is_converted(channel):
            assert schema is not None
            number = self._protobuf_schema(schema.name)
            self._carried[channel.id] = self.file.add_channel(
                channel.topic, number, "protobuf", channel.metadata
            )
        else:
            number = 0 if schema is None else self._schema(schema.name, schema.encoding, schema.data)
            self._carried[channel.id] = self.file.add_channel(
                channel.topic, number, channel.message_encoding, channel.metadata
            )
        if channel.topic in ADDED and channel.message_encoding == "json":
            topic, kind, make = ADDED[channel.topic]
            made = self.file.add_channel(topic, self._protobuf_schema(f"foxglove.{kind}"), "protobuf")
            self._added[channel.id] = made, _message_class(f"foxglove.{kind}"), make

    def _put(self, record: Message) -> None:
        data, channel = record.data, self._channels[record.channel_id]
        if self._is_converted(channel):
            data = serialised(_message_class(self._schemas[channel.schema_id].name), json.loads(record.data))
        self.file.add_message(
            self._carried[channel.id], record.log_time, data, record.publish_time, record.sequence
        )
        self.messages += 1
        if channel.id in self._added:
            made, kind, make = self._added[channel.id]
            message = make(json.loads(record.data), record.log_time, self._occupied)
            self.file.add_message(made, record.log_time, serialised(kind, message), record.publish_time)
            self.messages += 1
        self.file.settle()

    def _is_converted(self, channel: Channel) -> bool:
        schema = self._schemas.get(channel.schema_id)
        return schema is not None and schema.name in _CONVERTED and channel.message_encoding == "json"

    def _protobuf_schema(self, name: str) -> int:
        from mcap_protobuf.schema import build_file_descriptor_set

        return self._schema(
            name, "protobuf", build_file_descriptor_set(_message_class(name)).SerializeToString()
        )

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        if name not in self._schema_ids:
            self._schema_ids[name] = self.file.add_schema(name, encoding, data)
        return self._schema_ids[name]


def serialised(kind: Any, message: dict[str, Any]) -> bytes:
    """A Foxglove message of JSON as protobuf of the class ``kind``. Raises ValueError where it does not
    fit."""
    from google.protobuf import json_format

    try:
        return json_format.ParseDict(_well_known(message), kind()).SerializeToString()
    except json_format.ParseError as error:
        raise ValueError(str(error)) from None


def _message_class(name: str) -> Any:
    """Class of a foxglove message; ``name`` is never a file's own word: it is one of ours."""
    short = name.removeprefix("foxglove.")
    return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{short}_pb2"), short)


def _well_known(value: Any, key: str = "") -> Any:
    """The same with times as protobuf's own JSON has them."""
    if isinstance(value, list):
        return [_well_known(item) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"sec", "nsec"}:
        return _duration(value) if key == "lifetime" else _timestamp(value)
    return {name: _well_known(item, name) for name, item in value.items()}


def _timestamp(value: dict[str, int]) -> str:
    moment = datetime.datetime(1970, 1, 1) + datetime.timedelta(seconds=int(value["sec"]))
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{int(value['nsec']):09d}Z"


def _duration(value: dict[str, int]) -> str:
    return f"{int(value['sec'])}.{int(value['nsec']):09d}s"
