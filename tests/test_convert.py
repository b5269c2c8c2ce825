"""Logs with protobuf messages: nothing is lost or changed, and Rerun draws poses, transforms, images and
point clouds from them."""

import base64
import importlib.util
import json

import numpy as np
import pytest
from google.protobuf import json_format
from mcap.reader import make_reader

from tests.command import run_cli
from tests.reference import logs as episode
from uuvtai.config import Config
from uuvtai.logs import convert as module
from uuvtai.logs.container import McapFile
from uuvtai.logs.convert import ADDED, convert, serialised
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.mcap_log import McapEpisodeLog
from uuvtai.logs.reader import info, read_head, read_messages
from uuvtai.logs.topics.map_topics import grid_values

N_STEP = 60
FLOAT32 = 1e-6
"""positions up to 20 m, rounded once"""

if any(importlib.util.find_spec(name) is None for name in ("foxglove_schemas_protobuf", "mcap_protobuf")):
    pytest.skip("needs the extra uuvtai[viz]", allow_module_level=True)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    with McapEpisodeLog(path, episode.header(), depth_images=True) as log:
        for snap in episode.snapshots(N_STEP):
            log.write(snap)
        log.close(episode.result(N_STEP))
    return path


@pytest.fixture(scope="module")
def converted(recorded):
    out = recorded.with_name("b.mcap")
    convert(recorded, out)
    return out


def decoded(path):
    """{topic: [(time, message)]} by the official reader and decoder, checksums verified."""
    from mcap_protobuf.decoder import DecoderFactory

    found = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.message_encoding == "protobuf":
                factory = DecoderFactory().decoder_for("protobuf", schema)
                found.setdefault(channel.topic, []).append((message.log_time, factory(message.data)))
    return found


def by_topic(path, topic):
    return [m.data for m in read_messages(path, [topic])]


def test_every_message_is_there_and_says_the_same(recorded, converted):
    before, after = info(recorded), info(converted)
    counts = {topic["topic"]: (topic["schema"], topic["messages"]) for topic in after["topics"]}
    for topic in before["topics"]:
        assert counts.pop(topic["topic"]) == (topic["schema"], topic["messages"])
    assert set(counts) == {topic for topic, _kind, _make in ADDED.values()}
    assert read_head(recorded) == read_head(converted)
    answer = decoded(converted)
    assert {
        topic["topic"] for topic in before["topics"] if topic["schema"].startswith("foxglove.")
    } == answer.keys() - counts.keys()
    for topic in answer.keys() - counts.keys():
        for (time_ns, message), original in zip(answer[topic], read_messages(recorded, [topic]), strict=True):
            assert time_ns == round(original.time_s * 1e9)
            assert_same(message, original.data)


def assert_same(message, data):
    """A protobuf message holds what the JSON does: printed back, with times as Foxglove writes them."""
    assert message.DESCRIPTOR.full_name.startswith("foxglove.")
    for key, value in data.items():
        inner = getattr(message, key)
        if isinstance(value, dict) and value.keys() == {"sec", "nsec"}:
            assert (inner.seconds, inner.nanos) == (value["sec"], value["nsec"]), key
        elif isinstance(value, dict):
            assert_same(inner, value)
        elif isinstance(value, list):
            assert len(inner) == len(value)
            for one, other in zip(inner, value, strict=True):
                if isinstance(other, dict):
                    assert_same(one, other)
                else:
                    assert one == other
        elif key == "data":
            assert inner == base64.b64decode(value)
        else:
            assert inner == value, key


def test_our_own_topics_are_carried_over_to_the_byte(recorded, converted):
    for topic in ("/state", "/policy", "/obstacles/truth"):
        assert by_topic(recorded, topic) == by_topic(converted, topic)


def cloud_of(message):
    return np.frombuffer(message.data, "<f4").reshape(-1, 3)


def test_occupied_cells_are_those_of_the_map(recorded, converted):
    grids, clouds = by_topic(recorded, "/map/static"), decoded(converted)["/map/static/cells"]
    assert len(clouds[-1][1].data) > 0
    for grid, (_time, cloud) in zip(grids, clouds, strict=True):
        values, origin = grid_values(grid), grid["pose"]["position"]
        rows, columns = np.nonzero(values >= Config().mapping.occupied)
        expected = np.column_stack(
            [origin["x"] + (columns + 0.5) * episode.CELL_M, origin["y"] + (rows + 0.5) * episode.CELL_M]
        )
        np.testing.assert_allclose(cloud_of(cloud)[:, :2], expected, atol=FLOAT32)
        assert cloud.frame_id == "world" and [field.name for field in cloud.fields] == ["x", "y", "z"]


def test_returns_lie_at_their_range_and_bearing(recorded, converted):
    scan, (_time, cloud) = by_topic(recorded, "/sonar/scan")[5], decoded(converted)["/sonar/points"][5]
    hit = np.array(scan["intensities"]) > 0
    points = cloud_of(cloud)
    assert 0 < len(points) == hit.sum() < len(hit) and cloud.frame_id == "sonar"
    np.testing.assert_allclose(
        np.hypot(points[:, 0], points[:, 1]), np.array(scan["ranges"])[hit], rtol=FLOAT32
    )
    bearing = 2 * np.pi * np.flatnonzero(hit) / len(hit)
    np.testing.assert_allclose(
        np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi), bearing, atol=FLOAT32
    )


def test_waypoints_look_ahead(recorded, converted):
    plan, (_time, poses) = by_topic(recorded, "/plan/info")[0], decoded(converted)["/plan/waypoints"][0]
    assert [pose.position.x for pose in poses.poses] == [point["x"] for point in plan["points"]]
    first, second = poses.poses[:2]
    yaw = 2 * np.arctan2(first.orientation.z, first.orientation.w)
    ahead = np.arctan2(second.position.y - first.position.y, second.position.x - first.position.x)
    assert yaw == pytest.approx(ahead)


def test_rerun_draws_poses_transforms_images_and_clouds(converted, recorded):
    """Read back by the loader that Rerun's viewer has."""
    reader = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (uuvtai[dev])").McapReader(
        str(converted)
    )
    columns, values = {}, {}
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        entity = str(chunk.entity_path)
        columns.setdefault(entity, set()).update(batch.schema.names)
        for name in (
            "Points3D:positions",
            "InstancePoses3D:translations",
            "Transform3D:translation",
            "EncodedImage:blob",
        ):
            if name in batch.schema.names:
                values.setdefault((entity, name), []).extend(batch.column(name).to_pylist())
    cells = values["/map/static/cells", "Points3D:positions"]
    answer = decoded(converted)
    np.testing.assert_allclose(
        np.array(cells[-1]), cloud_of(answer["/map/static/cells"][-1][1]), atol=FLOAT32
    )
    assert len(values["/sonar/points", "Points3D:positions"]) == len(answer["/sonar/points"])
    positions = np.array(values["/pose", "InstancePoses3D:translations"]).reshape(-1, 3)
    expected = [list(data["pose"]["position"].values()) for data in by_topic(recorded, "/pose")]
    np.testing.assert_allclose(positions, expected, atol=FLOAT32)
    assert {"Transform3D:parent_frame", "Transform3D:child_frame", "Transform3D:quaternion"} <= columns["/tf"]
    assert len(values["/tf", "Transform3D:translation"]) == 3 * (N_STEP + 1)
    assert len(values["/camera/depth", "EncodedImage:blob"]) == len(by_topic(recorded, "/camera/depth")) > 1
    assert "TextLog:text" in columns["/log"] and "CoordinateFrame:frame" in columns["/pose"]


# ----------------------------------------------------------------------------------------------------- errors


def test_the_command(recorded, tmp_path, capfd):
    out = tmp_path / "deep" / "x.mcap"
    assert run_cli("log", "convert", recorded, "--out", out) == 0
    assert capfd.readouterr().out == f"{out}: {info(out)['messages']} messages\n"
    whole = out.read_bytes()
    assert run_cli("log", "convert", recorded, "--out", out) == 2
    assert "is already there" in capfd.readouterr().err and out.read_bytes() == whole
    assert run_cli("log", "convert", recorded, "--out", out, "--force") == 0


def one_message(path, topic, schema, data, config=b"{}"):
    file = McapFile(path)
    file.add_attachment("config.yaml", "application/yaml", config)
    file.add_message(file.add_channel(topic, file.add_schema(schema, "jsonschema", b"{}")), 0, data)
    file.finish()
    return path


@pytest.mark.parametrize(
    ("topic", "schema", "data"),
    [
        ("/pose", "foxglove.PoseInFrame", b'{"pose": 3}'),
        ("/pose", "foxglove.PoseInFrame", b'{"unheard": 3}'),
        ("/pose", "foxglove.PoseInFrame", b"[1]"),
        ("/pose", "foxglove.PoseInFrame", b"not json"),
        ("/pose", "foxglove.PoseInFrame", b'{"timestamp": {"sec": 1e30, "nsec": 0}}'),
        ("/map/static", "uuv.Strange", b'{"cell_stride": 8}'),
        ("/sonar/scan", "uuv.Strange", b"[" * 100_000),
    ],
)
def test_messages_unlike_their_schema_leave_nothing(tmp_path, topic, schema, data):
    path = one_message(tmp_path / "a.mcap", topic, schema, data)
    with pytest.raises(LogError, match="is not as its schema says"):
        convert(path, tmp_path / "b.mcap")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


def test_schemas_that_a_file_names_are_never_imported(tmp_path):
    path = one_message(tmp_path / "a.mcap", "/x", "foxglove.os", b"{}")
    assert convert(path, tmp_path / "b.mcap") == 1
    assert info(tmp_path / "b.mcap")["topics"][0]["schema"] == "foxglove.os"


def test_a_log_that_was_cut_off_leaves_nothing(recorded, tmp_path):
    (tmp_path / "a.mcap").write_bytes(recorded.read_bytes()[: recorded.stat().st_size // 2])
    with pytest.raises(LogError, match="uuv log repair"):
        convert(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("config", [b"a: *x", b"mapping: 3", b"mapping: {occupied: much}", b"\xff"])
def test_a_config_that_cannot_be_read(tmp_path, config):
    path = one_message(tmp_path / "a.mcap", "/x", "s", b"{}", config)
    with pytest.raises(LogError, match=r"its config.yaml cannot be read"):
        convert(path, tmp_path / "b.mcap")


def test_the_runs_own_threshold_counts(tmp_path, recorded):
    grid = json.dumps(by_topic(recorded, "/map/static")[-1]).encode()
    sizes = []
    for number, occupied in enumerate((0.1, 2.0)):
        path = one_message(
            tmp_path / f"{number}.mcap",
            "/map/static",
            "foxglove.Grid",
            grid,
            f"mapping: {{occupied: {occupied}}}".encode(),
        )
        convert(path, tmp_path / f"{number}_out.mcap")
        sizes.append(len(decoded(tmp_path / f"{number}_out.mcap")["/map/static/cells"][0][1].data))
    assert sizes[0] > sizes[1] == 0


def test_without_the_extra_it_says_what_to_install(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_PACKAGES", ("nothing_of_this_name",))
    with pytest.raises(LogError, match=r"pip install 'uuvtai\[viz\]'"):
        convert(recorded, tmp_path / "b.mcap")


def test_durations_and_times_are_exact():
    from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity

    entity = SceneEntity.FromString(
        serialised(
            SceneEntity, {"timestamp": {"sec": 90061, "nsec": 20000001}, "lifetime": {"sec": 2, "nsec": 5}}
        )
    )
    assert (
        entity.timestamp.seconds,
        entity.timestamp.nanos,
        entity.lifetime.seconds,
        entity.lifetime.nanos,
    ) == (90061, 20000001, 2, 5)
    assert json_format.MessageToDict(entity)["lifetime"] == "2.000000005s"
