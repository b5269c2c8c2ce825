"""JSON schemas: the Foxglove messages that viewers know, and what our own ``uuv.*`` are made of.

The Foxglove messages follow https://docs.foxglove.dev/docs/sdk/schemas field by field, so that Foxglove,
Lichtblick and PlotJuggler show them without a plug-in. Times are {sec, nsec} of simulation time; byte fields
are base64.

Our own keep to what those viewers' JSON schema parsers accept: below ``properties`` every field has one plain
type and lists hold numbers, strings or objects. A field that may be null has no plain type, so it stands
under ``patternProperties``, which validators honour and viewers skip: they still show it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Schema = dict[str, Any]

NUMBER: Schema = {"type": "number"}
STRING: Schema = {"type": "string"}
BOOLEAN: Schema = {"type": "boolean"}
BASE64: Schema = {"type": "string", "contentEncoding": "base64"}
UINT: Schema = {"type": "integer", "minimum": 0}
INT: Schema = {"type": "integer"}
THREE: Schema = {"type": "array", "items": NUMBER, "minItems": 3, "maxItems": 3}
FOUR: Schema = {"type": "array", "items": NUMBER, "minItems": 4, "maxItems": 4}
_NSEC: Schema = {"type": "integer", "minimum": 0, "maximum": 999_999_999}


def record(
    title: str, description: str = "", nullable: Mapping[str, Schema] | None = None, /, **properties: Schema
) -> Schema:
    """Schema of an object with these properties, and perhaps more; those in ``nullable`` may be null."""
    schema: Schema = {
        "title": title,
        "type": "object",
        "properties": properties,
        "required": [*properties, *(nullable or {})],
    }
    if nullable:
        schema["patternProperties"] = {
            f"^{name}$": {"anyOf": [inner, {"type": "null"}]} for name, inner in nullable.items()
        }
    return {**schema, "description": description} if description else schema


def array_of(items: Schema) -> Schema:
    return {"type": "array", "items": items}


def described(schema: Schema, text: str) -> Schema:
    return {**schema, "description": text}


def _choice(title: str, names: str) -> Schema:
    """Of numbers, which count the names from 0."""
    return {"title": title, "oneOf": [{"title": n, "const": i} for i, n in enumerate(names.split())]}


# --------------------------------------------------------------------------------------------------- Foxglove

TIME: Schema = {"type": "object", "title": "time", "properties": {"sec": UINT, "nsec": _NSEC}}
DURATION: Schema = {
    "type": "object",
    "title": "duration",
    "properties": {"sec": {"type": "integer"}, "nsec": _NSEC},
}
_TYPES: dict[str, Schema] = {
    "number": NUMBER,
    "uint": UINT,
    "string": STRING,
    "bool": BOOLEAN,
    "bytes": BASE64,
    "time": TIME,
    "duration": DURATION,
    "NumericType": _choice(
        "foxglove.NumericType", "UNKNOWN UINT8 INT8 UINT16 INT16 UINT32 INT32 FLOAT32 FLOAT64"
    ),
    "LogLevel": _choice("foxglove.LogLevel", "UNKNOWN DEBUG INFO WARNING ERROR FATAL"),
    "LineType": _choice("foxglove.LineType", "LINE_STRIP LINE_LOOP LINE_LIST"),
    "SceneEntityDeletionType": _choice("foxglove.SceneEntityDeletionType", "MATCHING_ID ALL"),
}
"""types by their names in Foxglove's schemas; each message that follows is one more"""


def _foxglove(name: str, fields: str) -> Schema:
    """The message of this name; ``fields``: ``type name name .., ..``; ``type[]`` is a list of them."""
    found: dict[str, Schema] = {}
    for kind, *names in map(str.split, fields.split(",")):
        of = _TYPES[kind.removesuffix("[]")]
        found |= dict.fromkeys(names, array_of(of) if kind.endswith("[]") else of)
    _TYPES[name] = record(f"foxglove.{name}", **found)
    return _TYPES[name]


VECTOR2 = _foxglove("Vector2", "number x y")
VECTOR3 = _foxglove("Vector3", "number x y z")
POINT3 = _foxglove("Point3", "number x y z")
QUATERNION = _foxglove("Quaternion", "number x y z w")
COLOR = _foxglove("Color", "number r g b a")
POSE = _foxglove("Pose", "Vector3 position, Quaternion orientation")

_foxglove(
    "FrameTransform",
    "time timestamp, string parent_frame_id child_frame_id, Vector3 translation, Quaternion rotation",
)
FRAME_TRANSFORMS = _foxglove("FrameTransforms", "FrameTransform[] transforms")
POSE_IN_FRAME = _foxglove("PoseInFrame", "time timestamp, string frame_id, Pose pose")

LASER_SCAN = record(
    "foxglove.LaserScan",
    timestamp=described(TIME, "when the ping was taken; the message is logged when it is delivered"),
    frame_id=STRING,
    pose=POSE,
    start_angle=described(NUMBER, "[rad] bearing of the first beam, counter-clockwise from ahead"),
    end_angle=described(NUMBER, "[rad] bearing of the last beam"),
    ranges=described(array_of(NUMBER), "[m] as sensed; no return = maximum range"),
    intensities=described(array_of(NUMBER), "[0, 1]; 0 = no return"),
)


def compressed_image(text: str) -> Schema:
    """foxglove.CompressedImage; ``text`` says what its data are."""
    return record(
        "foxglove.CompressedImage",
        timestamp=TIME,
        frame_id=STRING,
        data=described(BASE64, text),
        format=STRING,
    )


UINT8, FLOAT32 = 1, 7  # numeric types of packed fields
PACKED_FIELD = _foxglove("PackedElementField", "string name, uint offset, NumericType type")
GRID = record(
    "foxglove.Grid",
    timestamp=TIME,
    frame_id=STRING,
    pose=described(POSE, "outer corner of cell (0, 0)"),
    column_count=UINT,
    cell_size=VECTOR2,
    row_stride=UINT,
    cell_stride=UINT,
    fields=array_of(PACKED_FIELD),
    data=described(BASE64, "rows along y, cells of a row along x"),
)

DEBUG, INFO, WARNING, ERROR = 1, 2, 3, 4  # levels of foxglove.Log
LOG = _foxglove("Log", "time timestamp, LogLevel level, string message name file, uint line")

LINE_STRIP, LINE_LOOP = 0, 1  # types of foxglove.LinePrimitive
_foxglove(
    "LinePrimitive",
    "LineType type, Pose pose, number thickness, bool scale_invariant, Point3[] points, Color color, "
    "Color[] colors, uint[] indices",
)
_foxglove(
    "ArrowPrimitive", "Pose pose, number shaft_length shaft_diameter head_length head_diameter, Color color"
)
_foxglove("CubePrimitive", "Pose pose, Vector3 size, Color color")
_foxglove("SpherePrimitive", "Pose pose, Vector3 size, Color color")
_foxglove("CylinderPrimitive", "Pose pose, Vector3 size, number bottom_scale top_scale, Color color")
_foxglove("TriangleListPrimitive", "Pose pose, Point3[] points, Color color, Color[] colors, uint[] indices")
_foxglove(
    "TextPrimitive",
    "Pose pose, bool billboard, number font_size, bool scale_invariant, Color color, string text",
)
_foxglove(
    "ModelPrimitive",
    "Pose pose, Vector3 scale, Color color, bool override_color, string url media_type, bytes data",
)
_foxglove("KeyValuePair", "string key value")
_foxglove(
    "SceneEntity",
    "time timestamp, string frame_id id, duration lifetime, bool frame_locked, KeyValuePair[] metadata, "
    "ArrowPrimitive[] arrows, CubePrimitive[] cubes, SpherePrimitive[] spheres, "
    "CylinderPrimitive[] cylinders, LinePrimitive[] lines, TriangleListPrimitive[] triangles, "
    "TextPrimitive[] texts, ModelPrimitive[] models",
)
_foxglove("SceneEntityDeletion", "time timestamp, SceneEntityDeletionType type, string id")
SCENE_UPDATE = _foxglove("SceneUpdate", "SceneEntityDeletion[] deletions, SceneEntity[] entities")
