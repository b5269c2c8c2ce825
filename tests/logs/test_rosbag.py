"""Logs as ROS 2 bags: two independent readers see what the log says. Bags of others: test_recordings.py."""

import importlib.util
import json
import math

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.command import run_cli
from tests.oracles import logs as episode
from uuvtai.logs import ros2
from uuvtai.logs.encode import LogError
from uuvtai.logs.reader import read_messages
from uuvtai.logs.ros2 import WRITTEN
from uuvtai.logs.rosbag import to_rosbag2
from uuvtai.logs.topics.perception import grid_values

if any(importlib.util.find_spec(name) is None for name in ("rosbags", "mcap_ros2")):
    pytest.skip("needs the extra uuvtai[ros]", allow_module_level=True)

N_STEP = 30
INF = math.inf


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return episode.record(tmp_path_factory.mktemp("logs") / "a.mcap", N_STEP)


@pytest.fixture(scope="module")
def bag(recorded):
    out = recorded.with_name("bag")
    to_rosbag2(recorded, out)
    return out


def by_rosbags(bag):
    """{topic: [(time, message)]} by the reader of rosbags, metadata.yaml included."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store, found = get_typestore(Stores.ROS2_HUMBLE), {}
    with Reader(bag) as reader:
        for connection, time_ns, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time_ns, message))
    return found


def by_mcap_ros2(bag):
    """The same by MCAP's reader and decoder, which parses the definitions in the file."""
    from mcap_ros2.decoder import DecoderFactory

    found = {}
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        for _schema, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


@pytest.fixture(scope="module", params=[by_rosbags, by_mcap_ros2])
def ros(request, bag):
    return request.param(bag)


def by_topic(path, topic):
    return [m.data for m in read_messages(path, [topic])]


def xyz(value):
    return [value.x, value.y, value.z]


def test_all_topics_are_there(ros, recorded):
    assert ros.keys() == WRITTEN.keys()
    for topic, source in (("/tf", "/tf"), ("/scan", "/sonar/scan"), ("/map", "/map/static")):
        assert len(ros[topic]) == len(by_topic(recorded, source)) > 1


def test_motion(ros, recorded):
    states = by_topic(recorded, "/state")
    for state, (_, truth), (_, own), (_, pressure), (_, imu) in zip(
        states,
        *(ros[topic] for topic in ("/ground_truth/odom", "/odometry/filtered", "/pressure", "/imu/data")),
        strict=True,
    ):
        assert xyz(truth.pose.pose.position) == state["position"]
        assert xyz(truth.twist.twist.linear) == state["velocity"]
        assert (truth.header.frame_id, truth.child_frame_id) == ("map", "base_link")
        assert xyz(own.twist.twist.linear) == state["measured"]["velocity"]
        assert xyz(imu.angular_velocity) == state["measured"]["rates"]
        assert imu.linear_acceleration_covariance[0] == -1
        water = episode.config().vehicle
        depth = (pressure.fluid_pressure - 101325) / (water.water_density_kg_m3 * water.gravity_m_s2)
        assert depth == pytest.approx(state["measured"]["depth_m"], abs=1e-9)


def test_scans_and_clouds(ros, recorded):
    for scan, (_, found), (_, cloud) in zip(
        by_topic(recorded, "/sonar/scan"), ros["/scan"], ros["/sonar/points"], strict=True
    ):
        hit = np.array(scan["intensities"]) > 0
        ranges = np.array(found.ranges)
        said = np.float32(scan["ranges"])[hit]
        assert np.isposinf(ranges[~hit]).all()
        assert (ranges[hit] == np.where(said < 0, -INF, said)).all()
        assert found.header.frame_id == "sonar_link"
        assert found.angle_increment == pytest.approx(2 * math.pi / episode.N_RAY)
        points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 5)
        assert len(points) == hit.sum() == cloud.width
        np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 1]), np.abs(said), rtol=1e-6)


def test_a_cloud_of_a_sonar_without_doppler_says_no_speed():
    scan = {"timestamp": {"sec": 1, "nsec": 5}, "frame_id": "sonar", "start_angle": -0.5, "end_angle": 0.5}
    scan |= {"ranges": [1.0, 12.0, 3.0], "intensities": [0.5, 0.0, 0.2]}
    cloud = ros2._cloud(ros2.RosMessages(), scan, [])
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 5)
    assert not cloud.is_dense and np.isnan(points[:, 4]).all()
    np.testing.assert_allclose(points[:, 1], [np.sin(-0.5), 3.0 * np.sin(0.5)], rtol=1e-6)


def test_maps_and_commands(ros, recorded):
    grid, (_, found) = by_topic(recorded, "/map/static")[-1], ros["/map"][-1]
    values = np.array(found.data).reshape(found.info.height, found.info.width)
    np.testing.assert_allclose(values / 100, np.clip(grid_values(grid), 0, 1), atol=0.0051)
    applied = by_topic(recorded, "/action")[-1]["applied"]
    speed = ros["/cmd_vel"][-1][1].linear.x
    assert speed == pytest.approx(applied[0] * episode.config().vehicle.max_surge_m_s)


# ----------------------------------------------------------------------------------------------------- errors


def test_the_command(recorded, tmp_path, capfd):
    bag = tmp_path / "bag"
    assert run_cli("log", "convert", recorded, "--out", bag) == 0
    assert f"{bag}: " in capfd.readouterr().out
    for words, reason in (
        (("--from", "rosbag2"), "No such option: --from; now it is uuv log import FILE"),
        (("--to", "rosbag2"), "No such option: --to; now it is uuv log convert FILE, without it"),
        (("--out", bag), "is already there, and a bag is a new folder"),
    ):
        assert run_cli("log", "convert", recorded, *words) == 2
        assert reason in capfd.readouterr().err
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"]


def test_a_bag_is_imported_again(bag, tmp_path, capfd):
    """What it tells of the instruments; maps and the truth are none of theirs."""
    out = tmp_path / "back.mcap"
    assert run_cli("log", "import", bag, "--out", out, "--json") == 0
    found = json.loads(capfd.readouterr().out)
    dropped = {row["what"].partition(" ")[0]: row["why"] for row in found["files"][0]["dropped"]}
    assert dropped.keys() >= {"/tf", "/map", "/cmd_vel"} and found["readings"]["imu"] == N_STEP + 1


def test_without_the_extra_it_says_what_to_install(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(ros2, "_PACKAGE", "nothing_of_this_name")
    with pytest.raises(LogError, match=r"pip install 'uuvtai\[ros\]'"):
        to_rosbag2(recorded, tmp_path / "b")
