"""Every key that a preset gives, its own, those it builds on and the defaults: ``uuv presets show --all``."""

from __future__ import annotations

from typing import Any

from uuvtai import loader
from uuvtai.scene_options import SceneOptions


def whole_preset(kind: str, name: str) -> tuple[Any, str]:
    """As a document and as YAML. Raises ConfigError, CheckpointError."""
    if kind == "grid":
        found = loader.read_preset(kind, name)
        return found, loader.dumped(found)
    config = _config_of(kind, name)
    return config.model_dump(mode="json"), loader.to_yaml(config)


def _config_of(kind: str, name: str) -> Any:
    if kind == "train":
        return SceneOptions().training(name)
    chosen: dict[str, Any] = {kind: name}
    return SceneOptions(**chosen).config()
