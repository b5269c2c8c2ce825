"""Running episodes for the page's player, as messages in JSON: what every vehicle does, and of those that
somebody follows what they sense, map and plan (``player/running.mjs`` reads them)."""

from __future__ import annotations

import base64
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

import numpy as np

from uuvtai.common.colours import PALETTE, agent_colours
from uuvtai.common.enums import TRIGGERS, clearance_m, occupancy
from uuvtai.common.obstacle_motion import describe_scenario
from uuvtai.logs.encode import EpisodeEnd, numbered
from uuvtai.logs.scenario import scenario_document
from uuvtai.logs.topics.perception import map_origin
from uuvtai.logs.topics.planning import code_name
from uuvtai.logs.writer import Recordable, RecordedJob
from uuvtai.report.recorded import SHARE, scene_header

FRAME_S, MAP_S = 0.05, 0.5
"""[s] of the clock between two frames, [s] of the episode between two maps"""
_FAR_S, _CLEAR_M = 1e5, 0.1
_LEAST_WEIGHT, _EVERY_POINT = 0.1, 5  # of forecasts, as recorded episodes have them
_OUTCOMES = {"ttc": "TTC stop", "out_of_tank": "out of the tank"}


class Audience(Protocol):
    """Whoever looks at the page."""

    with_truth: bool
    """whether it sees what no vehicle senses"""

    def asked(self) -> list[tuple[Any, int]]:
        """(who, tank) of those who have begun to follow a tank since the last call; -1 = who has come, and is
        told all there is so far."""
        ...

    def followed(self) -> set[int]:
        """Tanks that somebody follows."""
        ...

    def tell(self, message: str, tank: int | None = None, to: Any = None) -> None:
        """A message for all, for those who follow a tank, or for one."""

    def note(self, text: str) -> None:
        """Say it in place of what was said before."""

    def is_held(self, at_start: bool = False) -> bool:
        """Whether the episode has to wait, of which a moment has been waited."""
        ...


class _Moment(NamedTuple):
    """What a vehicle does, in truth and by its own estimate."""

    time_s: float
    pose: tuple[list[float], list[float]]  # x, y, z [m], yaw [rad]: true, own
    speed_m_s: tuple[float, float]  # true, own
    clearance_m: float
    ttc_s: float  # -1 = nothing closes in
    leaf: int
    places: list[float]  # x, y [m] of each obstacle that moves

    def row(self, with_truth: bool) -> list[Any]:
        """For the page."""
        own = 0 if with_truth else 1
        safety = [self.clearance_m, self.ttc_s] if with_truth else [None, None]
        places = self.places if with_truth else []
        return [self.time_s, *self.pose[own], *safety, self.speed_m_s[own], self.leaf, places]


@dataclass
class _Tank:
    """An episode, as far as it was shown."""

    head: dict[str, Any]
    moving: list[int]  # slots of the obstacles that move
    moments: list[_Moment] = field(default_factory=list)
    replans: list[tuple[float, str]] = field(default_factory=list)
    map_s: float = -math.inf  # when the newest map was shown
    end: dict[str, Any] | None = None


class RunningEpisodes:
    """Shows every row of a simulator as a tank; an ``EpisodeObserver``."""

    def __init__(
        self,
        audience: Audience,
        world: str,
        agent: str,
        rate: float = 1.0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """``rate``: seconds of the episode in one of the clock's, by which frames keep their distance; 0 = as
        fast as it goes."""
        self._audience, self._world, self._agent, self._rate, self._now = audience, world, agent, rate, now
        self._tanks: dict[int, _Tank] = {}
        self._steps, self._due_s = 0, -math.inf

    def begin(self, sim: Recordable, row: int, job: RecordedJob) -> None:
        """An episode was just reset in this row."""
        described = describe_scenario(lambda name: _read(sim, name, [row])[0])
        scenario = scenario_document(sim.config, described, self._world, job.seed, job.episode)
        scene, moving = scene_header(scenario)
        colour = agent_colours([self._agent])[self._agent]
        head = {
            "kind": "begin", "tank": row, "title": f"seed {job.seed}, episode {job.episode}", "scene": scene,
            "agent": self._agent, "colour": [colour, PALETTE.index(colour) if colour in PALETTE else -1],
            "leaves": numbered(sim.tree.names), "grid": _grid(sim), "of": len(sim.rows(sim.s.clock.step)),
        }  # fmt: skip
        tank = self._tanks[row] = _Tank(head, [one["slot"] for one in moving])
        tank.moments += self._moments(sim, [row])
        self._audience.note("")
        self._audience.tell(self._whole(tank, self._audience.with_truth))
        self._wait(sim, at_start=True)

    def step(self, sim: Recordable) -> None:
        """A control step has been done in all rows."""
        self._steps += 1
        running = [row for row, tank in self._tanks.items() if tank.end is None]
        self._note_replans(sim, running)
        if self._is_due(sim.config.episode.control_dt_s):
            self._show(sim, running)
        self._wait(sim)

    def end(self, sim: Recordable, row: int, result: EpisodeEnd) -> None:
        """The episode of this row is over."""
        self._show(sim, [row])
        said = _OUTCOMES.get(result.outcome, result.outcome)
        end = {"outcome": said, "failed": result.outcome != "success", "time": result.time_s}
        self._tanks[row].end = end
        self._audience.tell(_dumped({"kind": "end", "tank": row, "end": end}))
        if not self._audience.with_truth:  # now it does no harm
            self._audience.tell(self._whole(self._tanks[row], with_truth=True))

    def _is_due(self, dt_s: float) -> bool:
        """Whether a frame's time has come: by the episode's time, which the clock follows by the rate, so
        that a busy machine shows as many; without a rate by the clock."""
        if not self._rate:
            return self._now() >= self._due_s
        gap_s = FRAME_S * self._rate
        return math.floor(self._steps * dt_s / gap_s + 1e-9) > math.floor(
            (self._steps - 1) * dt_s / gap_s + 1e-9
        )

    def _show(self, sim: Recordable, rows: list[int]) -> None:
        """A frame of these rows, with what those who follow one of them see."""
        self._due_s = self._now() + FRAME_S
        shown = []
        for row, moment in zip(rows, self._moments(sim, rows), strict=True):
            moments = self._tanks[row].moments
            if moment.time_s > moments[-1].time_s:
                moments.append(moment)
                shown.append([row, moment.row(self._audience.with_truth)])
        if shown:
            self._audience.tell(_dumped({"kind": "frame", "tanks": shown}))
        for row in self._audience.followed().intersection(rows):
            tank = self._tanks[row]
            has_map = tank.moments[-1].time_s - tank.map_s >= MAP_S - 1e-6
            if has_map:
                tank.map_s = tank.moments[-1].time_s
            self._audience.tell(_detail(sim, row, tank.moments[-1].time_s, has_map), tank=row)

    def _wait(self, sim: Recordable, at_start: bool = False) -> None:
        """Tell those who have come or have turned to another tank what there is, and wait while the episode
        is held."""
        while True:
            for who, row in self._audience.asked():
                for found in [row] if row >= 0 else sorted(self._tanks):
                    if (tank := self._tanks.get(found)) is None:
                        continue
                    if row < 0:
                        self._audience.tell(self._whole(tank, self._audience.with_truth), to=who)
                    else:
                        self._audience.tell(_detail(sim, row, tank.moments[-1].time_s, True), to=who)
            if not self._audience.is_held(at_start):
                return
            at_start = False

    def _whole(self, tank: _Tank, with_truth: bool) -> str:
        """All of an episode up to now."""
        head = dict(tank.head)
        if not with_truth:
            head["scene"] = head["scene"] | {"obstacles": []}
        rows = [moment.row(with_truth) for moment in tank.moments]
        return _dumped(head | {"rows": rows, "replans": tank.replans, "end": tank.end})

    def _moments(self, sim: Recordable, rows: list[int]) -> list[_Moment]:
        dt_s = sim.config.episode.control_dt_s
        names = (
            *("clock.step", "vehicle.pos_w", "vehicle.quat_wb", "vehicle.vel_b", "ego.pos_w", "ego.rpy"),
            *("ego.vel_b", "termination.clearance_m", "termination.ttc_s", "behavior.leaf", "world.pos_w"),
        )
        found = []
        for row, *read in zip(rows, *(_read(sim, name, rows) for name in names), strict=True):
            step, place, quat, velocity, own, rpy, own_velocity, clearance, ttc_s, leaf, obstacles = read
            w, x, y, z = map(float, quat)
            yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            poses = _rounded([*place, yaw], 3), _rounded([*own, rpy[2]], 3)
            speeds = [round(float(np.linalg.norm(each)), 2) for each in (velocity, own_velocity)]
            ttc_s = -1.0 if ttc_s > _FAR_S else round(float(ttc_s), 2)
            places = _rounded(obstacles[self._tanks[row].moving, :2].ravel(), 2)
            found.append(
                _Moment(
                    round(int(step) * dt_s, 4), poses, (speeds[0], speeds[1]), round(float(clearance), 3),
                    ttc_s, int(leaf), places,
                )
            )  # fmt: skip
        return found

    def _note_replans(self, sim: Recordable, rows: list[int]) -> None:
        """Told as they come; those of the reset are in the first message of all."""
        names = ("route.n_way", "route.plan_step", "clock.step", "route.trigger")
        read = [_read(sim, name, rows) for name in names]
        for row, count, planned, step, trigger in zip(rows, *read, strict=True):
            if count > 0 and planned == step:
                replan = round(int(step) * sim.config.episode.control_dt_s, 4), code_name(TRIGGERS, trigger)
                self._tanks[row].replans.append(replan)
                self._audience.tell(_dumped({"kind": "replan", "tank": row, "replan": replan}))


def _read(sim: Recordable, name: str, rows: list[int]) -> np.ndarray:
    return sim.rows(attrgetter(name)(sim.s), rows)


def _grid(sim: Recordable) -> dict[str, Any]:
    shape = _read(sim, "grid_map.static_occ", [0])[0].shape
    x, y = map_origin(sim.config, shape)
    return {"rows": shape[0], "columns": shape[1], "x": x, "y": y, "cell_m": sim.config.mapping.cell_m}


def _detail(sim: Recordable, row: int, time_s: float, with_map: bool) -> str:
    """What a vehicle senses and plans at this time, and what it has mapped."""

    def read(name: str) -> np.ndarray:
        return _read(sim, name, [row])[0]

    n_way, sonar = int(read("route.n_way")), sim.config.sensors.sonar
    hit = np.flatnonzero(read("scan.hit") == 1)
    bearing = float(read("scan.ping_yaw")) + sonar.first_beam_rad + sonar.beam_step_rad * hit
    echoes = read("scan.ping_pos_w")[:2] + read("scan.range_m")[hit, None] * np.column_stack(
        [np.cos(bearing), np.sin(bearing)]
    )
    moving = (read("tracks.alive") == 1) & (read("tracks.moving") == 1)
    tracks = zip(
        read("tracks.state")[moving],
        read("tracks.radius_m")[moving],
        read("tracks.cov")[moving][:, [0, 1, 4]],
        strict=True,
    )
    message = {
        "kind": "detail", "tank": row, "time": time_s,
        "route": _rounded(read("route.way_w")[:n_way], 2),
        "ahead": _rounded(read("route.lookahead_w")[:2], 2) if n_way else None,
        "echoes": _rounded(echoes, 2),
        "tracks": [[*_rounded([*state, radius], 2), *_rounded(cov, 4)] for state, radius, cov in tracks],
        "futures": _futures(read),
    }  # fmt: skip
    if with_map:
        layers = [occupancy(read(f"grid_map.{name}_occ")) / SHARE for name in ("static", "dynamic")]
        layers.append(clearance_m(read("clearance.site"), sim.config) / _CLEAR_M)
        packed = [
            base64.b64encode(np.clip(np.rint(one), 0, 255).astype(np.uint8).tobytes()) for one in layers
        ]
        message["map"] = [one.decode() for one in packed]
    return _dumped(message)


def _futures(read: Callable[[str], np.ndarray]) -> list[Any]:
    """[weight, [[x, y], ..]] of where each moving track may go."""
    shares, radius_m = read("futures.share"), read("forecast.radius_m")
    others, forecast = read("futures.pos_w"), read("forecast.pos_w")
    found = []
    for track in np.flatnonzero(radius_m[:, 0] >= 0):
        paths = [*zip(shares[track].tolist(), others[track], strict=True)]
        paths.append((1.0 - float(shares[track].sum()), forecast[track]))
        found += [
            [round(w, 2), _rounded(points[::_EVERY_POINT], 2)] for w, points in paths if w >= _LEAST_WEIGHT
        ]
    return found


def _rounded(values: Any, digits: int) -> list[Any]:
    return np.round(np.asarray(values, float), digits).tolist()


def _dumped(message: dict[str, Any]) -> str:
    return json.dumps(message, separators=(",", ":"), allow_nan=False)
