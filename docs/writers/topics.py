"""Topics of a recorded episode, from the table that the log is written by."""

from __future__ import annotations

from uuvtai.config import Config
from uuvtai.logs.encode import EpisodeHeader
from uuvtai.logs.schemas import Schema
from uuvtai.logs.topics import TOPICS
from uuvtai.report.tables import text_table

_NO_RUN = EpisodeHeader(agent="", config=Config(), config_yaml="", scenario={})
"""schemas of its topics have no fields that depend on a run"""


def page() -> str:
    """All topics: when and by which schema; then the fields of our own."""
    rows = [
        [f"`{topic.name}`", topic.schema_for(_NO_RUN)["title"], topic.when.text + topic.note]
        for topic in TOPICS
    ]
    parts = [
        "# Log topics",
        "`uuv eval --record K` writes one MCAP file per episode: JSON messages, zstd chunks, simulation time "
        "from 0, SI units, world frame z-up, body frame forward-left-up. `foxglove.*` schemas are those of "
        "<https://docs.foxglove.dev/docs/sdk/schemas>; our own follow below. Attachments: `config.yaml`, "
        "`scenario.json`. Metadata: `uuv.run`, `uuv.result`. What opens a log: [logs](../logs.md).",
        text_table(["topic", "schema", "written"], rows),
    ]
    for topic in TOPICS:
        schema = topic.schema_for(_NO_RUN)
        if schema["title"].startswith("uuv."):
            about = f"`{topic.name}`. {schema.get('description', '')}".strip()
            parts += [f"## `{schema['title']}`", about, *_fields(schema, topic.varies)]
    return "\n\n".join(parts) + "\n"


def _fields(schema: Schema, varies: str) -> list[str]:
    rows = [[f"`{name}`", _type(field), _meaning(field)] for name, field in schema["properties"].items()]
    for pattern, field in schema.get("patternProperties", {}).items():
        inner = field["anyOf"][0]
        rows.append([f"`{pattern.strip('^$')}`", f"{_type(inner)} or null", _meaning(inner)])
    fixed = [text_table(["field", "type", "meaning"], rows)] if rows else []
    return fixed + ([varies] if varies else [])


def _type(field: Schema) -> str:
    if field["type"] == "array":
        count = f"{field['minItems']} of: " if "minItems" in field else "list: "
        return count + _type(field["items"])
    return field.get("title", field["type"])


def _meaning(field: Schema) -> str:
    inner = field.get("items", field)
    parts = [field.get("description", "")]
    if "properties" in inner and str(inner.get("title", "")).startswith("uuv."):
        parts += [f"`{name}` {_meaning(part)}".strip() for name, part in inner["properties"].items()]
    if "enum" in field:
        parts.append(" or ".join(field["enum"]))
    return ", ".join(part for part in parts if part)
