"""What the sonar hears."""

from __future__ import annotations

import base64
import json
from typing import Any

import cv2
import numpy as np

from uuvtai.logs.encode import IDENTITY, numbers
from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import (
    LASER_SCAN,
    NUMBER,
    THREE,
    TIME,
    array_of,
    compressed_image,
    described,
    record,
)
from uuvtai.logs.topic import NEW_SCAN, SONAR_IMAGES, Topic
from uuvtai.multibeam import SHOWN_DB, gain

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


ROWS = (
    Topic(
        "/sonar/scan",
        NEW_SCAN,
        LASER_SCAN,
        _scan,
        (
            "scan.ping_step",
            "scan.hit",
            "scan.range_m",
            "scan.intensity",
            "scan.new_from",
            "scan.new_count",
        ),
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
