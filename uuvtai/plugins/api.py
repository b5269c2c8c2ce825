"""What a plugin of the user's is called with and what it gives back: the types that her checker knows.

A planner is a function ``plan`` or an object with that method, a controller one of ``act``, a policy one of
``act``, ``predict`` (Stable-Baselines3's) or any callable. Whoever keeps something per env has ``reset`` too.
"""

from __future__ import annotations

import re
import shlex
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import numpy as np

from uuvtai.common.errors import OwnCodeError, SettingError

COMMAND = "surge, sway, heave [m/s], yaw rate [rad/s]"
ACTION = "surge, sway, heave, yaw rate, each in [-1, 1]"


@dataclass(frozen=True)
class About:
    """What is known before the first episode; a class, and a function named ``load``, may take it."""

    num_envs: int
    dt_s: float
    """[s] of a control step"""
    limits: np.ndarray
    """(4,) of the command: surge, sway, heave [m/s], yaw rate [rad/s]"""
    columns: Mapping[str, slice]
    """columns of the observation by name"""
    n_obs: int
    cell_m: float
    """[m] edge of a cell of the map"""
    min_clearance_m: float
    """[m] that the built-in planner keeps from what is occupied"""
    device: str
    """"cpu" or "cuda": where torch tensors are"""
    argument: str = ""
    """what stands after = in ``mine.py:load=...``"""


class Forecast(NamedTuple):
    """Where tracked moving obstacles are expected, B of them at K times."""

    position: np.ndarray
    """(B, K, 2) [m] in the frame of start and goal; k = 0 is now"""
    radius: np.ndarray
    """(B, K) [m] with what the uncertainty adds"""
    dt_s: float
    """[s] between two times"""


class OwnPlanner(Protocol):
    """Plans one route for one env."""

    def plan(
        self, clearance: np.ndarray, cell_m: float, start: np.ndarray, goal: np.ndarray, forecast: Forecast
    ) -> Any:
        """Waypoints (n, 2) [m] from start to goal, or None where there is no way (the old route stays).

        clearance: (n_row, n_col) [m] to the nearest occupied cell, 0 where occupied or outside the tank.
        Places are in metres from the grid's corner: x = column * cell_m, y = row * cell_m.
        """
        ...


class Ego(NamedTuple):
    """What the vehicle knows of itself."""

    position: Any
    """(n, 3) [m] estimate, world, z up"""
    rpy: Any
    """(n, 3) [rad]"""
    velocity: Any
    """(n, 3) [m/s] body, as the DVL measured it last"""
    rates: Any
    """(n, 3) [rad/s] body"""
    depth: Any
    """(n,) [m] positive down"""


class Scan(NamedTuple):
    """The newest sonar scan, counter-clockwise. Of a ring beam 0 was ahead when it was taken, of a fan it is
    the rightmost one. Of a mechanical beam: each bearing's newest return, where it is seen from here."""

    range_m: Any
    """(n, R) [m]; maximum range without a return"""
    hit: Any
    """(n, R) bool"""
    doppler: Any
    """(n, R) [m/s] rate of change of the range, own motion included; NaN where the sonar measures none"""
    intensity: Any
    """(n, R) [0, 1]"""
    yaw: Any
    """(n,) [rad] own yaw when it was taken"""
    age_s: Any
    """(n,) [s]"""
    bearing: Any
    """(n, R) [rad] where each beam looked, from ahead, counter-clockwise"""


class Tracks(NamedTuple):
    """Forecast that the tracker follows."""

    moving: Any
    """(n, T) bool: the slot holds an obstacle that is known to move"""
    position: Any
    """(n, T, 2) [m] world"""
    velocity: Any
    """(n, T, 2) [m/s] world"""
    radius: Any
    """(n, T) [m]"""
    forecast: Any
    """(n, T, K, 2) [m] world"""
    forecast_radius: Any
    """(n, T, K) [m]; negative = no forecast"""


class OccupancyGrid(NamedTuple):
    """The map; rows along y, columns along x."""

    static: Any
    """(n, n_row, n_col) occupancy in [0, 1] of what rests"""
    moving: Any
    """(n, n_row, n_col) occupancy of what moves"""
    clearance: Any
    """(n, n_row, n_col) [m] to the nearest static cell or wall"""


class Way(NamedTuple):
    """The route."""

    count: Any
    """(n,) waypoints in use; 0 = no route"""
    waypoints: Any
    """(n, W, 2) [m] world; those beyond ``count`` mean nothing"""
    lookahead: Any
    """(n, 3) [m] world: where to steer"""
    heading_error: Any
    """(n,) [rad] bearing of that point less the own yaw"""
    cross_track: Any
    """(n,) [m] left positive"""
    remaining: Any
    """(n,) [m]"""


class View(Protocol):
    """What a controller is shown of n envs: what they sense, remember and decided, never the truth. Arrays
    are NumPy's or torch's as ``plugin(arrays=...)`` says; with ``rows="one"`` their first axis is gone."""

    rows: Any
    """(n,) numbers of the envs: their own memory is kept by these"""
    time_s: Any
    """(n,) [s] since the episode began"""
    obs: Any
    """(n, M) the observation that policies see"""
    goal: Any
    """(n, 3) [m] world"""
    limits: Any
    """(4,) of the command"""
    dt_s: float
    columns: Mapping[str, slice]
    cell_m: float
    origin: tuple[float, float]
    """[m] world x, y of the grid's corner"""

    @property
    def ego(self) -> Ego: ...
    @property
    def scan(self) -> Scan: ...
    @property
    def tracks(self) -> Tracks: ...
    @property
    def map(self) -> OccupancyGrid: ...
    @property
    def route(self) -> Way: ...
    def __getitem__(self, column: str) -> Any:
        """Columns of the observation by name: (n, width)."""
        ...

    def in_body(self, vectors_w: Any) -> Any:
        """Horizontal or 3-D vectors of the world (n, 2 or 3), turned by the own yaw: ahead, left(, up)."""
        ...


class OwnController(Protocol):
    """Drives the envs that it is shown."""

    def act(self, view: View) -> Any:
        """Velocity command (n, 4) in the body frame: surge, sway, heave [m/s], yaw rate [rad/s]; cut off at
        the limits."""
        ...


class RewardView(View, Protocol):
    """What ``terms(view)`` of ``uuv train --reward`` is shown after each control step: a view of all envs,
    and what a reward may know and a policy never does."""

    clearance: Any
    """(n,) [m] from the hull to the nearest obstacle or wall, the truth"""
    ttc: Any
    """(n,) [s] to a collision, the truth; a large number for none"""
    outcome: Any
    """(n,) index into ``uuvtai.envs.vector_env.VectorEnv.outcomes``; 0 = the episode runs"""
    action: Any
    """(n, 4) that was driven, in parts of the limits"""


class OwnPolicy(Protocol):
    """A trained policy: what it does follows from the observation alone."""

    def act(self, obs: Any) -> Any:
        """Actions (n, 4) in [-1, 1] for observations (n, M), without exploration."""
        ...


class Remembers(Protocol):
    """Keeps something per env."""

    def reset(self, rows: np.ndarray) -> None:
        """New episodes begin in these envs (numbers)."""


Plugin = TypeVar("Plugin", bound=Callable[..., Any])


def plugin(
    rows: Literal["batch", "one"] = "batch", arrays: Literal["numpy", "torch"] = "numpy", hold_steps: int = 1
) -> Callable[[Plugin], Plugin]:
    """Decorator of a controller or policy, function or class: how it wants to be called.

    rows: all envs at once, or one after the other; arrays: what it is given; hold_steps: control steps that a
    decision is held for. Without it: the batch, NumPy, every step. ValueError for other values.
    """
    if rows not in ("batch", "one") or arrays not in ("numpy", "torch"):
        raise ValueError(f"rows is 'batch' or 'one', arrays 'numpy' or 'torch', got {rows!r} and {arrays!r}")
    if not isinstance(hold_steps, int) or isinstance(hold_steps, bool) or not 1 <= hold_steps <= 10_000:
        raise ValueError(f"hold_steps is a number of control steps from 1, got {hold_steps!r}")

    def marked(found: Plugin) -> Plugin:
        for name, value in (("rows", rows), ("arrays", arrays), ("hold_steps", hold_steps)):
            setattr(found, name, value)
        return found

    return marked


# ---- What goes wrong in a plugin of the user's, told by her file and line.


class PluginError(OwnCodeError):
    """A plugin cannot be used, or its code failed: which line, what, and what is wanted."""


def failed(error: BaseException, path: Path, what: str) -> PluginError:
    """Of an exception in the user's code: the last line of her file on the way to it."""
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if _is(frame, path)]
    line = lines[-1] if lines else None
    if isinstance(error, SyntaxError) and error.filename == str(path):
        line = error.lineno
    place = f"{path}:{line}" if line else str(path)
    reason = " ".join(str(error).split())[:300]
    return PluginError(f"{place}: {type(error).__name__}{f': {reason}' if reason else ''} ({what})")


def line_of_frame(frame: FrameType | None, path: Path) -> int | None:
    """Line of ``path`` that runs now, or has called what runs."""
    while frame is not None and not _is(frame, path):
        frame = frame.f_back
    return frame.f_lineno if frame is not None else None


def _is(frame: FrameType, path: Path) -> bool:
    return frame.f_code.co_filename == str(path)


# ---- Names of the user's plugins on a command line: ``mine.py:plan``, ``mine.py:load=FOLDER``,
# ``model.onnx``.

PLANNER, CONTROLLER, POLICY = "planner", "controller", "policy"
REWARD, MOTION = "reward", "motion"
_DRIVES = (PLANNER, CONTROLLER, POLICY)
_DEFAULT = {PLANNER: "plan", CONTROLLER: "act", POLICY: "load", REWARD: "terms", MOTION: "paths"}
"""what is meant where no object is named"""
_PYTHON = re.compile(r"(?P<file>.+?\.py)(?::(?P<name>[^=:/\\]*))?(?:=(?P<argument>.*))?")
_EXAMPLE = {
    PLANNER: "--planner mine.py:plan",
    CONTROLLER: "--agent mine.py:act",
    POLICY: "--agent model.onnx or --agent mine.py:load",
    REWARD: "--reward mine.py:terms",
    MOTION: "--motion mine.py:paths",
}


@dataclass(frozen=True)
class PluginSpec:
    """A plugin as it was named."""

    kind: str
    path: Path
    name: str = ""
    """of the object in a Python file; empty for an ONNX graph"""
    argument: str = ""
    """what stands after ="""

    @property
    def text(self) -> str:
        """As a request keeps it: ``plugin_spec`` reads it."""
        return f"{self.kind}:{self.typed}"

    @property
    def typed(self) -> str:
        """As it is typed behind the option."""
        return (
            f"{self.path}{f':{self.name}' if self.name else ''}{f'={self.argument}' if self.argument else ''}"
        )

    @property
    def option(self) -> str:
        """As it is typed, with its option."""
        if self.kind in (PLANNER, REWARD, MOTION):
            return f"--{self.kind} {self.typed}"
        is_plain = plugin_spec(self.typed).kind == self.kind
        return f"--agent {self.typed if is_plain else self.text}"

    @property
    def label(self) -> str:
        """What it is called in tables and files: file, object (if it is not ``load``) and argument."""
        parts = [self.path.stem]
        if self.name and self.name != _DEFAULT[POLICY]:
            parts.append(self.name)
        if self.argument:
            parts.append(Path(self.argument).name)
        return re.sub(r"[^\w.-]+", "_", "-".join(parts))

    @property
    def is_code(self) -> bool:
        """Whether using it runs Python of the user's."""
        return self.path.suffix == ".py"

    def located(self, folder: Path) -> PluginSpec:
        """The same with its file, and an argument that is a path, looked for in ``folder`` where they are not
        here."""
        argument = folder / self.argument
        moved = self.argument and not Path(self.argument).exists() and argument.exists()
        path = self.path if self.path.exists() else folder / self.path
        return replace(self, path=path, argument=str(argument) if moved else self.argument)

    def absolute(self) -> PluginSpec:
        """The same from any folder."""
        argument = Path(self.argument)
        found = str(argument.resolve()) if self.argument and argument.exists() else self.argument
        return replace(self, path=self.path.resolve(), argument=found)


def is_plugin(text: str) -> bool:
    """Whether an agent's name is that of a plugin of the user's."""
    kind, colon, _rest = text.partition(":")
    return (kind in _DRIVES and bool(colon)) or bool(_PYTHON.fullmatch(text)) or text.endswith(".onnx")


def plugin_spec(text: str, kind: str = "") -> PluginSpec:
    """The plugin of a text. ``kind`` where the text does not begin with one; without either, a graph and an
    object named ``load`` are policies, every other one is a controller. SettingError."""
    first, colon, rest = text.partition(":")
    if first in _DRIVES and colon:
        kind, text = first, rest
    if kind in ("", POLICY) and text.endswith(".onnx"):
        return PluginSpec(POLICY, Path(text))
    found = _PYTHON.fullmatch(text)
    if not kind:
        kind = POLICY if found and found["name"] == _DEFAULT[POLICY] else CONTROLLER
    option = _EXAMPLE[kind].partition(" ")[0]
    if found is None:
        raise SettingError(f"{option} {text!r}: names no plugin; for example {_EXAMPLE[kind]}")
    name = found["name"] or _DEFAULT[kind]
    if not name.isidentifier():
        raise SettingError(f"{option} {text!r}: {name!r} is no name of Python; for example {_EXAMPLE[kind]}")
    return PluginSpec(kind, Path(found["file"]), name, found["argument"] or "")


def _code_of(names: Sequence[str]) -> list[Path]:
    return [spec.path for name in names if is_plugin(name) and (spec := plugin_spec(name)).is_code]


def to_resume(place: Path, names: Sequence[str]) -> str:
    """What is typed to go on with a run of these agents."""
    return shlex.join(["--resume", str(place)] + (["--allow-code"] if _code_of(names) else []))


def refuse_code(place: Path, names: Sequence[str], allowed: bool) -> None:
    """SettingError where going on with a run folder would run Python that the folder names, unless the user
    said that it is hers: a folder may come from anybody."""
    code = _code_of(names)
    if code and not allowed:
        files = ", ".join(map(str, dict.fromkeys(code)))
        raise SettingError(
            f"{place}: goes on by running the Python code of {files}; look at it, and add --allow-code if "
            "you trust it"
        )
