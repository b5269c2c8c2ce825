"""Topics of sensors: sonar and depth camera."""

from __future__ import annotations

import base64
import json
import math
import struct
import zlib
from typing import Any

import cv2
import numpy as np

from uuvtai.config import Config
from uuvtai.config.multibeam import SHOWN_DB, gain
from uuvtai.logs.encode import (
    IDENTITY,
    IMAGES,
    NEW_IMAGE,
    NEW_SCAN,
    SONAR_IMAGES,
    LogError,
    Moment,
    Topic,
    numbers,
)
from uuvtai.logs.schemas import (
    BASE64,
    LASER_SCAN,
    NUMBER,
    THREE,
    TIME,
    UINT,
    array_of,
    compressed_image,
    described,
    record,
)

_THOUSANDTHS = [f"{i / 1000:g}" for i in range(1001)]
"""Intensities are printed to three digits; nothing is computed from them."""
_IDENTITY_TEXT = json.dumps(IDENTITY, separators=(",", ":"))

_DOPPLER = record(
    "uuv.SonarDoppler",
    timestamp=described(TIME, "when the ping was taken"),
    velocity=described(
        array_of(NUMBER),
        "[m/s] how fast what a beam met recedes, own motion included; 0 where nothing returned; empty where "
        "the sonar measures none",
    ),
    own_velocity=described(THREE, "[m/s] own velocity in the body frame as measured when the ping was taken"),
)


_IMAGE = compressed_image(
    "8-bit PNG of the power that each beam hears, in which ranges are detected: column 0 is the leftmost "
    "beam, the last row the nearest range bin; 50 dB from black to white, gain follows range and absorption"
)


def _scan(moment: Moment) -> bytes:
    """Ranges as sensed; where nothing returned: maximum range with intensity 0, which no return has. Of a
    mechanical beam only what was taken in this step."""
    sonar = moment.header.config.sensors.sonar
    begin, count = int(moment["scan.new_from"]), int(moment["scan.new_count"])
    if not sonar.mechanical:
        begin, count = 0, len(moment["scan.hit"])
    beams = (begin + np.arange(count)) % sonar.n_ray
    hit = moment["scan.hit"][beams] != 0
    ranges = np.where(hit, moment["scan.range_m"][beams], np.float32(sonar.max_range_m))
    thousandths = np.where(hit, np.clip(np.rint(moment["scan.intensity"][beams] * 1000), 1, 1000), 0)
    intensities = ",".join(map(_THOUSANDTHS.__getitem__, thousandths.astype(np.int32).tolist()))
    first = sonar.first_beam_rad + sonar.turn_rad(begin)
    last = first + sonar.turn_rad(count - 1 if sonar.mechanical else sonar.n_ray - 1)
    return (
        f'{{"timestamp":{moment.stamp_of(int(moment["scan.ping_step"]))},"frame_id":"sonar",'
        f'"pose":{_IDENTITY_TEXT},"start_angle":{first:.17g},"end_angle":{last!r},'
        f'"ranges":{numbers(ranges)},"intensities":[{intensities}]}}'
    ).encode()


def _doppler(moment: Moment) -> bytes:
    """Doppler of every beam and the own velocity it has to be compensated with."""
    stamp = moment.stamp_of(int(moment["scan.ping_step"]))
    velocity = np.where(moment["scan.hit"] != 0, moment["scan.doppler_m_s"], np.float32(0))
    if not moment.header.config.sensors.sonar.doppler:
        velocity = velocity[:0]
    own = numbers(moment["scan.ping_vel_b"])
    return f'{{"timestamp":{stamp},"velocity":{numbers(velocity)},"own_velocity":{own}}}'.encode()


def _read_scan(data: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """(ranges (n,), bearings (n,) from ahead, hit (n,), when it was taken)."""
    ping_s = data["timestamp"]["sec"] + data["timestamp"]["nsec"] / 1e9
    ranges = np.array(data["ranges"])
    bearing = np.linspace(float(data["start_angle"]), float(data["end_angle"]), len(ranges))
    return ranges, bearing, np.array(data["intensities"]) > 0, ping_s


def _image(moment: Moment) -> bytes:
    """8-bit PNG."""
    sonar = moment.header.config.sensors.sonar
    heard = np.asarray(moment["sonar_image.heard"], float)[: sonar.n_ray, : sonar.image_bins]
    range_m = sonar.max_range_m * (np.arange(heard.shape[1]) + 0.5) / heard.shape[1]
    level = 10.0 * np.log10(np.maximum(heard * gain(range_m, sonar), 1e-12))
    grey = np.clip(255.0 * (level / SHOWN_DB + 1.0), 0, 255).astype(np.uint8)
    shown = grey.T[::-1, ::-1].copy()  # left is left
    png = base64.b64encode(cv2.imencode(".png", shown)[1].tobytes()).decode()
    return f'{{"timestamp":{moment.stamp},"frame_id":"sonar","data":"{png}","format":"png"}}'.encode()


SONAR_ROWS = (
    Topic(
        "/sonar/scan",
        NEW_SCAN,
        LASER_SCAN,
        _scan,
        ("scan.ping_step", "scan.hit", "scan.range_m", "scan.intensity", "scan.new_from", "scan.new_count"),
        _read_scan,
    ),
    Topic(
        "/sonar/doppler",
        NEW_SCAN,
        _DOPPLER,
        _doppler,
        ("scan.ping_step", "scan.hit", "scan.doppler_m_s", "scan.ping_vel_b"),
    ),
    Topic("/sonar/image", SONAR_IMAGES, _IMAGE, _image, ("sonar_image.heard",), on_request=True),
)


# ---- What the camera sees: on request whole images, and always what the map takes from them, without which
# nobody could redo the map.

_NO_RETURN_SHARE = 0.999  # as in ``kernels.evidence``: a pixel beyond this share of the range saw nothing
_PNG_HEAD = struct.Struct(">8s4x4sII")  # signature, first chunk's name, width, height
_MAX_PIXELS = 1 << 24  # of a depth image: a thousand times the camera's, far below what a file can claim

_DEPTH_LINE = record(
    "uuv.DepthLine",
    "What the camera tells the map: per image column the nearest pixel at the vehicle's own depth; columns "
    "without one are left out.",
    timestamp=described(TIME, "when the image was taken"),
    column=described(array_of(UINT), "0 = left"),
    row=described(array_of(UINT), "0 = top"),
    depth=described(array_of(NUMBER), "[m] along the camera's axis"),
)

_DEPTH_IMAGE = compressed_image("16-bit PNG of the z-depth [mm]; maximum range = no return")

_DEPTH_EXACT = record(
    "uuv.DepthExact",
    "Every image to the last bit, for `uuv replay`.",
    timestamp=described(TIME, "when the image was taken"),
    rows=UINT,
    columns=UINT,
    data=described(
        BASE64,
        "zlib of four planes, least significant byte first, of 32-bit differences: each pixel's float32 [m] "
        "taken as a whole number, less its predecessor's row by row, modulo 2^32; maximum range = no return",
    ),
)


def _line(moment: Moment) -> bytes:
    depth_m = moment["image.depth_m"]
    column, row = depth_line(depth_m, moment["image.shot_rpy"], moment.header.config)
    columns, rows = (",".join(map(str, indices.tolist())) for indices in (column, row))
    depth = numbers(depth_m[row, column])
    return f'{{"timestamp":{moment.stamp},"column":[{columns}],"row":[{rows}],"depth":{depth}}}'.encode()


def depth_line(depth_m: np.ndarray, rpy: np.ndarray, config: Config) -> tuple[np.ndarray, np.ndarray]:
    """(columns, rows): in every column of a depth image (rows, cols) that has one, the nearest pixel within
    ``mapping.depth_gate_m`` of the vehicle's own depth; ``rpy`` [rad] is its attitude estimate."""
    camera = config.sensors.depth
    rows, cols = depth_m.shape
    focal = 0.5 * camera.cols / math.tan(math.radians(0.5 * camera.fov_deg))
    left = (0.5 * camera.cols - 0.5 - np.arange(cols)) / focal
    up = (0.5 * camera.rows - 0.5 - np.arange(rows))[:, None] / focal
    roll, pitch = (float(v) for v in rpy[:2])
    ahead_z, left_z = -math.sin(pitch), math.sin(roll) * math.cos(pitch)
    up_z = math.cos(roll) * math.cos(pitch)
    mount = np.dot((ahead_z, left_z, up_z), camera.offset_b_m)
    rise = mount + depth_m * (ahead_z + left_z * left + up_z * up)
    counts = (
        (np.abs(rise) <= config.mapping.depth_gate_m)
        & (depth_m > 0)
        & (depth_m < camera.max_range_m * _NO_RETURN_SHARE)
    )
    gated = np.where(counts, depth_m, np.inf)
    row = np.argmin(gated, axis=0)
    column = np.flatnonzero(np.isfinite(gated[row, np.arange(cols)]))
    return column, row[column]


def _png(moment: Moment) -> bytes:
    """16-bit PNG in millimetres."""
    depth_m = np.asarray(moment["image.depth_m"], np.float64)
    millimetres = np.clip(np.rint(depth_m * 1000.0), 0, 65535).astype(np.uint16)
    png = base64.b64encode(cv2.imencode(".png", millimetres)[1].tobytes()).decode()
    return f'{{"timestamp":{moment.stamp},"frame_id":"camera","data":"{png}","format":"png"}}'.encode()


def logged_image(data: dict[str, Any]) -> np.ndarray:
    """PNG of a CompressedImage (row, col): depth [mm] uint16, sonar's intensity uint8. Raises LogError."""
    png = base64.b64decode(data["data"])
    signature, name, width, height = _PNG_HEAD.unpack_from(png.ljust(_PNG_HEAD.size, b"\0"))
    if signature != b"\x89PNG\r\n\x1a\n" or name != b"IHDR":
        raise LogError("an image of the log cannot be decoded: it is not a PNG")
    if width * height > _MAX_PIXELS:
        raise LogError(f"an image of the log claims {width} x {height} pixels: no sensor of ours has so many")
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise LogError("an image of the log cannot be decoded: it is damaged")
    return image


def _exact(moment: Moment) -> bytes:
    """Every bit of the image; neighbouring pixels of clean images differ little, which the packing uses."""
    depth_m = np.ascontiguousarray(moment["image.depth_m"], "<f4")
    rows, cols = depth_m.shape
    steps = np.diff(depth_m.view("<u4").ravel(), prepend=np.uint32(0)).astype("<u4")
    planes = steps.view(np.uint8).reshape(-1, 4).T.tobytes()
    data = base64.b64encode(zlib.compress(planes, 6)).decode()
    return f'{{"timestamp":{moment.stamp},"rows":{rows},"columns":{cols},"data":"{data}"}}'.encode()


def exact_image(data: dict[str, Any], shape: tuple[int, int]) -> np.ndarray:
    """Depth image [m] of a uuv.DepthExact, float32 of ``shape``. Raises LogError for a damaged one."""
    if (data["rows"], data["columns"]) != shape:
        raise LogError(
            f"an exact depth image of the log has {data['rows']} x {data['columns']} pixels, but its "
            f"config.yaml says {shape[0]} x {shape[1]}"
        )
    size = 4 * shape[0] * shape[1]
    try:
        planes = zlib.decompressobj().decompress(base64.b64decode(data["data"]), size)
    except (ValueError, zlib.error) as error:
        raise LogError(f"an exact depth image of the log is damaged ({error})") from None
    if len(planes) != size:
        raise LogError("an exact depth image of the log is damaged: it is too short")
    steps = np.frombuffer(planes, np.uint8).reshape(4, -1).T.copy().view("<u4").ravel()
    return np.cumsum(steps, dtype=np.uint32).view(np.float32).reshape(shape)


CAMERA_ROWS = (
    Topic("/camera/line", NEW_IMAGE, _DEPTH_LINE, _line, ("image.depth_m", "image.shot_rpy")),
    Topic("/camera/depth", IMAGES, _DEPTH_IMAGE, _png, ("image.depth_m",), logged_image, on_request=True),
    Topic(
        "/camera/exact",
        NEW_IMAGE,
        _DEPTH_EXACT,
        _exact,
        ("image.depth_m",),
        note=", with `--depth-images`",
        on_request=True,
    ),
)
