"""How values become JSON text: what the encoders of the topics have in common.

Numbers are printed with nine significant digits, which is exact for float32: an outsider recomputes from the
very values that the simulator had. Messages at control rate are printed from templates, several times faster
than ``json.dumps``; the rest are dicts. Whatever is not finite is refused with a ValueError.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from uuvtai.common.enums import RUNNING
from uuvtai.common.errors import ODD, UserError
from uuvtai.common.version import __version__
from uuvtai.config import Config
from uuvtai.logs.schemas import LINE_STRIP, Schema

Vector = Sequence[float] | np.ndarray

IDENTITY = {"position": {"x": 0, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}

_XYZ = '{"x":%.9g,"y":%.9g,"z":%.9g}'
_WXYZ = '{"w":%.9g,"x":%.9g,"y":%.9g,"z":%.9g}'
_POSE = '{"position":' + _XYZ + ',"orientation":' + _WXYZ + "}"
_TRANSFORM = (
    '{"timestamp":%s,"parent_frame_id":"%s","child_frame_id":"%s","translation":'
    + _XYZ
    + ',"rotation":'
    + _WXYZ
    + "}"
)


@functools.cache
def _list_template(length: int) -> str:
    return "[" + ",".join(["%.9g"] * length) + "]"


def numbers(values: Any) -> str:
    flat = np.asarray(values).ravel()
    return finite(_list_template(len(flat)) % tuple(flat.tolist()))


def number(value: float) -> str:
    return finite("%.9g" % value)  # noqa: UP031 - the one way of printing numbers here


def number_or_null(value: float | None) -> str:
    return "null" if value is None else number(value)


def numbers_or_null(values: Any | None) -> str:
    return "null" if values is None else numbers(values)


def finite(text: str) -> str:
    """Printed numbers without 'nan' and 'inf': the only ones that contain an n."""
    if "n" in text:
        raise ValueError(f"a number that is not finite: {text[:200]}")
    return text


def dumped(message: dict[str, Any]) -> bytes:
    try:
        return json.dumps(message, separators=(",", ":"), allow_nan=False).encode()
    except ValueError:
        raise ValueError(f"a number that is not finite: {str(message)[:200]}") from None


# ------------------------------------------------------------------------------------------------------ poses


def transform(stamp: str, parent: str, child: str, translation: Vector, rotation: Vector) -> str:
    return _TRANSFORM % (stamp, parent, child, *translation, *rotation)


def pose_in_frame(stamp: str, position: Vector, quat: Vector) -> bytes:
    pose = checked(_POSE % (*map(float, position), *map(float, quat)))
    return f'{{"timestamp":{stamp},"frame_id":"world","pose":{pose}}}'.encode()


# --------------------------------------------------------------------------------------------------- scenes


def scene_entity(time_ns: int, name: str, **primitives: list) -> dict[str, Any]:
    """foxglove.SceneEntity in the world; replaces the one of the same name."""
    sec, nsec = divmod(time_ns, 1_000_000_000)
    kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    return {
        "timestamp": {"sec": sec, "nsec": nsec},
        "frame_id": "world",
        "id": name,
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        "metadata": [],
        **{kind: primitives.get(kind, []) for kind in kinds},
    }


def scene_update(*entities: dict[str, Any]) -> bytes:
    return dumped({"deletions": [], "entities": entities})


def line(
    points: Iterable[Vector], rgba: Sequence[float], thickness: float, kind: int = LINE_STRIP
) -> dict[str, Any]:
    """foxglove.LinePrimitive, thickness in metres."""
    return {
        "type": kind,
        "pose": IDENTITY,
        "thickness": thickness,
        "scale_invariant": False,
        "points": [vector(point) for point in points],
        "color": color(rgba),
        "colors": [],
        "indices": [],
    }


def vector(values: Vector) -> dict[str, float]:
    """foxglove.Vector3 or Point3."""
    x, y, z = (short(v) for v in values)
    return {"x": x, "y": y, "z": z}


def short(value: float) -> float:
    """The float with the fewest digits that gives back this float32."""
    return float("%.9g" % value)  # noqa: UP031


def color(rgba: Sequence[float]) -> dict[str, float]:
    return dict(zip("rgba", rgba, strict=True))


def upright_pose(position: Vector, yaw: float = 0.0) -> dict[str, Any]:
    """foxglove.Pose turned about z."""
    return {
        "position": vector(position),
        "orientation": {"x": 0, "y": 0, "z": math.sin(0.5 * yaw), "w": math.cos(0.5 * yaw)},
    }


def checked(text: str) -> str:
    """Printed objects without numbers that are not finite."""
    if "nan" in text or "inf" in text:
        raise ValueError(f"a number that is not finite: {text[:200]}")
    return text


# ---- What a log is made of: an episode's header, and one control step at a time as the state's own rows.

Values = Mapping[str, Any]
"""One env at one control step: 'struct.field' of the state -> copy of the env's row (shapes, units and frames
as in ``state``), and below 'agent.' what drives it: ``applied``, the action (4,) that led here, and of a
policy ``action`` (4,), ``value``, ``std`` (4,), ``distillation_lambda``, ``residual`` and ``uncertainty``,
each None where there is none."""


@dataclass(frozen=True, eq=False)
class EpisodeHeader:
    """What is known before the first step; it comes first in the log."""

    agent: str  # name of the agent that drives: 'bt', 'planner', 'straight' or a policy's name
    config: Config
    config_yaml: str  # the same as text
    scenario: dict[str, Any]  # of ``scenario_document``: everything true about the world, in closed form
    reward_terms: tuple[str, ...] = ()  # names of ``reward.term``'s entries
    tree_nodes: tuple[str, ...] = ()  # names of ``behavior.status``'s entries; numbered where two are equal
    tree_xml: bytes = b""  # the tree as it was read; empty = unknown
    git_sha: str = "unknown"
    checkpoint_sha256: str = ""  # of the policy's checkpoint; empty = no policy
    version: str = __version__

    @cached_property
    def nodes(self) -> tuple[str, ...]:
        return numbered(self.tree_nodes)


def numbered(names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of a tree's nodes, where two are equal with their number: 'Hold', 'Hold#7'."""
    return tuple(name if names.index(name) == i else f"{name}#{i}" for i, name in enumerate(names))


class EpisodeEnd(Protocol):
    """How the episode ended: the last thing in the log."""

    @property
    def outcome(self) -> str: ...
    @property
    def episode_return(self) -> float: ...
    @property
    def time_s(self) -> float: ...
    @property
    def min_clearance_m(self) -> float: ...
    @property
    def replans(self) -> dict[str, int]: ...
    @property
    def planned_by(self) -> dict[str, int]: ...


@dataclass(frozen=True, eq=False)
class Moment:
    """One control step, the reset (step 0) included, as encoders see it: ``moment['ego.pos_w']``."""

    header: EpisodeHeader
    values: Values

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    @cached_property
    def step(self) -> int:
        """Control steps since the start."""
        return int(self["clock.step"])

    @cached_property
    def time_s(self) -> float:
        return self.step * self.header.config.episode.control_dt_s

    @cached_property
    def time_ns(self) -> int:
        return self.ns_of(self.step)

    @cached_property
    def stamp(self) -> str:
        """Simulation time as a foxglove time."""
        return time_text(self.time_ns)

    def stamp_of(self, step: int) -> str:
        """Time of another step as a foxglove time."""
        return time_text(self.ns_of(step))

    def ns_of(self, step: int) -> int:
        return round(step * self.header.config.episode.control_dt_s * 1e9)

    @property
    def ended(self) -> bool:
        """The episode ended in this step: nothing follows."""
        return int(self["termination.outcome"]) != RUNNING

    @property
    def replanned(self) -> bool:
        return bool(self["route.n_way"] > 0 and self["route.plan_step"] == self.step)


def time_text(time_ns: int) -> str:
    return '{"sec":%d,"nsec":%d}' % divmod(time_ns, 1_000_000_000)  # noqa: UP031


# ---- A row of the table of topics: when a topic is written, from what, how, and how it is read back.

Encode = Callable[[Moment], bytes | list[bytes]]
"""JSON text of a step's message, or of each of its messages. ValueError for numbers that are not finite."""


@dataclass(frozen=True)
class When:
    """The steps in which a topic is written."""

    text: str  # for the reference
    holds: Callable[[Moment, bool], bool]
    """whether a step is one; the second value: the last message is ``1 / hertz`` old, or there is none"""
    reads: tuple[str, ...] = ()  # what ``holds`` looks at; 'struct.field' of the state
    hertz: float = 0.0


@dataclass(frozen=True)
class Topic:
    """One topic of a log. A step that lacks one of ``reads`` has no message on it."""

    name: str
    when: When
    schema: Schema | Callable[[EpisodeHeader], Schema]  # a function where it depends on the run
    encode: Encode
    reads: tuple[str, ...] = ()
    """what ``encode`` looks at; 'struct.field' of the state, or 'agent.' (``moment.Values``)"""
    read: Callable[[dict[str, Any]], Any] | None = None
    """what pictures and videos take of a message: an array, a Layer, or a tuple with some of them"""
    in_picture: bool = False  # pictures show it too, not videos alone
    note: str = ""  # follows ``when.text`` in the reference
    varies: str = ""  # which of its fields depend on the run, for the reference
    on_request: bool = False  # only in logs with depth images

    def schema_for(self, header: EpisodeHeader) -> Schema:
        return self.schema(header) if callable(self.schema) else self.schema


_ROUTE = ("route.n_way", "route.plan_step")
_OUTCOME = ("termination.outcome",)

EVERY_STEP = When("every control step", lambda moment, waited: True)
NEW_SCAN = When("every new scan", lambda moment, waited: bool(moment["scan.fresh"]), ("scan.fresh",))
NEW_IMAGE = When("every new image", lambda moment, waited: bool(moment["image.fresh"]), ("image.fresh",))
REPLAN = When("on every replan", lambda moment, waited: moment.replanned, _ROUTE)
OBSTACLES = When("10 Hz", lambda moment, waited: waited or moment.ended, _OUTCOME, hertz=10.0)
MAPS = When(
    "2 Hz, on every replan, and at the end",
    lambda moment, waited: waited or moment.replanned or moment.ended,
    (*_ROUTE, *_OUTCOME),
    hertz=2.0,
)
IMAGES = When(
    "2 Hz, with `--depth-images`",
    lambda moment, waited: waited and bool(moment["image.fresh"]),
    ("image.fresh",),
    hertz=2.0,
)
SONAR_IMAGES = When(
    "2 Hz, with `--depth-images`, where `sensors.sonar.detector` is on",
    lambda moment, waited: (
        waited and bool(moment["scan.fresh"]) and moment.header.config.sensors.sonar.detector != "none"
    ),
    ("scan.fresh",),
    hertz=2.0,
)
EVADING = When(
    "every decision that looks for an evasion",
    lambda moment, waited: bool(moment["behavior.want_evade"]),
    ("behavior.want_evade",),
)
EVENTS = When(
    "replans, end of the episode",
    lambda moment, waited: moment.replanned or moment.ended,
    (*_ROUTE, *_OUTCOME),
)


# ---- What can be wrong with a log file, and with the name of a file that is to be drawn from it.


class LogError(UserError, RuntimeError):
    """A log that cannot be written, read or drawn: what, where, why and what to type next."""


@contextmanager
def unlike_schema(path: Path, *also: type[Exception]) -> Iterator[None]:
    """What a message unlike its schema raises inside, ``also`` these, is told as a LogError."""
    try:
        yield
    except UserError:
        raise
    except (*ODD, *also) as error:
        raise LogError(
            f"{path}: a message is not as its schema says ({error!r:.200}); see what is in it with: uuv log "
            f"info {path}"
        ) from None


def checked_suffix(out: Path, formats: Sequence[str], what: str) -> str:
    """The ending of ``out`` in small letters. Raises LogError for one that is not among ``formats``."""
    suffix = out.suffix.lower()
    if suffix not in formats:
        raise LogError(
            f"{out}: a {what} can be {', '.join(formats)}; give a name that ends so with --out FILE"
        )
    return suffix
