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
VECTOR2 = record("foxglove.Vector2", x=NUMBER, y=NUMBER)
VECTOR3 = record("foxglove.Vector3", x=NUMBER, y=NUMBER, z=NUMBER)
POINT3 = record("foxglove.Point3", x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = record("foxglove.Quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
COLOR = record("foxglove.Color", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)
POSE = record("foxglove.Pose", position=VECTOR3, orientation=QUATERNION)

FRAME_TRANSFORM = record(
    "foxglove.FrameTransform",
    timestamp=TIME,
    parent_frame_id=STRING,
    child_frame_id=STRING,
    translation=VECTOR3,
    rotation=QUATERNION,
)
FRAME_TRANSFORMS = record("foxglove.FrameTransforms", transforms=array_of(FRAME_TRANSFORM))
POSE_IN_FRAME = record("foxglove.PoseInFrame", timestamp=TIME, frame_id=STRING, pose=POSE)

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
PACKED_FIELD = record(
    "foxglove.PackedElementField",
    name=STRING,
    offset=UINT,
    type=_choice("foxglove.NumericType", "UNKNOWN UINT8 INT8 UINT16 INT16 UINT32 INT32 FLOAT32 FLOAT64"),
)
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
LOG = record(
    "foxglove.Log",
    timestamp=TIME,
    level=_choice("foxglove.LogLevel", "UNKNOWN DEBUG INFO WARNING ERROR FATAL"),
    message=STRING,
    name=STRING,
    file=STRING,
    line=UINT,
)

LINE_STRIP, LINE_LOOP = 0, 1  # types of foxglove.LinePrimitive
_LINE = record(
    "foxglove.LinePrimitive",
    type=_choice("foxglove.LineType", "LINE_STRIP LINE_LOOP LINE_LIST"),
    pose=POSE,
    thickness=NUMBER,
    scale_invariant=BOOLEAN,
    points=array_of(POINT3),
    color=COLOR,
    colors=array_of(COLOR),
    indices=array_of(UINT),
)
_ARROW = record(
    "foxglove.ArrowPrimitive",
    pose=POSE,
    shaft_length=NUMBER,
    shaft_diameter=NUMBER,
    head_length=NUMBER,
    head_diameter=NUMBER,
    color=COLOR,
)
_CUBE = record("foxglove.CubePrimitive", pose=POSE, size=VECTOR3, color=COLOR)
_SPHERE = record("foxglove.SpherePrimitive", pose=POSE, size=VECTOR3, color=COLOR)
_CYLINDER = record(
    "foxglove.CylinderPrimitive", pose=POSE, size=VECTOR3, bottom_scale=NUMBER, top_scale=NUMBER, color=COLOR
)
_TRIANGLES = record(
    "foxglove.TriangleListPrimitive",
    pose=POSE,
    points=array_of(POINT3),
    color=COLOR,
    colors=array_of(COLOR),
    indices=array_of(UINT),
)
_TEXT = record(
    "foxglove.TextPrimitive",
    pose=POSE,
    billboard=BOOLEAN,
    font_size=NUMBER,
    scale_invariant=BOOLEAN,
    color=COLOR,
    text=STRING,
)
_MODEL = record(
    "foxglove.ModelPrimitive",
    pose=POSE,
    scale=VECTOR3,
    color=COLOR,
    override_color=BOOLEAN,
    url=STRING,
    media_type=STRING,
    data=BASE64,
)
SCENE_ENTITY = record(
    "foxglove.SceneEntity",
    timestamp=TIME,
    frame_id=STRING,
    id=STRING,
    lifetime=DURATION,
    frame_locked=BOOLEAN,
    metadata=array_of(record("foxglove.KeyValuePair", key=STRING, value=STRING)),
    arrows=array_of(_ARROW),
    cubes=array_of(_CUBE),
    spheres=array_of(_SPHERE),
    cylinders=array_of(_CYLINDER),
    lines=array_of(_LINE),
    triangles=array_of(_TRIANGLES),
    texts=array_of(_TEXT),
    models=array_of(_MODEL),
)
SCENE_UPDATE = record(
    "foxglove.SceneUpdate",
    deletions=array_of(
        record(
            "foxglove.SceneEntityDeletion",
            timestamp=TIME,
            type=_choice("foxglove.SceneEntityDeletionType", "MATCHING_ID ALL"),
            id=STRING,
        )
    ),
    entities=array_of(SCENE_ENTITY),
)
