"""The manifest of a checkpoint: what it is, for which observation and action, and the sha256 of every file.
Read without trust."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError

from uuvtai.errors import UserError
from uuvtai.files import FileError, open_file, parsed_json, read_bytes
from uuvtai.learn.packing import PackingError
from uuvtai.version import __version__

SCHEMA = 1
"""of the folder; another one is refused"""
READABLE_VERSIONS = ("0.1",)
"""uuvtai's series whose checkpoints mean the same to this one: same networks, same columns, same units"""

MANIFEST, MODEL, TRAINING, SIMULATOR = (
    "manifest.json",
    "model.safetensors",
    "training.safetensors",
    "simulator.zst",
)
OPTIONAL = (TRAINING, SIMULATOR)
"""files that a policy drives without"""
_MAX_BYTES = 8 << 20
LARGEST = {MODEL: 256 << 20, TRAINING: 512 << 20, SIMULATOR: 8 << 30}
"""[bytes] most that a file may have; the first two are read into memory, the last one as far as its reader
expects"""
_CHUNK_BYTES = 1 << 20


class CheckpointError(UserError, RuntimeError):
    """A checkpoint that cannot be used or written: what, where, why, what to type next."""


class DescribedColumn(Protocol):
    """A row of the observation table (``env.ObservationColumn``)."""

    @property
    def name(self) -> str: ...
    @property
    def slice(self) -> slice: ...
    @property
    def unit(self) -> str: ...
    @property
    def frame(self) -> str: ...


class FileEntry(BaseModel):
    """Size and content of one file."""

    model_config = ConfigDict(extra="forbid", strict=True)
    bytes: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class Manifest(BaseModel):
    """What ``manifest.json`` says."""

    model_config = ConfigDict(extra="forbid", strict=True, populate_by_name=True)

    schema_number: int = Field(alias="schema")
    version: str
    created: str
    step: int = Field(ge=0)
    """training iterations done"""
    score: float | None
    """of the evaluation at this step; None = there was none"""
    metrics: dict[str, float | int | str | None]
    config: dict[str, Any]
    config_sha256: str
    observation_table: list[dict[str, Any]]
    action: list[dict[str, Any]]
    files: dict[str, FileEntry]
    model: Any
    training: Any = None
    simulator: Any = None
    simulator_layout: list[tuple[str, str, list[int]]] | None = None


# -------------------------------------------------------------------------------------- reading without trust


def manifest_content(path: Path) -> bytes:
    """Bytes of a checkpoint folder's manifest. Raises CheckpointError."""
    file = path / MANIFEST
    if not path.is_dir():
        raise CheckpointError(f"{path}: no such folder; give a run folder or one of its checkpoints/step_N")
    if file.is_symlink() or not file.is_file():
        raise CheckpointError(f"{file}: is missing; the folder is no checkpoint, or its writing was cut off")
    with refused(file):
        return read_bytes(file, _MAX_BYTES, path)


def parsed(content: bytes) -> Manifest:
    """The manifest itself. Raises PackingError for another schema or version before anything else is looked
    at, ValueError for nonsense."""
    try:
        raw = parsed_json(content, MANIFEST)
    except FileError as error:
        raise ValueError(str(error)) from None
    if not isinstance(raw, dict) or "schema" not in raw:
        raise PackingError("is not a manifest of uuvtai")
    if raw["schema"] != SCHEMA:
        raise PackingError(
            f"has schema {raw['schema']!r}, this uuvtai reads {SCHEMA}; use the version that wrote it: "
            f"{raw.get('version')}"
        )
    version = str(raw.get("version"))
    if version.rpartition(".")[0] not in READABLE_VERSIONS:
        raise PackingError(
            f"was written by uuvtai {version}, this is {__version__}; use that version, or train again"
        )
    return Manifest.model_validate_json(content)


def verify(file: Path, entry: FileEntry | None, is_optional: bool) -> None:
    """Raise CheckpointError where a file is not what the manifest says of it."""
    if file.is_symlink():
        raise CheckpointError(f"{file}: is a link; a checkpoint holds plain files only")
    if not file.is_file():
        if is_optional:
            return
        raise CheckpointError(f"{file}: is missing; take another checkpoint of the run")
    if entry is None:
        raise CheckpointError(f"{file}: is not listed in {MANIFEST}; take another checkpoint of the run")
    size, most = file.stat().st_size, LARGEST[file.name]
    if size > most:
        raise CheckpointError(f"{file}: has {size:,} bytes, more than the {most:,} that such a file may have")
    if size != entry.bytes:
        raise CheckpointError(
            f"{file}: has {size} bytes instead of {entry.bytes}, it was cut off; take another checkpoint of "
            "the run"
        )
    if sha256_of(file) != entry.sha256:
        raise CheckpointError(
            f"{file}: is damaged, its sha256 is not that of {MANIFEST}; take another checkpoint of the run"
        )


@contextlib.contextmanager
def refused(file: Path) -> Iterator[None]:
    """Turn everything that bad content can raise into a CheckpointError that names the file."""
    try:
        yield
    except SafetensorError as error:
        raise CheckpointError(
            f"{file}: is not a safetensors file ({error}); pickles and other formats are never opened"
        ) from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise CheckpointError(
            f"{file}: {where}: {first['msg']}; it was not written by this version of uuvtai"
        ) from None
    except (PackingError, FileError) as error:
        raise CheckpointError(f"{file}: {str(error).removeprefix(f'{file}: ')}") from None
    except (ValueError, RecursionError, OSError) as error:
        raise CheckpointError(
            f"{file}: cannot be read ({error}); take another checkpoint of the run"
        ) from None


# ----------------------------------------------------------------------------------------------------- tables


def table_rows(table: Sequence[DescribedColumn]) -> list[dict[str, Any]]:
    """An observation table as the manifest keeps it."""
    return [
        {"name": c.name, "first": c.slice.start, "stop": c.slice.stop, "unit": c.unit, "frame": c.frame}
        for c in table
    ]


def action_rows(config: Any) -> list[dict[str, Any]]:
    """What an action of 1 means, for every component: the vehicle's limits."""
    v = config.vehicle
    limits = (
        ("surge", v.max_surge_m_s),
        ("sway", v.max_sway_m_s),
        ("heave", v.max_heave_m_s),
        ("yaw_rate", v.max_yaw_rate_rad_s),
    )
    return [
        {"name": name, "limit": limit, "unit": "rad/s" if name == "yaw_rate" else "m/s"}
        for name, limit in limits
    ]


def config_sha256(config: dict[str, Any]) -> str:
    """Of a config's values as canonical JSON."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()


def difference(own: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> str:
    """First place where two tables differ, in words."""
    for mine, other in zip(own, theirs, strict=False):
        if mine != other:
            return (
                f"it expects {mine}, this environment gives {other}; evaluate it with the config it was "
                "trained with"
            )
    return (
        f"it expects {len(own)} rows, this environment gives {len(theirs)}; evaluate it with the config "
        "it was trained with"
    )


def finite(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Metrics as JSON can hold them: NaN and infinity become None."""
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in metrics.items()
    }


def sha256_of(file: Path) -> str:
    """Of a file's content, hexadecimal."""
    digest = hashlib.sha256()
    with open_file(file, LARGEST[SIMULATOR], file.parent) as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()
