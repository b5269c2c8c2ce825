"""Episodes for Rerun: what its own loader reads back of an .rrd is what the messages say; and what cannot be
shown is refused."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from tests.command import uuv
from tests.reference import logs as episode
from uuvtai.live import rerun_viewer
from uuvtai.live.broadcast import EveryViewer, LiveEpisode
from uuvtai.live.rerun_viewer import RerunViewer
from uuvtai.live.viewer_server import LiveError
from uuvtai.logs.mcap_log import McapEpisodeLog
from uuvtai.logs.recording import load_recording
from uuvtai.measure import watching

chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (uuvtai[rerun]), which is for Python 3.11")
N_STEP = 60
FLOAT32 = 1e-5


class Watched:
    """A viewer that keeps what it is told."""

    def __init__(self):
        self.messages, self.times, self.begun = [], [], 0

    def begin(self, schemas):
        self.begun += 1

    def tell_time(self, time_ns):
        self.times.append(time_ns)

    def send(self, message):
        self.messages.append(message)


def read_back(path):
    """Values of an .rrd by (entity, column), as Rerun's own loader has them."""
    columns = {}
    for part in chunk.RrdReader(str(path)).stream():
        batch = part.to_record_batch()
        for name in batch.schema.names:
            column = batch.column(name).cast("int64") if name == "time" else batch.column(name)
            columns.setdefault((str(part.entity_path), name), []).extend(column.to_pylist())
    return columns


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """(rows of the .rrd by entity and column, messages of both episodes)."""
    path = tmp_path_factory.mktemp("rerun") / "new" / "live.rrd"
    beside = Watched()
    with RerunViewer(str(path)) as viewer:
        for number in (3, 4):
            live = LiveEpisode(EveryViewer(viewer, beside), episode.header("bt", number), True)
            for values in episode.snapshots(N_STEP):
                live.write(values)
    return read_back(path), beside


def by_topic(beside, topic):
    return [json.loads(message.data) for message in beside.messages if message.topic == topic]


def test_the_vehicle_is_where_the_messages_say(shown):
    columns, beside = shown
    poses = [list(data["pose"]["position"].values()) for data in by_topic(beside, "/pose")]
    places = np.array(columns["/world/vehicle", "Transform3D:translation"]).reshape(-1, 3)
    assert len(poses) == 2 * (N_STEP + 1) and beside.begun == 2
    np.testing.assert_allclose(places, poses, atol=FLOAT32)


def test_time_goes_on_over_episodes_and_numbers_tell_them_apart(shown):
    columns, _ = shown
    times = [value / 1e9 for value in columns["/world/vehicle", "time"]]
    assert times == sorted(times) and times[-1] == pytest.approx(2 * N_STEP * 0.02 + 1.0)
    assert set(columns["/world/vehicle", "episode"]) == {0, 1}
    assert len(columns["/world/map", "Clear:is_recursive"]) == 2


def test_returns_maps_routes_images_and_lines_of_the_log_are_there(shown, tmp_path):
    columns, beside = shown
    with McapEpisodeLog(tmp_path / "a.mcap", episode.header(), True) as log:
        for values in episode.snapshots(N_STEP):
            log.write(values)
        log.close(episode.result(N_STEP, "success"))
    recording = load_recording(tmp_path / "a.mcap")
    returns = columns["/world/sonar/returns", "Points3D:positions"]
    ranges, bearing, hit, _ = recording["/sonar/scan"].values[7]
    x, y, z, yaw = recording["/pose"].values[7]
    truth = np.column_stack([x + ranges * np.cos(bearing + yaw), y + ranges * np.sin(bearing + yaw)])[hit]
    np.testing.assert_allclose(np.array(returns[7])[:, :2], truth, atol=1e-4)
    assert np.allclose(np.array(returns[7])[:, 2], z)
    layer = recording["/map/static"].values[-1]
    cells = [row for row in columns["/world/map/static", "Points3D:positions"] if row]
    assert len(cells[-1]) == (layer.values >= 0.5).sum() > 0
    assert len(columns["/sonar/image", "EncodedImage:blob"]) == len(by_topic(beside, "/sonar/image")) > 2
    said = [row[0] for row in columns["/log", "TextLog:text"]]
    assert said == [data["message"] for data in by_topic(beside, "/log")]
    bodies = by_topic(beside, "/obstacles")[0]["entities"][0]
    boxes = columns["/world/truth/obstacles/cubes", "Boxes3D:half_sizes"][0]
    np.testing.assert_allclose(boxes[0], [0.5 * s for s in bodies["cubes"][0]["size"].values()], atol=FLOAT32)
    assert ("/safety/clearance_m", "Scalars:scalars") in columns


def test_watch_shows_every_episode_to_foxglove_and_to_rerun(monkeypatch, tmp_path):
    """The command's own loop, with made-up episodes in place of the simulator's."""

    def played(comparison, method, job, viewers, rate):
        live = LiveEpisode(viewers, episode.header("bt", job.episode), False)
        for values in episode.snapshots(5):
            live.write(values)
        return {"episode": job.episode}

    said, path = [], tmp_path / "live.rrd"
    monkeypatch.setattr(watching, "methods_of", lambda *_: [SimpleNamespace(name="bt", own=None)])
    monkeypatch.setattr(watching, "comparison_of", lambda *_: None)
    monkeypatch.setattr(watching, "_watched", played)
    request = SimpleNamespace(controllers=[], episodes=2, seeds=[0])
    options = watching.LiveOptions(port=0, rate=0.0, rerun=str(path))
    told = watching.watch_episodes(request, options, SimpleNamespace(note=said.append))
    assert [entry["episode"] for entry in told] == [0, 1] and "serving ws://localhost:" in said[0]
    assert set(read_back(path)["/world/vehicle", "episode"]) == {0, 1}, "the file is whole afterwards"


# ----------------------------------------------------------------------------------------------------- errors


def test_a_file_that_is_there_is_kept_and_others_are_no_target(tmp_path):
    there = tmp_path / "a.rrd"
    there.write_text("hers")
    with pytest.raises(LiveError, match=r"is kept.*--rerun a_2\.rrd"):
        RerunViewer(str(there))
    assert there.read_text() == "hers"
    with pytest.raises(LiveError, match=r"--rerun live\.rrd"):
        RerunViewer(str(tmp_path / "a.mcap"))
    (tmp_path / "file").write_text("")
    with pytest.raises(LiveError, match="cannot be written"):
        RerunViewer(str(tmp_path / "file" / "a.rrd"))


@pytest.mark.parametrize("place", ["127.0.0.1:9", "127.0.0.1:many"])
def test_a_viewer_that_is_not_there_is_told_of_at_once(place):
    with pytest.raises(LiveError, match=r"no viewer answers.*rerun --port"):
        RerunViewer(f"rerun+http://{place}/proxy")


def test_without_the_sdk_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(rerun_viewer.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(LiveError, match=r"uuvtai\[rerun\]"):
        RerunViewer("a.rrd")


def test_the_command_refuses_before_it_plays(capfd, tmp_path):
    code, _, err = uuv(capfd, "watch", "--episodes", "1", "--port", "0", "--rerun", str(tmp_path / "a.txt"))
    assert code == 2 and "--rerun live.rrd" in err
