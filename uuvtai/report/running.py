"""Running episodes for the page's player, as messages in JSON: what every vehicle does, and of those that
somebody follows what they sense, map and plan (``player/running.mjs`` reads them)."""

from __future__ import annotations

import base64
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import numpy as np

from uuvtai.common.colours import PALETTE, agent_colours
from uuvtai.common.enums import TRIGGERS, clearance_m, occupancy
from uuvtai.common.obstacle_motion import describe_scenario
from uuvtai.logs.drawing import OUTCOME_NAMES, towards
from uuvtai.logs.encode import EpisodeEnd, dumped, numbered
from uuvtai.logs.scenario import scenario_document
from uuvtai.logs.topics.perception import map_origin
from uuvtai.logs.topics.planning import code_name
from uuvtai.logs.writer import Recordable, RecordedJob
from uuvtai.report.recorded import CLEAR_M, EVERY_POINT, LEAST_WEIGHT, SHARE, camera_view, scene_header

FRAME_S, MAP_S = 0.05, 0.5
"""[s] of the clock between two frames, [s] of the episode between two maps"""
_FAR_S = 1e5
_MOTION = (
    *("clock.step", "vehicle.pos_w", "vehicle.quat_wb", "vehicle.vel_b", "ego.pos_w", "ego.rpy", "ego.vel_b"),
    *("termination.clearance_m", "termination.ttc_s", "behavior.leaf", "world.pos_w"),
)


@dataclass
class _Tank:
    """An episode, as far as it was shown."""

    sim: Recordable
    row: int
    number: int
    head: dict[str, Any]
    moving: list[int]  # slots of the obstacles that move
    rows: list[tuple[list[Any], list[Any]]] = field(default_factory=list)
    """time [s], x, y, z, yaw, clearance, time to collision, speed, leaf, places of what moves: by what the
    vehicle knows, in truth"""
    replans: list[tuple[float, str]] = field(default_factory=list)
    map_s: float = -math.inf  # when the newest map was shown
    end: dict[str, Any] | None = None

    @property
    def time_s(self) -> float:
        return self.rows[-1][0][0]

    def whole(self, with_truth: bool) -> str:
        """All of it up to now."""
        scene = self.head["scene"] | ({} if with_truth else {"obstacles": []})
        rows = [pair[with_truth] for pair in self.rows]
        return _text(self.head | {"scene": scene, "rows": rows, "replans": self.replans, "end": self.end})


class RunningEpisodes:
    """Shows every row of a simulator as a tank; an ``EpisodeObserver``."""

    def __init__(
        self, audience: Any, world: str, agents: Sequence[str], rate: float = 1.0, which: int = 0
    ) -> None:
        """``audience``: a ``live.page.PageServer``; ``rate``: seconds of the episode in one of the clock's,
        by which frames keep their distance; 0 = as fast as it goes; ``which`` of the agents drives here."""
        self._audience, self._world, self._rate = audience, world, rate
        self._agents, self._which = agents, which
        self._tanks: dict[int, _Tank] = {}
        self._steps, self._shown_s = 0, -math.inf

    def side_by_side(self) -> list[RunningEpisodes]:
        """One of these for each agent: all run the same episodes, and their tanks stand side by side."""
        others = [
            RunningEpisodes(self._audience, self._world, self._agents, self._rate, which)
            for which in range(1, len(self._agents))
        ]
        for other in others:
            other._tanks = self._tanks
        return [self, *others]

    def begin(self, sim: Recordable, row: int, job: RecordedJob) -> None:
        described = describe_scenario(lambda name: _read(sim, name, [row])[0])
        scene, moving = scene_header(
            scenario_document(sim.config, described, self._world, job.seed, job.episode)
        )
        agent, rows = self._agents[self._which], len(sim.rows(sim.s.clock.step))
        colour, number = agent_colours(self._agents)[agent], row * len(self._agents) + self._which
        head = {
            "kind": "begin", "tank": number, "title": f"seed {job.seed}, episode {job.episode}",
            "scene": scene, "agent": agent, "leaves": numbered(sim.tree.names), "grid": _grid(sim),
            "colour": [colour, PALETTE.index(colour) if colour in PALETTE else -1],
            "of": len(self._agents) * rows,
        }  # fmt: skip
        tank = self._tanks[number] = _Tank(sim, row, number, head, [one["slot"] for one in moving])
        tank.rows += _motion([tank])
        self._audience.note("")
        self._audience.tell(tank.whole(self._audience.with_truth))
        self._note_replans([tank])
        self._wait(at_start=True)

    def step(self, sim: Recordable) -> None:
        self._steps += 1
        running = [tank for tank in self._tanks.values() if tank.sim is sim and tank.end is None]
        self._note_replans(running)
        if self._is_due(sim.config.episode.control_dt_s):
            self._show(running)
        self._wait()

    def end(self, sim: Recordable, row: int, result: EpisodeEnd) -> None:
        """The episode of this row is over."""
        (tank,) = (one for one in self._tanks.values() if one.sim is sim and one.row == row)
        self._show([tank])
        said = OUTCOME_NAMES.get(result.outcome, result.outcome)
        tank.end = {"outcome": said, "failed": result.outcome != "success", "time": result.time_s}
        self._audience.tell(_text({"kind": "end", "tank": tank.number, "end": tank.end}))
        if not self._audience.with_truth:  # now it does no harm
            self._audience.tell(tank.whole(with_truth=True))

    def _is_due(self, dt_s: float) -> bool:
        """Whether a frame's time has come: by the episode's time, which the clock follows by the rate, so
        that a busy machine shows as many; without a rate by the clock."""
        if not self._rate:
            return time.monotonic() >= self._shown_s + FRAME_S
        gap = FRAME_S * self._rate / dt_s  # in steps
        return self._steps // gap > (self._steps - 1) // gap

    def _show(self, tanks: list[_Tank]) -> None:
        """A frame of these tanks, with what those who follow one of them see."""
        self._shown_s, shown = time.monotonic(), []
        for tank, pair in zip(tanks, _motion(tanks), strict=True):
            if pair[0][0] > tank.time_s:
                tank.rows.append(pair)
                shown.append([tank.number, pair[self._audience.with_truth]])
        if shown:
            self._audience.tell(_text({"kind": "frame", "tanks": shown}))
        followed = self._audience.followed()
        for tank in tanks:
            if tank.number in followed:
                has_map = tank.time_s - tank.map_s >= MAP_S - 1e-6
                if has_map:
                    tank.map_s = tank.time_s
                self._audience.tell(_detail(tank, has_map), tank=tank.number)

    def _wait(self, at_start: bool = False) -> None:
        """Tell those who have come or have turned to another tank what there is, and wait while the episode
        is held."""
        while True:
            for who, wants_all in self._audience.asked().items():
                for tank in self._tanks.values():
                    if wants_all:
                        self._audience.tell(tank.whole(self._audience.with_truth), to=who)
                    if who.tank == tank.number:
                        self._audience.tell(_detail(tank, True), to=who)
            if not self._audience.is_held(at_start):
                return
            at_start = False

    def _note_replans(self, tanks: list[_Tank]) -> None:
        """Told as they come, that of the reset too."""
        names = ("route.n_way", "route.plan_step", "clock.step", "route.trigger")
        for tank, count, planned, step, why in zip(tanks, *_read_all(tanks, names), strict=True):
            if count > 0 and planned == step:
                dt_s = tank.sim.config.episode.control_dt_s
                replan = round(int(step) * dt_s, 4), code_name(TRIGGERS, why)
                tank.replans.append(replan)
                self._audience.tell(_text({"kind": "replan", "tank": tank.number, "replan": replan}))


def _motion(tanks: list[_Tank]) -> list[tuple[list[Any], list[Any]]]:
    """What the vehicles do, as ``_Tank.rows`` has it."""
    found = []
    for tank, *read in zip(tanks, *_read_all(tanks, _MOTION), strict=True):
        step, place, (w, x, y, z), velocity, own, rpy, own_velocity, clearance, ttc_s, leaf, at = read
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        time_s = round(int(step) * tank.sim.config.episode.control_dt_s, 4)
        speeds = _rounded([np.linalg.norm(own_velocity), np.linalg.norm(velocity)], 2)
        safety = _rounded([clearance, -1.0 if ttc_s > _FAR_S else ttc_s], 3)
        known = [time_s, *_rounded([*own, rpy[2]], 3), None, None, speeds[0], int(leaf), []]
        places = _rounded(at[tank.moving, :2].ravel(), 2)
        true = [time_s, *_rounded([*place, yaw], 3), *safety, speeds[1], int(leaf), places]
        found.append((known, true))
    return found


def _read_all(tanks: list[_Tank], names: Sequence[str]) -> list[np.ndarray]:
    """Of tanks of one simulator."""
    return [_read(tanks[0].sim, name, [tank.row for tank in tanks]) for name in names] if tanks else []


def _read(sim: Recordable, name: str, rows: list[int]) -> np.ndarray:
    return sim.rows(attrgetter(name)(sim.s), rows)


def _grid(sim: Recordable) -> dict[str, Any]:
    shape = _read(sim, "grid_map.static_occ", [0])[0].shape
    x, y = map_origin(sim.config, shape)
    return {"rows": shape[0], "columns": shape[1], "x": x, "y": y, "cell_m": sim.config.mapping.cell_m}


def _detail(tank: _Tank, with_map: bool) -> str:
    """What a vehicle senses and plans at this time, and what it has mapped."""
    sim = tank.sim

    def read(name: str) -> np.ndarray:
        return _read(sim, name, [tank.row])[0]

    n_way, sonar = int(read("route.n_way")), sim.config.sensors.sonar
    hit = np.flatnonzero(read("scan.hit") == 1)
    bearing = float(read("scan.ping_yaw")) + sonar.first_beam_rad + sonar.beam_step_rad * hit
    echoes = read("scan.ping_pos_w")[:2] + read("scan.range_m")[hit, None] * towards(bearing)
    moving = (read("tracks.alive") == 1) & (read("tracks.moving") == 1)
    state, radius_m, cov = (read(f"tracks.{name}")[moving] for name in ("state", "radius_m", "cov"))
    message = {
        "kind": "detail", "tank": tank.number, "time": tank.time_s,
        "route": _rounded(read("route.way_w")[:n_way], 2),
        "ahead": _rounded(read("route.lookahead_w")[:2], 2) if n_way else None,
        "echoes": _rounded(echoes, 2),
        "tracks": _rounded(np.column_stack([state, radius_m, cov[:, [0, 1, 4]]]), 4),
        "futures": _futures(read),
        "camera": base64.b64encode(camera_view(read("image.depth_m")).tobytes()).decode(),
    }  # fmt: skip
    if with_map:
        layers = [occupancy(read(f"grid_map.{name}_occ")) / SHARE for name in ("static", "dynamic")]
        layers.append(clearance_m(read("clearance.site"), sim.config) / CLEAR_M)
        cells = [np.clip(np.rint(layer), 0, 255).astype(np.uint8).tobytes() for layer in layers]
        message["map"] = [base64.b64encode(layer).decode() for layer in cells]
    return _text(message)


def _futures(read: Callable[[str], np.ndarray]) -> list[Any]:
    """[weight, [[x, y], ..]] of where each moving track may go."""
    shares, others, forecast = read("futures.share"), read("futures.pos_w"), read("forecast.pos_w")
    found = []
    for track in np.flatnonzero(read("forecast.radius_m")[:, 0] >= 0):
        weights = [*shares[track], 1.0 - shares[track].sum()]
        paths = zip(_rounded(weights, 2), [*others[track], forecast[track]], strict=True)
        found += [[w, _rounded(points[::EVERY_POINT], 2)] for w, points in paths if w >= LEAST_WEIGHT]
    return found


def _rounded(values: Any, digits: int) -> list[Any]:
    return np.round(np.asarray(values, float), digits).tolist()


def _text(message: dict[str, Any]) -> str:
    return dumped(message).decode()
