"""Topics of a recorded episode, from the schemas that the log is written by."""

from __future__ import annotations

from uuvtai.logs import schemas
from uuvtai.logs.mcap_log import DEPTH_HZ, MAP_HZ, OBSTACLE_HZ, topic_schemas
from uuvtai.tables.table import text_table

STEP, SCAN, MAPS = "every control step", "every new scan", f"{MAP_HZ:g} Hz, on every replan, and at the end"
WHEN = {
    "/tf": STEP,
    "/pose": f"{STEP}; truth",
    "/pose_estimate": STEP,
    "/sonar/scan": SCAN,
    "/sonar/doppler": SCAN,
    "/camera/line": "every new image",
    "/camera/depth": f"{DEPTH_HZ:g} Hz, with `--depth-images`",
    "/map/static": MAPS,
    "/map/dynamic": MAPS,
    "/map/clearance": MAPS,
    "/map/risk": MAPS,
    "/plan": "on every replan",
    "/plan/info": "on every replan",
    "/plan/lookahead": f"{STEP} with a route",
    "/goal": f"{OBSTACLE_HZ:g} Hz",
    "/obstacles": f"{OBSTACLE_HZ:g} Hz; truth",
    "/obstacles/truth": f"{OBSTACLE_HZ:g} Hz; truth",
    "/tracks": SCAN,
    "/state": f"{STEP}; truth and measurements",
    "/action": STEP,
    "/policy": STEP,
    "/safety": f"{STEP}; truth",
    "/tree": STEP,
    "/log": "replans, end of the episode",
}
"""when a topic is written"""

VARIABLE = {
    "/policy": "Each term of the reward under its own name ([`reward`](configuration/reward.md)): number",
    "/tree": "Each node of the behaviour tree by its name: its status as text",
}
"""fields that depend on the run"""


def page() -> str:
    """All topics: when and by which schema; then the fields of our own."""
    found = topic_schemas((), (), (), depth_images=True)
    if found.keys() != WHEN.keys():
        raise ValueError(
            "docs/writers/topics.py does not say when these topics are written: "
            f"{sorted(found.keys() ^ WHEN.keys())}"
        )
    rows = [[f"`{topic}`", f"{schema['title']}", WHEN[topic]] for topic, schema in found.items()]
    own = {topic: schema for topic, schema in found.items() if schema["title"].startswith("uuv.")}
    parts = [
        "# Log topics",
        "`uuv eval --record K` writes one MCAP file per episode: JSON messages, zstd chunks, simulation time "
        "from 0, SI units, world "
        "frame z-up, body frame forward-left-up. `foxglove.*` schemas are those of "
        "<https://docs.foxglove.dev/docs/sdk/schemas>; our "
        "own follow below. Attachments: `config.yaml`, `scenario.json`. Metadata: `uuv.run`, `uuv.result`. "
        "What opens a log: "
        "[viewers](../viewers.md).",
        text_table(["topic", "schema", "written"], rows),
    ]
    for topic, schema in own.items():
        parts += [
            f"## `{schema['title']}`",
            f"`{topic}`. {schema.get('description', '')}".strip(),
            *_fields(topic, schema),
        ]
    return "\n\n".join(parts) + "\n"


def _fields(topic: str, schema: schemas.Schema) -> list[str]:
    rows = [[f"`{name}`", _type(field), _told(field)] for name, field in schema["properties"].items()]
    for pattern, field in schema.get("patternProperties", {}).items():
        inner = field["anyOf"][0]
        rows.append([f"`{pattern.strip('^$')}`", f"{_type(inner)} or null", _told(inner)])
    fixed = [text_table(["field", "type", "meaning"], rows)] if rows else []
    return fixed + ([VARIABLE[topic]] if topic in VARIABLE else [])


def _type(field: schemas.Schema) -> str:
    if field["type"] == "array":
        count = f"{field['minItems']} of: " if "minItems" in field else "list: "
        return count + _type(field["items"])
    return field.get("title", field["type"])


def _told(field: schemas.Schema) -> str:
    inner = field.get("items", field)
    parts = [field.get("description", "")]
    if "properties" in inner and str(inner.get("title", "")).startswith("uuv."):
        parts += [f"`{name}` {_told(part)}".strip() for name, part in inner["properties"].items()]
    if "enum" in field:
        parts.append(" or ".join(field["enum"]))
    return ", ".join(part for part in parts if part)
