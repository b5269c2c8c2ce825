"""Checkpoints: safetensors and a JSON manifest, whole or not at all, verified before anything is used;
opening one executes nothing.

``checkpoints/step_000050/`` holds ``manifest.json`` (what it is, for which observation and action, sha256 of
every file), ``model.safetensors`` (the networks with their normalisers: all that driving needs),
``training.safetensors`` (optimisers, generators, counters) and ``simulator.zst`` (the envs themselves, large,
so only beside the newest ones). The folder is written under another name, flushed to disk and renamed: a
process killed at any moment leaves the newest verified one usable.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import secrets
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import safetensors.torch
import torch
import zstandard
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError

from uuvtai.common.errors import UserError
from uuvtai.common.files import (
    FileError,
    flush,
    open_file,
    open_new,
    parsed_json,
    read_bytes,
    refuse_links,
    refuse_links_in,
)
from uuvtai.common.version import __version__
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import renamed

# ------------------------------------------------------------------------------------------------------------
# Nested state as named tensors and plain JSON, and back to the last bit; big arrays as one compressed stream
# of known size.


Layout = list[tuple[str, str, list[int]]]
"""(name, NumPy dtype, shape) of every array in a stream, in order"""

MAX_STREAM_BYTES = 1 << 40
"""[bytes] of a stream on disk, of which no more is read than its reader expects"""
_LEVEL = 1
"""of zstandard: higher ones save a few per cent of disk and take several times as long"""


class PackingError(UserError, ValueError):
    """Something that cannot be packed, or a packed state that does not fit together."""


def pack(state: Any, name: str = "state", copy: bool = True) -> tuple[Any, dict[str, torch.Tensor]]:
    """(plain, tensors): ``plain`` is JSON with references to ``tensors`` on the host, contiguous, by default
    copies apart from each other.

    Dictionaries, lists, tuples, tensors, NumPy arrays, numbers, texts, booleans and None are kept as they
    are; anything else is a PackingError that names the place.
    """
    tensors: dict[str, torch.Tensor] = {}
    return _packed(state, name, tensors, copy), tensors


def unpack(plain: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """The state that ``pack`` was given. Raises PackingError."""
    try:
        return _unpacked(plain, tensors)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise PackingError(f"the packed state does not fit together ({error!r})") from None


def _packed(node: Any, place: str, tensors: dict[str, torch.Tensor], copy: bool) -> Any:
    if isinstance(node, torch.Tensor | np.ndarray):
        if place in tensors:
            raise PackingError(f"{place}: two tensors have this name")
        is_array = isinstance(node, np.ndarray)
        tensor = torch.from_numpy(np.asarray(node, order="C")) if is_array else node.detach()
        tensors[place] = tensor.to("cpu", copy=copy).contiguous()
        return {"$array" if is_array else "$tensor": place}
    if isinstance(node, dict):
        if all(isinstance(key, str) and not key.startswith("$") for key in node):
            return {key: _packed(value, f"{place}.{key}", tensors, copy) for key, value in node.items()}
        return {
            "$items": [
                [_packed(key, place, tensors, copy), _packed(value, f"{place}.{key}", tensors, copy)]
                for key, value in node.items()
            ]
        }
    if isinstance(node, list | tuple):
        items = [_packed(value, f"{place}.{i}", tensors, copy) for i, value in enumerate(node)]
        return items if isinstance(node, list) else {"$tuple": items}
    if isinstance(node, float) and not math.isfinite(node):
        return {"$float": repr(float(node))}
    if node is None or type(node) in (bool, int, float, str):
        return node
    raise PackingError(f"{place}: a {type(node).__name__} cannot be kept in a checkpoint")


def _unpacked(node: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(node, list):
        return [_unpacked(value, tensors) for value in node]
    if not isinstance(node, dict):
        return node
    match list(node.items()):
        case [("$tensor", name)]:
            return tensors[name]
        case [("$array", name)]:
            return tensors[name].numpy()
        case [("$items", items)]:
            return {_unpacked(key, tensors): _unpacked(value, tensors) for key, value in items}
        case [("$tuple", items)]:
            return tuple(_unpacked(value, tensors) for value in items)
        case [("$float", text)]:
            return float(text)
        case items:
            return {key: _unpacked(value, tensors) for key, value in items}


# ---------------------------------------------------------------------------------------------------- streams


def layout_of(tensors: dict[str, torch.Tensor]) -> Layout:
    """Names, dtypes and shapes, in the order of ``tensors``."""
    return [(name, str(tensor.numpy().dtype), list(tensor.shape)) for name, tensor in tensors.items()]


def write_stream(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Compress host tensors one after the other into a new file."""
    size = sum(tensor.nbytes for tensor in tensors.values())
    compressor = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True)
    with open_new(path) as file, compressor.stream_writer(file, size=size, closefd=False) as stream:
        for tensor in tensors.values():
            stream.write(_bytes_of(tensor.numpy()))


def read_stream(path: Path, layout: Layout) -> dict[str, torch.Tensor]:
    """Read exactly what ``layout`` says, so that a file cannot unfold to more than its reader expects. Raises
    PackingError."""
    tensors = {}
    try:
        with (
            open_file(path, MAX_STREAM_BYTES, path.parent) as file,
            zstandard.ZstdDecompressor().stream_reader(file) as stream,
        ):
            for name, dtype, shape in layout:
                array = np.empty(shape, dtype)
                _fill(_bytes_of(array), stream, name)
                tensors[name] = torch.from_numpy(array)
            if stream.read(1):
                raise PackingError("holds more than its layout says")
    except zstandard.ZstdError as error:
        raise PackingError(f"is not a whole zstandard stream ({error})") from None
    return tensors


def _bytes_of(array: np.ndarray) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _fill(view: memoryview, stream: zstandard.ZstdDecompressionReader, name: str) -> None:
    filled = 0
    while filled < len(view):
        count = stream.readinto(view[filled:])
        if not count:
            raise PackingError(f"ends within {name}")
        filled += count


# ------------------------------------------------------------------------------------------------------------
# The manifest of a checkpoint: what it is, for which observation and action, and the sha256 of every file.
# Read without trust.


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
            f"{file}: {where}: {first['msg']}{renamed(where)}; it was not written by this version of uuvtai"
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


# ------------------------------------------------------------------------------------------------------------


MODEL_PARTS = ("policy", "world_model", "forecast", "tree")
"""parts of a trainer's state that go into model.safetensors"""
SIMULATOR_PART = "env"
"""part of a trainer's state that goes into simulator.zst"""

_KEEP_SIMULATORS = 2
"""newest checkpoints that keep the simulator's state: the last one, and one in case the disk damages it"""
_STEP, _PARTIAL = "step_", ".partial-"


@dataclass(frozen=True)
class Checkpoint:
    """A verified checkpoint."""

    path: Path
    manifest: Manifest
    config: LearningConfig
    sha256: str
    """of the manifest, which holds the sha256 of everything else"""

    @property
    def step(self) -> int:
        """Training iterations done."""
        return self.manifest.step

    @property
    def is_resumable(self) -> bool:
        """Everything that training needs to go on is there."""
        return all((self.path / name).is_file() for name in OPTIONAL)

    def model(self) -> dict[str, Any]:
        """State of the networks, by the names of MODEL_PARTS that were saved. Raises CheckpointError."""
        return self._part(MODEL, self.manifest.model)

    def training(self) -> dict[str, Any]:
        """What training needs beside the networks that drive and the simulator. Raises CheckpointError."""
        return self._part(TRAINING, self.manifest.training)

    def state(self, like: Mapping[str, Any]) -> dict[str, Any]:
        """The trainer's whole state. ``like`` is the state of the trainer it is meant for: a simulator of
        another size is refused."""
        if not self.is_resumable:
            raise CheckpointError(
                f"{self.path}: has networks only and cannot be trained on; resume the run's newest checkpoint"
            )
        state = self.model() | self.training()
        plain, expected = pack(like[SIMULATOR_PART], SIMULATOR_PART, copy=False)
        layout = self.manifest.simulator_layout
        if _structure(plain) != _structure(self.manifest.simulator) or layout != layout_of(expected):
            raise CheckpointError(
                f"{self.path}: the simulator's state has other arrays than this simulator; resume with the "
                "run's own config, number of envs and version of uuvtai"
            )
        with refused(self.path / SIMULATOR):
            state[SIMULATOR_PART] = unpack(
                self.manifest.simulator, read_stream(self.path / SIMULATOR, layout_of(expected))
            )
        return state

    def check_table(self, table: Sequence[DescribedColumn], config: Any) -> None:
        """Raise CheckpointError where an environment's observation or action is not what the policy was
        trained for."""
        for what, own, theirs in (
            ("observation", self.manifest.observation_table, table_rows(table)),
            ("action", self.manifest.action, action_rows(config)),
        ):
            if own != theirs:
                raise CheckpointError(
                    f"{self.path}: made for another {what} table: {difference(own, theirs)}"
                )

    def _part(self, name: str, plain: Any) -> dict[str, Any]:
        with refused(self.path / name):
            content = read_bytes(self.path / name, LARGEST[name], self.path)
            if hashlib.sha256(content).hexdigest() != self.manifest.files[name].sha256:
                raise PackingError("has changed since it was verified")
            return unpack(plain, safetensors.torch.load(content))


# ---------------------------------------------------------------------------------------------------- writing


def save(
    checkpoints: Path,
    step: int,
    state: Mapping[str, Any],
    config: LearningConfig,
    table: Sequence[DescribedColumn],
    metrics: Mapping[str, Any] | None = None,
    score: float | None = None,
) -> Path:
    """Write ``checkpoints/step_N`` and thin out older ones (newest ``train.keep_checkpoints`` and the best
    stay).

    ``state`` is what ``Trainer.state`` gives: MODEL_PARTS, SIMULATOR_PART and whatever else training needs,
    nested. ``score``: higher is better. Raises CheckpointError where the disk refuses; then nothing
    half-written is taken for a checkpoint.
    """
    target = checkpoints / f"{_STEP}{step:06d}"
    try:
        checkpoints.mkdir(parents=True, exist_ok=True)
        refuse_links(checkpoints.parent, checkpoints)  # what lies there is deleted one day
        refuse_links_in(checkpoints)
        sweep(checkpoints)
        partial = checkpoints / f"{_PARTIAL}{target.name}.{secrets.token_hex(4)}"
        partial.mkdir()
        described = _write_parts(partial, state)
        manifest = Manifest(
            version=__version__,
            created=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            step=step,
            score=score,
            metrics=finite(metrics or {}),
            config=config.model_dump(mode="json"),
            config_sha256=config_sha256(config.model_dump(mode="json")),
            observation_table=table_rows(table),
            action=action_rows(config),
            files={path.name: entry_of(path) for path in sorted(partial.iterdir())},
            **described,
        )
        _publish(partial, target, manifest)
        _thin(checkpoints, config.train.keep_checkpoints)
    except FileError as error:
        raise CheckpointError(str(error)) from None
    except OSError as error:
        sweep(checkpoints)
        raise CheckpointError(
            f"{target}: cannot be written ({error.strerror}); make room or mend the folder, then: --resume"
        ) from None
    return target


def sweep(checkpoints: Path) -> None:
    """Remove what a killed process left half-written or half-removed."""
    for left in checkpoints.glob(f"{_PARTIAL}*"):
        shutil.rmtree(left, ignore_errors=True)


def _write_parts(folder: Path, state: Mapping[str, Any]) -> dict[str, Any]:
    """Write the files of ``state``; what the manifest says of them."""
    model, tensors = pack({name: state[name] for name in MODEL_PARTS if state.get(name) is not None}, "")
    _write(folder / MODEL, safetensors.torch.save(_named(tensors)))
    rest = {name: part for name, part in state.items() if name not in (*MODEL_PARTS, SIMULATOR_PART)}
    training, tensors = pack(rest, "")
    _write(folder / TRAINING, safetensors.torch.save(_named(tensors)))
    described: dict[str, Any] = {"schema": SCHEMA, "model": model, "training": training}
    if SIMULATOR_PART in state:
        described["simulator"], tensors = pack(state[SIMULATOR_PART], SIMULATOR_PART, copy=False)
        described["simulator_layout"] = layout_of(tensors)
        write_stream(folder / SIMULATOR, tensors)
    return described


def _named(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return tensors or {"nothing": torch.zeros(0)}  # safetensors has no empty file


def _publish(partial: Path, target: Path, manifest: Manifest) -> None:
    """Flush everything to disk, then give the folder its name."""
    text = json.dumps(manifest.model_dump(mode="json", by_alias=True), indent=1, allow_nan=False)
    _write(partial / MANIFEST, text.encode())
    for path in partial.iterdir():
        flush(path)
    flush(partial)
    if target.exists():
        _remove(target)
    partial.rename(target)
    flush(target.parent)


def _thin(checkpoints: Path, keep: int) -> None:
    """Remove all but the newest ``keep`` and the best, and the simulator's state of all but the newest."""
    newest = _folders(checkpoints)
    for path in newest[_KEEP_SIMULATORS:]:
        (path / SIMULATOR).unlink(missing_ok=True)
    best = _best_folder(newest)
    for path in newest[keep:]:
        if path != best:
            _remove(path)


def _remove(folder: Path) -> None:
    """Under another name first: half a folder must never be taken for a checkpoint."""
    doomed = folder.with_name(f"{_PARTIAL}{folder.name}.old.{secrets.token_hex(4)}")
    folder.rename(doomed)
    shutil.rmtree(doomed)


def _write(path: Path, content: bytes) -> None:
    with open_new(path) as file:
        file.write(content)


def entry_of(path: Path) -> FileEntry:
    """Size and sha256 of a file."""
    return FileEntry(bytes=path.stat().st_size, sha256=sha256_of(path))


# ---------------------------------------------------------------------------------------------------- reading


def open_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint's manifest and verify every file. Raises CheckpointError."""
    content = manifest_content(path)
    with refused(path / MANIFEST):
        manifest = parsed(content)
        # keys that are younger than this config get their defaults, which mean what was done before there was
        # a choice
        config = LearningConfig.model_validate_json(json.dumps(manifest.config), strict=True)
        if config_sha256(manifest.config) != manifest.config_sha256:
            raise PackingError("its config does not have the sha256 that it states")
    for name in manifest.files:
        if name not in (MODEL, *OPTIONAL):
            raise CheckpointError(
                f"{path / MANIFEST}: lists the file {name!r}, which no checkpoint has; it was not written by "
                "uuvtai"
            )
    for name in (MODEL, *OPTIONAL):
        verify(path / name, manifest.files.get(name), name in OPTIONAL)
    return Checkpoint(path, manifest, config, hashlib.sha256(content).hexdigest())


def newest(
    run: Path, note: Callable[[str], None] = lambda _text: None, resumable: bool = False
) -> Checkpoint:
    """Newest checkpoint of a run folder that passes verification; ``note`` is told of newer ones that do not.
    Raises CheckpointError."""
    checkpoints, reasons = run / "checkpoints", list[str]()
    for path in _folders(checkpoints):
        try:
            found = _open_below(run, path)
            if not resumable or found.is_resumable:
                return found
            reasons.append(f"{path} has no simulator state to go on from")
        except CheckpointError as error:
            reasons.append(str(error))
        note(f"left out: {reasons[-1]}")
    why = f" ({reasons[0]})" if reasons else ""
    raise CheckpointError(f"{checkpoints}: holds no usable checkpoint{why}; give a run of 'uuv train'")


def best(run: Path, note: Callable[[str], None] = lambda _text: None) -> Checkpoint:
    """The checkpoint with the highest score, else the newest one. Raises CheckpointError."""
    found = _best_folder(_folders(run / "checkpoints"))
    if found is not None:
        try:
            return _open_below(run, found)
        except CheckpointError as error:
            note(f"left out: {error}")
    return newest(run, note)


def _open_below(run: Path, path: Path) -> Checkpoint:
    """As ``open_checkpoint``, of a run's own folder; a link to another one is none of its own."""
    with refused(path):
        refuse_links(run, path)
    return open_checkpoint(path)


def _folders(checkpoints: Path) -> list[Path]:
    """Folders that claim to be checkpoints, newest first."""
    found = [path for path in checkpoints.glob(f"{_STEP}*") if path.name.removeprefix(_STEP).isdecimal()]
    return sorted(found, key=lambda path: int(path.name.removeprefix(_STEP)), reverse=True)


def _best_folder(folders: list[Path]) -> Path | None:
    """Highest score, the newest of equals; None where nothing was scored."""
    scored = []
    for path in folders:
        with contextlib.suppress(UserError, ValueError, RecursionError):
            score = parsed(manifest_content(path)).score
            scored += [] if score is None else [(score, path)]
    return max(scored, key=lambda pair: pair[0])[1] if scored else None


def _structure(plain: Any) -> str:
    return json.dumps(plain, sort_keys=True)
