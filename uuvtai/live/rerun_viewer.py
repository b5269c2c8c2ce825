"""Running episodes for Rerun: into an .rrd file, or to a viewer that is open. The topics of the log become
Rerun's own archetypes in one world, on one timeline over all episodes."""

from __future__ import annotations

import base64
import importlib.util
import json
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from uuvtai.live.viewer_server import LiveError
from uuvtai.logs.recording import read_value
from uuvtai.logs.schemas import Schema
from uuvtai.logs.topic_stream import TopicMessage

EXTRA = "uuvtai[rerun]"
_SCHEME, _PORT = "rerun+http", 9876
_HULL_M = (0.2285, 0.169, 0.127)
"""half of a BlueROV2, for the eye"""
_OCCUPIED = 0.5
_GAP_NS = 1_000_000_000
"""between two episodes on the timeline"""
_STANDING, _MOVING, _ROUTE, _ECHO = (60, 66, 77), (224, 49, 49), (25, 113, 194), (11, 122, 117)


class RerunViewer:
    """Takes what a ``ViewerServer`` takes. Use as a context: it ends with it."""

    def __init__(self, target: str) -> None:
        """``target``: a file .rrd that is not there yet, or the address of a viewer,
        rerun+http://HOST:PORT/proxy. Raises LiveError."""
        _require_sdk()
        import rerun

        self._rr, self._stream = rerun, rerun.RecordingStream("uuvtai")
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        if target.startswith(f"{_SCHEME}://"):
            _refuse_absent(target)
            self._stream.connect_grpc(target)
        else:
            self._stream.save(_new_file(target))
        self._begun_ns, self._now_ns, self._episode = 0, 0, -1
        self._pose: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
        self._way: list[tuple[float, float, float]] = []
        self._log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        hull = rerun.Boxes3D(half_sizes=[_HULL_M], fill_mode="solid", colors=[_ROUTE])
        self._log("world/vehicle/hull", hull, static=True)

    def begin(self, schemas: Mapping[str, Schema]) -> None:
        """Another episode: what is seen of the one before goes, and time goes on."""
        self._episode += 1
        self._begun_ns = self._now_ns + _GAP_NS * (self._episode > 0)
        self._way.clear()
        self.tell_time(0)
        for place in ("world/map", "world/sonar", "world/route", "world/tracks", "world/truth", "world/way"):
            self._log(place, self._rr.Clear(recursive=True))

    def tell_time(self, time_ns: int) -> None:
        """It is now this late in the episode."""
        self._now_ns = self._begun_ns + time_ns
        self._stream.set_time("time", duration=self._now_ns / 1e9)
        self._stream.set_time("episode", sequence=self._episode)

    def send(self, message: TopicMessage) -> None:
        """Draw a message; topics that Rerun has no picture of are left out."""
        draw = _DRAWN.get(message.topic)
        if draw is not None:
            draw(self, message.topic, json.loads(message.data))

    def close(self) -> None:
        """Write and send what is left."""
        self._stream.flush()
        self._stream.disconnect()

    def __enter__(self) -> RerunViewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------------------------------------- topics

    def _draw_pose(self, topic: str, data: dict[str, Any]) -> None:
        self._pose = read_value(topic, data)
        place, turn = data["pose"]["position"], data["pose"]["orientation"]
        at = (place["x"], place["y"], place["z"])
        turned = self._rr.Quaternion(xyzw=[turn["x"], turn["y"], turn["z"], turn["w"]])
        self._log("world/vehicle", self._rr.Transform3D(translation=at, rotation=turned))
        self._way.append(at)
        if len(self._way) % 10 == 1:
            strip = self._rr.LineStrips3D([self._way], colors=[_ROUTE], radii=0.02)
            self._log("world/way", strip)

    def _draw_layer(self, topic: str, data: dict[str, Any]) -> None:
        layer = read_value(topic, data)
        row, col = np.nonzero(layer.values >= _OCCUPIED)
        flat = np.column_stack([col, row]) + 0.5
        at = np.column_stack(
            [np.array(layer.origin_m) + layer.cell_m * flat, np.full(len(row), self._pose[2])]
        )
        color = _STANDING if topic.endswith("static") else _MOVING
        cells = self._rr.Points3D(at, radii=0.5 * layer.cell_m, colors=[color] * len(at))
        self._log(f"world{topic}", cells)

    def _draw_scan(self, topic: str, data: dict[str, Any]) -> None:
        ranges, bearing, hit, _ = read_value(topic, data)
        x, y, z, yaw = self._pose
        away = bearing[hit] + yaw
        at = np.column_stack([x + ranges[hit] * np.cos(away), y + ranges[hit] * np.sin(away)])
        at = np.column_stack([at, np.full(len(at), z)])
        self._log("world/sonar/returns", self._rr.Points3D(at, radii=0.03, colors=[_ECHO] * len(at)))

    def _draw_route(self, topic: str, data: dict[str, Any]) -> None:
        way = [(point["x"], point["y"], point["z"]) for point in data["points"]]
        self._log("world/route", self._rr.LineStrips3D([way] if way else [], radii=0.03))

    def _draw_tracks(self, topic: str, data: dict[str, Any]) -> None:
        found = read_value(topic, data)
        at = np.column_stack([found[:, :2], np.full(len(found), self._pose[2])])
        self._log("world/tracks", self._rr.Ellipsoids3D(centers=at, radii=found[:, 2]))

    def _draw_scene(self, topic: str, data: dict[str, Any]) -> None:
        for kind, archetype in (("cubes", "Boxes3D"), ("spheres", "Ellipsoids3D"), ("cylinders", "Boxes3D")):
            parts = [part for entity in data["entities"] for part in entity[kind]]
            if parts:
                shapes = getattr(self._rr, archetype)(
                    centers=[list(part["pose"]["position"].values()) for part in parts],
                    half_sizes=[[0.5 * size for size in part["size"].values()] for part in parts],
                    quaternions=[[part["pose"]["orientation"][axis] for axis in "xyzw"] for part in parts],
                )
                self._log(f"world/truth{topic}/{kind}", shapes)

    def _draw_image(self, topic: str, data: dict[str, Any]) -> None:
        png, kind = base64.b64decode(data["data"]), "image/png"
        shown = self._rr.EncodedImage(contents=png, media_type=kind)
        if topic == "/camera/depth":  # 16 bits, millimetres
            shown = self._rr.EncodedDepthImage(png, media_type=kind, meter=1000.0)
        self._log(topic.strip("/"), shown)

    def _draw_safety(self, topic: str, data: dict[str, Any]) -> None:
        for name in ("clearance_m", "ttc_s", "path_risk"):
            if data[name] is not None:
                self._log(f"safety/{name}", self._rr.Scalars([float(data[name])]))

    def _draw_text(self, topic: str, data: dict[str, Any]) -> None:
        self._log("log", self._rr.TextLog(data["message"]))

    def _log(self, entity: str, archetype: Any, static: bool = False) -> None:
        self._stream.log(entity, archetype, static=static)


_DRAWN = {
    "/pose": RerunViewer._draw_pose,
    "/map/static": RerunViewer._draw_layer,
    "/map/dynamic": RerunViewer._draw_layer,
    "/sonar/scan": RerunViewer._draw_scan,
    "/plan/info": RerunViewer._draw_route,
    "/tracks": RerunViewer._draw_tracks,
    "/goal": RerunViewer._draw_scene,
    "/obstacles": RerunViewer._draw_scene,
    "/sonar/image": RerunViewer._draw_image,
    "/camera/depth": RerunViewer._draw_image,
    "/safety": RerunViewer._draw_safety,
    "/log": RerunViewer._draw_text,
}


def _new_file(target: str) -> Path:
    """Refuses what would be lost, and what no file can be. Raises LiveError."""
    path = Path(target)
    if path.suffix != ".rrd":
        raise LiveError(
            f"--rerun {target}: wanted is a file that ends in .rrd, or the address of a viewer: "
            f"--rerun live.rrd, or --rerun {_SCHEME}://127.0.0.1:{_PORT}/proxy"
        )
    if path.exists():
        raise LiveError(f"{path}: is there already, and is kept; name another: --rerun {path.stem}_2.rrd")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        raise LiveError(
            f"{path}: cannot be written ({error.strerror}); name another place: --rerun FILE.rrd"
        ) from error
    return path


def _refuse_absent(target: str) -> None:
    """The SDK would wait without a word for a viewer that is not there. Raises LiveError."""
    try:
        place = urlsplit(target)
        with socket.create_connection((place.hostname or "", place.port or _PORT), 3):
            return
    except (OSError, ValueError) as error:
        raise LiveError(
            f"--rerun {target}: no viewer answers there ({error}); start it first: rerun --port {_PORT}"
        ) from None


def _require_sdk() -> None:
    if importlib.util.find_spec("rerun") is None:
        raise LiveError(
            f"--rerun needs Rerun's SDK, which is not here (Python 3.11 or newer): pip install '{EXTRA}'"
        )
