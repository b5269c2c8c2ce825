"""Recordings of others as one log of ours: every file here is made by the test, byte by byte."""

import json
import math
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymavlink")
pytest.importorskip("rosbags")

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.command import run_cli, uuv
from tests.vehicle.identify.test_ardusub_log import FORMATS, dataflash, drive
from tests.vehicle.identify.test_ardusub_log import tlog as driven
from tests.vehicle.test_replay import build, log  # noqa: F401 (fixtures)
from uuvtai.config.loader import load_config
from uuvtai.logs.container import McapFile
from uuvtai.logs.reader import info, read_head, read_messages
from uuvtai.vehicle import replay as replaying
from uuvtai.vehicle.identify.ardusub_log import read_ardusub, read_imported
from uuvtai.vehicle.instruments.emulate import FakePing360
from uuvtai.vehicle.instruments.ping import AUTO_DEVICE_DATA, DEVICE_DATA, frame
from uuvtai.vehicle.mavlink import MavCodec, MavMessage
from uuvtai.vehicle.messages import DvlReading, SonarPing
from uuvtai.vehicle.pilot_log import LinkLog
from uuvtai.vehicle.recordings import bags, combine, sources
from uuvtai.vehicle.replay import read_feed

T0, SECONDS, SPEED = 1_700_000_000.0, 12.0, 0.3
START, SIDE = (4.0, 3.0, -0.8), 6.0  # [m] of the pool across
MATCHED = ("--sensors", "ping360", "--world", "pool", "--start", "4,3,-0.8", "--goal", "12,3,-0.8")


def place(time_s):
    """[m] along x of a vehicle that drives ahead through the pool."""
    return START[0] + SPEED * time_s


def tlog(path, seconds=SECONDS):
    """Attitude, pressure, pulses of a BlueROV2 that looks east; a battery and a text, which nobody reads."""
    link, out = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), b""
    for step in range(round(seconds / 0.05)):
        now_s = 0.05 * step
        milli = 1000 + round(1e3 * now_s)
        told = [
            mavlink.MAVLink_attitude_message(milli, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0),
            mavlink.MAVLink_scaled_pressure2_message(milli, 1013.25 + 80.0, 0.0, 20),
        ]
        if step % 10 == 0:
            told += [
                mavlink.MAVLink_heartbeat_message(12, 3, 129, 4, 4, 3),
                mavlink.MAVLink_servo_output_raw_message(1000 * milli, 0, *[1600] * 6, 0, 0),
                mavlink.MAVLink_statustext_message(6, b"hello"),
            ]
        for message in told:
            out += struct.pack(">Q", round(1e6 * (T0 + now_s))) + message.pack(link)
    path.write_bytes(out)
    return path


def a50_line(vx=SPEED, valid=True, **more):
    said = {"time": 100.0, "vx": vx, "vy": 0.0, "vz": 0.0, "fom": 0.001, "velocity_valid": valid}
    return json.dumps(said | {"type": "velocity"} | more)


def a50(path, stamp=lambda time_s: f"{T0 + time_s:.3f} ", seconds=SECONDS):
    lines = [stamp(0.1 * k) + a50_line(altitude=1 + 1e-3 * k) for k in range(round(10 * seconds))]
    path.write_text("\n".join(lines) + "\n")
    return path


def echo_m(time_s, bearing):
    """To the pool's side walls."""
    across = math.sin(bearing)
    return (SIDE / 2) / abs(across) if abs(across) > 0.5 else math.inf


def ping360(path, begin_s=0.0, wide=False, seconds=SECONDS, number=AUTO_DEVICE_DATA):
    """As Ping Viewer writes it, on Windows with two bytes a character; a beam every 50 ms, 6.2 m."""

    def text(written):
        data = written.encode("utf-16-be") if wide else written.encode()
        return struct.pack(">I", len(data)) + data

    out = text("PingViewer sensor log file") + struct.pack(">i", 1)
    out += text("abc") + struct.pack(">I", 0xFFFFFFFF) + text("v2") + text("Linux") + text("5")
    out += struct.pack(">ii", 1, 2)
    head, period, samples = FakePing360("127.0.0.1", 0), 276, 1200
    gradians = [*range(138, 266, 4), *range(258, 138, -4)]
    for k in range(round(seconds / 0.05)):
        time_s, gradian = 0.05 * k, gradians[k % len(gradians)]
        bearing = -math.radians(0.9 * (gradian - 200))
        profile = head.profile(echo_m(time_s, bearing), 0.5 * 25e-9 * period * 1500.0, samples)
        about = struct.pack("<BBHHHH", 1, 1, gradian, 30, period, 740)
        if number == AUTO_DEVICE_DATA:
            about += struct.pack("<HHBB", 138, 262, 4, 0)
        message = frame(number, about + struct.pack("<HH", samples, samples) + profile, source=2)
        minutes, rest = divmod(begin_s + time_s, 60.0)
        out += text(f"{int(minutes // 60):02}:{int(minutes % 60):02}:{rest:06.3f}")
        out += struct.pack(">I", len(message)) + message
    head.close()
    path.write_bytes(out)
    return path


def imported(capfd, *words):
    """The document; the log is whole and its messages rise in time."""
    code, out, err = uuv(capfd, "log", "import", *words, "--json")
    assert code == 0, err
    found = json.loads(out)
    times = [message.time_s for message in read_messages(Path(found["log"]))]
    assert times == sorted(times) and times[0] == 0.0 and info(Path(found["log"]))["messages"] == len(times)
    return found


def told(found, topic):
    return [(m.time_s, m.data) for m in read_messages(Path(found["log"]), [topic])]


def dropped(found, which=0):
    return {row["what"]: (row["count"], row["why"]) for row in found["files"][which]["dropped"]}


def test_three_files_become_one_log_that_the_stack_reads(tmp_path, capfd):
    files = tlog(tmp_path / "a.tlog"), a50(tmp_path / "dvl.jsonl"), ping360(tmp_path / "sonar.bin")
    found = imported(capfd, *files, *MATCHED, "--offset", f"{files[2]}={T0}", "--out", tmp_path / "one.mcap")
    assert found["notes"] == [] and found["localization"] == "estimated"
    assert [row["kind"] for row in found["files"]] == ["tlog", "A50", "Ping Viewer"]
    assert dropped(found) == {"STATUSTEXT": (24, "not used")}
    counts = {"imu": 240, "pressure": 240, "dvl": 120, "motors": 24}
    assert {name: found["readings"][name] for name in counts} == counts
    assert found["readings"]["sonar"] > 200
    (_, velocity), (_, imu) = told(found, "/sensors/dvl")[5], told(found, "/sensors/imu")[5]
    np.testing.assert_allclose(velocity["velocity"], [SPEED, 0, 0], atol=1e-6)
    np.testing.assert_allclose(imu["attitude"], 0.0, atol=1e-6)
    assert told(found, "/sensors/pressure")[0][1]["depth_m"] == pytest.approx(0.8)
    feed = read_feed(Path(found["log"]))
    assert feed.is_imported and feed.mission.start == START and not feed.steps
    pings = [each.message for each in feed.arrivals if hasattr(each.message, "first_beam")]
    sonar = load_config("pool", "ping360").sensors.sonar
    for ping in pings:
        far = echo_m(0.0, sonar.first_beam_rad + ping.first_beam * sonar.beam_step_rad)
        assert bool(ping.hit[0]) == (far < 6.0) and (far > 6.0 or abs(ping.range_m[0] - far) < 0.05)
    assert run_cli("replay", found["log"]) == 2
    assert "holds no commands to compare with; see what the stack does: --open" in capfd.readouterr().err


def test_a_yaw_at_the_start_turns_the_world(tmp_path, capfd):
    found = imported(capfd, tlog(tmp_path / "a.tlog"), "--start", "4,3,-2,90", "--world", "open")
    assert told(found, "/sensors/imu")[0][1]["attitude"][2] == pytest.approx(math.pi / 2)
    assert found["goal"] == pytest.approx([4.0, 8.0, -2.0])


def test_files_apart_and_files_that_tell_the_same(tmp_path, capfd):
    first, late = tlog(tmp_path / "a.tlog"), ping360(tmp_path / "sonar.bin", 3600.0, wide=True)
    found = imported(capfd, first, late, "--out", tmp_path / "x.mcap")
    (note,) = [note for note in found["notes"] if "overlaps" in note]
    offset = note.rpartition("--offset ")[2]
    again = imported(capfd, first, late, "--offset", offset, "--out", tmp_path / "y.mcap")
    assert not any("overlaps" in note for note in again["notes"]) and again["duration_s"] < SECONDS + 1
    copy = tlog(tmp_path / "b.tlog", SECONDS + 5.0)
    twice = imported(capfd, first, copy, "--out", tmp_path / "z.mcap")
    assert twice["readings"]["imu"] == 340
    assert dropped(twice, 1)["readings: imu"] == (240, "a.tlog tells it")


@pytest.mark.parametrize(
    ("stamp", "seconds"),
    [
        (lambda t: f"{T0 + t:.3f} ", 0.1), (lambda t: f"[{1e3 * (T0 + t):.0f}] ", 0.1), (lambda t: "", 0.1),
        (lambda t: f"2023-11-14T22:13:{20 + t:06.3f}Z: ", 0.1), (lambda t: f"22:13:{20 + t:06.3f},", 0.1),
        (lambda t: f"2023-11-14 22:13:{20 + t:06.3f} ", 0.1),
    ],
)  # fmt: skip
def test_times_before_the_lines_of_a_dvl(stamp, seconds, tmp_path, capfd):
    found = imported(capfd, a50(tmp_path / "a.txt", stamp, 3.0))
    times = [time_s for time_s, _ in told(found, "/sensors/dvl")]
    np.testing.assert_allclose(np.diff(times), seconds, atol=2e-3)


def test_odd_lines_and_times_are_named(tmp_path, capfd):
    lines = [f"{T0 + 0.1 * k} {a50_line(altitude=k)}" for k in range(20)]
    lines[3:6] = ["hello", f"{T0} {a50_line(valid=False)}", f"{T0} [1, 2]"]
    lines[8] = lines[7]
    lines[10], lines[11] = f"1e99 {a50_line()}", f"12:xx {a50_line(altitude=9)}"
    lines[13] = f"{T0 - 5e6} {a50_line(altitude=3)}"
    lines += [f"{T0} {a50_line(vx=1e9)}", f"{T0 + 0.05} " + '{"type": "position_local", "x": 1}']
    (tmp_path / "a.txt").write_text("\n".join(lines) + '\n{"vx": 0.3, "cut')
    found = imported(capfd, tmp_path / "a.txt")
    reasons = {row["why"]: row["count"] for row in found["files"][0]["dropped"]}
    assert reasons == {
        "no JSON object": 3, "velocity not valid: the bottom is lost": 1, "the same line again": 1,
        "a time that is a day or more from the others'": 2, "numbers that cannot be": 2,
        "position_local: not used": 1,
    }  # fmt: skip
    assert found["readings"] == {"dvl": 13} and found["duration_s"] < 2.0


def test_lines_of_a_clock_go_on_after_midnight(tmp_path, capfd):
    path = a50(
        tmp_path / "a.txt", lambda t: f"{(23, 0)[t >= 2]:02}:{(59, 0)[t >= 2]:02}:{(58 + t) % 60:04.1f} ", 4
    )
    found = imported(capfd, path)
    assert found["duration_s"] == pytest.approx(3.9, abs=0.01) and found["readings"] == {"dvl": 40}


def test_a_file_that_is_silent_leaves_the_time_to_another(tmp_path, capfd):
    first, second = a50(tmp_path / "a.txt"), a50(tmp_path / "b.txt")
    lines = first.read_text().splitlines()
    first.write_text("\n".join(lines[:20] + lines[80:]) + "\n")
    found = imported(capfd, first, second)
    assert [row["readings"] for row in found["files"]] == [60, 60]
    assert dropped(found, 1) == {"readings: dvl": (60, "a.txt tells it")}


def test_damage_in_a_dataflash_log_is_counted_and_floods_no_terminal(tmp_path, capfd):
    data = dataflash(drive(), FORMATS)
    (tmp_path / "a.bin").write_bytes(data[:9000] + bytes(5000) + data[9000:])
    code, out, err = uuv(capfd, "log", "import", tmp_path / "a.bin", "--json")
    assert code == 0 and len(err) < 2000
    count, why = dropped(json.loads(out))["bytes"]
    assert 5000 <= count < 5100 and why == "no message of a DataFlash log"


def test_a_dataflash_log_says_what_mavlink_says(tmp_path, capfd):
    formats = FORMATS | {"BARO": (8, "QBf", "TimeUS,I,Press"), "MAG": (9, "Qf", "TimeUS,X")}
    rows = [*drive(), *(("BARO", (200_000 * k, 1, 1e5 + 980.0 * k)) for k in range(20)), ("MAG", (0, 1.0))]
    (tmp_path / "a.bin").write_bytes(dataflash(rows, formats))
    found = imported(capfd, tmp_path / "a.bin")
    assert dropped(found)["MAG"] == (1, "not used") and found["readings"]["dvl"] > 50
    _, imu = told(found, "/sensors/imu")[3]
    np.testing.assert_allclose(imu["attitude"][:2], [0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(imu["rates"], [0.01, -0.02, -0.03], atol=1e-6)
    depth = [data["depth_m"] for _, data in told(found, "/sensors/pressure")]
    np.testing.assert_allclose(np.diff(depth), 0.1, atol=2e-3)


def pilots(path, seconds=SECONDS):
    """What uuv pilot writes of a vehicle with a DVL and a head of its own; something of each is broken."""
    made, codec = LinkLog(path, {}), MavCodec(1, 191)
    link = mavlink.MAVLink(None, srcSystem=3, srcComponent=1)
    for step in range(round(seconds / 0.1)):
        now_s, milli = 0.1 * step, 100 * step + 1
        made.begin_step()
        for message in (
            mavlink.MAVLink_attitude_message(milli, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
            mavlink.MAVLink_scaled_pressure2_message(milli, 1013.25 + 80.0, 0.0, 20),
            mavlink.MAVLink_local_position_ned_message(milli, 0.0, 0.0, 0.0, 9.0, 9.0, 9.0),
        ):
            (seen,) = codec.decode(message.pack(link))
            made.saw(now_s, seen)
        made.read(now_s, DvlReading(now_s, np.array([SPEED, 0.0, 0.0])))
        made.read(now_s, SonarPing(now_s, np.array([2.0]), np.ones(1), np.zeros(0), step % 64))
    made.saw(now_s, MavMessage("ATTITUDE", 3, 1, {"roll": None}))
    made._write("/instruments/read", now_s, {"kind": "gps", "fields": {"time_s": 0.0}})
    made._write("/instruments/read", now_s, {"kind": "dvl", "fields": {"time_s": 0.0}})
    made.read(now_s, SonarPing(now_s, np.ones(2), np.ones(1), np.zeros(0)))
    made.read(now_s, SonarPing(now_s, np.ones(()), np.ones(()), np.zeros(0)))
    made.read(now_s, DvlReading(now_s, np.zeros(2)))
    made._write("/instruments/read", now_s, {"kind": "depth", "fields": {"time_s": 0.0, "depth_m": [[1.0]]}})
    made.close()
    return path


def test_a_log_of_the_pilot_is_what_it_heard(tmp_path, capfd):
    path = pilots(tmp_path / "pilot.mcap")
    code, _, err = uuv(capfd, "replay", path)
    assert code == 2 and f"uuv log import {path}" in " ".join(err.replace("\n", "").split())
    found = imported(capfd, path, *MATCHED, "--out", tmp_path / "one.mcap")
    assert [row["kind"] for row in found["files"]] == ["uuv pilot"] and found["localization"] == "truth"
    assert found["readings"] == {"imu": 120, "pressure": 120, "position": 120, "dvl": 120, "sonar": 120}
    odd = {what: count for what, (count, _) in dropped(found).items()}
    assert odd == {"ATTITUDE": 1, "gps": 1, "dvl": 2, "sonar": 2, "depth": 1}
    (time_s, velocity), (_, scan) = told(found, "/sensors/dvl")[5], told(found, "/sonar/scan")[5]
    assert time_s == pytest.approx(0.5) and velocity["velocity"] == [SPEED, 0, 0] and scan["ranges"] == [2.0]


def test_identify_finds_the_same_drives_in_the_log(tmp_path, capfd):
    (tmp_path / "a.tlog").write_bytes(driven())
    found = imported(capfd, tmp_path / "a.tlog")
    vehicle = load_config("open", "clean", "bluerov2_16v").vehicle
    (own,), (other,) = read_ardusub(tmp_path / "a.tlog", vehicle), read_imported(Path(found["log"]), vehicle)
    steps = min(len(own.rpm), len(other.rpm)) - 10
    assert (np.abs(other.rpm[:steps] - own.rpm[:steps]) < 1.0).mean() > 0.99
    np.testing.assert_allclose(np.nanmean(other.velocity, 0), np.nanmean(own.velocity, 0), atol=1e-5)
    assert run_cli("identify", found["log"], "--truth", "--out", tmp_path / "v.yaml") == 2
    assert "leave --truth out" in capfd.readouterr().err


# ------------------------------------------------------------------------------------------------------- bags

STORES = {True: get_typestore(Stores.ROS1_NOETIC), False: get_typestore(Stores.ROS2_HUMBLE)}
for store in STORES.values():
    for kind, text in bags.DECLARED.items():
        store.register(get_types_from_msg(text, kind))


def made(is_ros1, kind, **fields):
    """A message whose other fields are zero."""
    store = STORES[is_ros1]

    def value(field):
        family, told = field
        if family == 1:  # a basic type
            return "" if told[0] == "string" else False if told[0] == "bool" else 0
        if family == 2:
            return made(is_ros1, told)
        (_, inner), count = told
        basic = isinstance(inner, tuple)
        if not basic:
            return [made(is_ros1, inner) for _ in range(count if family == 3 else 0)]
        return np.zeros(count if family == 3 else 0, inner[0])

    names = store.fielddefs[kind][1]
    return store.types[kind](**{name: fields.get(name, value(field)) for name, field in names})


def header(is_ros1, time_s):
    stamp = STORES[is_ros1].types["builtin_interfaces/msg/Time"](
        sec=int(time_s), nanosec=round(1e9 * (time_s % 1))
    )
    return made(is_ros1, "std_msgs/msg/Header", stamp=stamp)


def quaternion(is_ros1, yaw):
    return made(is_ros1, "geometry_msgs/msg/Quaternion", w=math.cos(yaw / 2), z=math.sin(yaw / 2))


def vector(is_ros1, x, y, z):
    return made(is_ros1, "geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def messages(is_ros1, time_s):
    """(topic, message) of one moment: heading north, 0.3 m/s ahead, 0.8 m deep."""

    def of(kind, **fields):
        return made(is_ros1, kind, header=header(is_ros1, time_s), **fields)

    def vec(*xyz):
        return vector(is_ros1, *xyz)

    twist = made(is_ros1, "geometry_msgs/msg/Twist", linear=vec(0.9, 0.0, 0.0))
    covered = made(is_ros1, "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
    yield "/imu", of("sensor_msgs/msg/Imu", orientation=quaternion(is_ros1, math.pi / 2),
        angular_velocity=vec(0.0, 0.0, 0.1), linear_acceleration=vec(0.0, 0.0, 9.8))  # fmt: skip
    yield "/depth", of("sensor_msgs/msg/FluidPressure", fluid_pressure=1e5 + 9780.0 * time_s % 7)
    yield "/dvl", of("marine_acoustic_msgs/msg/Dvl", velocity=vec(0.3, 0.1, -0.05), num_good_beams=4)
    yield "/twist", of("geometry_msgs/msg/TwistWithCovarianceStamped", twist=covered)
    yield "/scan", of("sensor_msgs/msg/LaserScan", angle_min=-1.2, angle_max=1.2, angle_increment=0.01,
        range_min=0.2, range_max=30.0, ranges=np.full(241, 5.0, np.float32))  # fmt: skip
    yield "/rc", of("mavros_msgs/msg/RCOut", channels=np.full(8, 1600, np.uint16))
    yield "/text", of("sensor_msgs/msg/Temperature")


def rows_of(is_ros1, seconds=2.0):
    for k in range(round(10 * seconds)):
        for topic, message in messages(is_ros1, T0 + 0.1 * k):
            store, kind = STORES[is_ros1], message.__msgtype__
            data = (store.serialize_ros1 if is_ros1 else store.serialize_cdr)(message, kind)
            yield topic, kind, T0 + 0.1 * k + 0.01, bytes(data)


def bag_mcap(path):
    file, channels = McapFile(path, profile="ros2"), {}
    for topic, kind, time_s, data in rows_of(False):
        if topic not in channels:
            channels[topic] = file.add_channel(topic, file.add_schema(kind, "ros2msg", b"evil ("), "cdr")
        file.add_message(channels[topic], round(1e9 * time_s), data)
    file.finish()
    return path


def bag_db3(path, extra=()):
    path.unlink(missing_ok=True)
    base, known = sqlite3.connect(path), {}
    base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, more TEXT)")
    base.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
    )
    for topic, kind, time_s, data in [*rows_of(False), *extra]:
        if topic not in known:
            known[topic] = len(known) + 1
            base.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr')", (known[topic], topic, kind))
        base.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)",
            (known[topic], round(1e9 * time_s), data),
        )
    base.commit()
    base.close()
    return path


def bag_ros1(path, compression="none", extra=b""):
    path.unlink(missing_ok=True)
    writer, known = Writer(path), {}
    if compression != "none":
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer:
        for topic, kind, time_s, data in rows_of(True):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=STORES[True])
            writer.write(known[topic], round(1e9 * time_s), data)
        if extra:
            writer.write(known["/text"], round(1e9 * T0), extra)
    return path


BAGS = {
    "mcap": bag_mcap,
    "db3": bag_db3,
    **{name: (lambda path, name=name: bag_ros1(path, name)) for name in ("none", "bz2", "lz4")},
}


@pytest.mark.parametrize("name", BAGS)
def test_bags(name, tmp_path, capfd):
    path = BAGS[name](tmp_path / f"a.{name if name in ('mcap', 'db3') else 'bag'}")
    found = imported(capfd, path, "--out", tmp_path / "x.log")
    assert found["readings"] == {"imu": 20, "pressure": 20, "dvl": 20, "sonar": 20, "motors": 20}
    assert dropped(found) == {
        "/text (sensor_msgs/msg/Temperature)": (20, "not used"),
        "/twist (geometry_msgs/msg/TwistWithCovarianceStamped)": (20, "/dvl tells it"),
    }
    (_, imu), (_, dvl) = told(found, "/sensors/imu")[1], told(found, "/sensors/dvl")[1]
    np.testing.assert_allclose(imu["attitude"], 0.0, atol=1e-6)
    np.testing.assert_allclose(imu["rates"] + imu["specific_force"], [0, 0, 0.1, 0, 0, 9.8], atol=1e-6)
    np.testing.assert_allclose(dvl["velocity"], [0.3, -0.1, 0.05], atol=1e-6)
    _, scan = told(found, "/sonar/scan")[0]
    assert set(scan["ranges"]) == {5.0} and len(scan["ranges"]) == 256
    assert told(found, "/motors/pulses")[0][1]["us"] == [1600.0] * 8


def read_kind(kind, topic, tmp_path, capfd, *words, **fields):
    """The document of a bag of ROS 2 with a message of this kind beside the others."""
    message = made(False, kind, **fields)
    data = bytes(STORES[False].serialize_cdr(message, kind))
    extra = [(topic, kind, T0 + 0.1 * k, data) for k in range(3)]
    path = bag_db3(tmp_path / "a.db3", extra)
    return imported(capfd, path, "--out", tmp_path / f"{len(list(tmp_path.iterdir()))}.log", *words)


def test_other_sonars_of_a_bag(tmp_path, capfd):
    """An echo of a Ping360 counts before a scan, a scan before a cloud."""
    profile = np.full(1200, 3, np.uint8)
    profile[500:506] = 200
    echo = {"angle": -math.radians(19.8) + math.pi, "range": 6, "speed_of_sound": 1500, "gain": 1}
    kind = "ping360_sonar_msgs/msg/SonarEcho"
    found = read_kind(kind, "/echo", tmp_path, capfd, *MATCHED, **echo, intensities=profile)
    (_, ping), *_ = told(found, "/sonar/scan")
    assert ping["ranges"] == [pytest.approx(503 * 6 / 1200, abs=0.03)] and len(ping["ranges"]) == 1
    assert ping["start_angle"] == pytest.approx(math.radians(19.8), abs=0.001)
    assert dropped(found)["/scan (sensor_msgs/msg/LaserScan)"] == (20, "/echo tells it")
    points = np.array([[3.0, 1.0, 0.1], [4.0, 1.33, 0.0], [2.0, 0.0, 5.0]], "<f4")
    fields = [made(False, "sensor_msgs/msg/PointField", name=n, offset=4 * i, datatype=7, count=1)
        for i, n in enumerate("xyz")]  # fmt: skip
    bag = bags._Bag(source := sources.Source(Path("a"), "bag"), load_config("open", "multibeam"), START)
    cloud = {"width": 3, "height": 1, "point_step": 12, "row_step": 36, "fields": fields}
    message = made(False, "sensor_msgs/msg/PointCloud2", **cloud, data=points.view(np.uint8).ravel())
    bag.cloud(message, 1.0, set(), "/points")
    (ping,) = source.readings
    assert ping.hit.sum() == 1 and ping.range_m[ping.hit > 0][0] == pytest.approx(math.hypot(3, 1))


def test_odometry_tells_what_nobody_else_does(tmp_path, capfd):
    q = np.array([math.cos(0.2), 0, 0, math.sin(0.2)], np.float32)
    kind, odd = "px4_msgs/msg/VehicleOdometry", np.full(3, np.nan, np.float32)
    found = read_kind(kind, "/px4", tmp_path, capfd, q=q, position=odd, velocity=odd, velocity_frame=3)
    assert found["localization"] == "estimated", "a place that is no number is none"
    assert dropped(found)["/px4 (px4_msgs/msg/VehicleOdometry)"][0] == 3
    place = made(False, "geometry_msgs/msg/Point", x=1.0, y=2.0, z=-3.0)
    pose = made(False, "geometry_msgs/msg/Pose", position=place, orientation=quaternion(False, math.pi / 2))
    whole = made(False, "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    head = header(False, T0 + 1.0)
    found = read_kind("nav_msgs/msg/Odometry", "/odom", tmp_path, capfd, header=head, pose=whole)
    assert found["localization"] == "truth" and found["readings"]["position"] == 3
    assert found["readings"]["dvl"] == 20, "its velocity is not used beside a DVL's"


def test_odd_rows_and_an_imu_without_orientation_leave_the_others_alone(tmp_path, capfd):
    kind = "sensor_msgs/msg/Imu"
    bare = bytes(STORES[False].serialize_cdr(made(False, kind), kind))
    path = bag_db3(tmp_path / "a.db3", [("/bare", kind, T0 + 0.05 * k, bare) for k in range(40)])
    base = sqlite3.connect(path)
    for odd in ((T0, 2**40), (T0, "text"), (None, b"x"), ("now", b"x")):
        base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", odd)
    base.commit()
    base.close()
    found = imported(capfd, path, "--out", tmp_path / "x.log")
    assert found["readings"] == {"imu": 20, "pressure": 20, "dvl": 20, "sonar": 20, "motors": 20}
    assert dropped(found)["/bare (sensor_msgs/msg/Imu)"] == (40, "/imu tells it")
    assert dropped(found)["/imu (no message of ROS)"] == (4, "not used")


def test_a_pressure_in_another_unit_is_named(tmp_path):
    bag = bags._Bag(sources.Source(tmp_path, "bag"), load_config("open", "multibeam"), START)
    message = made(False, "sensor_msgs/msg/FluidPressure", fluid_pressure=1093.0)
    with pytest.raises(ValueError, match="pascals"):
        bag.pressure(message, 1.0, set(), "/depth")


# -------------------------------------------------------------------------------------------------- bad input


def bomb(path):
    return bag_ros1(path, "lz4", bytes(70 << 20))


def view(path):
    bag_db3(path)
    base = sqlite3.connect(path)
    base.executescript("ALTER TABLE messages RENAME TO x; CREATE VIEW messages AS SELECT * FROM x;")
    base.close()
    return path


def cut(make, share):
    def of(path):
        make(path)
        content = path.read_bytes()
        path.write_bytes(content[: round(share * len(content))])
        return path

    return of


def content(data):
    def of(path):
        path.write_bytes(data)
        return path

    return of


def folder(path):
    path.mkdir()
    return path


BAD = {
    "nothing": (lambda path: path, "cannot be read (No such file or directory)"),
    "empty": (content(b""), "is empty"),
    "a folder": (folder, "is a folder without .mcap or .db3 files"),
    "another kind": (content(b"\x7fELF" + bytes(100)), "begins neither like a .tlog"),
    "text": (content(b"time,u,v,w\n1,2,3,4\n"), "begins neither like a .tlog"),
    "a log of ours": (lambda path: path, "tells nothing that the stack reads"),
    "a ROS 1 bag that is cut": (cut(bag_ros1, 0.6), "is cut off or damaged"),
    "an MCAP bag that is cut": (cut(bag_mcap, 0.6), "uuv log repair"),
    "a SQLite bag that is cut": (cut(bag_db3, 0.3), "is damaged"),
    "a bomb": (bomb, "a chunk would unpack to more than 64 MiB"),
    "a view": (view, "has no table messages"),
    "a record without end": (
        content(b"#ROSBAG V2.0\n" + struct.pack("<I", 0xFFFFFFF0)), "is cut off or damaged"),
    "a DataFlash log of noise": (content(b"\xa3\x95\x80" + bytes(range(256)) * 9), "tells nothing"),
    "lines that are none": (content(b"{" + b"x" * 70_000 * 8 + b"\n"), "has a line of more than"),
    "an endless entry": (
        content(b"\0\0\0\x1aPingViewer sensor log file\0\0\0\1" + b"\x7f" * 50), "tells nothing"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_end_in_one_line_and_leave_nothing(name, tmp_path, capfd):
    make, why = BAD[name]
    path = make(tmp_path / "a.bin")
    if name == "a log of ours":
        file = McapFile(path)
        file.add_message(file.add_channel("/a", file.add_schema("s", "jsonschema", b"{}")), 0, b"{}")
        file.finish()
    there = sorted(entry.name for entry in tmp_path.rglob("*"))
    code, out, err = uuv(capfd, "log", "import", path, "--out", tmp_path / "x.mcap")
    assert code == 2 and why in err and str(path) in err and out == ""
    assert err.count("\n") == 1 + ("FMT" in err), "pymavlink's parser in C has a word of its own"
    assert sorted(entry.name for entry in tmp_path.rglob("*")) == there


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--offset", "b.txt=3"), "names none of the files"),
        (("--offset", "a.txt=x"), "write --offset FILE=SECONDS"),
        (("--offset", "a.txt=nan"), "write --offset FILE=SECONDS"),
        (("--start", "1,2"), "give 3 finite numbers"),
        (("--start", "1,2,3"), "within the tank"),
        (("--sensors", "paper"), "no recording has a sonar with Doppler"),
        (("--out", "{file}"), "is what is read here"),
        (("--out", "/proc/x/y.mcap"), "cannot write there"),
    ],
)
def test_what_is_typed_wrong(words, why, tmp_path, capfd):
    path = a50(tmp_path / "a.txt", seconds=1.0)
    typed = [word.replace("{file}", str(path)) for word in words]
    code, _, err = uuv(capfd, "log", "import", path, *typed)
    assert code == 2 and why in err and [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("make", [tlog, a50, ping360, bag_ros1, bag_db3, bag_mcap], ids=lambda f: f.__name__)
@pytest.mark.parametrize("seed", range(2))
def test_damage_anywhere_is_named_or_refused(make, seed, tmp_path, capfd):
    rng, path = np.random.default_rng(seed), make(tmp_path / "a.bin")
    data = bytearray(path.read_bytes())
    for at in rng.integers(30, len(data), 40):
        data[at] = rng.integers(256)
    path.write_bytes(data[: rng.integers(len(data) // 2, len(data))])
    code, _, err = uuv(capfd, "log", "import", path, "--out", tmp_path / "x.mcap")
    assert code in (0, 2) and (code == 0) == (tmp_path / "x.mcap").exists() and "Traceback" not in err


# ------------------------------------------------------------------------------------------------------- open


def test_a_log_that_is_opened_gives_log_picture_and_report(log, build, tmp_path, monkeypatch):  # noqa: F811
    """Of a log of ours, whose commands are known: the stack's own log says the same."""
    monkeypatch.chdir(tmp_path)
    found, run = replaying.open_replay(log, build=build)
    assert found["steps"] == 91 and sum(found["nodes"].values()) == 91 and found["held_for"] == {}
    assert Path(found["picture"]).stat().st_size > 1000
    own, other = ([m.data["behavior"] for m in read_messages(Path(path), ["/action"])]
        for path in (log, found["recorded"]))  # fmt: skip
    speeds = [np.linalg.norm(m.data["velocity"]) for m in read_messages(Path(found["recorded"]), ["/state"])]
    assert max(speeds) > 0.05, "as estimated, in place of the truth"
    assert own == other and read_head(Path(found["recorded"])).metadata["uuv.result"]["outcome"] == "replayed"
    assert json.loads((run / "run.json").read_text())["status"] == "finished"


def test_while_the_stack_is_held_no_node_drives(log, build, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.chdir(tmp_path)
    blind = replaying.Faults(outages=(replaying.Outage("sonar", 0.0, 9.0),))
    found, _ = replaying.open_replay(log, blind, build=build)
    leaves = [m.data["leaf"] for m in read_messages(Path(found["recorded"]), ["/action"])]
    assert found["held_steps"] == leaves.count("") > 50 and len(leaves) == 91


def test_hours_are_too_long(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(combine, "_FAR_S", math.inf)
    lines = f"{T0} {a50_line()}\n{T0 + 4000} {a50_line(altitude=2)}\n"
    (tmp_path / "a.txt").write_text(lines)
    found = imported(capfd, tmp_path / "a.txt")
    assert run_cli("replay", found["log"], "--open") == 2
    assert "the log has no /sensors/imu" in capfd.readouterr().err
    assert DEVICE_DATA == 2300
