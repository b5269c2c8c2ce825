"""What a command line says about world, sensing, vehicle and stack, and the config that it gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from uuvtai.config import Config
    from uuvtai.config.learning import LearningConfig

Setting = str | tuple[str, Any]
"""``key.sub=value`` as typed, or (key, value)"""


@dataclass(frozen=True)
class SceneOptions:
    """Names of presets or paths of YAML files, and changes; None = as the presets have it."""

    world: str | None = None
    sensors: str | None = None
    vehicle: str | None = None
    stack: str | None = None
    n_static: int | None = None
    n_dynamic: int | None = None
    speed_m_s: float | None = None
    overrides: Sequence[str] | None = None
    """what ``--set`` said"""

    @property
    def settings(self) -> list[Setting]:
        """Changes of the config, each outweighing those before it: the stack, -S -D --speed, --set."""
        typed = {
            "stack": self.stack,
            "world.n_static": self.n_static,
            "world.n_dynamic": self.n_dynamic,
            "world.dynamic_speed_m_s": self.speed_m_s,
        }
        given: list[Setting] = [(key, value) for key, value in typed.items() if value is not None]
        return [*given, *(self.overrides or [])]

    @property
    def world_name(self) -> str:
        """The world, the default one where none was typed."""
        from uuvtai.config.loader import DEFAULT_WORLD

        return DEFAULT_WORLD if self.world is None else self.world

    def config(self, first: Sequence[Setting] = ()) -> Config:
        """Config of the presets, ``first`` and the settings. Raises ConfigError."""
        from uuvtai.config.loader import load_config

        return load_config(self.world_name, self.sensors, self.vehicle, [*first, *self.settings])

    def training(self, preset: str, first: Sequence[Setting] = ()) -> LearningConfig:
        """Config of a training preset in this scene, ``first`` and the settings. Raises ConfigError."""
        from uuvtai.config.loader import load_training

        return load_training(preset, [*first, *self.settings], self.world, self.sensors, self.vehicle)


def whole_preset(kind: str, name: str) -> tuple[Any, str]:
    """Every key that a preset gives, its own, those it builds on and the defaults, as a document and as YAML.
    Raises ConfigError, CheckpointError."""
    from uuvtai.config import loader

    if kind == "grid":
        found = loader.read_preset(kind, name)
        return found, loader.dumped(found)
    chosen: dict[str, Any] = {kind: name}
    config = SceneOptions().training(name) if kind == "train" else SceneOptions(**chosen).config()
    return config.model_dump(mode="json"), loader.to_yaml(config)
