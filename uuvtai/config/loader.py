"""Presets and YAML: load a config from named or user-given files, apply overrides, and say precisely what is
wrong and where.

A preset is a YAML file that states differences only. Its top-level keys are config sections, plus ``extends``
(another preset of the same kind) and, in a world, ``sensors: NAME`` or ``vehicle: NAME`` in place of a
section. A training preset may name all three, ``world: NAME`` or, to change something in it, ``world:
{preset: NAME, ...}``, and ``stack: NAME``. A stack preset says how the classical half works
(``STACK_SECTIONS``) and names a ``tree``; ``--set stack=NAME`` puts one below everything else that is set.
Loading never executes code: safe YAML, no tags, no aliases, no duplicate keys, at most 1 MiB.
"""

from __future__ import annotations

import difflib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError

from uuvtai.common.errors import UserError
from uuvtai.common.files import read_text, refusing
from uuvtai.common.presets import built_in_file, preset_names
from uuvtai.config import Config
from uuvtai.config.learning import LearningConfig

DEFAULT_WORLD, DEFAULT_SENSORS, DEFAULT_VEHICLE = "pool", "paper", "bluerov2"
_SCENE_KINDS = ("world", "sensors", "vehicle")
STACK_SECTIONS = (
    "localization", "tracking", "forecast", "height", "camera_tracking", "mapping", "clearance", "voronoi",
    "quiet", "route", "behavior", "slow", "fast", "baselines",
)  # fmt: skip
"""what a stack preset may set: nothing that a scenario, a sensor, the termination check or the observation's
columns depend on"""
LEARNING_SECTIONS = LearningConfig.model_fields.keys() - Config.model_fields.keys()
MAX_BYTES = 1 << 20
"""of a YAML file"""
_MAX_EXTENDS = 8
_MAX_SCALAR, _MAX_NODES = 1000, 50_000
"""characters of one value, values of one file: some of YAML's own readers take the square of a value's
length"""


Overrides = dict[str, Any] | list[str | tuple[str, Any]]
AnyConfig = TypeVar("AnyConfig", bound=Config)


class ConfigError(UserError, ValueError):
    """What is wrong, where, why, and what to type next."""


@dataclass
class _Layer:
    """One nested dict of settings, remembering where each dotted key was written."""

    tree: dict[str, Any] = field(default_factory=dict)
    origin: dict[str, str] = field(default_factory=dict)

    def merge(self, layer: _Layer) -> None:
        _merge(self.tree, layer.tree)
        self.origin.update(layer.origin)


def load_config(
    world: str = "pool",
    sensors: str | None = None,
    vehicle: str | None = None,
    overrides: Overrides | None = None,
) -> Config:
    """Config of a world (preset name or path) with a sensor and a vehicle preset on top, then overrides.

    ``overrides`` maps dotted keys to values, or lists (key, value) pairs and ``key.sub=value`` texts as typed
    on the command line; ``stack`` among them names a stack preset. Without ``sensors`` the world's own choice
    counts, else ``paper``. Raises ConfigError.
    """
    typed = _overrides(overrides or {})
    merged = _scene(world, sensors, vehicle)
    merged.merge(_stack_of(typed))
    merged.merge(typed)
    return validated(merged.tree, merged.origin)


def load_training(
    preset: str,
    overrides: Overrides | None = None,
    world: str | None = None,
    sensors: str | None = None,
    vehicle: str | None = None,
) -> LearningConfig:
    """Config of a training preset (name or path), then overrides as for ``load_config``; raises ConfigError.

    ``world``, ``sensors`` and ``vehicle`` replace the presets that the training preset names; what it changes
    in those sections stays.
    """
    layer = _read_preset("train", preset)
    named = {
        kind: layer.tree[kind].pop("preset", None)
        for kind in _SCENE_KINDS
        if isinstance(layer.tree.get(kind), dict)
    }
    for kind, name in named.items():
        if name is not None and not isinstance(name, str):
            raise ConfigError(
                f"{layer.origin.get(f'{kind}.preset', preset)}: {kind}.preset must be the name or path of a "
                f"{kind} preset, got {name!r}"
            )
    chosen_world = world or named.get("world") or DEFAULT_WORLD
    typed = _overrides(overrides or {})
    merged = _scene(chosen_world, sensors or named.get("sensors"), vehicle or named.get("vehicle"))
    own, asked = _stack_of(layer), _stack_of(typed)
    merged.merge(asked if asked.tree or "stack" in typed.origin else own)
    merged.merge(layer)
    merged.merge(typed)
    return _checked(LearningConfig, merged.tree, merged.origin)


def with_stack(any_cfg: AnyConfig, stack: str) -> AnyConfig:
    """The config with what a stack preset (name or path) states in place of its own. Raises ConfigError."""
    merged = _Layer(any_cfg.model_dump(mode="json"))
    merged.merge(_read_stack(stack))
    return _checked(type(any_cfg), merged.tree, merged.origin)


def tree_of_stack(stack: str) -> str:
    """Name of the tree that drives a stack (name or path of its preset). Raises ConfigError."""
    tree = _read_preset("stack", stack).tree.get("tree")
    if not isinstance(tree, str):
        raise ConfigError(
            f"{preset_path('stack', stack)}: needs 'tree:', the name of the behaviour tree that drives, for "
            "example tree: bt"
        )
    return tree


def _stack_of(layer: _Layer) -> _Layer:
    """What the stack preset says that a layer names, which loses the name; nothing where it names none."""
    name = layer.tree.pop("stack", None)
    if name is None:
        return _Layer()
    if not isinstance(name, str):
        raise ConfigError(
            f"{layer.origin.get('stack', 'stack')}: stack must be the name or path of a stack preset, got "
            f"{name!r}"
        )
    return _read_stack(name)


def _read_stack(name: str) -> _Layer:
    """Sections of a stack preset, without its tree."""
    layer = _read_preset("stack", name)
    layer.tree.pop("tree", None)
    for key in layer.tree.keys() - set(STACK_SECTIONS):
        raise ConfigError(
            f"{layer.origin[key]}: a stack cannot set '{key}'{renamed(key)}; it has "
            f"{', '.join(STACK_SECTIONS)} and tree"
        )
    return layer


def _scene(world: str, sensors: str | None, vehicle: str | None) -> _Layer:
    """A world with its sensors and its vehicle, the ones given before the ones that it names itself."""
    layer = _read_preset("world", world)
    named = {
        kind: layer.tree.pop(kind) for kind in ("sensors", "vehicle") if isinstance(layer.tree.get(kind), str)
    }
    merged = _read_preset("sensors", sensors or named.get("sensors", DEFAULT_SENSORS))
    if chosen := vehicle or named.get("vehicle"):
        merged.merge(_read_preset("vehicle", chosen))
    if sensors is not None:
        layer.tree.pop("sensors", None)
    merged.merge(layer)
    return merged


def preset_of(kind: str, world: str, given: str | None) -> str:
    """Name of the preset of sensors or of a vehicle that ``load_config`` takes: the one given, else the
    world's own, else ``paper`` or ``bluerov2``."""
    own = _read_preset("world", world).tree.get(kind)
    default = DEFAULT_SENSORS if kind == "sensors" else DEFAULT_VEHICLE
    return given or (own if isinstance(own, str) else default)


def validated(tree: dict[str, Any], origin: dict[str, str] | None = None) -> Config:
    """Config from a nested dict; ConfigError names the key, its origin, the reason and the nearest known
    name."""
    return _checked(Config, tree, origin or {})


def _checked(model: type[AnyConfig], tree: dict[str, Any], origin: dict[str, str]) -> AnyConfig:
    try:
        return model.model_validate_json(json.dumps(tree), strict=True)
    except ValidationError as error:
        raise ConfigError(_explained(error, origin, model)) from None
    except (TypeError, ValueError) as error:
        raise ConfigError(f"config: {error}; values are numbers, strings, lists and mappings") from None


def load_resolved(path: Path, overrides: Overrides | None = None) -> Config:
    """Config from a run folder's ``config.yaml`` (complete, no presets), then overrides; of a training run, a
    LearningConfig."""
    layer = _read_yaml(path, path.parent)
    typed = _overrides(overrides or {})
    layer.merge(_stack_of(typed))
    layer.merge(typed)
    return _checked(
        LearningConfig if LEARNING_SECTIONS & layer.tree.keys() else Config, layer.tree, layer.origin
    )


def to_yaml(config: Config) -> str:
    """Complete YAML of a config; ``load_resolved`` reads it back."""
    return dumped(config.model_dump(mode="json"))


def stated(path: Path) -> dict[str, Any]:
    """What the file of a preset says itself, as nested dicts, ``extends`` among it. Raises ConfigError."""
    return _read_yaml(path).tree


def base_of(path: Path) -> str | None:
    """The preset that this one extends; None for none, and for files that cannot extend any."""
    base = _read_yaml(path).tree.get("extends") if path.suffix in (".yaml", ".yml") else None
    return base if isinstance(base, str) else None


def dumped(tree: dict[str, Any]) -> str:
    """YAML of nested dicts."""
    return yaml.safe_dump(tree, sort_keys=False, width=120)


def preset_path(kind: str, name: str) -> Path:
    """File of a preset given by name or path; ConfigError lists the names there are."""
    suffix = ".xml" if kind == "tree" else ".yaml"
    if name.endswith((suffix, ".yml")) or "/" in name:
        path = Path(name)
        if not path.is_file():
            raise ConfigError(
                f"{kind} {name!r}: no such file; give a {suffix} file or one of: "
                f"{', '.join(preset_names(kind))}"
            )
        return path
    if name not in preset_names(kind):
        raise ConfigError(
            f"{kind} {name!r} is no preset{nearest(name, preset_names(kind))}; there are: "
            f"{', '.join(preset_names(kind))} (see 'uuv presets'), or give the path of a {suffix} file"
        )
    return built_in_file(kind, name)


def read_preset(kind: str, name: str) -> dict[str, Any]:
    """What a preset (name or path) and those that it extends say, as nested dicts. Raises ConfigError."""
    return _read_preset(kind, name).tree


def _read_preset(kind: str, name: str, depth: int = 0) -> _Layer:
    if depth > _MAX_EXTENDS:
        raise ConfigError(
            f"{kind} {name!r}: 'extends' is nested more than {_MAX_EXTENDS} deep; is it a circle?"
        )
    path = preset_path(kind, name)
    own = _read_yaml(path)
    _refuse_other_kind(kind, path, own)
    if kind == "train":
        _spell_out(own)
    world = own.tree.get("world")
    if isinstance(world, dict) and isinstance(drawn := world.get("occupancy"), dict):
        if isinstance(drawn.get("image"), str):
            drawn["image"] = str(path.parent / drawn["image"])
    base = own.tree.pop("extends", None)
    if base is None:
        return own
    if not isinstance(base, str):
        raise ConfigError(f"{path}: 'extends' must be the name or path of a {kind} preset, got {base!r}")
    beside = path.parent / base
    layer = _read_preset(kind, str(beside) if beside.is_file() else base, depth + 1)
    layer.merge(own)
    return layer


def _refuse_other_kind(kind: str, path: Path, layer: _Layer) -> None:
    """Raise ConfigError for a file that states nothing, or what another option takes."""
    if not layer.tree:
        raise ConfigError(f"{path}: is empty; a {kind} preset states sections, or what it extends")
    if kind not in _SCENE_KINDS or isinstance(layer.tree.get(kind), dict) or "extends" in layer.tree:
        return
    for other in _SCENE_KINDS:
        if isinstance(layer.tree.get(other), dict):
            raise ConfigError(
                f"{path}: is no {kind}, it has no '{kind}:', but a {other}: give it as --{other} {path}"
            )


def _spell_out(layer: _Layer) -> None:
    """``world: NAME`` as ``world: {preset: NAME}``: a preset that extends this one can change the section
    without losing the name."""
    for kind in _SCENE_KINDS:
        if isinstance(layer.tree.get(kind), str):
            layer.tree[kind] = {"preset": layer.tree[kind]}
            layer.origin[f"{kind}.preset"] = layer.origin[kind]


# ------------------------------------------------------------------------------------------------------- YAML


class _SafeLoader(yaml.SafeLoader):
    """Safe YAML that reads 3e-4 as a number and refuses aliases, duplicate keys and what no config is as long
    as."""

    nodes = 0

    def compose_node(self, parent, index):  # type: ignore[override]
        event = self.peek_event()
        self.nodes += 1
        if isinstance(event, yaml.events.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem="aliases (*name) are not allowed here", problem_mark=event.start_mark
            )
        if isinstance(event, yaml.events.ScalarEvent) and len(event.value) > _MAX_SCALAR:
            raise yaml.MarkedYAMLError(
                problem=f"a value of {len(event.value)} characters", problem_mark=event.start_mark
            )
        if self.nodes > _MAX_NODES:
            raise yaml.MarkedYAMLError(
                problem=f"more than {_MAX_NODES} values", problem_mark=event.start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node, deep=False):  # type: ignore[override]
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.MarkedYAMLError(
                    problem=f"key {key!r} is not a name", problem_mark=key_node.start_mark
                )
            if key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key!r} is given twice", problem_mark=key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_SafeLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+0123456789.")
)


def parsed_yaml(text: str, where: str) -> Any:
    """Python value of a YAML text; ConfigError names ``where`` and the line."""
    return _composed(text, where)[0]


def _composed(text: str, where: str) -> tuple[Any, yaml.Node | None]:
    """(value, node) of a YAML text; None for an empty one. ConfigError as ``parsed_yaml``."""
    if len(text) > MAX_BYTES:
        raise ConfigError(f"{where}: larger than 1 MiB; a config is a small text file")
    try:
        loader = _SafeLoader(text)
        node = loader.get_single_node()
        return (None, None) if node is None else (loader.construct_document(node), node)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f":{mark.line + 1}" if mark else ""
        raise ConfigError(f"{where}{line}: not valid YAML: {error.problem}; mend that line") from None
    except (yaml.YAMLError, RecursionError, ValueError, OverflowError) as error:
        raise ConfigError(f"{where}: not valid YAML: {error}") from None


def _read_yaml(path: Path, folder: Path | None = None) -> _Layer:
    look, small = "check the path and its permissions", "a config is a small YAML file"
    with refusing(ConfigError, f"{path}: cannot be read", look, small):
        text = read_text(path, MAX_BYTES, folder)
    found, node = _composed(text, str(path))
    tree = found or {}
    if not isinstance(tree, dict):
        raise ConfigError(
            f"{path}: must be a mapping of sections such as 'world:', got {type(tree).__name__}"
        )
    return _Layer(tree, dict(_lines(node, str(path), ())) if node is not None else {})


def _lines(node: yaml.Node, file: str, prefix: tuple[str, ...]):
    if isinstance(node, yaml.MappingNode):
        for key_node, value_node in node.value:
            dotted = (*prefix, str(key_node.value))
            yield ".".join(dotted), f"{file}:{key_node.start_mark.line + 1}"
            yield from _lines(value_node, file, dotted)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            dotted = (*prefix, str(index))
            yield ".".join(dotted), f"{file}:{item.start_mark.line + 1}"
            yield from _lines(item, file, dotted)


# -------------------------------------------------------------------------------------------------- overrides


def _overrides(overrides: Overrides) -> _Layer:
    layer = _Layer()
    given = overrides.items() if isinstance(overrides, dict) else overrides
    pairs = [_split(item) if isinstance(item, str) else item for item in given]
    for key, value in pairs:
        *parents, leaf = key.split(".")
        node = layer.tree
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise ConfigError(
                    f"--set {key}: '{parent}' was already set to a plain value; set its keys one by one"
                )
        node[leaf] = value
        layer.origin[key] = f"--set {key}"
    return layer


def _split(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set {text!r}: write key.sub=value, for example --set world.n_dynamic=9")
    return key.strip(), parsed_yaml(value, f"--set {key.strip()}")


def _merge(into: dict[str, Any], other: dict[str, Any]) -> None:
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = value


# --------------------------------------------------------------------------------------------------- messages


RENAMED = {
    "askew_clearance_m": "sideslip_clearance_m", "body_doubt": "obstacle_growth",
    "body_hidden": "obstacle_hidden", "body_returns_per_m": "obstacle_returns_per_m",
    "calm_s": "hysteresis_s", "distill": "distillation", "edge_sigmas": "place_sigmas",
    "elevation": "height", "features": "observation",
    "forecaster": "forecast_training", "gaze_clearance_m": "heading_clearance_m",
    "gaze_level_m": "heading_level_m", "gaze_m": "heading_range_m", "gaze_off_deg": "heading_off_deg",
    "heed_share": "evade_probability", "pose": "localization", "softness": "temperature",
    "spotting": "camera_tracking", "teacher": "behavior", "tuner": "parameter_search", "twin": "surrogate",
    "use_habits": "use_turn_history", "weight_body": "weight_obstacle",
}  # fmt: skip
"""old name of a section or key -> its name"""


def renamed(dotted: str) -> str:
    """What to add to the refusal of an old key: "; renamed to 'behavior.temperature'"."""
    found = ".".join(RENAMED.get(part, part) for part in dotted.split("."))
    return f"; renamed to '{found}'" if found != dotted else ""


_WITHIN = re.compile(r"Value error, ([a-z_]+(?:\.[a-z_0-9]+)*): (.+)", re.DOTALL)
_MOST_GOT = 200  # characters of a value that are shown


def _explained(error: ValidationError, origin: dict[str, str], model: type[BaseModel]) -> str:
    lines, is_strange = [], False
    for problem in error.errors():
        dotted = ".".join(str(part) for part in problem["loc"])
        where = _origin_of(dotted, origin)
        if problem["type"] == "extra_forbidden":
            if isinstance(given := problem["input"], dict) and given and renamed(dotted):
                dotted = f"{dotted}.{next(iter(given))}"
            like = renamed(dotted) or _alike(problem["loc"], model)
            lines.append(f"{where}unknown key '{dotted}'{like}")
            is_strange |= not like
        elif found := _WITHIN.match(problem["msg"]):  # a check of the whole names the part itself
            dotted = f"{dotted}.{found[1]}".lstrip(".")
            lines.append(f"{_origin_of(dotted, origin)}{dotted}: {found[2]}")
        else:
            got = repr(problem.get("input"))
            shown = got if len(got) <= _MOST_GOT else f"{got[:_MOST_GOT]} ..."
            where = where.removesuffix(f"{dotted}: ") + f"{dotted}: "  # an override says its key
            lines.append(f"{where}{problem['msg']} (got {shown})")
    lines.append("'uuv presets show NAME --all' prints every key with its value")
    if is_strange:
        lines[-1] += "; delete a key of an older version that is not among them"
    return "\n".join(lines)


def _origin_of(dotted: str, origin: dict[str, str]) -> str:
    inner = next((key for key in reversed(origin) if key.startswith(dotted + ".")), None)
    while dotted:
        if dotted in origin and not (inner and origin[inner].startswith("--set")):
            return f"{origin[dotted]}: "
        if inner:
            return f"{origin[inner]}: "
        dotted = dotted.rpartition(".")[0]
    return ""


def _alike(location: tuple[Any, ...], root: type[BaseModel]) -> str:
    """What an unknown key may have meant: one of this name in a section, one like it, or all of a section."""
    leaf, there = str(location[-1]), _siblings(location, root)
    told = [f"{name}.{leaf}" for name in root.model_fields if leaf in _siblings((name, leaf), root)]
    if not told and (found := nearest(leaf, there)):
        return found
    told = told or (there if len(location) > 1 and len(there) <= 16 else [])
    return f"; there are: {', '.join(told)}" if told else ""


def _siblings(location: tuple[Any, ...], root: type[BaseModel]) -> list[str]:
    model: Any = root
    for part in location[:-1]:
        model = (
            _inner_model(model.model_fields[part].annotation)
            if isinstance(part, str) and part in model.model_fields
            else model
        )
        if model is None:
            return []
    return list(model.model_fields)


def _inner_model(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) is not None:
        return next((found for arg in get_args(annotation) if (found := _inner_model(arg))), None)
    return None


def nearest(name: str, names: list[str]) -> str:
    """'; did you mean ...?' where a name is like one of those that there are, else nothing."""
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else ""
