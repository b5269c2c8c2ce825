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
import secrets
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from uuvtai.config.learning import LearningConfig
from uuvtai.errors import UserError
from uuvtai.files import FileError, flush, open_new, read_bytes, refuse_links, refuse_links_in
from uuvtai.learn.manifest import (
    LARGEST,
    MANIFEST,
    MODEL,
    OPTIONAL,
    SCHEMA,
    SIMULATOR,
    TRAINING,
    CheckpointError,
    DescribedColumn,
    FileEntry,
    Manifest,
    action_rows,
    config_sha256,
    difference,
    finite,
    manifest_content,
    parsed,
    refused,
    sha256_of,
    table_rows,
    verify,
)
from uuvtai.learn.packing import PackingError, layout_of, pack, read_stream, unpack, write_stream
from uuvtai.version import __version__

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
            files={path.name: _entry(path) for path in sorted(partial.iterdir())},
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


def _entry(path: Path) -> FileEntry:
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
    checkpoints = run / "checkpoints"
    for path in _folders(checkpoints):
        try:
            found = _open_below(run, path)
        except CheckpointError as error:
            note(f"left out: {error}")
            continue
        if not resumable or found.is_resumable:
            return found
        note(f"left out: {path} has no simulator state to go on from")
    raise CheckpointError(
        f"{checkpoints}: holds no usable checkpoint; give the folder of a run that 'uuv train' has written"
    )


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
