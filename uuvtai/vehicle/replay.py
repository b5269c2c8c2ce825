"""Feed a log to the pilot, step by step, and compare what it decides with what was decided then."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.common.errors import SettingError
from uuvtai.config import Config
from uuvtai.config.loader import LEARNING_SECTIONS, ConfigError, parsed_yaml, validated
from uuvtai.logs.drawing import REPLAYED
from uuvtai.logs.encode import LogError, unlike_schema
from uuvtai.logs.picture import picture
from uuvtai.logs.reader import IMPORTED, LogHead, LogMessage, read_head, read_messages
from uuvtai.logs.run_folder import RunFolder, default_run_dir
from uuvtai.logs.topics.motion import quaternion_of
from uuvtai.logs.topics.sensors import exact_image
from uuvtai.logs.writer import EpisodeRecorder
from uuvtai.sim.behavior_tree import FlatTree, parse_tree, read_tree
from uuvtai.vehicle import onboard
from uuvtai.vehicle.messages import KINDS, NAMES, three
from uuvtai.vehicle.pilot_log import ABOUT

# ---- A log as the pilot's sensors would have told it: messages with the step of their arrival.

_MAX_STEPS = 180_000  # an hour
_AGAIN = "record it again: uuv eval --record 1 --depth-images"


@dataclass(frozen=True)
class Delivery:
    """A message and when it reaches the pilot."""

    time_s: float
    message: onboard.SensorMessage


@dataclass(frozen=True, eq=False)
class LoggedStep:
    """What was decided in a control step; None where the log does not say."""

    action: np.ndarray  # (4,) float32 the tree's
    asked_w: np.ndarray  # (3,) float32
    leaf: str
    pos_w: np.ndarray | None = None  # (3,) float32 own position as estimated


@dataclass
class LogFeed:
    """All that a replay needs of a log."""

    path: Path
    config: Config
    tree: FlatTree
    mission: onboard.Mission
    run: dict[str, str]  # metadata uuv.run
    arrivals: list[Delivery] = field(default_factory=list)  # in the order of the log
    steps: list[LoggedStep] = field(default_factory=list)  # from step 0 on, without a gap
    is_imported: bool = False  # of recordings of others: without commands, and perhaps sensors


def read_feed(path: Path, tree: str | None = None) -> LogFeed:
    """Read a log; ``tree``: name or file of a tree in place of the one that it holds. Raises LogError
    for what cannot be replayed, TreeError and ConfigError for a tree that cannot be read."""
    head = read_head(path)
    with unlike_schema(path):
        feed = _begun(path, head, tree)
        _FeedReader(feed).run()
    return feed


def _begun(path: Path, head: LogHead, tree: str | None) -> LogFeed:
    config = _config(path, head)
    run = head.metadata.get("uuv.run") or head.metadata.get(IMPORTED) or {}
    scenario = head.scenario
    mission = onboard.Mission(
        start=three(scenario["start"]),
        goal=three(scenario["goal"]),
        seed=int(run["seed"]),
        episode=int(run["episode"]),
    )
    if run["agent"].endswith("+truth"):
        raise LogError(
            f"{path}: was driven with the truth, which no sensor tells; replay a log without +truth"
        )
    is_imported = "uuv.run" not in head.metadata and IMPORTED in head.metadata
    return LogFeed(path, config, _tree(path, head, tree), mission, run, is_imported=is_imported)


def _config(path: Path, head: LogHead) -> Config:
    if "config.yaml" not in head.attachments:
        pilot, other = f"uuv pilot wrote it: uuv log import {path}", "uuv eval --record did not write it"
        why = pilot if ABOUT in head.metadata else other
        raise LogError(f"{path}: the log has no attachment config.yaml: {why}")
    where = f"{path}: config.yaml"
    try:
        given = parsed_yaml(head.attachments["config.yaml"].decode(), where)
        driving = {name: given[name] for name in given if name not in LEARNING_SECTIONS}
        return validated(driving, dict.fromkeys(driving, where))
    except ConfigError as error:
        raise LogError(f"{where} cannot be used here ({error}); record the episode again") from None


def _tree(path: Path, head: LogHead, tree: str | None) -> FlatTree:
    if tree is not None:
        return read_tree(tree)
    if "tree.xml" not in head.attachments:
        raise LogError(
            f"{path}: the log does not hold the tree that drove; name it: uuv replay {path} --agent bt"
        )
    return parse_tree(head.attachments["tree.xml"], f"{path}: tree.xml")


def _array(values: Any) -> np.ndarray:
    """As the simulator had it: nine digits give back a float32."""
    return np.array(values, np.float32)


class _FeedReader:
    """Messages into the feed."""

    def __init__(self, feed: LogFeed) -> None:
        self._feed, self._config = feed, feed.config
        self._given = feed.config.sensors.localization != "estimated"
        self._scan: dict[str, Any] = {}
        self._pos_w: np.ndarray | None = None
        self._seen: set[str] = set()
        self._readers: dict[str, Callable[[LogMessage], None]] = {
            "/sensors/imu": self._imu,
            "/sensors/dvl": self._dvl,
            "/sensors/pressure": self._pressure,
            "/pose_estimate": self._position,
            "/sonar/scan": self._keep_scan,
            "/sonar/doppler": self._ping,
            "/camera/exact": self._shot,
            "/plan/info": self._plan,
            "/action": self._action,
        }

    def run(self) -> None:
        """All of the log. Raises LogError where something is missing."""
        path = self._feed.path
        for message in read_messages(path, set(self._readers)):
            self._seen.add(message.topic)
            self._readers[message.topic](message)
        wanted = {"/sensors/imu", "/sensors/dvl", "/sensors/pressure", "/sonar/doppler", "/action"}
        c = self._config
        if c.camera_tracking.use_camera or c.height.use_camera or c.mapping.depth_hit > 0:
            wanted.add("/camera/exact")
        if self._feed.is_imported:
            wanted = {"/sensors/imu"}  # without it nothing can be placed
        if missing := sorted(wanted - self._seen):
            other = "import a recording that tells it too: uuv log import"
            raise LogError(
                f"{path}: the log has no {', '.join(missing)}, without which nothing decides the same; "
                f"{other if self._feed.is_imported else _AGAIN}"
            )

    def _arrives(self, m: LogMessage, message: onboard.SensorMessage) -> None:
        self._feed.arrivals.append(Delivery(m.time_s, message))

    def _imu(self, m: LogMessage) -> None:
        parts = (_array(m.data[name]) for name in ("attitude", "rates", "specific_force"))
        self._arrives(m, onboard.ImuReading(m.time_s, *parts))

    def _dvl(self, m: LogMessage) -> None:
        self._arrives(m, onboard.DvlReading(m.time_s, _array(m.data["velocity"])))

    def _pressure(self, m: LogMessage) -> None:
        self._arrives(m, onboard.PressureReading(m.time_s, float(m.data["depth_m"])))

    def _position(self, m: LogMessage) -> None:
        place = m.data["pose"]["position"]
        self._pos_w = _array([place[axis] for axis in "xyz"])
        if self._given:
            self._arrives(m, onboard.PositionFix(m.time_s, self._pos_w))

    def _keep_scan(self, m: LogMessage) -> None:
        self._scan = m.data

    def _ping(self, m: LogMessage) -> None:
        stamp = m.data["timestamp"]
        if self._scan.get("timestamp") != stamp:
            raise LookupError("/sonar/doppler without its /sonar/scan")
        hit = np.array(self._scan["intensities"], np.float32) > 0
        ping_s = stamp["sec"] + stamp["nsec"] / 1e9
        ranges, velocity = _array(self._scan["ranges"]), _array(m.data["velocity"])
        sonar = self._config.sensors.sonar
        first = round((self._scan["start_angle"] - sonar.first_beam_rad) / sonar.beam_step_rad)
        self._arrives(m, onboard.SonarPing(ping_s, ranges, hit, velocity, first))

    def _shot(self, m: LogMessage) -> None:
        camera = self._config.sensors.depth
        self._arrives(m, onboard.DepthShot(m.time_s, exact_image(m.data, (camera.rows, camera.cols))))

    def _plan(self, m: LogMessage) -> None:
        if m.data["planner"] == "own":
            raise LogError(
                f"{self._feed.path}: its routes come from a planner of the user's, which no log holds; "
                "replay a log without --planner"
            )

    def _action(self, m: LogMessage) -> None:
        step = round(m.time_s / self._config.episode.control_dt_s)
        if step != len(self._feed.steps):
            raise LogError(
                f"{self._feed.path}: step {len(self._feed.steps)} is missing, and a replay begins at step 0 "
                "and leaves none out; replay a log that is whole"
            )
        if step > _MAX_STEPS:
            raise LogError(f"{self._feed.path}: is longer than {_MAX_STEPS} steps; no episode of ours is")
        if given_up := m.data.get("given_up"):
            self._arrives(m, onboard.ThrusterLoss(m.time_s, float(given_up)))
        logged = LoggedStep(_array(m.data["behavior"]), _array(m.data["asked"]), m.data["leaf"], self._pos_w)
        self._feed.steps.append(logged)


# ---- What goes wrong on the way to the pilot: messages lost or late, a sensor dead for a while.


@dataclass(frozen=True)
class Outage:
    """A sensor that says nothing of what is measured from ``from_s`` to ``to_s``."""

    sensor: str
    from_s: float
    to_s: float


@dataclass(frozen=True)
class Faults:
    """All together; nothing at all unless asked for. Random ones depend on ``seed`` alone."""

    drop: float = 0.0  # share of the messages that is lost
    jitter_s: float = 0.0  # a message arrives up to this much later, uniformly: out of order too
    outages: tuple[Outage, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.drop <= 1:
            raise SettingError(f"--drop {self.drop:g}: must be a share from 0 to 1, for example --drop 0.2")
        if not 0 <= self.jitter_s <= 10:
            raise SettingError(f"--jitter {self.jitter_s:g}: must be 0 to 10 s, for example --jitter 0.1")

    @property
    def any(self) -> bool:
        return self.drop > 0 or self.jitter_s > 0 or bool(self.outages)


@dataclass
class Disturbed:
    """What reaches the pilot, in the order in which it does, and how much was lost, by sensor."""

    arrivals: list[Delivery]
    lost: Counter[str] = field(default_factory=Counter)


def outage_of(text: str) -> Outage:
    """Outage of 'dvl:10:15'. Raises SettingError."""
    sensor, _, span = text.partition(":")
    try:
        first, last = (float(part) for part in span.split(":"))
    except ValueError:
        first, last = math.nan, math.nan
    if sensor not in KINDS or not 0 <= first < last < math.inf:
        raise SettingError(
            f"--lose {text}: must be SENSOR:FROM:TO in seconds, with a sensor of {', '.join(KINDS)}; for "
            "example --lose dvl:10:15"
        )
    return Outage(sensor, first, last)


def disturbed(arrivals: Sequence[Delivery], faults: Faults) -> Disturbed:
    """What is left of the messages, and when it comes."""
    draws = np.random.default_rng(faults.seed).random((len(arrivals), 2))
    found = Disturbed([])
    for arrival, (luck, delay) in zip(arrivals, draws.tolist(), strict=True):
        name, measured_s = NAMES[type(arrival.message)], arrival.message.time_s
        dead = any(o.sensor == name and o.from_s <= measured_s < o.to_s for o in faults.outages)
        if dead or luck < faults.drop:
            found.lost[name] += 1
        else:
            found.arrivals.append(Delivery(arrival.time_s + delay * faults.jitter_s, arrival.message))
    found.arrivals.sort(key=lambda arrival: arrival.time_s)
    return found


COMPARED = {
    "command": "action",
    "asked velocity": "asked_w",
    "node of the tree": "leaf",
    "own position": "pos_w",
}
"""what is compared per step: attribute of a PilotCommand and of a LoggedStep"""

Build = Callable[[LogFeed], onboard.OnboardPilot]


def replay(
    path: Path, faults: Faults | None = None, tree: str | None = None, build: Build | None = None
) -> dict[str, Any]:
    """What ``uuv replay --json`` prints. ``build`` makes the pilot (default: one with its own simulator).

    Numbers count as equal where they are equal as float32; logs do not keep the sign of a zero. Raises
    LogError, TreeError, ConfigError.
    """
    feed, faults = read_feed(path, tree), faults or Faults()
    if not feed.steps:
        raise LogError(f"{path}: holds no commands to compare with; see what the stack does: --open")
    told = disturbed(feed.arrivals, faults)
    pilot = (build or built)(feed)
    commands, tick_s = _played(pilot, feed, told)
    agreement = [_agreement(name, commands, feed) for name in COMPARED]
    return {
        "schema": 1,
        "log": str(path),
        **{name: feed.run.get(name, "") for name in ("agent", "world", "seed", "episode")},
        "steps": len(feed.steps),
        "faults": {**asdict(faults), "any": faults.any},
        "equal": all(row["first_difference"] is None for row in agreement),
        "agreement": agreement,
        "change": _change(commands, feed),
        **_fates(pilot, told, tick_s),
    }


def _fates(pilot: onboard.OnboardPilot, told: Disturbed, tick_s: list[float]) -> dict[str, Any]:
    return {
        "messages": {
            name: {**asdict(tally), "lost": told.lost[name]} for name, tally in pilot.tallies.items()
        },
        "tick_ms": {
            "median": round(1e3 * float(np.median(tick_s)), 3),
            "99th percentile": round(1e3 * float(np.quantile(tick_s, 0.99)), 3),
        },
    }


def built(feed: LogFeed) -> onboard.OnboardPilot:
    return onboard.OnboardPilot.built(feed.config, feed.tree, feed.mission)


def _played(
    pilot: onboard.OnboardPilot,
    feed: LogFeed,
    told: Disturbed,
    after: Callable[[int, onboard.PilotCommand], None] = lambda step, command: None,
) -> tuple[list[onboard.PilotCommand], list[float]]:
    """(commands of all steps, seconds that each took); ``after`` gets each step and its command."""
    commands, tick_s, sent = [], [], 0
    dt, arrivals = feed.config.episode.control_dt_s, told.arrivals
    last_s = max((arrival.message.time_s for arrival in feed.arrivals), default=0.0)
    steps = len(feed.steps) or math.floor(last_s / dt) + 1
    if steps > _MAX_STEPS:
        raise LogError(f"{feed.path}: is longer than an hour ({last_s:.0f} s); cut its recordings")
    for step in range(steps):
        until = (step + 0.5) * dt
        began = time.perf_counter()
        while sent < len(arrivals) and arrivals[sent].time_s <= until:
            _feed(pilot, arrivals[sent].message, feed.path)
            sent += 1
        commands.append(pilot.tick())
        tick_s.append(time.perf_counter() - began)
        after(step, commands[-1])
    return commands, tick_s


def _feed(pilot: onboard.OnboardPilot, message: onboard.SensorMessage, path: Path) -> None:
    try:
        pilot.feed(message)
    except ValueError as error:
        raise LogError(
            f"{path}: a message does not fit its config.yaml ({error}); see what is in it with: uuv log info "
            f"{path}"
        ) from None


def _agreement(name: str, commands: list[onboard.PilotCommand], feed: LogFeed) -> dict[str, Any]:
    """Of one of COMPARED: how many steps are equal, and where the first is not."""
    pairs = [
        (getattr(command, COMPARED[name]), getattr(logged, COMPARED[name]))
        for command, logged in zip(commands, feed.steps, strict=True)
    ]
    wrong = [
        step
        for step, (ours, theirs) in enumerate(pairs)
        if not (theirs is None or np.array_equal(ours, theirs))
    ]
    first = None
    if wrong:
        step = wrong[0]
        ours, theirs = (value if isinstance(value, str) else value.tolist() for value in pairs[step])
        time_s = round(step * feed.config.episode.control_dt_s, 9)
        first = {"step": step, "time_s": time_s, "replayed": ours, "logged": theirs}
    return {"what": name, "equal_steps": len(pairs) - len(wrong), "first_difference": first}


def _change(commands: list[onboard.PilotCommand], feed: LogFeed) -> dict[str, Any]:
    """How far the commands are from the logged ones, and how often the pilot stopped."""
    actions = np.array([command.action for command in commands], np.float64)
    off = np.abs(actions - np.array([logged.action for logged in feed.steps], np.float64)).max(axis=1)
    held = [command.held for command in commands]
    reasons: dict[str, int] = {}
    for name in (reason.partition(":")[0] for all_of in held for reason in all_of):
        reasons[name] = reasons.get(name, 0) + 1
    places = [
        float(np.linalg.norm(command.pos_w - logged.pos_w))
        for command, logged in zip(commands, feed.steps, strict=True)
        if logged.pos_w is not None
    ]
    return {
        "finite": bool(np.isfinite(actions).all()),
        "largest": float(off.max(initial=0.0)),
        "mean": float(off.mean()) if len(off) else 0.0,
        "steps_beyond_tenth": int((off > 0.1).sum()),
        "position_m": max(places, default=0.0),
        "held_steps": sum(bool(all_of) for all_of in held),
        "held_for": reasons,
    }


# ---- Without comparing: what the stack perceives, plans and would command, as the run folder of an episode.


@dataclass(frozen=True)
class _End:
    """A recording has no outcome."""

    time_s: float
    outcome: str = REPLAYED
    episode_return: float = 0.0
    min_clearance_m: float = 0.0
    replans: dict[str, int] = field(default_factory=dict)
    planned_by: dict[str, int] = field(default_factory=dict)


def open_replay(
    path: Path, faults: Faults | None = None, tree: str | None = None, build: Build | None = None
) -> tuple[dict[str, Any], Path]:
    """(what ``uuv replay --open --json`` prints, run folder with a log and a picture). Nobody knows the
    truth: in its place stands the estimated pose. Raises as ``replay``, RunFolderError."""
    feed, faults = read_feed(path, tree), faults or Faults()
    told = disturbed(feed.arrivals, faults)
    pilot = (build or built)(feed)
    assert isinstance(pilot.stack, onboard.SimStack)
    sim, views, mission = pilot.stack.sim, pilot.stack.views, feed.mission
    run = RunFolder(default_run_dir("replay"), feed.config, [mission.seed])
    with run.recorded():
        recorder = EpisodeRecorder(run.path / "logs", feed.run["world"], feed.run["agent"], [mission])

        def record(step: int, command: onboard.PilotCommand) -> None:
            views["vehicle.pos_w"][0] = views["ego.pos_w"][0]
            views["vehicle.vel_b"][0] = views["ego.vel_b"][0]
            views["vehicle.quat_wb"][0] = quaternion_of(views["ego.rpy"][0])
            leaf = int(views["behavior.leaf"][0])
            if command.held:
                views["behavior.leaf"][0] = -1  # the log says that no node drove
            if step:
                recorder.step(sim)
            else:
                recorder.begin(sim, 0, mission)
            views["behavior.leaf"][0] = leaf

        try:
            commands, tick_s = _played(pilot, feed, told, record)
            recorder.end(sim, 0, _End(len(commands) * feed.config.episode.control_dt_s))
        finally:
            recorder.abort()
        log = recorder.paths[mission]
        shown = run.path / "pictures" / f"{log.stem}.png"
        shown.parent.mkdir()
        picture(log, shown)
    held = Counter(reason.partition(":")[0] for command in commands for reason in command.held)
    return {
        "schema": 1, "log": str(path), "steps": len(commands),
        **{name: feed.run.get(name, "") for name in ("agent", "world", "seed", "episode")},
        "faults": {**asdict(faults), "any": faults.any},
        "run_folder": str(run.path), "recorded": str(log), "picture": str(shown),
        "nodes": dict(Counter(command.leaf for command in commands if not command.held)),
        "replans": sum(bool(command.trigger) for command in commands),
        "held_steps": sum(bool(command.held) for command in commands), "held_for": dict(held),
        **_fates(pilot, told, tick_s),
    }, run.path  # fmt: skip
