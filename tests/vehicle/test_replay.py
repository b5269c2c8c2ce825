"""A log fed to the pilot decides what was decided; with losses finite, with a reason to stop."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from tests.command import uuv
from tests.conftest import estimate_pose
from uuvtai.common.errors import SettingError
from uuvtai.config.loader import load_config
from uuvtai.evaluation.episodes import Job
from uuvtai.logs.container import McapFile
from uuvtai.logs.encode import LogError
from uuvtai.logs.reader import records
from uuvtai.logs.topics.sensors import exact_image
from uuvtai.logs.writer import EpisodeRecorder
from uuvtai.vehicle import onboard
from uuvtai.vehicle import replay as replaying
from uuvtai.vehicle.replay import Delivery, Faults, Outage, disturbed, outage_of, read_feed, replay

STEPS, SEED = 90, 77001
END = SimpleNamespace(
    outcome="cut", episode_return=0.0, time_s=1.8, min_clearance_m=1.0, replans={}, planned_by={}
)


def recorded(small, folder, depth_images=True, steps=STEPS, lost_at=None):
    """Path of a log of row 0, in which a thruster is taken for dead from step ``lost_at`` on."""
    job = Job(SEED, 3)
    recorder = EpisodeRecorder(folder, "pool", "bt", [job], depth_images)
    small.sim.sleep()
    small.begin([job.episode], seed=job.seed)
    recorder.begin(small.sim, 0, job)
    for step in range(steps):
        if step == lost_at:
            small.sim.s.ego.given_up[0] = 5
        small.sim.step()
        recorder.step(small.sim)
    recorder.end(small.sim, 0, END)
    return recorder.paths[job]


@pytest.fixture(scope="module")
def log(small, tmp_path_factory):
    return recorded(small, tmp_path_factory.mktemp("replay"))


@pytest.fixture(scope="module")
def feed(log):
    """What the log tells a pilot; nobody changes it."""
    return read_feed(log)


@pytest.fixture
def build(small, monkeypatch):
    """Makes pilots on the session's simulator, whose sensors are its own again afterwards."""
    monkeypatch.setattr(small.sim, "sensors", small.sim.sensors)
    return lambda feed: onboard.OnboardPilot(small.sim, feed.mission)


def commands(feed, build, arrivals=None):
    """Of every step, and the pilot."""
    pilot = build(feed)
    told = disturbed(feed.arrivals if arrivals is None else arrivals, Faults())
    return replaying._played(pilot, feed, told)[0], pilot


# --------------------------------------------------------------------------------------------------- equality


def test_a_log_gives_the_same_commands(log, build):
    found = replay(log, build=build)
    assert found["equal"] and found["steps"] == STEPS + 1
    assert [row["equal_steps"] for row in found["agreement"]] == [STEPS + 1] * 4
    assert found["change"]["largest"] == 0 and found["change"]["held_steps"] == 0
    counts = found["messages"]
    assert counts.pop("thruster")["fed"] == 0
    assert all(row["used"] == row["fed"] > 0 and row["bad"] == row["late"] == 0 for row in counts.values())
    assert counts["depth"]["fed"] == STEPS // 5 + 1


def test_the_logged_commands_are_worth_comparing(feed):
    actions = np.array([step.action for step in feed.steps])
    assert (actions.std(axis=0) > 0.01).sum() >= 2 and len({step.leaf for step in feed.steps}) >= 1


def test_the_same_with_an_estimated_pose_and_late_scans(small, build, monkeypatch, tmp_path):
    """The filter writes over yaw and velocity: the instruments' own values must come from the log."""
    estimate_pose(monkeypatch, small)
    log = recorded(small, tmp_path)
    apart = small.sim.s.ego.imu_rpy.to_numpy()[0] - small.sim.s.ego.rpy.to_numpy()[0]
    assert apart[2] != 0, "the filter corrects the yaw"
    found = replay(log, build=build)
    assert found["equal"] and found["messages"]["dvl"]["used"] < STEPS / 5
    assert "position" not in {name for name, row in found["messages"].items() if row["fed"]}


def test_a_pilot_that_begins_again_knows_nothing_of_before(small, build, monkeypatch, tmp_path):
    """From a start that is not exactly known a scan corrects the place; by none told it is believed."""
    estimate_pose(monkeypatch, small)
    feed = read_feed(recorded(small, tmp_path))
    first, pilot = commands(feed, build)
    again = build(feed)
    again.tick()
    again.begin_again(feed.mission)
    again, _ = replaying._played(again, feed, disturbed(feed.arrivals, Faults()))
    assert all(np.array_equal(a.action, b.action) for a, b in zip(first, again, strict=True))
    x, y, z = feed.mission.start
    off = dataclasses.replace(feed.mission, start=(x + 0.1, y, z))
    ends = {}
    for spread in ((), (0.01, 0.0, 0.0, 0.01, 0.0, 1e-4)):
        pilot.begin_again(dataclasses.replace(off, spread=spread))
        ends[spread] = replaying._played(pilot, feed, disturbed(feed.arrivals, Faults()))[0][-1].pos_w
    wrong_m = [math.dist(end[:2], first[-1].pos_w[:2]) for end in ends.values()]
    assert wrong_m[0] > 0.05 > wrong_m[1]


def test_the_same_while_the_dvl_is_silent(small, build, monkeypatch, tmp_path):
    silent = load_config("pool", "harsh", overrides={"sensors.dvl.dropout": 0.5}).sensors.dvl
    estimate_pose(monkeypatch, small, localization="dead_reckoning", dvl=silent)
    found = replay(recorded(small, tmp_path), build=build)
    assert found["equal"] and 0 < found["messages"]["dvl"]["used"] < STEPS / 20


def test_the_same_once_a_thruster_is_taken_for_dead(small, build, tmp_path):
    found = replay(recorded(small, tmp_path, lost_at=20), build=build)
    assert found["equal"] and found["messages"]["thruster"]["used"] == STEPS - 20
    assert small.arrays("ego")["ego.given_up"][0] == 5


def test_late_readings_are_carried_to_now(small, build, monkeypatch, tmp_path):
    """Also the first: a start without pressure is none at the surface. Estimates may be compared."""
    estimate_pose(monkeypatch, small)
    feed = read_feed(recorded(small, tmp_path))
    usual, _ = commands(feed, build)
    late = [
        Delivery(arrival.time_s + (0.1 if arrival.message.time_s < 0.1 else 0.06), arrival.message)
        if isinstance(arrival.message, onboard.PressureReading | onboard.ImuReading | onboard.DvlReading)
        else arrival
        for arrival in feed.arrivals
    ]
    found, _ = commands(feed, build, sorted(late, key=lambda arrival: arrival.time_s))
    apart = np.array([one.pos_w - two.pos_w for one, two in zip(usual, found, strict=True)])
    moved = np.array([one.pos_w - usual[0].pos_w for one in usual])
    assert np.abs(moved).max() > 0.3, "there was something to be late for"
    assert np.abs(apart[:, 2]).max() < 0.1 and np.abs(apart[-30:, 2]).max() < 0.02
    assert np.linalg.norm(apart[:, :2], axis=1).max() < 0.04


def test_an_estimated_position_does_not_run_away(small, build, monkeypatch, tmp_path):
    """Corrections still under way were made once per reading, and grew to 87 m."""
    estimate_pose(monkeypatch, small)
    feed = read_feed(recorded(small, tmp_path, steps=250))
    most_m = {0.2: 0.4, 1.24: 3.0}
    for late_s, far_m in farthest(feed, build, most_m):
        assert far_m < most_m[late_s], late_s


def test_a_given_position_with_a_late_dvl_does_not_run_away(small, feed, build):
    """With a reading a step each was carried by others on their way; the velocity grew without limit."""
    most_m = {0.06: 0.05, 0.1: 0.1, 0.2: 0.3}
    for late_s, far_m in farthest(feed, build, most_m):
        assert far_m < most_m[late_s], late_s
        assert np.abs(small.arrays("ego")["ego.vel_b"][0]).max() < 1.0


def farthest(feed, build, lates_s):
    """(late_s, [m] between the own positions with all messages on time and all that late) of each."""
    usual, _ = commands(feed, build)
    for late_s in lates_s:
        late = [Delivery(arrival.time_s + late_s, arrival.message) for arrival in feed.arrivals]
        found, _ = commands(feed, build, late)
        yield late_s, max(np.linalg.norm(a.pos_w - b.pos_w) for a, b in zip(usual, found, strict=True))


def test_what_arrives_twice_or_in_another_order_changes_nothing(feed, build):
    usual, _ = commands(feed, build)
    backwards = [arrival for arrival in reversed(feed.arrivals) for _ in range(2)]
    others, pilot = commands(feed, build, backwards)
    assert all(np.array_equal(one.action, two.action) for one, two in zip(usual, others, strict=True))
    assert all(tally.late == tally.used for tally in pilot.tallies.values())


def test_the_first_difference_is_told_with_its_place(log, feed, build, monkeypatch):
    moved = []
    for arrival in feed.arrivals:
        message = arrival.message
        if hasattr(message, "pos_w") and round(arrival.time_s / 0.02) == 40:
            message = dataclasses.replace(message, pos_w=message.pos_w + np.float32(0.25))
        moved.append(Delivery(arrival.time_s, message))
    moved = dataclasses.replace(feed, arrivals=moved)
    monkeypatch.setattr(replaying, "read_feed", lambda *_: moved)
    found = replay(log, build=build)
    command, asked, _, place = found["agreement"]
    assert not found["equal"] and place["first_difference"]["step"] == 40
    assert place["first_difference"]["time_s"] == 0.8
    gap = np.subtract(place["first_difference"]["replayed"], place["first_difference"]["logged"])
    assert gap == pytest.approx([0.25] * 3, abs=1e-6)
    assert command["first_difference"]["step"] >= 40 and asked["equal_steps"] >= 40


# ----------------------------------------------------------------------------------------------------- faults


def test_lost_late_and_dead_sensors_give_finite_commands(log, build):
    faults = Faults(0.2, 0.1, (outage_of("dvl:0.5:1.2"), outage_of("depth:0:9")), seed=5)
    found = replay(log, faults, build=build)
    again = replay(log, faults, build=build)
    whole = {name: row["fed"] for name, row in replay(log, build=build)["messages"].items()}
    assert found["change"]["finite"] and not found["equal"] and found["change"]["largest"] > 0
    assert found["change"] == again["change"] and found["messages"] == again["messages"]
    rows = found["messages"]
    assert rows["depth"]["lost"] == whole["depth"] and rows["depth"]["used"] == 0
    assert 0.1 < rows["imu"]["lost"] / whole["imu"] < 0.3 and rows["dvl"]["lost"] > rows["imu"]["lost"]
    assert rows["imu"]["late"] > 0


@pytest.mark.parametrize(("sensor", "limit_s"), [("imu", 0.5), ("sonar", 1.0), ("position", 0.5)])
def test_a_dead_sensor_stops_the_vehicle_with_a_reason(feed, build, sensor, limit_s):
    left = disturbed(feed.arrivals, Faults(outages=(Outage(sensor, 0.2, 9.0),))).arrivals
    found, _ = commands(feed, build, left)
    stopped = [command for command in found if command.held]
    assert 0.2 + limit_s - 0.04 <= stopped[0].time_s <= 0.2 + limit_s + 0.04
    assert len(stopped) == len(found) - stopped[0].step
    assert all(not command.action.any() and not command.velocity.any() for command in stopped)
    assert all(command.held[0].startswith(f"{sensor}: ") for command in stopped)


@pytest.mark.parametrize(
    ("lost", "known"), [(["dvl:0.2:9"], 1), (["dvl:0.2:9", "position:1.4:9"], 0), (["dvl:0.2:1.5"], 1)]
)
def test_without_a_dvl_it_goes_on_by_the_given_position(feed, build, small, lost, known):
    usual, _ = commands(feed, build)
    truth = small.arrays("ego")["ego.vel_b"][0].copy()
    left = disturbed(feed.arrivals, Faults(outages=tuple(map(outage_of, lost)))).arrivals
    found, _ = commands(feed, build, left)
    assert not any(command.held for command in found) and found[-1].action.any()
    ego = small.arrays("ego")
    assert ego["ego.vel_valid"][0] == known
    if known:
        assert np.abs(ego["ego.vel_b"][0] - truth).max() < 0.02
        apart = [np.abs(one.action - two.action).max() for one, two in zip(usual, found, strict=True)]
        assert np.median(apart) < 0.01


def test_a_position_that_jumps_is_no_velocity(feed, build, small):
    left = disturbed(feed.arrivals, Faults(outages=(outage_of("dvl:0.2:9"),))).arrivals
    jump = [
        dataclasses.replace(a, message=dataclasses.replace(a.message, pos_w=a.message.pos_w + np.float32(1)))
        if isinstance(a.message, onboard.PositionFix) and a.time_s > 1.79
        else a
        for a in left
    ]
    commands(feed, build, jump)
    assert small.arrays("ego")["ego.vel_valid"][0] == 0


def test_a_velocity_that_no_thrust_explains_moves_nothing(small, build, monkeypatch, tmp_path):
    """A DVL's single reading of 6 m/s had moved the own place for good."""
    estimate_pose(monkeypatch, small)
    feed = read_feed(recorded(small, tmp_path))
    usual, _ = commands(feed, build)
    told, spike = list(feed.arrivals), np.array([6.0, 0.0, 0.0])
    at = [n for n, each in enumerate(told) if isinstance(each.message, onboard.DvlReading)][8]
    message = dataclasses.replace(told[at].message, vel_b=told[at].message.vel_b + spike)
    told[at] = dataclasses.replace(told[at], message=message)
    found, pilot = commands(feed, build, told)
    assert pilot.tallies["dvl"].unplaced == 1
    assert max(math.dist(a.pos_w, b.pos_w) for a, b in zip(usual, found, strict=True)) < 0.03


def test_nothing_at_all_is_a_stop(feed, build):
    found, _ = commands(feed, build, [])
    assert all(not command.action.any() and command.leaf is not None for command in found)
    assert found[0].held == tuple(f"{name}: nothing yet" for name in ("imu", "pressure", "position", "sonar"))


def test_a_scan_without_an_attitude_is_not_drawn(feed, build, small):
    left = [arrival for arrival in feed.arrivals if not isinstance(arrival.message, onboard.ImuReading)]
    _, pilot = commands(feed, build, left)
    tally = pilot.tallies["sonar"]
    assert tally.used == 0 and tally.unplaced == tally.fed > 0
    assert not small.arrays("grid_map")["grid_map.static_occ"][0].any()


def test_nonsense_is_counted_and_forgotten(feed, build):
    usual, _ = commands(feed, build)
    spoilt = []
    for arrival in feed.arrivals:
        message = arrival.message
        spoilt.append(arrival)
        if isinstance(message, onboard.SonarPing):
            wild = message.range_m.copy()
            wild[7] = np.nan
            later = message.time_s + 1e-6
            spoilt.append(Delivery(arrival.time_s, dataclasses.replace(message, time_s=later, range_m=wild)))
        if isinstance(message, onboard.PressureReading):
            spoilt.append(Delivery(arrival.time_s, onboard.PressureReading(message.time_s + 1e-6, 1e30)))
            spoilt.append(Delivery(arrival.time_s, onboard.PressureReading(float("nan"), 1.0)))
    found, pilot = commands(feed, build, spoilt)
    assert all(np.array_equal(one.action, two.action) for one, two in zip(usual, found, strict=True))
    assert pilot.tallies["sonar"].bad == STEPS + 1 and pilot.tallies["pressure"].bad == 2 * (STEPS + 1)


def test_what_is_no_message_or_has_another_shape_is_refused(feed, build):
    pilot = build(feed)
    with pytest.raises(TypeError, match="no message of a sensor"):
        pilot.feed("imu")
    with pytest.raises(ValueError, match=r"depth: depth_m must have the shape \(72, 128\)"):
        pilot.feed(onboard.DepthShot(0.0, np.zeros((3, 3))))
    with pytest.raises(ValueError, match="imu: rpy"):
        pilot.feed(onboard.ImuReading(0.0, np.zeros(2), np.zeros(3), np.zeros(3)))


@pytest.mark.parametrize(
    "text", ["dvl", "dvl:5", "dvl:5:4", "dvl:-1:4", "dvl:a:b", "gps:1:2", "dvl:1:inf", "dvl:1:2:3", ""]
)
def test_an_outage_that_makes_no_sense_is_refused(text):
    with pytest.raises(SettingError, match="SENSOR:FROM:TO"):
        outage_of(text)


@pytest.mark.parametrize("wrong", [{"drop": -0.1}, {"drop": 1.5}, {"drop": float("nan")}, {"jitter_s": -1}])
def test_faults_out_of_range_are_refused(wrong):
    with pytest.raises(SettingError, match="must be"):
        Faults(**wrong)


# ------------------------------------------------------------------------------------------------------- logs


def rewritten(log, path, change):
    """A copy of a log whose records ``change(kind, name, data)`` keeps, changes or (None) leaves out."""
    file, topics, schemas = McapFile(path), {}, {}
    for record in records(log):
        kind = type(record).__name__
        if kind == "Schema":
            schemas[record.id] = file.add_schema(record.name, record.encoding, record.data)
        elif kind == "Channel":
            topics[record.id] = record.topic, file.add_channel(record.topic, schemas[record.schema_id])
        elif kind == "Message":
            topic, channel = topics[record.channel_id]
            data = change("message", topic, record.data)
            if data is not None:
                file.add_message(channel, record.log_time, data)
        elif kind == "Metadata":
            file.add_metadata(record.name, change("metadata", record.name, record.metadata))
        elif (data := change("attachment", record.name, record.data)) is not None:
            file.add_attachment(record.name, "application/octet-stream", data)
    file.finish()
    return path


def without(*names):
    return lambda kind, name, data: None if name in names else data


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without("/camera/exact"), "has no /camera/exact, .* --depth-images"),
        (without("/sensors/imu"), "has no /sensors/imu"),
        (without("/action"), "has no /action"),
        (without("config.yaml"), "no attachment config.yaml"),
        (without("scenario.json"), "no attachment scenario.json"),
        (without("tree.xml"), "--agent bt"),
        (lambda kind, name, data: b"{a: [" if name == "config.yaml" else data, "config.yaml cannot be used"),
        (lambda kind, name, data: b"{}" if name == "/sensors/imu" else data, "not as its schema says"),
        (
            lambda kind, name, data: b'{"velocity": [1]}' if name == "/sensors/dvl" else data,
            "vel_b must have",
        ),
        (
            lambda kind, name, data: (
                data.replace(b"behavior:", b"teacher:") if name == "config.yaml" else data
            ),
            "renamed to 'behavior",
        ),
        (
            lambda kind, name, data: {**data, "agent": "bt+truth"} if name == "uuv.run" else data,
            "driven with the truth",
        ),
        (
            lambda kind, name, data: (
                json.dumps({**json.loads(data), "data": "AAAA"}).encode() if name == "/camera/exact" else data
            ),
            "is damaged",
        ),
        (
            lambda kind, name, data: (
                json.dumps({**json.loads(data), "planner": "own"}).encode() if name == "/plan/info" else data
            ),
            "a planner of the user's",
        ),
    ],
)
def test_a_log_that_cannot_be_replayed_says_why(log, build, tmp_path, change, said):
    with pytest.raises(LogError, match=said):
        replay(rewritten(log, tmp_path / "other.mcap", change), build=build)


def test_a_gap_is_refused_and_a_tree_can_be_named(log, build, tmp_path):
    left = iter(range(10_000))

    def one_missing(kind, name, data):
        return None if name == "/action" and next(left) == 30 else data

    with pytest.raises(LogError, match="step 30 is missing"):
        replay(rewritten(log, tmp_path / "gap.mcap", one_missing), build=build)
    bare = rewritten(log, tmp_path / "bare.mcap", without("tree.xml"))
    assert replay(bare, tree="bt", build=build)["equal"]


def test_exact_images_keep_every_bit(feed):
    shots = [a.message for a in feed.arrivals if isinstance(a.message, onboard.DepthShot)]
    assert len(shots) == STEPS // 5 + 1 and shots[0].depth_m.dtype == np.float32
    assert shots[0].depth_m.std() > 0.1
    with pytest.raises(LogError, match="72 x 128 pixels"):
        exact_image({"rows": 72, "columns": 128, "data": ""}, (2, 2))


# ---------------------------------------------------------------------------------------------------- command


def test_the_command_tells_what_agrees(log, build, monkeypatch, capfd):
    monkeypatch.setattr(replaying, "built", build)
    code, out, _ = uuv(capfd, "replay", log)
    assert code == 0 and f"{STEPS + 1} of {STEPS + 1}" in out and "all commands equal the logged ones" in out
    code, out, _ = uuv(capfd, "replay", log, "--drop", "0.5", "--lose", "sonar:0:9")
    assert (
        code == 0 and "stopped in" in out and "sonar" in out and "commands differ, under these faults" in out
    )
    code, out, _ = uuv(capfd, "replay", log, "--json")
    assert code == 0 and json.loads(out)["equal"]


def test_the_command_fails_where_commands_differ(log, feed, build, monkeypatch, capfd):
    """Driven by another tree than the log's, with nothing disturbed."""
    monkeypatch.setattr(replaying, "built", build)
    small_tree = build(feed).stack.sim.tree
    try:
        build(feed).stack.sim.use_tree(read_feed(log, "straight").tree)
        code, out, _ = uuv(capfd, "replay", log)
    finally:
        build(feed).stack.sim.use_tree(small_tree)
    assert code == 3 and "though nothing was disturbed" in out and "instead of" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["no.mcap"], "no.mcap"),
        (["LOG", "--drop", "2"], "--drop 2"),
        (["LOG", "--jitter", "-1"], "--jitter -1"),
        (["LOG", "--lose", "gps:1:2"], "--lose gps:1:2"),
        (["LOG", "--fault-seed", "-1"], "--fault-seed"),
        (["LOG", "--agent", "nobody"], "nobody"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(log, capfd, arguments, said):
    code, out, err = uuv(capfd, "replay", *[str(log) if word == "LOG" else word for word in arguments])
    assert code == 2 and said in err and out == "" and "Traceback" not in err
