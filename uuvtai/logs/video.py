"""Top-down video of an episode: what the vehicle senses, maps, plans and does, with the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.error import FFmpegError
from PIL import Image

from uuvtai.common.files import flush, refusing, whole_file
from uuvtai.logs import drawing
from uuvtai.logs.encode import LogError, checked_suffix
from uuvtai.logs.topics.perception import Layer

_MARGINS = (52, 28, 84, 212)  # [px] left, right, top, bottom
_PANEL = 160  # [px] height of the panel below the map
_GOOD = drawing.bgr("#2b8a3e")
_LEGEND = (
    (drawing.ROUTE, "route"),
    (drawing.ECHO, "sonar"),
    (drawing.STATIC, "mapped"),
    (drawing.DYNAMIC, "tracked"),
    (drawing.MOVER, "true, dynamic"),
    (drawing.GREY, "true, static"),
)
_HOLD_S = 1.0  # The last frame stays this long.
_DRAWN_PX = 1280  # Narrower frames are drawn this wide and made smaller: the panel below needs the room.
FORMATS = {".mp4": (1280, 15.0), ".gif": (800, 10.0)}
"""what a video's name may end in: (width [px], frames per second) unless told"""
WIDTHS, FPS, SPEEDS = (320, 3840), (1.0, 60.0), (0.05, 100.0)  # least and most
_MOST_FRAMES = 100_000
_FEW_FRAMES, _FRAMES_PER_POSE = 1000, 10
"""a small file must not cost minutes: beyond so many frames a log has to hold something new for them (ours
hold 50 poses a second)"""

Progress = Callable[[int, int], None]  # Called with (frames done, frames in all).


def video(
    path: Path,
    out: Path,
    width_px: int | None = None,
    fps: float | None = None,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Render a log as MP4 or GIF, as the name of ``out`` ends; ``width_px`` and ``fps`` default to what
    ``FORMATS`` says of it.

    ``speed`` 2 shows it twice as fast as it was. Raises LogError; the file appears whole or not at all.
    """
    out = Path(out)
    suffix = checked_suffix(out, tuple(FORMATS), "video")
    width_px = FORMATS[suffix][0] if width_px is None else width_px
    fps = FORMATS[suffix][1] if fps is None else fps
    given = ("--width", width_px, WIDTHS), ("--fps", fps, FPS), ("--speed", speed, SPEEDS)
    for name, value, (least, most) in given:
        if not least <= value <= most:
            raise LogError(f"{name} {value:g}: must be from {least:g} to {most:g}")
    recording = drawing.load_recording(path)
    times = frame_times(recording, fps, speed)
    with drawing.drawing(Path(path)):
        artist = FrameArtist(recording, max(width_px, _DRAWN_PX))
        samples = [_sized(artist.frame(recording.duration_s * share), width_px) for share in (0.0, 0.5, 1.0)]
    frames = _frames(artist, times, width_px, progress)
    with refusing(LogError, f"{out}: cannot write the video", "choose another place with --out FILE"):
        out.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(out, f".tmp{out.suffix.lower()}") as (_, part):
            check_whole(part, write_video(part, frames, fps, samples, artist.inks), out)
    return out


def frame_times(recording: drawing.Recording, fps: float, speed: float) -> np.ndarray:
    """Moments [s] of the frames; the last stays for a while. Raises LogError for too many frames."""
    n_frames = recording.duration_s * fps / speed
    if n_frames > _MOST_FRAMES:
        raise LogError(
            f"{recording.path}: {n_frames:,.0f} frames, more than {_MOST_FRAMES:,}; raise --speed or lower "
            "--fps"
        )
    poses = len(recording["/pose"].times)
    if n_frames > _FEW_FRAMES and n_frames > _FRAMES_PER_POSE * poses:
        raise LogError(
            f"{recording.path}: {poses} poses in {recording.duration_s:,.0f} s are no episode to watch; "
            "raise --speed or lower --fps"
        )
    times = np.arange(0.0, recording.duration_s, speed / fps)
    return np.concatenate([times, np.full(1 + round(_HOLD_S * fps), recording.duration_s)])


def _frames(
    artist: FrameArtist, times: np.ndarray, width_px: int, progress: Progress | None
) -> Iterator[np.ndarray]:
    for i, time_s in enumerate(times):
        with drawing.drawing(artist.recording.path):
            frame = _sized(artist.frame(float(time_s)), width_px)
        yield frame
        if progress:
            progress(i + 1, len(times))


def _sized(frame: np.ndarray, width_px: int) -> np.ndarray:
    """The frame in this width (one less where that is odd), with an even height, as the codecs want it."""
    height, width = frame.shape[:2]
    wanted = width_px - width_px % 2
    size = wanted, 2 * round(height * wanted / width / 2)
    return frame if wanted == width else cv2.resize(frame, size, interpolation=cv2.INTER_AREA)


class FrameArtist:
    """Draws the frame of any moment of a recording; what stays between two maps is drawn once."""

    def __init__(self, recording: drawing.Recording, width_px: int = 1280) -> None:
        self.recording = recording
        self._ink = drawing.agent_inks([recording.agent])[recording.agent]
        self._canvas = drawing.map_canvas(recording.scenario["tank"], width_px - width_px % 2, _MARGINS)
        self._base: np.ndarray | None = None
        self._base_map: Layer | None = None
        self._track = recording.positions
        self._times = np.array(recording["/pose"].times)
        self._clearance = np.array([value[0] for value in recording["/safety"].values])

    @property
    def inks(self) -> list[drawing.Color]:
        """Colours that mean something."""
        return [
            self._ink,
            drawing.GOAL,
            _GOOD,
            drawing.FAILED,
            *(color for color, _ in _LEGEND),
            *drawing.TRIGGER_COLORS.values(),
        ]

    def frame(self, time_s: float) -> np.ndarray:
        """Image (height, width, 3), blue green red."""
        canvas, recording = self._canvas, self.recording
        canvas.image = self._background(time_s).copy()
        i = max(int(np.searchsorted(self._times, time_s + 1e-9)) - 1, 0)
        pose = self._track[i]
        drawing.paint_truth(canvas, recording.scenario, time_s, float(pose[2]))
        self._paint_plan(time_s)
        canvas.line(self._track[: i + 1, :2], self._ink, 2)
        for echo in recording.echoes(time_s):
            canvas.disc(echo, 2.4, drawing.ECHO)
        tracks = recording["/tracks"].at(time_s)
        for x, y, radius in () if tracks is None else tracks[:, :3]:
            canvas.disc((x, y), (radius + 0.06) * canvas.scale, drawing.DYNAMIC, 2)
        self._paint_goal()
        canvas.vehicle(pose, self._ink)
        self._paint_head(time_s)
        self._paint_panel(time_s, i)
        return canvas.image

    def _background(self, time_s: float) -> np.ndarray:
        static, dynamic = (self.recording[f"/map/{name}"].at(time_s) for name in ("static", "dynamic"))
        if self._base is None or static is not self._base_map:
            canvas = self._canvas
            canvas.image = np.full_like(canvas.image, drawing.PAPER)
            drawing.paint_water(canvas, self.recording.scenario["tank"])
            if static and dynamic:
                drawing.paint_layers(canvas, static, dynamic)
            drawing.paint_walls(canvas, self.recording.scenario["tank"])
            drawing.paint_ruler(canvas)
            self._base, self._base_map = canvas.image, static
        return self._base

    def _paint_plan(self, time_s: float) -> None:
        canvas, plan = self._canvas, self.recording["/plan/info"].at(time_s)
        route, ahead = () if plan is None else plan[0], self.recording["/plan/lookahead"].at(time_s)
        if len(route) > 1:
            canvas.line(route, drawing.PAPER, 5)
            canvas.line(route, drawing.ROUTE, 2)
        if ahead is not None:
            canvas.disc(ahead, 7, drawing.PAPER)
            canvas.disc(ahead, 5, drawing.ROUTE)

    def _paint_goal(self) -> None:
        canvas, scenario = self._canvas, self.recording.scenario
        goal, radius = scenario["goal"], scenario["goal_radius_m"]
        canvas.dashes(np.array(goal[:2]) + radius * drawing.ring(72), drawing.INK, 1)
        canvas.star(goal, 14)

    def _paint_head(self, time_s: float) -> None:
        canvas, recording, scenario = self._canvas, self.recording, self.recording.scenario
        width = canvas.image.shape[1]
        which = f"{scenario['world']} · seed {scenario['seed']} · episode {scenario['episode']}"
        canvas.text((24, 34), f"{recording.agent} · {which}", 22, drawing.INK, bold=True)
        moving = f", {scenario['D']} dynamic at {scenario['v_m_s']:g} m/s" if scenario["D"] else ""
        canvas.text(
            (24, 60),
            f"{scenario['S']} static obstacles{moving}; dashed while wholly above or below the vehicle",
            16,
            drawing.GREY,
        )
        canvas.text((width - 28, 36), f"{time_s:5.1f} s", 26, drawing.INK, bold=True, align="right")
        if time_s >= recording.duration_s:
            good = recording.outcome == "success"
            ink = _GOOD if good else drawing.FAILED
            canvas.text((width - 150, 36), recording.outcome_text, 24, ink, bold=True, align="right")

    # -------------------------------------------------------------------------------------------- panel below

    def _paint_panel(self, time_s: float, i: int) -> None:
        canvas, recording = self._canvas, self.recording
        top = canvas.image.shape[0] - _PANEL
        safety, leaf, speed = (recording[name].at(time_s) for name in ("/safety", "/action", "/state"))
        clearance = None if safety is None else safety[0]
        near = clearance is not None and clearance < 0.3
        said = "-" if clearance is None else f"{clearance:.2f} m"
        self._figure(24, top, "clearance", said, drawing.FAILED if near else drawing.INK)
        said = "-" if not safety or safety[1] is None else f"{safety[1]:.1f} s"
        self._figure(164, top, "time to collision", said, drawing.INK)
        self._figure(320, top, "speed", "-" if speed is None else f"{speed:.2f} m/s", drawing.INK)
        canvas.text((24, top + 86), "tree", 15, drawing.GREY)
        canvas.text((24, top + 112), leaf or "-", 21, drawing.INK, bold=True)
        self._paint_legend(24, top + 138)
        self._paint_curve(time_s, i, top)

    def _figure(self, x: int, top: int, label: str, value: str, color: drawing.Color) -> None:
        self._canvas.text((x, top + 24), label, 15, drawing.GREY)
        self._canvas.text((x, top + 54), value, 25, color, bold=True)

    def _paint_legend(self, x: float, y: float) -> None:
        canvas = self._canvas
        for color, label in _LEGEND:
            square = np.array([(0, -9), (9, -9), (9, 0), (0, 0)]) + np.array([x, y])
            canvas.filled(square, color)
            x += 16 + canvas.text((x + 14, y), label, 14, drawing.GREY) + 14

    def _paint_curve(self, time_s: float, i: int, top: int) -> None:
        """Clearance over the episode; replans as ticks in the colour of their trigger."""
        canvas, recording = self._canvas, self.recording
        left, right, low, high = 560, canvas.image.shape[1] - 28, top + 122, top + 26
        most = max(1.0, float(np.ceil(self._clearance.max(initial=0.0))))

        def place(times: np.ndarray, values: np.ndarray) -> np.ndarray:
            across = left + (right - left) * times / max(recording.duration_s, 1e-6)
            return np.column_stack([across, low - (low - high) * np.clip(values, 0, most) / most])

        for value in (0.0, most):
            y = round(float(place(np.zeros(1), np.array([value]))[0, 1]))
            cv2.line(canvas.image, (left, y), (right, y), drawing.FAINT, 1)
            canvas.text((left - 8, y + 5), f"{value:g}", 13, drawing.GREY, align="right")
        canvas.text((left, top + 12), "clearance [m]", 14, drawing.GREY)
        self._paint_replans(place, time_s, low)
        curve = place(np.array(recording["/safety"].times), self._clearance)
        canvas.strip(curve, drawing.mixed(self._ink, drawing.PAPER, 0.25), 2)
        if i > 0:
            canvas.strip(curve[: i + 1], self._ink, 2)
        if len(curve):
            canvas.dot(curve[min(i, len(curve) - 1)], 4, self._ink)

    def _paint_replans(
        self, place: Callable[[np.ndarray, np.ndarray], np.ndarray], time_s: float, low: int
    ) -> None:
        canvas, x, plans = self._canvas, 700.0, self.recording["/plan/info"]
        replans = [(at, trigger) for at, (_, trigger) in zip(plans.times, plans.values, strict=True)]
        for name, color in drawing.TRIGGER_COLORS.items():
            count = sum(trigger == name and at <= time_s for at, trigger in replans)
            label = f"{name} {count}"
            x += 14 + canvas.text((x, low + 22), label, 14, color, bold=True) + 10
        canvas.text((560, low + 22), "replans by trigger:", 14, drawing.GREY)
        for at, trigger in replans:
            if at <= time_s:
                px = round(float(place(np.array([at]), np.zeros(1))[0, 0]))
                ink = drawing.TRIGGER_COLORS.get(trigger, drawing.GREY)
                cv2.line(canvas.image, (px, low), (px, low - 12), ink, 2, cv2.LINE_AA)


# ---- Frames into a file: MP4 (H.264) and GIF, at a quality rather than a bit rate.

Frames = Iterable[np.ndarray]  # images (height, width, 3), blue green red, all of one size

_BT601 = 6  # the matrix by which frames become YUV; named in the file, or players guess by the height
_LIMITED_RANGE = 1
_CODECS: dict[str, tuple[str, dict[str, str]]] = {
    # H.264 in 4:2:0 with its index first: what slides, phones and browsers all play
    ".mp4": ("libx264", {"crf": "26", "preset": "veryfast"})
}
_GIF_TICKS = 100  # per second: a GIF counts hundredths


def write_video(
    part: Path, frames: Frames, fps: float, samples: Sequence[np.ndarray], inks: Sequence[drawing.Color]
) -> int:
    """Write frames into ``part``, as its name ends; gives their number. Raises OSError.

    A GIF gets the colours of ``samples``, which are frames, and the ``inks``, which may be rare and must stay
    what they are.
    """
    if part.suffix == ".gif":
        return _write_gif(part, frames, fps, samples, inks)
    return _write_video(part, frames, fps)


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
    flush(part)


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
    part: Path, frames: Frames, fps: float, samples: Sequence[np.ndarray], inks: Sequence[drawing.Color]
) -> int:
    """One palette for all frames, no dithering: what stands still stays the same pixel and costs nothing."""
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


def _palette(samples: Sequence[np.ndarray], inks: Sequence[drawing.Color]) -> np.ndarray:
    """(256, 3) red green blue."""
    seen = _image(np.concatenate(samples)).quantize(256 - len(inks), dither=Image.Dither.NONE)
    known = [*(ink[::-1] for ink in inks), *np.reshape(seen.getpalette("RGB") or [], (-1, 3))]
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
