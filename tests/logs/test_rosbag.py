"""Logs as ROS 2 bags: two independent readers see what the log says, and a bag gives the log back."""

import base64
import importlib.util
import math

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader

from tests.command import run_cli
from tests.oracles import logs as episode
from uuvtai.logs import ros2
from uuvtai.logs.container import McapFile
from uuvtai.logs.encode import LogError
from uuvtai.logs.reader import info, read_head, read_messages
from uuvtai.logs.ros2 import WRITTEN
from uuvtai.logs.rosbag import from_rosbag2, to_rosbag2
from uuvtai.logs.topics.perception import grid_values

if any(importlib.util.find_spec(name) is None for name in ("rosbags", "mcap_ros2")):
    pytest.skip("needs the extra uuvtai[ros]", allow_module_level=True)

N_STEP = 30
ROS = ros2.RosMessages()
INF, NAN = math.inf, math.nan


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return episode.record(tmp_path_factory.mktemp("logs") / "a.mcap", N_STEP)


@pytest.fixture(scope="module")
def bag(recorded):
    out = recorded.with_name("bag")
    to_rosbag2(recorded, out)
    return out


@pytest.fixture(scope="module")
def back(bag):
    out = bag.with_name("back.mcap")
    from_rosbag2(bag, out)
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


def test_round_trip(recorded, back):
    assert by_topic(back, "/tf") == by_topic(recorded, "/tf")
    for one, other in zip(by_topic(back, "/sonar/scan"), by_topic(recorded, "/sonar/scan"), strict=True):
        inside = np.maximum(0, other["ranges"])  # noise next to a hull can go below, which is no range in ROS
        np.testing.assert_allclose(one["ranges"], inside, rtol=1e-6)
        np.testing.assert_allclose(one["intensities"], other["intensities"], rtol=1e-6)
        assert one["end_angle"] == pytest.approx(other["end_angle"], rel=1e-6)
        assert one["timestamp"] == other["timestamp"] and one["frame_id"] == "sonar"
    for one, other in zip(by_topic(back, "/map/dynamic"), by_topic(recorded, "/map/dynamic"), strict=True):
        assert one["pose"] == other["pose"]
        np.testing.assert_allclose(grid_values(one), np.clip(grid_values(other), 0, 1), atol=0.0051)
    for one, other in zip(by_topic(back, "/ground_truth/odom"), by_topic(recorded, "/state"), strict=True):
        assert list(one["pose"]["position"].values()) == other["position"]
        assert one["velocity"] == other["velocity"] and one["rates"] == other["rates"]
    assert read_head(back) == read_head(recorded)
    times = [m.time_s for m in read_messages(recorded, ["/tf"])]
    assert [m.time_s for m in read_messages(back, ["/tf"])] == times


# ------------------------------------------------------------------------------------------ bags of others


def odometry(covariance=0.0, turned=1):
    pose = ROS(
        "geometry_msgs/msg/Pose",
        position=ROS.vector(1, 2, -1, "Point"),
        orientation=ROS.quaternion(turned, 0, 0, 0),
    )
    part = "geometry_msgs/msg/PoseWithCovariance"
    twist = "geometry_msgs/msg/TwistWithCovariance"
    return ROS(
        "nav_msgs/msg/Odometry",
        header=ROS.header(10**18, "odom"),
        child_frame_id="base_link",
        pose=ROS(part, pose=pose, covariance=np.full(36, covariance)),
        twist=ROS(twist, twist=ROS.twist((0.5, 0, 0), (0, 0, 0)), covariance=np.zeros(36)),
    )


def imu(turned, unknown):
    covariance = np.full(9, -1.0 if unknown else 0.0)
    return ROS(
        "sensor_msgs/msg/Imu", header=ROS.header(10**18, "base_link"),
        orientation=ROS.quaternion(turned, 0, 0, 0), orientation_covariance=covariance,
        angular_velocity=ROS.vector(0, 0, 0.1), angular_velocity_covariance=np.zeros(9),
        linear_acceleration=ROS.vector(0, 0, 9.8), linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip


def scan(ranges, shine=(), least=0.75, most=20.0):
    return ROS(
        "sensor_msgs/msg/LaserScan", header=ROS.header(10**18, "sonar_link"), angle_min=0.0, angle_max=6.28,
        angle_increment=0.1, time_increment=0.0, scan_time=0.0, range_min=least, range_max=most,
        ranges=np.array(ranges, np.float32), intensities=np.array(shine, np.float32),
    )  # fmt: skip


def grid(width, height, value=-1):
    pose = ROS(
        "geometry_msgs/msg/Pose",
        position=ROS.vector(0, 0, 0, "Point"),
        orientation=ROS.quaternion(1, 0, 0, 0),
    )
    head = ROS.header(10**18, "map")
    info = ROS(
        "nav_msgs/msg/MapMetaData", map_load_time=head.stamp, resolution=0.1, width=width, height=height,
        origin=pose,
    )  # fmt: skip
    cells = np.full(width * height, value, np.int8)
    return ROS("nav_msgs/msg/OccupancyGrid", header=head, info=info, data=cells)


def cloud(filled=0, big=False, cut=0):
    rows = np.zeros((3, 4 * 12 + filled), np.uint8)
    rows[:, : 4 * 12] = np.arange(144).reshape(3, -1)
    return ROS(
        "sensor_msgs/msg/PointCloud2",
        header=ROS.header(10**18, "sonar_link"),
        height=3,
        width=4,
        fields=[ROS("sensor_msgs/msg/PointField", name="x", offset=0, datatype=7, count=1)],
        is_bigendian=big,
        point_step=12,
        row_step=rows.shape[1],
        data=rows.ravel()[: rows.size - cut],
        is_dense=True,
    )


def bag_of(path, *rows, pack=lambda data: data):
    """A bag of (topic, message), a second apart."""
    file = McapFile(path, profile="ros2")
    for k, (topic, message) in enumerate(rows):
        kind = message.__msgtype__
        channel = file.add_channel(topic, file.add_schema(kind, "ros2msg", ROS.definition(kind)), "cdr")
        file.add_message(channel, 10**18 + k * 10**9, pack(ROS.packed(message)))
    file.finish()
    return path


ODD = {
    "a covariance that is no number": (odometry(NAN), "a number that is not finite"),
    "a covariance without end": (odometry(INF), "a number that is not finite"),
    "an orientation of zeros": (odometry(turned=0), "an orientation that is none (0, 0, 0, 0)"),
    "a place that is no number": (odometry(turned=NAN), "a number that is not finite"),
    "an attitude that is no number": (imu(NAN, False), "a number that is not finite"),
    "a map without cells": (grid(0, 0), "a map of 0 x 0 with 0 cells"),
    "a map above a hundred": (grid(2, 2, 101), "a map of 2 x 2 with 4 cells"),
    "points that are big-endian": (cloud(big=True), "big-endian or cut off"),
    "points that are cut off": (cloud(cut=3), "big-endian or cut off"),
    "too few intensities": (scan([1.0] * 8, [1.0] * 7), "8 ranges with 7 intensities"),
    "ranges without end": (scan([INF], most=INF), "a number that is not finite"),
}


@pytest.mark.parametrize(("odd", "why"), ODD.values(), ids=ODD)
def test_one_odd_message_is_left_out_and_named(odd, why, tmp_path, capfd):
    path = bag_of(tmp_path / "a.mcap", ("/odom", odometry()), ("/x", odd), ("/odom", odometry()), ("/x", odd))
    assert run_cli("log", "convert", path, "--from", "rosbag2") == 0
    out, err = capfd.readouterr()
    assert "2 messages" in out and "/x: left out 2 odd, the first: " in err and why in err
    assert len(by_topic(tmp_path / "a.log.mcap", "/odom")) == 2


def test_what_is_only_unlike_ours_is_read(tmp_path):
    """Rows of points that are filled up, an attitude that is not measured, messages compressed one by one."""
    rows = [("/points", cloud(filled=8)), ("/imu", imu(NAN, True)), ("/imu", imu(0, False))]
    for name, pack in (("a.mcap", bytes), ("b.mcap", zstandard.ZstdCompressor().compress)):
        out = tmp_path / f"{name}.log"
        assert from_rosbag2(bag_of(tmp_path / name, *rows, pack=pack), out) == (3, [])
        (points,), (read, zeros) = by_topic(out, "/points"), by_topic(out, "/imu")
        assert base64.b64decode(points["data"]) == bytes(range(144)) and points["point_stride"] == 12
        assert read["orientation"] is None is zeros["orientation"] and read["rates"] == [0.0, 0.0, 0.1]


S = 10**9
T0 = 10**18
CLOCKS = {
    # (topic, logged at, stamped) in the order of the file -> times in the log, stamps, what is said
    "in order": ([("/a", T0, T0), ("/a", T0 + 3 * S, T0 + S)], [0, 3], [0, 1], {}),
    "topic after topic": ([("/a", T0 + 5 * S, T0 + 5 * S), ("/b", T0, T0), ("/b", T0 + 7 * S, T0 + 6 * S)],
        [5, 0, 7], [5, 0, 6], {}),
    "a clock of the device's own": ([("/a", T0, 7 * S), ("/a", T0 + S, 8 * S), ("/b", T0 + 2 * S, T0 + S)],
        [0, 1, 2], [0, 1, 1], {"/a": 2}),
    "no stamp": ([("/a", T0, 0), ("/a", T0 + S, 0), ("/b", T0 + S, T0)], [0, 1, 1], [0, 1, 0], {"/a": 2}),
    "from the future": ([("/a", T0, T0 + 99 * S), ("/a", T0 + S, T0 + S)], [0, 1], [0, 1], {"/a": 1}),
    "measured before the first was logged": ([("/a", T0, T0 - S // 9), ("/b", T0 + S, T0)], [0, 1], [0, 0],
        {}),
}  # fmt: skip


@pytest.mark.parametrize("name", CLOCKS)
def test_times_of_a_bag(name, tmp_path, capfd):
    rows, times, stamps, said = CLOCKS[name]
    file = McapFile(tmp_path / "a.mcap", profile="ros2")
    schema = file.add_schema("sensor_msgs/msg/Imu", "ros2msg", ROS.definition("sensor_msgs/msg/Imu"))
    channels = {topic: file.add_channel(topic, schema, "cdr") for topic in ("/a", "/b", "/text")}
    file.add_message(
        file.add_channel("/early", file.add_schema("x", "ros2msg", b""), "cdr"), T0 - 99 * S, b""
    )
    for topic, logged, stamped in rows:
        message = imu(0.0, True)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamped, S)
        file.add_message(channels[topic], logged, ROS.packed(message))
    file.finish()
    assert run_cli("log", "convert", tmp_path / "a.mcap", "--from", "rosbag2") == 0
    found = list(read_messages(tmp_path / "a.log.mcap"))
    assert [message.time_s for message in found] == times
    stamped = [message.data["timestamp"] for message in found]
    assert [one["sec"] + one["nsec"] / S for one in stamped] == stamps
    err = capfd.readouterr().err
    assert err.count("dated by when they were logged") == len(said)
    for topic, count in said.items():
        assert f"{topic}: {count} with stamps of another clock than the bag's" in err


@pytest.mark.parametrize("name", ["topic after topic", "in order"])
def test_info_of_a_log_of_others(name, tmp_path, capfd):
    rows, times, *_ = CLOCKS[name]
    file = McapFile(tmp_path / "a.mcap")
    channel = file.add_channel("/a", file.add_schema("x", "jsonschema", b"{}"))
    for _, logged, _ in rows:
        file.add_message(channel, logged, b"{}")
    file.finish()
    found = info(tmp_path / "a.mcap")
    assert found["duration_s"] == max(times) and not found["is_eval"]
    assert found["topics"][0]["rate_hz"] == pytest.approx(len(rows) / max(times), abs=1e-3)
    assert run_cli("log", "info", tmp_path / "a.mcap") == 0
    out = capfd.readouterr().out
    assert f"duration {max(times):.2f} s, not a log of uuv eval" in out and "cut off" not in out


RANGES = {
    3.0: (3.0, True), 0.75: (0.75, True), 20.0: (20.0, True), -INF: (0.75, True), INF: (20.0, False),
    NAN: (0.0, False), 0.3: (0.0, False), 0.0: (0.0, False), -1.0: (0.0, False), 25.0: (0.0, False),
}  # fmt: skip
"""of a sonar from 0.75 to 20 m: (range, whether it is a return) in a log"""


def test_only_plus_infinity_is_free_water(tmp_path):
    for shine in ((), [NAN, *[0.5] * (len(RANGES) - 1)]):
        out = tmp_path / f"{len(shine)}.log"
        from_rosbag2(bag_of(tmp_path / f"{len(shine)}.mcap", ("/scan", scan(list(RANGES), shine))), out)
        (found,) = by_topic(out, "/sonar/scan")
        hits = [value > 0 for value in found["intensities"]]
        assert list(zip(found["ranges"], hits, strict=True)) == list(RANGES.values())
    again = ros2._scan(ROS, ros2.Setup.of({}), found | {"ranges": [-0.1, *found["ranges"][1:]]})
    assert again.ranges[:5].tolist() == [-INF, 0.75, 20.0, 0.75, INF]
    assert np.isnan(again.ranges[5:]).all()


def test_names_stay_apart(tmp_path):
    rows = [
        ("/scan", scan([3.0])),
        ("/sonar/scan", scan([5.0])),
        ("/map", grid(2, 2)),
        ("/map/static", grid(3, 3)),
    ]
    from_rosbag2(bag_of(tmp_path / "a.mcap", *rows), tmp_path / "a.log")
    for topic, message in rows[:2]:
        assert [one["ranges"] for one in by_topic(tmp_path / "a.log", topic)] == [message.ranges.tolist()]
    for topic, width in (("/map", 2), ("/map/static", 3)):
        assert [one["column_count"] for one in by_topic(tmp_path / "a.log", topic)] == [width]


FOLDERS = {
    "SQLite": (["a.db3"], "is a bag in SQLite"),
    "parts": (["a_0.mcap", "a_1.mcap"], "is a bag of 2 parts, and one file is read at a time"),
    "packed": (["a_0.mcap.zstd"], "holds a_0.mcap.zstd, which is compressed as a whole"),
    "packed parts": (
        ["a_0.mcap.zstd", "a_1.mcap.zstd"],
        "holds a_0.mcap.zstd, which is compressed as a whole",
    ),
}


@pytest.mark.parametrize(("names", "why"), FOLDERS.values(), ids=FOLDERS)
def test_bags_of_other_kinds_are_named(names, why, tmp_path):
    bag = tmp_path / "a bag"
    bag.mkdir()
    for name in (*names, "metadata.yaml"):
        (bag / name).write_bytes(b"\x28\xb5\x2f\xfd")
    with pytest.raises(
        LogError, match=f"{why}.*; first: rosbags-convert --src '{bag}' --dst NEW --dst-storage mcap"
    ):
        from_rosbag2(bag, tmp_path / "b.mcap")
    packed = bag / names[0]
    if packed.suffix == ".zstd":
        with pytest.raises(LogError, match=f"first: zstd -d '{packed}' -o '{bag}/a_0.mcap'"):
            from_rosbag2(packed, tmp_path / "b.mcap")


# ----------------------------------------------------------------------------------------------------- errors


def test_the_command(recorded, tmp_path, capfd):
    bag, out = tmp_path / "bag", tmp_path / "b.mcap"
    assert run_cli("log", "convert", recorded, "--out", bag) == 0
    assert run_cli("log", "convert", bag, "--from", "rosbag2", "--out", out) == 0
    assert f"{out}: {info(out)['messages']} messages\n" in capfd.readouterr().out
    for words, reason in (
        (("--to", "rosbag2"), "No such option: --to; now it is --from"),
        (("--from", "bag"), "--from bag: use mcap or rosbag2"),
        (("--out", bag), "is a new folder"),
        (("--from", "rosbag2", "--out", tmp_path / "c.mcap"), "none of the messages that can be read"),
    ):
        assert run_cli("log", "convert", recorded, *words) == 2
        assert reason in capfd.readouterr().err
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["b.mcap", "bag"]


@pytest.mark.parametrize("kind", sorted(set(WRITTEN.values())))
@pytest.mark.parametrize("data", [b"", b"\0\1\0\0" + b"\xff" * 400, b"\0\1\0\0" + b"\0" * 9])
def test_hostile_messages_leave_nothing(tmp_path, kind, data):
    file = McapFile(tmp_path / "a.mcap")
    file.add_message(file.add_channel("/x", file.add_schema(kind, "ros2msg", b"?"), "cdr"), 0, data)
    file.finish()
    with pytest.raises(LogError, match="is not as its schema says"):
        from_rosbag2(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


def test_without_the_extra_it_says_what_to_install(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(ros2, "_PACKAGE", "nothing_of_this_name")
    with pytest.raises(LogError, match=r"pip install 'uuvtai\[ros\]'"):
        to_rosbag2(recorded, tmp_path / "b")
