"""Frames into a file: WebM (VP9), MP4 (H.264) and GIF, at a quality rather than a bit rate.

What stands still costs next to nothing so.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from PIL import Image

from uuvtai.logs.canvas import Color
from uuvtai.logs.log_errors import LogError

Frames = Iterable[np.ndarray]
"""images (height, width, 3), blue green red, all of one size"""

_BT601 = 6
"""the matrix by which frames are turned into YUV; named in the file, or a player would guess by the height"""
_LIMITED_RANGE = 1
_CODECS: dict[str, tuple[str, dict[str, str]]] = {
    # VP9 as for a call, at its quickest: drawing the frames takes longer
    ".webm": ("libvpx-vp9", {"crf": "36", "b": "0", "deadline": "realtime", "cpu-used": "8", "row-mt": "1"}),
    # H.264 in 4:2:0 with its index first: what slides, phones and browsers all play
    ".mp4": ("libx264", {"crf": "26", "preset": "veryfast"}),
}
_GIF_TICKS = 100
"""per second: a GIF counts hundredths"""


def write_film(
    part: Path, frames: Frames, fps: float, samples: Sequence[np.ndarray], inks: Sequence[Color]
) -> int:
    """Write frames into ``part``, as its name ends; gives their number. Raises OSError.

    A GIF gets the colours of ``samples``, which are frames, and the ``inks``, which may be rare and must stay
    what they are.
    """
    return (
        _write_gif(part, frames, fps, samples, inks)
        if part.suffix == ".gif"
        else _write_video(part, frames, fps)
    )


def check_whole(part: Path, n_frames: int, out: Path) -> None:
    """Read the file back: a full disk does not show in every write. Raises LogError."""
    try:
        with _refused(), av.open(str(part)) as container:
            found = sum(1 for packet in container.demux(video=0) if packet.size)
    except OSError:
        found = -1
    if found != n_frames:
        raise LogError(
            f"{out}: the video could not be written whole; is the disk full? Make room or choose another "
            "place with --out FILE"
        )
    handle = os.open(part, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _write_video(part: Path, frames: Frames, fps: float) -> int:
    name, options = _CODECS[part.suffix]

    def start(container: Any, frame: np.ndarray) -> Any:
        stream = container.add_stream(name, rate=Fraction(fps).limit_denominator(1000), options=options)
        stream.height, stream.width = frame.shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 0
        stream.codec_context.colorspace, stream.codec_context.color_range = _BT601, _LIMITED_RANGE
        return stream

    def picture(frame: np.ndarray, _i: int) -> Any:
        return av.VideoFrame.from_ndarray(frame, format="bgr24")

    return _write(part, frames, start, picture, {"movflags": "+faststart"} if part.suffix == ".mp4" else {})


def _write_gif(
    part: Path, frames: Frames, fps: float, samples: Sequence[np.ndarray], inks: Sequence[Color]
) -> int:
    """One palette for all frames and no dithering: what stands still stays the same pixel, which costs
    nothing."""
    known = _palette(samples, inks)
    colors = Image.new("P", (1, 1))
    colors.putpalette(known.tobytes())
    table = np.column_stack([np.full(len(known), 255, np.uint8), known])  # alpha red green blue

    def start(container: Any, frame: np.ndarray) -> Any:
        stream = container.add_stream("gif", rate=_GIF_TICKS)
        stream.height, stream.width = frame.shape[:2]
        stream.pix_fmt = "pal8"
        stream.codec_context.time_base = Fraction(1, _GIF_TICKS)
        return stream

    def picture(frame: np.ndarray, i: int) -> Any:
        pal8: Any = (np.asarray(_image(frame).quantize(palette=colors, dither=Image.Dither.NONE)), table)
        found = av.VideoFrame.from_ndarray(pal8, format="pal8")
        found.pts, found.time_base = round(_GIF_TICKS * i / fps), Fraction(1, _GIF_TICKS)
        return found

    return _write(part, frames, start, picture, {"final_delay": str(round(_GIF_TICKS / fps))})


def _palette(samples: Sequence[np.ndarray], inks: Sequence[Color]) -> np.ndarray:
    """(256, 3) red green blue."""
    found = (
        _image(np.concatenate(samples)).quantize(256 - len(inks), dither=Image.Dither.NONE).getpalette("RGB")
        or []
    )
    known = [*(ink[::-1] for ink in inks), *np.reshape(found, (-1, 3))]
    return np.array([*known, *[known[0]] * (256 - len(known))], np.uint8)


def _image(frame: np.ndarray) -> Image.Image:
    return Image.fromarray(np.ascontiguousarray(frame[..., ::-1]))


def _write(
    part: Path,
    frames: Frames,
    start: Callable[[Any, np.ndarray], Any],
    picture: Callable[[np.ndarray, int], Any],
    options: dict[str, str],
) -> int:
    n_frames, stream = 0, None
    with _refused(), av.open(str(part), "w", format=part.suffix.lstrip("."), options=options) as container:
        for frame in frames:
            stream = stream or start(container, frame)
            container.mux(stream.encode(picture(frame, n_frames)))
            n_frames += 1
        if stream is not None:
            container.mux(stream.encode())
    return n_frames


@contextmanager
def _refused() -> Iterator[None]:
    """FFmpeg's errors as what Python calls them."""
    try:
        yield
    except FFmpegError as error:
        raise OSError(error.errno, error.strerror or str(error)) from error
