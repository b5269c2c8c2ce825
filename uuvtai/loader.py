"""Presets and YAML: load a config from named or user-given files, apply overrides, and say clearly what is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from uuvtai.config import Config

PRESET_DIR = Path(__file__).parent / "presets"


def load_config(
    world: str = "pool",
    sensors: str | None = None,
    vehicle: str | None = None,
    overrides: dict[str, Any] | None = None,
) -> Config:
    """Config of a world preset (name or path), with a sensor and a vehicle preset on top, then dotted overrides."""
    tree: dict[str, Any] = {}
    for kind, name in (("worlds", world), ("sensors", sensors), ("vehicles", vehicle)):
        if name is None:
            continue
        path = Path(name) if name.endswith((".yaml", ".yml")) else PRESET_DIR / kind / f"{name}.yaml"
        _merge(tree, yaml.safe_load(path.read_text()) or {})
    for key, value in (overrides or {}).items():
        *parents, leaf = key.split(".")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[leaf] = value
    return Config.model_validate(tree)


def _merge(into: dict[str, Any], other: dict[str, Any]) -> None:
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = value
