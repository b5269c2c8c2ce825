"""Pictures and videos are what their names say, judged by readers of others: Pillow, FFmpeg."""

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from tests.oracles import logs as episode
from uuvtai.cli import main
from uuvtai.common.colours import PALETTE, agent_colours, contrast
from uuvtai.common.errors import UserError
from uuvtai.logs import drawing
from uuvtai.logs import video as film
from uuvtai.logs.drawing import PICTURE_TOPICS, load_recording
from uuvtai.logs.picture import paint_picture, picture
from uuvtai.logs.topics.perception import Layer
from uuvtai.logs.video import FrameArtist, video

N_STEP = 60
DURATION_S = N_STEP * episode.DT
PLACES = np.array([65536, 256, 1])
"""of red, green and blue in one number"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("formats")


@pytest.fixture(scope="module")
def logs(folder):
    straight = episode.header("straight")
    return [
        episode.record(folder / "bt.mcap", N_STEP),
        episode.record(folder / "straight.mcap", N_STEP, straight, sway=-0.9),
    ]


def code(color):
    return "#" + "".join(f"{part:02x}" for part in reversed(color))


# --------------------------------------------------------------------------------------------------- pictures


def test_a_png_is_a_png(folder, logs):
    with Image.open(picture(logs, folder / "p.PNG")) as image:
        assert (image.format, image.size[0]) == ("PNG", 1600)


# ----------------------------------------------------------------------------------------------------- videos


@pytest.mark.parametrize(
    ("name", "container", "codec"), [("v.mp4", "mov,mp4,m4a,3gp,3g2,mj2", "h264"), ("v.gif", "gif", "gif")]
)
def test_a_video_is_what_its_name_says(folder, logs, capfd, name, container, codec):
    """Container, codec, size, rate and length by FFmpeg; pixels; nothing on stderr."""
    fps, speed = 10.0, 2.0
    out = video(logs[0], folder / name, fps=fps, speed=speed, width_px=640)
    assert capfd.readouterr().err == ""
    expected = len(np.arange(0.0, DURATION_S, speed / fps)) + 11
    with av.open(str(out)) as found:
        stream = found.streams.video[0]
        assert (found.format.name, stream.codec_context.name.removeprefix("libdav1d")) == (container, codec)
        frames = [frame.to_ndarray(format="bgr24").astype(int) for frame in found.decode(video=0)]
        assert float(stream.average_rate) == pytest.approx(fps, rel=0.01)
        if codec == "h264":
            assert stream.codec_context.pix_fmt == "yuv420p", "the only one that every player knows"
            content = out.read_bytes()
            assert 0 < content.index(b"moov") < content.index(b"mdat"), "it can be played while it loads"
    assert len(frames) == expected and frames[0].shape[1] == 640 and frames[0].shape[0] % 2 == 0
    drawn = cv2.resize(
        FrameArtist(load_recording(logs[0])).frame(0.4),
        (640, frames[0].shape[0]),
        interpolation=cv2.INTER_AREA,
    )
    errors = [np.abs(frame - drawn).mean() for frame in frames]
    assert int(np.argmin(errors)) == 2 and errors[2] < 6


def test_a_gif_keeps_its_time_and_its_colours(folder, logs):
    """15 frames a second are no whole hundredths; rare colours must not melt into frequent ones."""
    with Image.open(video(logs[0], folder / "t.gif", fps=15.0, speed=4.0)) as image:
        durations, seen = [], set()
        for i in range(image.n_frames):
            image.seek(i)
            durations.append(image.info["duration"])
            seen |= set(np.unique(np.array(image.convert("RGB")) @ PLACES)) if i % 8 == 0 else set()
        assert image.info["loop"] == 0 and image.size[0] == 800
    assert sum(durations) == pytest.approx(1000 * (image.n_frames / 15), abs=40)
    inks = drawing.GOAL, drawing.ROUTE, drawing.agent_inks(["bt"])["bt"]
    assert {int(color[::-1] @ PLACES) for color in map(np.array, inks)} <= seen


def test_what_cannot_be_written_is_refused_before_anything_is_read(tmp_path):
    for draw, name, there in (
        (picture, "a.pdf", ".png"),
        (video, "a.avi", ".mp4, .gif"),
        (video, "a", ".mp4"),
    ):
        with pytest.raises(UserError, match="can be") as answer:
            draw(tmp_path / "nowhere.mcap", tmp_path / name)
        assert there in str(answer.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "wrong",
    [
        {"speed": 0.0},
        {"speed": -1.0},
        {"speed": float("nan")},
        {"fps": 1e9},
        {"fps": 0.5},
        {"width_px": 100_000},
    ],
)
def test_values_without_sense_are_refused(tmp_path, logs, wrong):
    with pytest.raises(UserError, match="must be from"):
        video(logs[0], tmp_path / "a.mp4", **wrong)
    assert list(tmp_path.iterdir()) == []


def test_a_cut_file_is_seen(tmp_path, logs):
    frames = [np.full((64, 64, 3), 20 * i, np.uint8) for i in range(10)]
    for suffix in (".mp4", ".gif"):
        path = tmp_path / f"a{suffix}"
        assert film.write_video(path, frames, 10.0, frames, []) == 10
        film.check_whole(path, 10, path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(UserError, match="disk full"):
            film.check_whole(path, 10, path)


def test_the_command_takes_speed_rate_and_width_and_tells_its_progress(tmp_path, logs, capfd, monkeypatch):
    monkeypatch.setattr("uuvtai.console.screen._PERIOD_S", 0.0)
    out = tmp_path / "talk.gif"
    with pytest.raises(SystemExit) as left:
        main(
            ["log", "render", str(logs[0]), "--out", str(out), "--speed", "3", "--fps", "5", "--width", "400"]
        )
    said = capfd.readouterr()
    assert left.value.code == 0 and said.out.strip() == str(out) and "frames" in said.err
    with Image.open(out) as image:
        assert image.size[0] == 400


# ---------------------------------------------------------------------------------------------------- colours


METHODS = ["straight", "planner", "bt", "paper", "best", "oracle", "bt+truth", "dwa", "mppi"]


def test_a_method_has_one_colour_wherever_it_is_shown():
    known = agent_colours(METHODS)
    assert len(set(known.values())) == len(known)
    for name, colour in known.items():
        assert agent_colours([name]) == {name: colour} and agent_colours(["mine", name])[name] == colour


def test_other_methods_take_what_is_free_in_their_order():
    found = agent_colours(["bt", "a", "b", "c"])
    assert len(set(found.values())) == 4
    assert agent_colours(["bt", "a"]) == {name: found[name] for name in ("bt", "a")}
    many = agent_colours([f"m{i}" for i in range(20)])
    assert set(many.values()) <= set(PALETTE) and len(set(many.values())) == 7


def test_every_method_stands_out_from_what_a_map_shows():
    for colour in agent_colours(METHODS).values():
        assert contrast(colour, "#ffffff") > 1.9
        for meaning in (drawing.DYNAMIC, drawing.MOVER):
            assert np.abs(np.array(drawing.bgr(colour)) - meaning).max() > 60


def test_a_video_draws_its_method_in_its_colour(folder, logs):
    recording = load_recording(logs[1])
    own, other = drawing.agent_inks(["straight"])["straight"], drawing.agent_inks(["bt"])["bt"]
    image = FrameArtist(recording).frame(1.0)
    assert has(image, own) and not has(image, other)


def has(image, color):
    return bool((image == np.array(color)).all(axis=2).any())


def test_methods_of_a_user_keep_the_colour_that_they_have_beside_each_other(tmp_path):
    path = episode.record(tmp_path / "b.mcap", 20, episode.header("second"))
    names = ["bt", "first", "second"]
    image = paint_picture([load_recording(path, PICTURE_TOPICS)], agents=names).image
    assert has(image, drawing.agent_inks(names)["second"])


def test_maps_of_a_harbour_are_kept_packed():
    values = np.zeros((1000, 2000), np.float32)
    values[3, 4] = 0.75
    layer = Layer.of(values, (0.0, 0.0), 0.1)
    assert layer.nbytes < values.nbytes / 100 and np.array_equal(layer.values, values)
