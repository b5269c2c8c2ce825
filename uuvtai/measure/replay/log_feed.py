"""A log as the pilot's sensors would have told it: messages with the step of their arrival, and what was
decided then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.loader import ConfigError, parsed_yaml, validated
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.reader import LogHead, LogMessage, read_head, read_messages
from uuvtai.logs.topics.camera_topics import exact_image
from uuvtai.pilot import (
    DepthShot,
    DvlReading,
    ImuReading,
    Mission,
    PositionFix,
    PressureReading,
    SensorMessage,
    SonarPing,
    ThrusterLoss,
)
from uuvtai.tree import FlatTree, parse_tree, read_tree

_MAX_STEPS = 180_000
"""an hour"""


@dataclass(frozen=True)
class Delivery:
    """A message and when it reaches the pilot."""

    time_s: float
    message: SensorMessage


@dataclass(frozen=True, eq=False)
class LoggedStep:
    """What was decided in a control step; None where the log does not say."""

    action: np.ndarray
    """(4,) float32 the tree's"""
    asked_w: np.ndarray
    """(3,) float32"""
    leaf: str
    pos_w: np.ndarray | None = None
    """(3,) float32 own position as estimated"""


@dataclass
class LogFeed:
    """All that a replay needs of a log."""

    path: Path
    config: Config
    tree: FlatTree
    mission: Mission
    run: dict[str, str]
    """metadata uuv.run"""
    arrivals: list[Delivery] = field(default_factory=list)
    """in the order of the log"""
    steps: list[LoggedStep] = field(default_factory=list)
    """from step 0 on, without a gap"""


def read_feed(path: Path, controller: str | None = None) -> LogFeed:
    """Read a log; ``controller``: name or file of a tree in place of the one that it holds. Raises LogError
    for what cannot be replayed, TreeError and ConfigError for a tree that cannot be read."""
    head = read_head(path)
    try:
        feed = _begun(path, head, controller)
        _FeedReader(feed).run()
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        if isinstance(error, LogError):
            raise
        raise LogError(
            f"{path}: a message is not as its schema says ({error!r}); see what is in it: uuv log info {path}"
        ) from error
    return feed


def _begun(path: Path, head: LogHead, controller: str | None) -> LogFeed:
    config, run = _config(path, head), head.metadata.get("uuv.run", {})
    scenario = head.scenario
    mission = Mission(
        start=_place(scenario["start"]),
        goal=_place(scenario["goal"]),
        seed=int(run["seed"]),
        episode=int(run["episode"]),
    )
    if run["controller"].endswith("+truth") or config.mapping.stamp > 0:
        raise LogError(
            f"{path}: was driven with the truth, which no sensor tells; replay a log without +truth"
        )
    return LogFeed(path, config, _tree(path, head, controller, config), mission, run)


def _config(path: Path, head: LogHead) -> Config:
    if "config.yaml" not in head.attachments:
        raise LogError(f"{path}: the log has no attachment config.yaml: uuv eval --record did not write it")
    where = f"{path}: config.yaml"
    try:
        given = parsed_yaml(head.attachments["config.yaml"].decode(), where)
        known = {name: given[name] for name in Config.model_fields if name in given}
        return validated(known, dict.fromkeys(known, where))
    except ConfigError as error:
        raise LogError(f"{where} cannot be used here ({error}); record the episode again") from None


def _tree(path: Path, head: LogHead, controller: str | None, config: Config) -> FlatTree:
    if controller is not None:
        return read_tree(controller, config.teacher.max_node)
    if "tree.xml" not in head.attachments:
        raise LogError(
            f"{path}: the log does not hold the tree that drove; name it: uuv replay {path} --controller bt"
        )
    return parse_tree(head.attachments["tree.xml"], f"{path}: tree.xml", config.teacher.max_node)


def _place(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


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
        if uses_camera(self._config):
            wanted.add("/camera/exact")
        if missing := sorted(wanted - self._seen):
            raise LogError(
                f"{path}: the log has no {', '.join(missing)}, without which nothing decides the same; "
                "record it again: uuv eval --record 1 --depth-images"
            )

    def _arrives(self, m: LogMessage, message: SensorMessage) -> None:
        self._feed.arrivals.append(Delivery(m.time_s, message))

    def _imu(self, m: LogMessage) -> None:
        parts = (_array(m.data[name]) for name in ("attitude", "rates", "specific_force"))
        self._arrives(m, ImuReading(m.time_s, *parts))

    def _dvl(self, m: LogMessage) -> None:
        self._arrives(m, DvlReading(m.time_s, _array(m.data["velocity"])))

    def _pressure(self, m: LogMessage) -> None:
        self._arrives(m, PressureReading(m.time_s, float(m.data["depth_m"])))

    def _position(self, m: LogMessage) -> None:
        place = m.data["pose"]["position"]
        self._pos_w = _array([place[axis] for axis in "xyz"])
        if self._given:
            self._arrives(m, PositionFix(m.time_s, self._pos_w))

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
        self._arrives(m, SonarPing(ping_s, ranges, hit, velocity, first))

    def _shot(self, m: LogMessage) -> None:
        camera = self._config.sensors.depth
        self._arrives(m, DepthShot(m.time_s, exact_image(m.data, (camera.rows, camera.cols))))

    def _plan(self, m: LogMessage) -> None:
        if m.data["planner"] == "own":
            raise LogError(
                f"{self._feed.path}: its routes come from a planner of the user's, which no log holds; "
                "replay a log of --controller"
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
            self._arrives(m, ThrusterLoss(m.time_s, float(given_up)))
        logged = LoggedStep(_array(m.data["teacher"]), _array(m.data["asked"]), m.data["leaf"], self._pos_w)
        self._feed.steps.append(logged)


def uses_camera(config: Config) -> bool:
    """Whether any stage behind the camera looks at its images."""
    return config.spotting.use_camera or config.elevation.use_camera or config.mapping.depth_hit > 0
