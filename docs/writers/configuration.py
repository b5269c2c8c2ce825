"""Reference of the configuration, from the pydantic models: a page per section with key, type, default, unit
and meaning."""

from __future__ import annotations

import ast
import functools
import inspect
import json
import re
from typing import Any, get_args

from pydantic import BaseModel

from docs.writers.markdown import contents
from uuvtai.config import loader
from uuvtai.config.base import LARGEST, MOST, SMALLEST
from uuvtai.config.learning import LearningConfig
from uuvtai.report.tables import text_table

Schema = dict[str, Any]
Model = type[BaseModel]

KINDS = ("world", "sensors", "vehicle", "stack", "train")
"""of presets that set config keys"""

UNITS = {
    "kg_m2": "kg m^2", "kg_m3": "kg/m^3", "rad_s_rthz": "rad/s/rtHz", "m_s2": "m/s^2", "rad_s": "rad/s",
    "m_s": "m/s", "n_m": "N m",
    "per_s": "1/s", "m3": "m^3", "kg": "kg", "deg": "deg", "rad": "rad", "rpm": "rpm", "steps": "steps",
    "n": "N", "m": "m", "s": "s",
}  # fmt: skip
"""by the end of a key, longest first"""

LONGEST_DEFAULT = 60
"""characters; longer ones are told by their length"""


def pages() -> dict[str, str]:
    """The list of sections, and a page for each."""
    fields = LearningConfig.model_fields
    return {"configuration.md": _list(), **{f"configuration/{name}.md": _page(name) for name in fields}}


def section(name: str) -> Model:
    """Model of a top-level section."""
    model = LearningConfig.model_fields[name].annotation
    assert isinstance(model, type) and issubclass(model, BaseModel)
    return model


def _list() -> str:
    rows = [
        [f"[`{name}`](configuration/{name}.md)", _about(section(name))]
        for name in LearningConfig.model_fields
    ]
    return "\n\n".join(
        [
            "# Configuration",
            "Every key can be set in a preset or a YAML file of your own, and on the command line by `--set "
            "section.key=value`. Unknown"
            " keys, wrong types and values out of range are refused with the nearest name. Configurations "
            "are immutable once they are loaded. `uuv presets show NAME --all` prints a preset with every "
            "key. Steps are control steps (`episode.control_dt_s`).",
            text_table(["section", "holds"], rows),
            contents([f"configuration/{name}" for name in LearningConfig.model_fields]),
        ]
    )


def _page(name: str) -> str:
    parts = [f"# `{name}`", *_tables(name, section(name))]
    rows = [
        [f"`{key}`", f"`{value}`", ", ".join(presets)]
        for (key, value), presets in sorted(_set_by(name).items())
    ]
    if rows:
        parts += ["## Presets that set it", text_table(["key", "value", "presets"], rows)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _about(model: Model) -> str:
    return (
        inspect.cleandoc(model.__doc__)
        if model.__doc__ and "Base of every section" not in model.__doc__
        else ""
    )


def _tables(path: str, model: Model) -> list[str]:
    """The section's own keys, then the sections inside it."""
    explained, schema = meanings(model), _schemas()[model.__name__]["properties"]
    inner = {
        key: found for key, field in model.model_fields.items() if (found := _model_in(field.annotation))
    }
    single = [key for key, found in inner.items() if model.model_fields[key].annotation is found]
    rows = [_row(key, schema[key], explained.get(key, "")) for key in model.model_fields if key not in single]
    parts = [_about(model)] + (
        [text_table(["key", "type", "default", "unit", "meaning"], rows)] if rows else []
    )
    for key, found in inner.items():
        parts += [
            f"## `{path}.{key}`" + ("" if key in single else ", each"),
            *_tables(f"{path}.{key}", found),
        ]
    return parts


@functools.cache
def _schemas() -> dict[str, Schema]:
    return LearningConfig.model_json_schema()["$defs"]


def _model_in(annotation: Any) -> Model | None:
    """The section that a field holds, alone or in a tuple."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for inner in get_args(annotation) if (found := _model_in(inner))), None)


def _row(key: str, schema: Schema, explained: str) -> list[str]:
    default = f"`{_plain(schema['default'])}`" if "default" in schema else "needed"
    unit = unit_of(key, explained)
    return [f"`{key}`", type_text(schema), default, unit, explained.removeprefix(f"[{unit}]")]


def _plain(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= LONGEST_DEFAULT or not isinstance(value, list) else f"list of {len(value)}"


# ---------------------------------------------------------------------------------------------- what a key is


def meanings(model: Model) -> dict[str, str]:
    """The text under each field in the source."""
    (body,) = ast.parse(inspect.getsource(model)).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
        ):
            found[ast.unparse(field.target)] = " ".join(str(text.value.value).split())
    return found


def unit_of(key: str, explained: str) -> str:
    """Unit: in brackets at the start of the text, or by the end of the name."""
    if stated := re.match(r"(?:\w+ )?\[([^\]\d][^\]]*|1/[^\]]+)\]", explained):
        return stated[1]
    return next((unit for end, unit in UNITS.items() if key.endswith(f"_{end}")), "")


def type_text(schema: Schema) -> str:
    """What may stand there, from the JSON schema."""
    if "$ref" in schema:
        return "section"
    if "anyOf" in schema:
        return " or ".join(type_text(part) for part in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if schema["type"] == "array":
        return _list_text(schema)
    names = {
        "number": "number",
        "integer": "whole number",
        "boolean": "true or false",
        "string": "text",
        "null": "null",
    }
    return names[schema["type"]] + _bounds(schema)


def _list_text(schema: Schema) -> str:
    if "prefixItems" not in schema:
        return f"list: {type_text(schema['items'])}"
    parts = [type_text(part) for part in schema["prefixItems"]]
    return f"{len(parts)} of: {parts[0]}" if len(set(parts)) == 1 else f"[{', '.join(parts)}]"


_GUARDS = (SMALLEST, LARGEST, MOST)
"""bounds of every number, which keep arithmetic from overflowing and mean nothing to a reader"""


def _bounds(schema: Schema) -> str:
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    explained = [
        f"{sign} {schema[name]:.10g}"
        for name, sign in signs.items()
        if name in schema and abs(schema[name]) not in _GUARDS
    ]
    explained = ["> 0", *explained] if schema.get("minimum") == SMALLEST else explained
    explained += [f"multiple of {schema['multipleOf']}"] if "multipleOf" in schema else []
    return f" {', '.join(explained)}" if explained else ""


# ---------------------------------------------------------------------------------------------------- presets


def _set_by(name: str) -> dict[tuple[str, str], list[str]]:
    """Presets by the (key, value) that they, or those that they extend, set in a section."""
    found: dict[tuple[str, str], list[str]] = {}
    for preset, tree in _presets():
        for key, value in _leaves(name, tree[name]) if isinstance(tree.get(name), dict) else []:
            found.setdefault((key, _plain(value)), []).append(preset)
    return found


@functools.cache
def _presets() -> list[tuple[str, dict[str, Any]]]:
    """Every built-in preset of ``KINDS``: 'kind name', and what it says."""
    return [
        (f"{kind} `{name}`", loader.read_preset(kind, name))
        for kind in KINDS
        for name in loader.preset_names(kind)
    ]


def _leaves(path: str, tree: dict[str, Any]) -> list[tuple[str, Any]]:
    found = []
    for key, value in tree.items():
        inner = f"{path}.{key}"
        found += _leaves(inner, value) if isinstance(value, dict) else [(inner, value)]
    return [(key, value) for key, value in found if not key.endswith(".preset")]
