"""Record one episode as MCAP: every topic of the interface, from snapshots.

    with McapEpisodeLog(path, header) as log:
        log.write(snapshot)          # step 0, then after every control step; maps and depth images where
        ``log.due`` asks for them log.close(result)

The file grows as ``<path>.part`` and gets its name when it is complete. A killed process leaves the ``.part``
file, which lacks at most the messages of the last control step or the last hundredth, whichever is more;
``uuv log repair`` makes it whole.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from uuvtai.logs import encode, schemas
from uuvtai.logs.closed_form import FRAMES
from uuvtai.logs.container import McapFile
from uuvtai.logs.log_errors import LogError
from uuvtai.snapshot import RUNNING, EpisodeEnd, EpisodeHeader, EpisodeSnapshot

MAP_HZ, DEPTH_HZ, OBSTACLE_HZ = 2.0, 2.0, 10.0

_GOAL_COLOR, _ROUTE_COLOR, _TANK_COLOR = (
    (0.98, 0.75, 0.14, 1.0),
    (0.13, 0.55, 0.9, 1.0),
    (0.3, 0.38, 0.46, 1.0),
)


@dataclass(frozen=True)
class Due:
    """Which of the big arrays a snapshot should carry."""

    maps: bool
    depth_image: bool


class McapEpisodeLog:
    """One episode's log. Raises LogError where the file cannot be written; nothing half-written is left
    then."""

    def __init__(self, path: Path, header: EpisodeHeader, depth_images: bool = False) -> None:
        self.path, self.header = Path(path), header
        self._depth_images = depth_images
        self._written: dict[str, float] = {}
        self._tree_text: dict[bytes, bytes] = {}
        self._nodes = unique_names(header.tree_nodes)
        self._schema_ids: dict[str, int] = {}
        self._closed = False
        with self._guarded():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = McapFile(self.path)
        with self._guarded():
            self._write_head()
            topics = topic_schemas(header.reward_terms, self._nodes, header.tree_statuses, depth_images)
            self._channels = {topic: self._channel(topic, schema) for topic, schema in topics.items()}

    def due(self, step: int, replanned: bool = False, final: bool = False) -> Due:
        """What the snapshot of this step should carry: maps at 2 Hz, on a replan and at the end; depth images
        at 2 Hz if they are wanted.

        A depth image counts only where it is fresh; hand over the first fresh one from then on.
        """
        time_s = step * self.header.control_dt_s
        return Due(
            maps=replanned or final or self._elapsed("/map/static", time_s, MAP_HZ),
            depth_image=self._depth_images and self._elapsed("/camera/depth", time_s, DEPTH_HZ),
        )

    def write(self, snapshot: EpisodeSnapshot) -> None:
        """Add one control step. Raises ValueError for numbers that are not finite."""
        with self._guarded():
            self._write_step(snapshot)
            self._file.settle()

    def close(self, result: EpisodeEnd) -> None:
        """Add how it ended and finish the file under its name."""
        with self._guarded():
            self._file.add_metadata("uuv.result", _result_metadata(result))
            self._file.finish()
            self._closed = True

    def abandon(self) -> None:
        """Stop without a result: the ``.part`` file stays, complete up to the last step written."""
        if not self._closed:
            with self._guarded():
                self._file.leave()
            self._closed = True

    def __enter__(self) -> McapEpisodeLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.abandon()

    # --------------------------------------------------------------------------------------------------- head

    def _write_head(self) -> None:
        self._file.add_metadata("uuv.run", _run_metadata(self.header))
        self._file.add_attachment("config.yaml", "application/yaml", self.header.config_yaml.encode())
        scenario = json.dumps(self.header.scenario, indent=1, allow_nan=False)
        self._file.add_attachment("scenario.json", "application/json", scenario.encode())

    def _channel(self, topic: str, schema: schemas.Schema) -> int:
        name = schema["title"]
        if name not in self._schema_ids:
            self._schema_ids[name] = self._file.add_schema(
                name, "jsonschema", json.dumps(schema, separators=(",", ":")).encode()
            )
        return self._file.add_channel(topic, self._schema_ids[name])

    # -------------------------------------------------------------------------------------------------- steps

    def _write_step(self, snapshot: EpisodeSnapshot) -> None:
        self._time_s = snapshot.step * self.header.control_dt_s
        self._time_ns = round(self._time_s * 1e9)
        stamp = encode.time_text(self._time_ns)
        self._write_motion(stamp, snapshot)
        if snapshot.sonar_fresh:
            self._write_sonar(snapshot)
        if snapshot.depth_line is not None:
            self._put("/camera/line", encode.depth_line(stamp, snapshot.depth_line))
        if snapshot.depth_image_m is not None and self._depth_images:
            self._put("/camera/depth", encode.depth_png(stamp, snapshot.depth_image_m))
        if snapshot.route_fresh:
            self._write_route(stamp, snapshot)
        if snapshot.maps is not None:
            computed = snapshot.step if snapshot.maps.clearance_step is None else snapshot.maps.clearance_step
            for topic, data in encode.grids(stamp, self._stamp(computed), snapshot.maps).items():
                self._put(topic, data)
        ended = snapshot.outcome != RUNNING
        if ended or self._elapsed("/obstacles", self._time_s, OBSTACLE_HZ):
            self._write_truth(snapshot)
        self._write_mind(snapshot)
        if ended:
            self._put("/log", _log_line(stamp, schemas.INFO, "uuv.episode", f"outcome: {snapshot.outcome}"))

    def _write_motion(self, stamp: str, snapshot: EpisodeSnapshot) -> None:
        valid = "true" if snapshot.measured_vel_valid else "false"
        self._put(
            "/state",
            (
                f'{{"position":{encode.numbers(snapshot.pos_w)},'
                f'"orientation":{encode.numbers(snapshot.quat_wb)},'
                f'"velocity":{encode.numbers(snapshot.vel_b)},"rates":{encode.numbers(snapshot.rate_b)},'
                f'"current":{encode.numbers(snapshot.current_w)},"rpm":{encode.numbers(snapshot.rpm)},'
                f'"measured":{{"velocity":{encode.numbers(snapshot.measured_vel_b)},"velocity_valid":{valid},'
                f'"rates":{encode.numbers(snapshot.measured_rate_b)},'
                f'"depth_m":{encode.number(snapshot.depth_m)}}}}}'
            ).encode(),
        )
        self._put("/tf", encode.frame_transforms(stamp, snapshot, self.header.camera_offset_b_m))
        self._put("/pose", encode.pose_in_frame(stamp, snapshot.pos_w, snapshot.quat_wb))
        self._put(
            "/pose_estimate",
            encode.pose_in_frame(stamp, snapshot.estimate_pos_w, encode.quaternion_of(snapshot.estimate_rpy)),
        )

    def _write_sonar(self, snapshot: EpisodeSnapshot) -> None:
        stamp = self._stamp(snapshot.sonar_ping_step)
        self._put("/sonar/scan", encode.laser_scan(stamp, snapshot, self.header.sonar_max_range_m))
        self._put("/sonar/doppler", encode.sonar_doppler(stamp, snapshot))
        if snapshot.tracks is not None or snapshot.track_beams is not None:
            self._put("/tracks", encode.tracks_message(snapshot))

    def _write_route(self, stamp: str, snapshot: EpisodeSnapshot) -> None:
        points = np.asarray(snapshot.route_w, float)
        if points.shape[1] == 2:
            points = np.column_stack([points, np.full(len(points), self.header.scenario["goal"][2])])
        strip = encode.scene_entity(self._time_ns, "route", lines=[encode.line(points, _ROUTE_COLOR, 0.04)])
        self._put("/plan", encode.dumped({"deletions": [], "entities": [strip]}))
        plan = {
            "points": [encode.vector(point) for point in points],
            "planner": snapshot.route_planner,
            "trigger": snapshot.replan_trigger,
        }
        self._put("/plan/info", encode.dumped({**plan, "fallback": snapshot.route_fallback}))
        found = f"replan ({snapshot.replan_trigger}): {snapshot.route_planner}, {len(points)} waypoints"
        level = schemas.WARNING if snapshot.route_fallback else schemas.INFO
        self._put(
            "/log",
            _log_line(
                stamp,
                level,
                "uuv.route",
                found + (f"; voronoi: {snapshot.route_fallback}" if snapshot.route_fallback else ""),
            ),
        )

    def _write_truth(self, snapshot: EpisodeSnapshot) -> None:
        scenario = self.header.scenario
        n_rest = sum(body["path"] is None for body in scenario["bodies"])
        self._put("/obstacles", encode.obstacle_scene(self._time_ns, snapshot, n_rest))
        self._put("/obstacles/truth", encode.obstacle_truth(snapshot))
        diameter = 2 * scenario["goal_radius_m"]
        spheres = [
            {
                "pose": encode.upright_pose(scenario["goal"]),
                "size": {"x": size, "y": size, "z": size},
                "color": encode.color(rgba),
            }
            for size, rgba in ((0.25, _GOAL_COLOR), (diameter, (*_GOAL_COLOR[:3], 0.15)))
        ]
        entities = [
            encode.scene_entity(self._time_ns, "goal", spheres=spheres),
            encode.scene_entity(self._time_ns, "tank", lines=_tank_lines(scenario["tank"])),
        ]
        self._put("/goal", encode.dumped({"deletions": [], "entities": entities}))

    def _write_mind(self, snapshot: EpisodeSnapshot) -> None:
        """What drives: action, policy, safety, tree."""
        leaf = "" if snapshot.tree_leaf is None or snapshot.tree_leaf < 0 else self._nodes[snapshot.tree_leaf]
        self._put(
            "/action",
            (
                f'{{"policy":{encode.numbers_or_null(snapshot.action_policy)},'
                f'"teacher":{encode.numbers_or_null(snapshot.action_teacher)},'
                f'"applied":{encode.numbers(snapshot.action_applied)},'
                f'"thrust":{encode.numbers(snapshot.thrust_n)},"leaf":{json.dumps(leaf)}}}'
            ).encode(),
        )
        self._put("/policy", self._policy(snapshot))
        ttc = None if snapshot.ttc_s is None or snapshot.ttc_s > encode.FAR_M else snapshot.ttc_s
        self._put(
            "/safety",
            (
                f'{{"clearance_m":{encode.number(snapshot.clearance_m)},"ttc_s":{encode.number_or_null(ttc)},'
                f'"path_risk":{encode.number(snapshot.path_risk)},'
                f'"replan_trigger":"{snapshot.replan_trigger}"}}'
            ).encode(),
        )
        if snapshot.tree_status is not None:
            self._put("/tree", self._tree(snapshot.tree_status))
        if snapshot.lookahead_w is not None:
            stamp = encode.time_text(self._time_ns)
            self._put("/plan/lookahead", encode.pose_in_frame(stamp, snapshot.lookahead_w, (1, 0, 0, 0)))

    def _policy(self, snapshot: EpisodeSnapshot) -> bytes:
        terms = np.zeros(len(self.header.reward_terms)) if snapshot.reward is None else snapshot.reward
        rewards = ",".join(
            f'"{name}":{encode.number(value)}'
            for name, value in zip(self.header.reward_terms, terms, strict=True)
        )
        return (
            f'{{"value":{encode.number_or_null(snapshot.policy_value)},'
            f'"std":{encode.numbers_or_null(snapshot.policy_std)},'
            f'"reward":{encode.number(float(np.sum(terms)))},{rewards}{"," if rewards else ""}'
            f'"lambda":{encode.number_or_null(snapshot.distill_lambda)},'
            f'"wm_residual":{encode.number_or_null(snapshot.wm_residual)},'
            f'"wm_uncertainty":{encode.number_or_null(snapshot.wm_uncertainty)}}}'
        ).encode()

    def _tree(self, status: np.ndarray) -> bytes:
        """The same few ticks come again and again: their texts are kept."""
        key = status.tobytes()
        if key not in self._tree_text:
            names = (self.header.tree_statuses[int(code)] for code in status)
            self._tree_text[key] = encode.dumped(dict(zip(self._nodes, names, strict=True)))
        return self._tree_text[key]

    def _stamp(self, step: int) -> str:
        return encode.time_text(round(step * self.header.control_dt_s * 1e9))

    def _put(self, topic: str, data: bytes) -> None:
        self._written[topic] = self._time_s
        self._file.add_message(self._channels[topic], self._time_ns, data)

    def _elapsed(self, topic: str, time_s: float, hertz: float) -> bool:
        return topic not in self._written or time_s - self._written[topic] >= 1.0 / hertz - 1e-6

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._closed = True
            if hasattr(self, "_file"):
                self._file.discard()
            raise LogError(
                f"{self.path}: cannot write the log ({error.strerror or error}); nothing of it was kept. "
                "Make room or choose a folder that can be written: --run-dir DIR"
            ) from error


def topic_schemas(
    reward_terms: Sequence[str], nodes: Sequence[str], statuses: Sequence[str], depth_images: bool
) -> dict[str, schemas.Schema]:
    """Schema of every topic; those of the policy and the tree have a field per reward term and node."""
    known = {
        "/tf": schemas.FRAME_TRANSFORMS,
        "/pose": schemas.POSE_IN_FRAME,
        "/pose_estimate": schemas.POSE_IN_FRAME,
        "/sonar/scan": schemas.LASER_SCAN,
        "/sonar/doppler": schemas.SONAR_DOPPLER,
        "/camera/line": schemas.DEPTH_LINE,
        "/camera/depth": schemas.COMPRESSED_IMAGE,
        "/map/static": schemas.GRID,
        "/map/dynamic": schemas.GRID,
        "/map/clearance": schemas.GRID,
        "/map/risk": schemas.GRID,
        "/plan": schemas.SCENE_UPDATE,
        "/plan/info": schemas.PLAN,
        "/plan/lookahead": schemas.POSE_IN_FRAME,
        "/goal": schemas.SCENE_UPDATE,
        "/obstacles": schemas.SCENE_UPDATE,
        "/obstacles/truth": schemas.OBSTACLES,
        "/tracks": schemas.TRACKS,
        "/state": schemas.STATE,
        "/action": schemas.ACTION,
        "/policy": schemas.policy_schema(reward_terms),
        "/safety": schemas.SAFETY,
        "/tree": schemas.tree_schema(nodes, statuses),
        "/log": schemas.LOG,
    }
    if not depth_images:
        del known["/camera/depth"]
    return known


def unique_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """The same names, where two are equal with their number: 'Hold', 'Hold#7'."""
    return tuple(name if names.index(name) == i else f"{name}#{i}" for i, name in enumerate(names))


def _run_metadata(header: EpisodeHeader) -> dict[str, str]:
    scenario = header.scenario
    return {
        "version": header.version,
        "git_sha": header.git_sha,
        "controller": header.controller,
        "world": str(scenario["world"]),
        "seed": str(scenario["seed"]),
        "episode": str(scenario["episode"]),
        "config_sha256": hashlib.sha256(header.config_yaml.encode()).hexdigest(),
        "checkpoint_sha256": header.checkpoint_sha256,
        "control_dt_s": repr(header.control_dt_s),
        "sonar_max_range_m": repr(header.sonar_max_range_m),
        "frames": json.dumps(FRAMES),
    }


def _result_metadata(result: EpisodeEnd) -> dict[str, str]:
    return {
        "outcome": result.outcome,
        "return": encode.number(result.episode_return),
        "time_s": encode.number(result.time_s),
        "min_clearance_m": encode.number(result.min_clearance_m),
        "replans": str(sum(result.replans.values())),
        "replans_by_trigger": json.dumps(result.replans),
        "planned_by": json.dumps(result.planned_by),
    }


def _log_line(stamp: str, level: int, name: str, message: str) -> bytes:
    return (
        f'{{"timestamp":{stamp},"level":{level},"message":{json.dumps(message)},"name":"{name}","file":"",'
        f'"line":0}}'
    ).encode()


def _tank_lines(tank: dict) -> list[dict]:
    """Outline of floor and surface."""
    (x0, x1), (y0, y1) = tank["x_m"], tank["y_m"]
    flat = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    if tank["shape"] == "circle":
        angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        flat = [
            (0.5 * (x0 + x1) + tank["radius_m"] * np.cos(a), 0.5 * (y0 + y1) + tank["radius_m"] * np.sin(a))
            for a in angles
        ]
    return [
        encode.line([(x, y, z) for x, y in flat], _TANK_COLOR, 0.03, schemas.LINE_LOOP) for z in tank["z_m"]
    ]
