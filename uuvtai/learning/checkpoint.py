"""Checkpoints: safetensors and a JSON manifest, whole or not at all, verified before anything is used;
opening one executes nothing.

``checkpoints/step_000050/`` holds ``manifest.json`` (what it is, for which observation and action, sha256 of
every file), ``model.safetensors`` (the networks with their normalisers: all that driving needs),
``training.safetensors`` (optimisers, generators, counters) and ``simulator.zst`` (the envs themselves, large,
so only beside the newest ones). The folder is written under another name, flushed to disk and renamed: a
process killed at any moment leaves the newest verified one usable."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import safetensors.torch
import torch
import zstandard
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError
from torch import Tensor

from uuvtai.common import files
from uuvtai.common.errors import ODD, UserError
from uuvtai.common.files import FileError, open_file, open_new, parsed_json, read_bytes
from uuvtai.common.presets import POLICY, PRESET_DIR
from uuvtai.common.version import __version__
from uuvtai.config import Config
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import load_training, renamed


class CheckpointError(UserError, RuntimeError):
    """A checkpoint that cannot be used or written: what, where, why, what to type next."""


def pack(state: Any, name: str = "state") -> tuple[Any, dict[str, Tensor]]:
    """Nested state as (plain, tensors): JSON with references to host tensors, back to the last bit by
    ``unpack``. CheckpointError, naming the place, for what can be neither."""
    tensors: dict[str, Tensor] = {}

    def packed(node: Any, place: str) -> Any:
        if isinstance(node, Tensor | np.ndarray):
            if place in tensors:
                raise CheckpointError(f"{place}: two tensors have this name")
            is_array = isinstance(node, np.ndarray)
            tensor = torch.from_numpy(np.asarray(node, order="C")) if is_array else node.detach()
            tensors[place] = tensor.cpu().contiguous()
            return {"$array" if is_array else "$tensor": place}
        if isinstance(node, dict):
            items = [[packed(key, place), packed(value, f"{place}.{key}")] for key, value in node.items()]
            is_plain = all(isinstance(key, str) and not key.startswith("$") for key in node)
            return dict(items) if is_plain else {"$items": items}
        if isinstance(node, list | tuple):
            values = [packed(value, f"{place}.{i}") for i, value in enumerate(node)]
            return values if isinstance(node, list) else {"$tuple": values}
        if isinstance(node, float) and not math.isfinite(node):
            return {"$float": repr(float(node))}
        if node is None or type(node) in (bool, int, float, str):
            return node
        raise CheckpointError(f"{place}: a {type(node).__name__} cannot be kept in a checkpoint")

    return packed(state, name), tensors


def unpack(plain: Any, tensors: dict[str, Tensor]) -> Any:
    """The state that ``pack`` was given. Raises FileError."""

    def unpacked(node: dict[str, Any]) -> Any:
        match list(node.items()):
            case [("$tensor", name)]:
                return tensors[name]
            case [("$array", name)]:
                return tensors[name].numpy()
            case [("$items", items)]:
                return dict(items)
            case [("$tuple", values)]:
                return tuple(values)
            case [("$float", text)]:
                return float(text)
        return node

    try:
        return json.loads(json.dumps(plain), object_hook=unpacked)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise FileError(f"the packed state does not fit together ({error!r})") from None


def write_stream(path: Path, tensors: dict[str, Tensor]) -> None:
    """Compress host tensors one after the other into a new file."""
    size = sum(tensor.nbytes for tensor in tensors.values())
    compressor = zstandard.ZstdCompressor(level=1, write_checksum=True)  # higher ones: hardly smaller, slow
    with open_new(path) as file, compressor.stream_writer(file, size=size, closefd=False) as stream:
        for tensor in tensors.values():
            stream.write(tensor.numpy().tobytes())


def read_stream(path: Path, like: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors as they are in ``like``: a file cannot unfold to more than expected. Raises FileError."""
    found = {}
    try:
        with open_file(path, LARGEST[SIMULATOR], path.parent) as file:
            stream = zstandard.ZstdDecompressor().stream_reader(file)
            for name, tensor in like.items():
                content = stream.read(tensor.nbytes)
                if len(content) < tensor.nbytes:
                    raise FileError(f"ends within {name}")
                array = np.frombuffer(content, tensor.numpy().dtype).reshape(tensor.shape)
                found[name] = torch.from_numpy(array.copy())
            if stream.read(1):
                raise FileError("holds more than its layout says")
    except zstandard.ZstdError as error:
        raise FileError(f"is not a whole zstandard stream ({error})") from None
    return found


def layout_of(tensors: dict[str, Tensor]) -> list[tuple[str, str, list[int]]]:
    """(name, NumPy dtype, shape) of every tensor, in the order of a stream."""
    return [(name, str(tensor.numpy().dtype), list(tensor.shape)) for name, tensor in tensors.items()]


# ------------------------------------------------------------------------------------------------------------
# The manifest, read without trust.


SCHEMA = 1
READABLE_VERSIONS = ("0.1",)
"""uuvtai's series whose checkpoints mean the same to this one: same networks, same columns, same units"""

MANIFEST = "manifest.json"
MODEL, TRAINING, SIMULATOR = "model.safetensors", "training.safetensors", "simulator.zst"
LARGEST = {MODEL: 256 << 20, TRAINING: 512 << 20, SIMULATOR: 8 << 30}
"""[bytes] of a file; a policy drives by the first one alone"""
_MAX_BYTES, _CHUNK_BYTES = 8 << 20, 1 << 20  # of a manifest; of a file at once


class FileEntry(BaseModel):
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


def manifest_content(path: Path) -> bytes:
    """Bytes of a checkpoint folder's manifest. Raises CheckpointError."""
    file = path / MANIFEST
    if not path.is_dir():
        raise CheckpointError(f"{path}: no such folder; give a run folder or one of its checkpoints/step_N")
    if not file.is_file():
        raise CheckpointError(f"{file}: is missing; the folder is no checkpoint, or its writing was cut off")
    with refused(file):
        return read_bytes(file, _MAX_BYTES, path)


def parsed(content: bytes) -> Manifest:
    """Raises FileError for another schema or version before all else, ValueError for nonsense."""
    try:
        raw = parsed_json(content, MANIFEST)
    except FileError as error:
        raise ValueError(str(error)) from None
    if not isinstance(raw, dict) or "schema" not in raw:
        raise FileError("is not a manifest of uuvtai")
    version = str(raw.get("version"))
    if raw["schema"] != SCHEMA:
        raise FileError(f"has schema {raw['schema']!r}, this uuvtai reads {SCHEMA}; use version {version}")
    if version.rpartition(".")[0] not in READABLE_VERSIONS:
        raise FileError(f"was written by uuvtai {version}, this is {__version__}; use that version")
    return Manifest.model_validate_json(content)


def entry_of(file: Path) -> FileEntry:
    """Size and sha256 of a file of a checkpoint. Raises FileError, OSError."""
    digest = hashlib.sha256()
    with open_file(file, LARGEST[file.name], file.parent) as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            digest.update(chunk)
        return FileEntry(bytes=stream.tell(), sha256=digest.hexdigest())


def _verify(file: Path, entry: FileEntry | None) -> None:
    """Raise CheckpointError where a file is not what the manifest says of it."""
    other = "take another checkpoint of the run"
    if not file.is_symlink() and not file.is_file():
        if file.name == MODEL:
            raise CheckpointError(f"{file}: is missing; {other}")
        return
    if entry is None:
        raise CheckpointError(f"{file}: is not listed in {MANIFEST}; {other}")
    with refused(file):
        found = entry_of(file)
        if found.bytes != entry.bytes:
            raise FileError(f"has {found.bytes} bytes instead of {entry.bytes}, it was cut off; {other}")
        if found != entry:
            raise FileError(f"is damaged, its sha256 is not that of {MANIFEST}; {other}")


@contextlib.contextmanager
def refused(file: Path, what: str = "cannot be read") -> Iterator[None]:
    """Turn everything that bad content can raise into a CheckpointError that names the file."""
    try:
        yield
    except SafetensorError as error:
        told = f"is not a safetensors file ({error}); pickles and other formats are never opened"
        raise CheckpointError(f"{file}: {told}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        told = f"{first['msg']}{renamed(where)}; it was not written by this version of uuvtai"
        raise CheckpointError(f"{file}: {where}: {told}") from None
    except FileError as error:
        raise CheckpointError(f"{file}: {str(error).removeprefix(f'{file}: ')}") from None
    except (*ODD, OSError) as error:
        raise CheckpointError(f"{file}: {what} ({error}); take another checkpoint") from None


def table_rows(table: Sequence[Any]) -> list[dict[str, Any]]:
    """An observation table (rows of ``ObservationColumn``) as the manifest keeps it."""
    return [
        {"name": c.name, "first": c.slice.start, "stop": c.slice.stop, "unit": c.unit, "frame": c.frame}
        for c in table
    ]


def action_rows(config: Config) -> list[dict[str, Any]]:
    """What an action of 1 means, for every component: the vehicle's limits."""
    v = config.vehicle
    speeds = {"surge": v.max_surge_m_s, "sway": v.max_sway_m_s, "heave": v.max_heave_m_s}
    rows = [{"name": name, "limit": limit, "unit": "m/s"} for name, limit in speeds.items()]
    return [*rows, {"name": "yaw_rate", "limit": v.max_yaw_rate_rad_s, "unit": "rad/s"}]


def config_sha256(config: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()


def finite(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Metrics as JSON can hold them: NaN and infinity become None."""
    return {n: None if isinstance(x, float) and not math.isfinite(x) else x for n, x in metrics.items()}


MODEL_PARTS, SIMULATOR_PART = ("policy", "world_model", "forecast", "tree"), "env"
"""parts of a trainer's state that go into model.safetensors and into simulator.zst"""
_KEEP_SIMULATORS = 2
"""newest checkpoints that keep the simulator's state: the last one, and one in case the disk damages it"""
_STEP = "step_"
Note = Callable[[str], None]


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
        return all((self.path / name).is_file() for name in LARGEST)

    def model(self) -> dict[str, Any]:
        """State of the networks, by name. Raises CheckpointError."""
        return self._part(MODEL, self.manifest.model)

    def state(self, like: Mapping[str, Any]) -> dict[str, Any]:
        """The whole state, for a trainer whose own is ``like``: a simulator of another size is refused."""
        if not self.is_resumable:
            raise CheckpointError(f"{self.path}: has networks only; resume the run's newest checkpoint")
        plain, expected = pack(like[SIMULATOR_PART], SIMULATOR_PART)
        own = self.manifest.simulator, self.manifest.simulator_layout
        if own != (plain, layout_of(expected)):
            with_own = "resume with the run's own config, number of envs and version of uuvtai"
            raise CheckpointError(f"{self.path}: holds other arrays than this simulator; {with_own}")
        with refused(self.path / SIMULATOR):
            simulator = unpack(plain, read_stream(self.path / SIMULATOR, expected))
        training = self._part(TRAINING, self.manifest.training)
        return self.model() | training | {SIMULATOR_PART: simulator}

    def check_table(self, table: Sequence[Any], config: Config) -> None:
        """Raise CheckpointError where an environment's observation or action is another one."""
        of, action = self.manifest, action_rows(config)
        pairs = ("observation", of.observation_table, table_rows(table)), ("action", of.action, action)
        for what, own, theirs in pairs:
            if own != theirs:
                different = (pair for pair in zip(own, theirs, strict=False) if pair[0] != pair[1])
                mine, other = next(different, (f"{len(own)} rows", len(theirs)))
                told = f"it expects {mine}, this environment gives {other}; take the config of its training"
                raise CheckpointError(f"{self.path}: made for another {what} table: {told}")

    def _part(self, name: str, plain: Any) -> dict[str, Any]:
        with refused(self.path / name):
            content = read_bytes(self.path / name, LARGEST[name], self.path)
            if hashlib.sha256(content).hexdigest() != self.manifest.files[name].sha256:
                raise FileError("has changed since it was verified")
            return unpack(plain, safetensors.torch.load(content))


def save(
    checkpoints: Path,
    step: int,
    state: Mapping[str, Any],
    config: LearningConfig,
    table: Sequence[Any],
    metrics: Mapping[str, Any] | None = None,
    score: float | None = None,
) -> Path:
    """Write ``checkpoints/step_N`` of what ``Trainer.state`` gives, and thin out older ones (the newest
    ``train.keep_checkpoints`` and that of the highest ``score`` stay). Raises CheckpointError where the disk
    refuses; then nothing half-written is taken for a checkpoint."""
    target, plain = checkpoints / f"{_STEP}{step:06d}", config.model_dump(mode="json")
    mend = "make room or mend the folder; then --resume, or begin anew if this was the first checkpoint"
    with files.refusing(CheckpointError, f"{target}: cannot be written", mend, ""):
        checkpoints.mkdir(parents=True, exist_ok=True)
        files.refuse_links(checkpoints.parent, checkpoints)  # what lies there is deleted one day
        files.refuse_links_in(checkpoints)
        for left in checkpoints.glob(f".{_STEP}*.tmp"):  # by a process that was killed
            shutil.rmtree(left, ignore_errors=True)
        with files.whole_folder(target) as partial:
            described = _write_parts(partial, state)
            manifest = Manifest(
                schema=SCHEMA,
                version=__version__,
                created=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
                step=step,
                score=score,
                metrics=finite(metrics or {}),
                config=plain,
                config_sha256=config_sha256(plain),
                observation_table=table_rows(table),
                action=action_rows(config),
                files={path.name: entry_of(path) for path in sorted(partial.iterdir())},
                **described,
            )
            text = json.dumps(manifest.model_dump(mode="json", by_alias=True), indent=1, allow_nan=False)
            (partial / MANIFEST).write_text(text, encoding="utf-8")
            for path in (*partial.iterdir(), partial):
                files.flush(path)
            if target.exists():
                _remove(target)
        files.flush(checkpoints)
        _thin(checkpoints, config.train.keep_checkpoints)
    return target


def _write_parts(folder: Path, state: Mapping[str, Any]) -> dict[str, Any]:
    """What the manifest says of the files."""
    model = {name: state[name] for name in MODEL_PARTS if state.get(name) is not None}
    training = {name: part for name, part in state.items() if name not in (*MODEL_PARTS, SIMULATOR_PART)}
    described = {}
    for name, file, part in (("model", MODEL, model), ("training", TRAINING, training)):
        described[name], tensors = pack(part, "")
        arrays = {place: tensor.numpy() for place, tensor in tensors.items()}
        (folder / file).write_bytes(safetensors.numpy.save(arrays))
    described["simulator"], tensors = pack(state[SIMULATOR_PART], SIMULATOR_PART)
    write_stream(folder / SIMULATOR, tensors)
    return described | {"simulator_layout": layout_of(tensors)}


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
    doomed = folder.rename(files.unfinished(folder))
    shutil.rmtree(doomed)


def open_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint's manifest and verify every file. Raises CheckpointError."""
    content = manifest_content(path)
    with refused(path / MANIFEST):
        manifest = parsed(content)
        # younger keys get their defaults, which mean what was done before there was a choice
        config = LearningConfig.model_validate_json(json.dumps(manifest.config), strict=True)
        if config_sha256(manifest.config) != manifest.config_sha256:
            raise FileError("its config does not have the sha256 that it states")
    if unknown := manifest.files.keys() - LARGEST:
        raise CheckpointError(f"{path / MANIFEST}: lists {min(unknown)!r}, which no checkpoint has")
    for name in LARGEST:
        _verify(path / name, manifest.files.get(name))
    return Checkpoint(path, manifest, config, hashlib.sha256(content).hexdigest())


def built_in() -> Checkpoint:
    """The policy of the package: one file, the manifest inside, with today's config of its preset."""
    path = PRESET_DIR / POLICY
    with refused(path / MODEL):
        content = read_bytes(path / MODEL, LARGEST[MODEL], path)
        header = parsed_json(content[8 : 8 + int.from_bytes(content[:8], "little")], MODEL)
        manifest = parsed(header["__metadata__"]["manifest"].encode())
        manifest.files = {MODEL: entry_of(path / MODEL)}
    return Checkpoint(path, manifest, load_training(POLICY), manifest.files[MODEL].sha256)


def newest(
    run: Path, note: Note = lambda _text: None, resumable: bool = False, first: Path | None = None
) -> Checkpoint:
    """Newest checkpoint of a run folder that passes verification, ``first`` looked at before all others;
    ``note`` is told of those that do not pass. Raises CheckpointError."""
    checkpoints, reasons = run / "checkpoints", list[str]()
    for path in sorted(_folders(checkpoints), key=lambda path: path != first):
        try:
            with refused(path):
                files.refuse_links(run, path)  # to another folder, which is none of the run's own
            found = open_checkpoint(path)
            if not resumable or found.is_resumable:
                return found
            reasons.append(f"{path} has no simulator state to go on from")
        except CheckpointError as error:
            reasons.append(str(error))
        note(f"left out: {reasons[-1]}")
    why = f" ({reasons[0]})" if reasons else ""
    raise CheckpointError(f"{checkpoints}: holds no usable checkpoint{why}; give another run, or begin anew")


def best(run: Path, note: Note = lambda _text: None) -> Checkpoint:
    """The checkpoint with the highest score, else the newest one. Raises CheckpointError."""
    return newest(run, note, first=_best_folder(_folders(run / "checkpoints")))


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
