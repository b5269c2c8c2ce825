"""A controller or a policy of the user's as ``evaluation.episodes`` wants it."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from uuvtai.common.enums import clearance_m, occupancy
from uuvtai.config import SonarConfig
from uuvtai.config.task import TERMS
from uuvtai.learning.policy_agent import CHUNK, AgentDecision
from uuvtai.plugins import api
from uuvtai.sim.sim import Sim

# ---- What a controller of the user's is shown: rows of what the vehicle senses, remembers and decides, read
# when it is asked for. ``FIELDS`` is the whole of it; no truth is among them (a test asks).

FIELDS = {
    "goal": ("mission.goal_w",),
    "step": ("clock.step",),
    "ego": ("ego.pos_w", "ego.rpy", "ego.vel_b", "ego.rate_b", "ego.depth_m"),
    "scan": (
        "scan.range_m",
        "scan.hit",
        "scan.doppler_m_s",
        "scan.intensity",
        "scan.ping_yaw",
        "scan.ping_step",
    ),
    "tracks": ("tracks.alive", "tracks.moving", "tracks.state", "tracks.radius_m"),
    "forecast": ("forecast.pos_w", "forecast.radius_m"),
    "map": ("grid_map.static_occ", "grid_map.dynamic_occ", "clearance.site"),
    "route": (
        *("route.n_way", "route.way_w", "route.lookahead_w", "route.heading_error", "route.cross_track_m"),
        "route.remaining_m",
    ),
}
"""all that is ever read for a view"""

Array = np.ndarray


class Readings:
    """The state of chosen rows, each group read once, as NumPy copies."""

    def __init__(self, sim: Sim, rows: list[int], obs: torch.Tensor) -> None:
        """``obs`` (len(rows), n_obs): a copy that nobody else writes."""
        self.numbers, self.obs = np.asarray(rows, np.int64), obs
        self._sim, self._chosen = sim, None if len(rows) == sim.num_envs else rows
        self._known: dict[str, Any] = {}

    def group(self, name: str) -> Any:
        """A NamedTuple of the protocol, or an array."""
        if name not in self._known:
            self._known[name] = self._made(name)
        return self._known[name]

    def _read(self, name: str) -> list[Array]:
        return [self._sim.rows(attrgetter(path)(self._sim.s), self._chosen) for path in FIELDS[name]]

    def _made(self, name: str) -> Any:
        read, dt_s = self._read(name), self._sim.config.episode.control_dt_s
        if name == "scan":
            age_s = (self.group("step") - read[5]).astype(np.float32) * np.float32(dt_s)
            return _scan(read, age_s, self._sim.config.sensors.sonar)
        if name == "tracks":
            ahead = self._read("forecast")
            moving, state = (read[0] == 1) & (read[1] == 1), read[2]
            return api.Tracks(moving, state[..., :2], state[..., 2:], read[3], ahead[0], ahead[1])
        if name == "map":
            read = [*map(occupancy, read[:2]), clearance_m(read[2], self._sim.config)]
        kinds: dict[str, Callable[..., Any]] = {"ego": api.Ego, "map": api.OccupancyGrid, "route": api.Way}
        return kinds[name](*read) if name in kinds else read[0]


def _scan(read: list[Array], age_s: Array, sonar_cfg: SonarConfig) -> api.Scan:
    """Of what was read; a speed that is not measured is not a number."""
    range_m, hit, doppler, intensity, yaw, _step = read
    bearing = sonar_cfg.first_beam_rad + sonar_cfg.beam_step_rad * np.arange(sonar_cfg.n_ray)
    return api.Scan(
        range_m,
        hit == 1,
        doppler if sonar_cfg.doppler else np.full_like(doppler, np.nan),
        intensity,
        yaw,
        age_s,
        np.broadcast_to(bearing.astype(np.float32), range_m.shape).copy(),
    )


def _group_named(name: str) -> Any:
    """A view's property: a NamedTuple of the protocol, in the user's kind of arrays."""

    def group(view: PluginView) -> Any:
        found = view._readings.group(name)
        return type(found)(*(view._given(values) for values in found))

    return property(group)


class PluginView:
    """A ``protocol.View`` of readings: the whole batch, or one row of it."""

    def __init__(self, readings: Readings, fixed: Fixed, pick: int | None = None) -> None:
        self._readings, self._fixed, self._pick = readings, fixed, pick
        self.limits, self.dt_s, self.columns = fixed.limits, fixed.dt_s, fixed.columns
        self.cell_m, self.origin = fixed.cell_m, fixed.origin

    @property
    def rows(self) -> Any:
        numbers = self._readings.numbers
        return numbers if self._pick is None else int(numbers[self._pick])

    @property
    def time_s(self) -> Any:
        return self._given(self._readings.group("step").astype(np.float32) * np.float32(self.dt_s))

    @property
    def obs(self) -> Any:
        found = self._readings.obs
        found = found if self._pick is None else found[self._pick]
        return found if self._fixed.torch else found.cpu().numpy()

    @property
    def goal(self) -> Any:
        return self._given(self._readings.group("goal"))

    ego = _group_named("ego")
    scan = _group_named("scan")
    tracks = _group_named("tracks")
    map = _group_named("map")
    route = _group_named("route")

    def __getitem__(self, column: str) -> Any:
        """Columns of the observation by name (n, width). KeyError says which there are."""
        if column not in self.columns:
            raise KeyError(f"no column {column!r}; there are {', '.join(self.columns)}")
        return self.obs[..., self.columns[column]]

    def __getattr__(self, name: str) -> Any:
        """Only asked for what is not there: AttributeError says what is."""
        there = ", ".join(each for each in dir(self) if not each.startswith("_"))
        like = f"; a column is view[{name!r}]" if name in self.__dict__.get("columns", ()) else ""
        raise AttributeError(f"a view has no {name!r}{like}; there are {there}")

    def in_body(self, vectors_w: Any) -> Any:
        """World vectors (n, 2 or 3) turned by the own yaw: ahead, left(, up)."""
        yaw = self.ego.rpy[..., 2]
        sine, cosine = (torch.sin(yaw), torch.cos(yaw)) if self._fixed.torch else (np.sin(yaw), np.cos(yaw))
        x, y = vectors_w[..., 0], vectors_w[..., 1]
        parts = [cosine * x + sine * y, cosine * y - sine * x]
        parts += [vectors_w[..., 2]] if vectors_w.shape[-1] == 3 else []
        return torch.stack(parts, -1) if self._fixed.torch else np.stack(parts, -1)

    def __repr__(self) -> str:
        """What there is."""
        return (
            f"View(rows={self.rows}, columns: {', '.join(self.columns)}; obs, goal, time_s, ego, scan, "
            f"tracks, map, route; a command is {api.COMMAND})"
        )

    def _given(self, values: Array) -> Any:
        picked = values if self._pick is None else values[self._pick]
        return torch.as_tensor(picked, device=self._fixed.device) if self._fixed.torch else picked


JUDGED = {
    "clearance": "termination.clearance_m",
    "ttc": "termination.ttc_s",
    "outcome": "termination.outcome",
}
"""the truth that a reward is shown beside ``FIELDS``"""


class JudgedView(PluginView):
    """A ``protocol.RewardView``."""

    def __init__(self, sim: Sim, obs: torch.Tensor, fixed: Fixed, action: torch.Tensor) -> None:
        super().__init__(Readings(sim, list(range(sim.num_envs)), obs), fixed)
        self.action = action if fixed.torch else action.cpu().numpy()
        for name, place in JUDGED.items():
            setattr(self, name, self._given(sim.rows(attrgetter(place)(sim.s))))


class Fixed:
    """What a view says of every env and every step."""

    def __init__(self, sim: Sim, columns: Mapping[str, slice], limits: Array, arrays: str) -> None:
        self.torch, self.device = arrays == "torch", sim.device
        self.columns, self.dt_s = columns, sim.config.episode.control_dt_s
        self.limits = torch.as_tensor(limits, device=sim.device) if self.torch else limits
        self.cell_m, self.origin = sim.config.mapping.cell_m, sim.fallback.origin


# ---- What came back from the user's code, checked: shape, kind of number, NaN; each refusal says what was
# wanted.

MAX_WAYPOINTS = 10_000
_ENDS_M = 1e-4  # a route begins and ends within this of start and goal, or they are added


def commands(found: Any, n: int, place: str, meaning: str, device: torch.device) -> torch.Tensor:
    """(n, 4) float32 of what a controller or policy answered. Raises PluginError."""
    values = _tensor(found, place, f"({n}, 4): {meaning}")
    if values.shape != (n, 4):
        columns = values.shape[-1] if values.dim() else 0
        wrong = (
            f"{columns} columns" if values.dim() == 2 and len(values) == n else f"shape {tuple(values.shape)}"
        )
        raise api.PluginError(f"{place}: gave {wrong}; wanted is shape ({n}, 4): {meaning}")
    bad = (~torch.isfinite(values)).nonzero()
    if len(bad):
        row, column = bad[0].tolist()
        raise api.PluginError(
            f"{place}: gave {float(values[row, column])} in row {row}, column {column} of {n} x 4 ({meaning})"
            f", and {len(bad) - 1} more that are not finite"
        )
    return values.to(device)


def terms(found: Any, n: int, place: str, device: torch.device) -> dict[str, torch.Tensor]:
    """(n,) float32 by name of what a reward answered. Raises PluginError."""
    wanted = f"a dict of arrays ({n},), what each term adds to the reward"
    if not isinstance(found, dict) or not found or not all(str(name).isidentifier() for name in found):
        raise api.PluginError(
            f"{place}: gave {type(found).__name__} {found!r:.60}; wanted is {wanted}, by name"
        )
    if taken := [name for name in found if name in TERMS]:
        raise api.PluginError(
            f"{place}: {taken[0]} is a built-in term; name yours otherwise, or weight that one: "
            f"--set reward.{taken[0]}=0"
        )
    values = {str(name): _tensor(value, f"{place}: {name}", wanted) for name, value in found.items()}
    for name, value in values.items():
        if value.shape != (n,):
            raise api.PluginError(f"{place}: {name} has shape {tuple(value.shape)}; wanted is {wanted}")
        if len(bad := (~torch.isfinite(value)).nonzero()):
            row = int(bad[0])
            raise api.PluginError(
                f"{place}: {name} is {float(value[row])} in env {row}, and {len(bad) - 1} more"
            )
    return {name: value.to(device) for name, value in values.items()}


def command(found: Any, place: str, meaning: str) -> torch.Tensor:
    """(1, 4) float32 of what a controller answered for one env. Raises PluginError."""
    values = _tensor(found, place, f"(4,): {meaning}")
    if values.shape not in ((4,), (1, 4)):
        raise api.PluginError(f"{place}: gave shape {tuple(values.shape)}; wanted is shape (4,): {meaning}")
    return values.reshape(1, 4)


def waypoints(
    found: Any, ends: tuple[np.ndarray, np.ndarray], size_m: tuple[float, float], place: str
) -> np.ndarray:
    """Corners (n >= 2, 2) [m] of what a planner answered, from start to goal. Raises PluginError."""
    wanted = "waypoints (n, 2) [m] from the grid's corner, or None"
    values = _tensor(found, place, wanted).numpy()
    if values.ndim != 2 or values.shape[1] != 2 or len(values) > MAX_WAYPOINTS:
        raise api.PluginError(
            f"{place}: gave shape {values.shape}; wanted are {wanted}, at most {MAX_WAYPOINTS:,}"
        )
    if not np.isfinite(values).all():
        number = int(np.flatnonzero(~np.isfinite(values).all(1))[0])
        raise api.PluginError(
            f"{place}: waypoint {number} is {values[number].tolist()}; wanted are finite numbers"
        )
    outside = ((values < 0) | (values > size_m)).any(1)
    if outside.any():
        number = int(np.flatnonzero(outside)[0])
        raise api.PluginError(
            f"{place}: waypoint {number} is {np.round(values[number], 3).tolist()}, outside the grid of "
            f"{size_m[0]:g} x {size_m[1]:g} m; places are x = column * cell_m, y = row * cell_m"
        )
    start, goal = (end.astype(np.float32) for end in ends)
    if not len(values):
        return np.array([start, goal])
    before = [] if np.abs(values[0] - start).max() <= _ENDS_M else [start]
    after = [] if np.abs(values[-1] - goal).max() <= _ENDS_M and len(values) + len(before) > 1 else [goal]
    return np.array([*before, *values, *after], np.float32)


def _tensor(found: Any, place: str, wanted: str) -> torch.Tensor:
    if found is None:
        raise api.PluginError(
            f"{place}: gave None; wanted is {wanted}; does it return something on every way?"
        )
    if isinstance(found, torch.Tensor):
        if found.dtype == torch.bool or found.is_complex():
            raise api.PluginError(
                f"{place}: gave a tensor of {found.dtype}; wanted are real numbers, {wanted}"
            )
        return found.detach().cpu().to(torch.float32)
    try:
        array = np.asarray(found)
    except (TypeError, ValueError) as error:
        raise api.PluginError(
            f"{place}: gave {type(found).__name__}, no array ({error}); wanted is {wanted}"
        ) from None
    if array.dtype.kind not in "fiu":
        raise api.PluginError(
            f"{place}: gave {type(found).__name__} of {array.dtype}; wanted are real numbers, {wanted}"
        )
    return torch.from_numpy(array.astype(np.float32))


# ---- Time that the user's code takes, and a voice while a call does not come back.

STALL_S = 10.0
"""a call that takes longer is told while it runs"""


class CallMeter:
    """Sums up calls. The first one, which may load libraries, counts as a call but its time does not."""

    def __init__(
        self,
        what: str,
        path: Path,
        budget_s: float,
        note: Callable[[str], None],
        now: Callable[[], float] = time.perf_counter,
        stall_s: float = STALL_S,
    ) -> None:
        """``budget_s``: what one env's decision may take; beyond it a vehicle would have to wait for it."""
        self._what, self._path, self._note, self._now = what, path, note, now
        self.budget_s, self._stall_s = budget_s, stall_s
        self.calls = self.timed = self.late = self.decisions = 0
        self.seconds = self.worst_s = 0.0
        self._begun: float | None = None
        self._thread = 0
        self._stop = threading.Event()
        self._guard: threading.Thread | None = None

    @contextlib.contextmanager
    def call(self, decisions: int = 1) -> Iterator[None]:
        """Time a call that decides for so many envs."""
        if self._guard is None:
            self._guard = threading.Thread(target=self._watch, daemon=True)
            self._guard.start()
        self._thread = threading.get_ident()
        begun = self._begun = self._now()
        try:
            yield
        finally:
            took, self._begun = self._now() - begun, None
            self.calls += 1
            if self.calls > 1:
                self._add(took, decisions)

    def _add(self, took: float, decisions: int) -> None:
        each = took / max(1, decisions)
        self.timed += 1
        self.decisions += decisions
        self.seconds += took
        self.worst_s = max(self.worst_s, each)
        self.late += each > self.budget_s

    def close(self) -> None:
        """Nobody waits for a call any more."""
        self._stop.set()
        self._guard, self._stop = None, threading.Event()

    def document(self) -> dict[str, Any]:
        """As JSON; times are per decision of one env, None where none was timed."""
        ms = 1e3 * self.seconds / self.decisions if self.decisions else None
        return {
            "calls": self.calls,
            "decisions": self.decisions,
            "decision_ms": None if ms is None else round(ms, 4),
            "slowest_ms": round(1e3 * self.worst_s, 4) if self.timed else None,
            "late_calls": self.late,
            "budget_ms": round(1e3 * self.budget_s, 4),
        }

    def told(self) -> str:
        """What has to be said of slow calls; empty = nothing."""
        if not self.late:
            return ""
        return (
            f"{self._what}: {self.late} of {self.timed} calls took longer than a control step "
            f"({1e3 * self.budget_s:g} ms) for one env, the slowest {1e3 * self.worst_s:.0f} ms; the "
            "simulator waited, a vehicle would not"
        )

    def _watch(self) -> None:
        stop, told = self._stop, None
        while not stop.wait(min(1.0, self._stall_s / 4)):
            begun = self._begun
            if begun is not None and begun != told and self._now() - begun > self._stall_s:
                told = begun
                line = api.line_of_frame(sys._current_frames().get(self._thread), self._path)
                place = f"{self._path}:{line}" if line else str(self._path)
                self._note(
                    f"{place}: a call of {self._what} has not come back for {self._stall_s:g} s; Ctrl-C stops"
                )


# ---- The user's code as it is called, and as an agent.


class Marks(NamedTuple):
    """How a plugin wants to be called (``protocol.plugin``)."""

    rows: str = "batch"
    arrays: str = "numpy"
    hold_steps: int = 1


class OwnCode(NamedTuple):
    """The user's functions, and where they come from."""

    spec: api.PluginSpec
    act: Callable[..., Any]
    reset: Callable[..., Any] | None
    place: str
    """FILE:LINE of ``act``"""
    marks: Marks
    meter: CallMeter

    def called(self, function: Callable[..., Any], given: Any, decisions: int) -> Any:
        """What a function of hers answers. PluginError names the line where it fails."""
        try:
            with self.meter.call(decisions):
                return function(given)
        except (Exception, SystemExit) as error:
            raise api.failed(error, self.spec.path, self.spec.option) from error

    def forget(self, mask: torch.Tensor) -> None:
        """Tell her that new episodes begin in the rows where ``mask`` (n_env,) is not 0."""
        if self.reset is not None:
            rows = mask.nonzero().flatten().cpu().numpy()
            try:
                self.reset(rows)
            except (Exception, SystemExit) as error:
                raise api.failed(error, self.spec.path, f"in reset of {self.spec.option}") from error


Ask = Callable[[list[int], torch.Tensor], torch.Tensor]
"""(rows, their observations (n, n_obs)) -> actions (n, 4) in parts of the limits"""


class PluginAgent:
    """Asks for every row once per decision, the running rows alone. A ``episodes.Agent``."""

    world_model = None

    def __init__(self, sim: Sim, code: OwnCode, ask: Ask) -> None:
        self._sim, self.code, self._ask = sim, code, ask
        self._age = np.zeros(sim.num_envs, np.int64)
        self._due = np.ones(sim.num_envs, bool)
        self._action = torch.zeros(sim.num_envs, 4, device=sim.device)
        self.decision = self._decision()

    def reset(self, rows: torch.Tensor) -> None:
        begun = rows.cpu().numpy() != 0
        self._age[begun], self._due[begun] = 0, True
        self.code.forget(rows)

    @torch.no_grad()
    def decide(self, obs: torch.Tensor) -> AgentDecision:
        """What to do now; rows that have decided already are not asked again."""
        running = self._sim.rows(self._sim.s.clock.active) == 1
        rows = np.flatnonzero(self._due & running)
        if len(rows):
            chosen = torch.from_numpy(rows).to(obs.device)
            self._action[chosen] = self._ask(rows.tolist(), obs[chosen]).clamp(-1.0, 1.0)
            self._due[rows] = False
            self.decision = self._decision()
        return self.decision

    def advance(self) -> None:
        self._age += 1
        self._due |= self._age % self.code.marks.hold_steps == 0

    def _decision(self) -> AgentDecision:
        nothing = torch.zeros(0)
        return AgentDecision(self._action.clone(), *(nothing,) * (len(AgentDecision._fields) - 1))


def asking_controller(sim: Sim, code: OwnCode, columns: Mapping[str, slice], limits: np.ndarray) -> Ask:
    """Of ``act(view)``, which answers with a velocity command."""
    fixed, top = Fixed(sim, columns, limits, code.marks.arrays), torch.as_tensor(limits, device=sim.device)

    def ask(rows: list[int], obs: torch.Tensor) -> torch.Tensor:
        readings = Readings(sim, rows, obs)
        view: api.View = PluginView(readings, fixed)
        if code.marks.rows == "batch":
            found = code.called(code.act, view, len(rows))
        else:
            each = (code.called(code.act, PluginView(readings, fixed, i), 1) for i in range(len(rows)))
            found = torch.cat([command(one, code.place, api.COMMAND) for one in each])
        return commands(found, len(rows), code.place, api.COMMAND, sim.device) / top

    return ask


def asking_policy(code: OwnCode, device: torch.device) -> Ask:
    """Of ``act(obs)``, which answers with actions. Always ``CHUNK`` rows at once, the last chunk filled up:
    what a row does shall not depend on how many others are asked."""

    def ask(rows: list[int], obs: torch.Tensor) -> torch.Tensor:
        parts = []
        for first in range(0, len(rows), CHUNK):
            part = obs[first : first + CHUNK]
            whole = torch.cat([part, part[:1].expand(CHUNK - len(part), -1)])
            given = whole if code.marks.arrays == "torch" else whole.cpu().numpy()
            found = code.called(code.act, given, len(part))
            parts.append(commands(found, CHUNK, code.place, api.ACTION, device)[: len(part)])
        return torch.cat(parts)

    return ask
