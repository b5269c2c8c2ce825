"""What the sonar heard on the way, below a picture: its intensity image at four moments, as fans."""

from __future__ import annotations

import numpy as np

from uuvtai.logs.canvas import GREY, INK, PAPER, Canvas
from uuvtai.logs.fan_image import polar_picture
from uuvtai.logs.reader import read_messages
from uuvtai.logs.recording import Recording, read_value

TOPIC = "/sonar/image"
HEIGHT_PX = 300
"""of the strip, its headings included"""
_MOMENTS, _GAP, _HEAD = 4, 16, 44
"""fans; [px] between two; [px] above them"""


def fans_of(recordings: list[Recording]) -> Recording | None:
    """The recording whose images are shown: the first that has any."""
    return next((recording for recording in recordings if recording[TOPIC].values), None)


def paint_fan_marks(canvas: Canvas, recording: Recording) -> None:
    """Numbers on the way, where the images were taken."""
    for number, moment in enumerate(_moments(recording), 1):
        pose = recording["/pose"].at(recording[TOPIC].times[moment])
        if pose is None:
            continue
        canvas.disc(pose[:2], 9, PAPER)
        canvas.disc(pose[:2], 9, INK, 1)
        (x, y), *_ = canvas.pixels([pose[:2]])
        canvas.text((x, y + 5), str(number), 14, INK, align="center")


def paint_fans(canvas: Canvas, recording: Recording, left: int, top: int, right: int) -> None:
    """The strip between these edges [px]."""
    bearing, series = _bearing(recording), recording[TOPIC]
    canvas.text((left, top + 14), f"what the sonar of {recording.method} heard, vehicle at the tip", 18, GREY)
    width = (right - left - (_MOMENTS - 1) * _GAP) // _MOMENTS
    for place, moment in enumerate(_moments(recording)):
        shown = series.values[moment]
        if bearing is None or shown.ndim != 2 or shown.shape[1] != len(bearing):
            continue
        fan = _fitted(shown, bearing, width, HEIGHT_PX - _HEAD - 30)
        corner = (left + place * (width + _GAP), top + _HEAD)
        canvas.paste(corner, np.repeat(fan[:, :, None], 3, axis=2))
        text = f"{place + 1}  at {series.times[moment]:.1f} s"
        canvas.text((corner[0], corner[1] - 8), text, 15, INK)


def _fitted(shown: np.ndarray, bearing: np.ndarray, width: int, height: int) -> np.ndarray:
    """The fan as large as fits."""
    tall, wide = polar_picture(shown, bearing, 100, int(PAPER[0])).shape
    scale = min(height / tall, width / wide)
    return polar_picture(shown, bearing, max(2, int(tall * scale)), int(PAPER[0]))[:, :width]


def _moments(recording: Recording) -> list[int]:
    """Numbers of the images that are shown: evenly over the episode, the last one too."""
    count = len(recording[TOPIC].values)
    return sorted({round(i) for i in np.linspace(0, count - 1, _MOMENTS + 1)[1:]})


def _bearing(recording: Recording) -> np.ndarray | None:
    """(n,) [rad] of the beams from ahead, as the log's first scan has them."""
    for message in read_messages(recording.path, ("/sonar/scan",)):
        return read_value(message.topic, message.data)[1]
    return None
