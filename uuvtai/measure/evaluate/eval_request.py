"""What ``uuv eval`` was asked for, as an object and as the file from which an interrupted evaluation goes
on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uuvtai.config import Config
from uuvtai.files import read_text
from uuvtai.loader import ConfigError, preset_of, read_preset, validated
from uuvtai.own.piece_spec import is_piece, piece_spec
from uuvtai.run_folder import RunFolderError

if TYPE_CHECKING:
    from uuvtai.measure.episodes.methods import Method
    from uuvtai.scene_options import SceneOptions

FILE = "eval/request.json"
ORACLE = "oracle"
"""controller that is asked, not driven: the privileged upper bound"""

_MAX_BYTES = 1 << 22
_GIVE = "give the folder that an interrupted 'uuv eval' printed"


@dataclass(frozen=True)
class Request:
    """What ``uuv eval`` was asked for."""

    config: Config
    world: str
    sensors: str
    controllers: list[str]
    """names of trees or stacks, paths of XML or YAML files, each perhaps with ``+truth``; ``oracle``; pieces
    of the user's (``own.piece_spec``)"""
    seeds: list[int]
    episodes: int
    vehicle: str = ""
    """name of its preset; of old requests ''"""
    policies: tuple[str, ...] = ()
    """run folders or checkpoint folders"""
    num_envs: int | None = None
    record: int = 0
    video: bool = False
    depth_images: bool = False
    explain: bool = False
    explain_record: int = 3
    device: str = "auto"
    run_dir: Path | None = None

    @classmethod
    def typed(cls, scene: SceneOptions, policies: list[str], **rest: Any) -> Request:
        """What a command line asks for: the scene as it was typed, observed as the policies were trained.
        Raises ConfigError, CheckpointError."""
        from uuvtai.measure.episodes.methods import features_of

        config = scene.config(features_of(policies) if policies else [])
        world = scene.world_name
        named = {kind: preset_of(kind, world, getattr(scene, kind)) for kind in ("sensors", "vehicle")}
        return cls(config=config, world=world, **named, policies=tuple(policies), **rest)


class _Document(BaseModel):
    """The file, checked."""

    model_config = ConfigDict(strict=True, extra="forbid")

    schema_: int = Field(alias="schema", ge=1, le=1)
    config: dict[str, Any]
    world: str
    sensors: str
    vehicle: str = ""
    controllers: list[str]
    seeds: list[int] = Field(min_length=1)
    episodes: int = Field(ge=1)
    policies: list[str]
    num_envs: int = Field(ge=1)
    record: int = Field(ge=0)
    video: bool
    depth_images: bool
    explain: bool
    explain_record: int = Field(ge=0)
    device: str
    cwd: str
    drivers: dict[str, str]


def document_of(request: Request, num_envs: int, device: str, drivers: dict[str, str]) -> dict[str, Any]:
    """The request with what was chosen for it, as JSON; ``drivers``: sha256 of what drives, by method."""
    document = {
        field.name: getattr(request, field.name)
        for field in dataclasses.fields(request)
        if field.name not in ("config", "run_dir")
    }
    document |= {"policies": list(request.policies), "num_envs": num_envs, "device": device}
    return {
        "schema": 1,
        **document,
        "config": request.config.model_dump(mode="json"),
        "cwd": os.getcwd(),
        "drivers": drivers,
    }


def read_request(place: Path) -> tuple[Request, dict[str, str]]:
    """The request of a run folder, and the sha256 of what drove by method. Raises RunFolderError,
    FileError."""
    file = place / FILE
    try:
        found = _Document.model_validate_json(read_text(file, _MAX_BYTES, place))
        config = validated(found.config)
    except OSError as error:
        raise RunFolderError(f"{file}: cannot be read ({error.strerror}); {_GIVE}") from None
    except (ValidationError, ConfigError) as error:
        reason = (
            error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error).splitlines()[0]
        )
        raise RunFolderError(
            f"{file}: is no request of this version of 'uuv eval' ({reason}); {_GIVE}"
        ) from None
    given = found.model_dump(exclude={"schema_", "config", "cwd", "drivers"})
    request = Request(config=config, **given)
    return _found_again(replace(request, policies=tuple(found.policies)), Path(found.cwd)), found.drivers


def _found_again(request: Request, cwd: Path) -> Request:
    """Paths that were typed in another folder, seen from this one; names of what is shipped stay names."""

    def seen(name: str) -> str:
        file = name.removesuffix("+truth")
        return name if Path(file).exists() else str(cwd / name)

    def seen_driver(name: str) -> str:
        if is_piece(name):
            return piece_spec(name).located(cwd).text
        return seen(name) if name.removesuffix("+truth").endswith((".xml", ".yaml", ".yml")) else name

    controllers = [seen_driver(name) for name in request.controllers]
    return replace(request, controllers=controllers, policies=tuple(map(seen, request.policies)))


def drivers_of(methods: list[Method]) -> dict[str, str]:
    """sha256 of what drives, by method: of a policy's checkpoint, of a tree as it is played, with its stack,
    of the file of a piece of the user's."""
    return {
        method.name: method.own.sha256
        if method.own
        else method.checkpoint.sha256
        if method.checkpoint
        else _tree_sha256(method)
        for method in methods
    }


def refuse_others(place: Path, before: dict[str, str], now: dict[str, str]) -> None:
    """RunFolderError where another tree or policy has a method's name by now: episodes of both under one name
    would prove nothing."""
    changed = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if changed:
        what = ", ".join(changed)
        raise RunFolderError(
            f"{place}: {what} has changed since this evaluation began; begin a new one with another --run-dir"
        )


def _tree_sha256(method: Method) -> str:
    tree = dataclasses.asdict(method.tree)
    del tree["source"], tree["xml"]
    stack = [] if method.stack is None else [read_preset("stack", method.stack)]
    return hashlib.sha256(json.dumps([tree, method.privileged, *stack]).encode()).hexdigest()
