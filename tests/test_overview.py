"""Several logs as one film: a tank each, framed by how the episode ended."""

import av
import numpy as np
import pytest

from tests.command import uuv
from tests.test_pictures import record
from uuvtai.logs import overview as film
from uuvtai.logs.canvas import FAILED
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.overview import overview
from uuvtai.logs.recording import load_recording


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    return [
        record(folder / "a.mcap"),
        record(folder / "b.mcap", "straight", -0.9, "collision", 4),
        record(folder / "c.mcap", "planner", 0.5, "success", 5),
    ]


def test_every_episode_has_its_tank_and_its_end(logs):
    grid = film._Grid([load_recording(path, ("/pose",)) for path in logs], 641)
    end = max(tank.recording.duration_s for tank in grid._tiles)
    first, last = grid.frame(0.0), grid.frame(end)
    assert first.shape == last.shape and first.shape[0] % 2 == 0 and first.shape[1] == 640
    assert not np.array_equal(first, last)
    for colour, count in ((film._ARRIVED, 2), (FAILED, 1)):
        assert (grid.frame(end) == np.array(colour)).all(axis=2).sum() > 400 * count
        assert (first == np.array(colour)).all(axis=2).sum() == 0


def test_the_command_makes_one_film_of_several_logs(logs, tmp_path, capfd):
    out = tmp_path / "grid.mp4"
    code, said, _err = uuv(capfd, "log", "video", *logs, "--out", out, "--speed", "4", "--width", "320")
    assert code == 0 and str(out) in said
    with av.open(str(out)) as container:
        assert container.streams.video[0].width == 320
        assert sum(1 for _frame in container.decode(video=0)) > 15
    code, _said, err = uuv(capfd, "log", "video", *logs, "--out", logs[1])
    assert code == 2 and "is what is read here" in " ".join(err.split())


def test_what_nobody_could_see_is_refused(logs, tmp_path, monkeypatch):
    with pytest.raises(LogError, match="--width 100: must be from 320"):
        overview(logs, tmp_path / "x.mp4", width_px=100)
    monkeypatch.setattr(film, "_LEAST_PX", 400)
    with pytest.raises(LogError, match="give --width"):
        overview(logs * 3, tmp_path / "x.mp4", width_px=640)
    with pytest.raises(LogError, match="give 144 at most"):
        overview(logs * 50, tmp_path / "x.mp4")
    assert list(tmp_path.iterdir()) == []
