"""Reading an entry that anybody may have written: bounded, of one form, and without a contradiction in it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uuvtai.config import Config
from uuvtai.errors import UserError
from uuvtai.files import parsed_json, read_text
from uuvtai.measure.benchmark.benchmark_scenes import (
    ALL,
    COLUMNS,
    EPISODES,
    SEED,
    TRIAL_EPISODES,
    TRIAL_SEED,
    VERSION,
    BenchmarkScene,
    scenes_of,
)
from uuvtai.measure.benchmark.fingerprints import sealed
from uuvtai.outcomes import ENDINGS

MAX_BYTES = 4 << 20
"""an entry of all scenes has 40 kB"""
_MAX_FILES, _MAX_SCENES = 200, 64
_STEP_SHARE = 1e-3
"""of a control step: times of episodes are whole steps"""

_Sha = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_Text = Annotated[str, Field(max_length=4000)]
_Name = Annotated[str, Field(min_length=1, max_length=300)]
_Ending = Literal["success", "collision", "ttc", "out_of_tank", "timeout"]
_Row = tuple[
    Annotated[int, Field(ge=0, lt=EPISODES)],
    _Ending,
    Annotated[float, Field(gt=0, le=1e6)],
    Annotated[float, Field(ge=-1e6, le=1e6)],
    Annotated[float, Field(ge=0, le=1e6)],
]


class EntryError(UserError, ValueError):
    """A file is no entry, or one that was changed: what is wrong with it."""


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


class PlayedScene(_Part):
    """What became of one scene's episodes."""

    name: _Name
    config_sha256: _Sha
    scenarios_sha256: _Sha
    seed: int
    outcomes: dict[_Ending, Annotated[int, Field(ge=0)]]
    episodes: Annotated[list[_Row], Field(min_length=1, max_length=EPISODES)]


class EntryPilot(_Part):
    """Who played."""

    name: _Name
    typed: _Text
    is_shipped: bool
    sha256: _Sha
    files: Annotated[dict[_Name, _Sha], Field(max_length=_MAX_FILES)]


class EntryCode(_Part):
    """The package that played."""

    version: _Name
    sha256: _Sha
    commit: _Name | None


class Entry(_Part):
    """An entry, checked in itself."""

    schema_: Literal[1] = Field(alias="schema")
    benchmark: _Name
    benchmark_version: int
    is_entry: bool
    pilot: EntryPilot
    code: EntryCode
    versions: Annotated[dict[_Name, _Name], Field(max_length=100)]
    machine: _Text
    command: _Text
    played: _Name
    columns: list[_Name]
    scenes: Annotated[list[PlayedScene], Field(min_length=1, max_length=_MAX_SCENES)]
    seal: _Sha


def read_entry(file: Path) -> Entry:
    """The entry of a file. Raises EntryError or FileError, with the reason, for whatever else it is; nothing
    that stands in it is run or opened."""
    try:
        text = read_text(file, MAX_BYTES)
    except OSError as error:
        raise EntryError(
            f"{file}: cannot be read ({error.strerror}); give the entry.json that 'uuv benchmark' wrote"
        ) from None
    document = parsed_json(text, str(file))
    try:
        entry = Entry.model_validate_json(text)
    except (ValidationError, RecursionError) as error:
        raise EntryError(
            f"{file}: is no entry of a benchmark ({_reason(error)}); give the entry.json that 'uuv "
            "benchmark' wrote"
        ) from None
    if sealed(document)["seal"] != entry.seal:
        raise EntryError(
            f"{file}: was changed after it was written (its seal is that of another content); ask for the "
            "file as 'uuv benchmark' wrote it"
        )
    _refuse_contradictions(file, entry)
    return entry


def _reason(error: ValidationError | RecursionError) -> str:
    if isinstance(error, RecursionError):
        return "nested too deep"
    first = error.errors()[0]
    return f"{'.'.join(str(part)[:60] for part in first['loc']) or 'the whole'}: {first['msg'][:200]}"


def _refuse_contradictions(file: Path, entry: Entry) -> None:
    """EntryError for what no run of ours writes."""
    if entry.benchmark_version != VERSION:
        raise EntryError(
            f"{file}: is of version {entry.benchmark_version} of the benchmark, this is version {VERSION}; "
            "check it with the package that it names"
        )
    if tuple(entry.columns) != COLUMNS:
        raise _contradiction(file, f"its columns are not {', '.join(COLUMNS)}")
    scenes = {bench.name: bench for bench in scenes_of(entry.benchmark)}
    names = [scene.name for scene in entry.scenes]
    if len(set(names)) != len(names) or not set(names) <= set(scenes):
        raise _contradiction(file, f"its scenes are not those of {entry.benchmark}, each once")
    for played in entry.scenes:
        if fault := _fault(played, entry.is_entry, scenes[played.name].config()):
            raise _contradiction(file, f"{played.name}: {fault}")


def _contradiction(file: Path, what: str) -> EntryError:
    return EntryError(f"{file}: {what}; no run of 'uuv benchmark' writes such a file")


def _fault(played: PlayedScene, is_entry: bool, config: Config) -> str:
    """What cannot be in a scene's result; empty = nothing."""
    seed, episodes = (SEED, EPISODES) if is_entry else (TRIAL_SEED, TRIAL_EPISODES)
    if played.seed != seed:
        return f"its seed is {played.seed}, not {seed}"
    if [row[0] for row in played.episodes] != list(range(episodes)):
        return f"its episodes are not 0 to {episodes - 1}, each once and in order"
    counts = Counter(row[1] for row in played.episodes)
    if {name: counts[name] for name in ENDINGS} != {name: played.outcomes.get(name) for name in ENDINGS}:
        return "its counts are not those of its episodes"
    dt, horizon = config.episode.control_dt_s, config.episode.horizon_steps
    for number, outcome, time_s, _clearance, _length in played.episodes:
        steps = time_s / dt
        if abs(steps - round(steps)) > _STEP_SHARE or round(steps) > horizon:
            return f"episode {number} takes {time_s:g} s, which is no whole number of steps of {dt:g} s"
        if (outcome == "timeout") and round(steps) != horizon:
            return f"episode {number} times out after {time_s:g} s, not at the end of its time"
    return ""


def scenes_by_name(entry: Entry) -> dict[str, tuple[BenchmarkScene, PlayedScene]]:
    """The benchmark's scene and the entry's result of it."""
    known: dict[str, Any] = {bench.name: bench for bench in scenes_of(ALL)}
    return {played.name: (known[played.name], played) for played in entry.scenes}
