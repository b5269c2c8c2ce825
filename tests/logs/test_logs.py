"""Episode logs: messages against schemas with independent readers, kills, hostile files, export."""

import base64
import dataclasses
import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import typing
from collections import Counter
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Chunk, Header, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

from tests.command import read_by_viewer
from tests.map_bits import kept
from tests.oracles import logs as episode
from tests.oracles.world import path_position
from uuvtai.common.enums import NO_SITE, clearance_m, occupancy
from uuvtai.common.files import FileError
from uuvtai.common.obstacle_motion import KIND_NAMES, obstacle_positions
from uuvtai.config.loader import load_config
from uuvtai.kernels.core import geometry, grid
from uuvtai.logs.container import McapFile
from uuvtai.logs.encode import LogError, Moment
from uuvtai.logs.export import export, file_name, repair
from uuvtai.logs.picture import save_image
from uuvtai.logs.reader import info, read_head, read_messages
from uuvtai.logs.run_folder import write_atomic
from uuvtai.logs.topics import TOPICS
from uuvtai.logs.topics.perception import grid_values, map_origin
from uuvtai.logs.topics.sensors import logged_image
from uuvtai.logs.writer import NO_POLICY, SIGNS, McapEpisodeLog
from uuvtai.sim.stages import SimState

N_STEP = 210
DEPTH_ROUNDING_MM = 0.5 + 1e-3
"""a depth image has whole millimetres"""
RISK_ROUNDING = 1e-6
"""the log adds its terms in another order, in float32"""
LAYERS = ("grid_map.static_occ", "grid_map.dynamic_occ", "clearance.site")
CLOSED_FORM_M = 2e-6
"""float32 rounding of positions up to 20 m"""

SCHEMAS = {
    "/tf": "foxglove.FrameTransforms", "/pose": "foxglove.PoseInFrame",
    "/pose_estimate": "foxglove.PoseInFrame", "/pose_covariance": "uuv.PoseCovariance",
    "/sensors/imu": "uuv.ImuReading", "/sensors/dvl": "uuv.DvlReading",
    "/sensors/pressure": "uuv.PressureReading", "/sonar/scan": "foxglove.LaserScan",
    "/sonar/doppler": "uuv.SonarDoppler", "/sonar/image": "foxglove.CompressedImage",
    "/camera/line": "uuv.DepthLine", "/camera/depth": "foxglove.CompressedImage",
    "/camera/exact": "uuv.DepthExact", "/map/static": "foxglove.Grid", "/map/dynamic": "foxglove.Grid",
    "/map/clearance": "foxglove.Grid", "/map/risk": "foxglove.Grid", "/plan": "foxglove.SceneUpdate",
    "/plan/info": "uuv.Plan", "/goal": "foxglove.SceneUpdate", "/obstacles": "foxglove.SceneUpdate",
    "/obstacles/truth": "uuv.Obstacles", "/state": "uuv.State", "/action": "uuv.Action",
    "/policy": "uuv.Policy", "/safety": "uuv.Safety", "/tree": "uuv.Tree", "/log": "foxglove.Log",
}  # fmt: skip


@pytest.fixture(scope="module")
def snaps():
    return list(episode.snapshots(N_STEP))


@pytest.fixture(scope="module")
def log_path(tmp_path_factory, snaps):
    path = tmp_path_factory.mktemp("logs") / "bt_seed7_episode3.mcap"
    with McapEpisodeLog(path, episode.header(), depth_images=True) as log:
        for snap in snaps:
            log.write(snap)
        log.close(episode.result(N_STEP))
    return path


def strict_json(text):
    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def messages(path):
    """[(topic, schema, time_ns, publish_ns, data)] by the official Python reader, checksums verified."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return [
            (c.topic, s, m.log_time, m.publish_time, m.data)
            for s, c, m in reader.iter_messages(log_time_order=False)
        ]


def by_topic(path, topic):
    return [m.data for m in read_messages(path, [topic])]


# ---------------------------------------------------------------------------------------------------- content


def test_a_track_says_how_sure_it_is(log_path):
    """Covariance, turn rate, heights and other futures, in the order of the moving slots; null = free."""
    first, second = by_topic(log_path, "/tracks")[0]["tracks"]
    assert first["covariance"] == pytest.approx(np.arange(1, 11) * 1e-3)
    assert second["covariance"] == pytest.approx(np.arange(1, 11) * 2e-3)
    assert (first["turn_rate"], first["turn_variance"]) == pytest.approx((0.3, 0.04))
    assert (first["above"], first["below"]) == (None, -1.0)
    assert second["above"] == pytest.approx(-0.4) and second["below"] is None
    assert second["futures"] == pytest.approx([0.1, 0.25])
    assert (first["present"], second["present"]) == pytest.approx((0.95, 0.6))


def test_an_evasion_is_told_where_one_is_looked_for(log_path, snaps):
    """Only in the decisions that look for one; null = no conflict."""
    found = by_topic(log_path, "/evasion")
    assert len(found) == sum(int(snap["behavior.want_evade"]) for snap in snaps) > 0
    assert all(message["hold_conflict_s"] is None for message in found)
    assert {message["candidate"] for message in found} == {-1, 17}
    assert {message["conflict_s"] is None for message in found} == {True, False}
    assert found[0]["velocity"] == pytest.approx([0.1, 0.6, 0.2]) and found[0]["cost"] == 2.5


def test_futures_are_told_beside_the_forecast(log_path):
    """Slot 0 has its forecast alone; slot 2 has two futures, and its forecast what they leave."""
    found = by_topic(log_path, "/futures")
    assert len(found) == len(by_topic(log_path, "/evasion"))
    first, second = found[0]["tracks"]
    assert [path["weight"] for path in first["hypotheses"]] == [1.0]
    assert first["hypotheses"][0]["x"] == [0, -2, -4] and first["hypotheses"][0]["y"] == [-1, -3, -5]
    assert [path["weight"] for path in second["hypotheses"]] == pytest.approx([0.1, 0.25, 0.65])
    assert second["hypotheses"][1]["x"] == [30, 32, 34] and second["radius"] == pytest.approx([0.2] * 3)
    assert (second["above"], second["below"]) == (pytest.approx(-0.4), None)


def test_every_topic_has_its_schema_and_messages_fit_it(log_path):
    """The first of each topic; all of them by the viewers' own reader."""
    seen, validators, left = {}, {}, Counter({topic.name: 20 for topic in TOPICS})
    for topic, schema, _, _, data in messages(log_path):
        if topic not in validators:
            parsed = strict_json(schema.data)
            jsonschema.Draft202012Validator.check_schema(parsed)
            validators[topic] = jsonschema.Draft202012Validator(parsed)
            assert schema.encoding == "jsonschema"
        left[topic] -= 1
        if left[topic] >= 0:
            validators[topic].validate(strict_json(data))
        seen[topic] = schema.name
    assert SCHEMAS.items() <= seen.items()
    assert seen.keys() == {topic.name for topic in TOPICS} >= {"/tracks", "/plan/lookahead"}


def test_how_sure_the_pose_is_stands_beside_how_far_off_it_is(log_path, snaps):
    message, snap = by_topic(log_path, "/pose_covariance")[20], snaps[20]
    matrix, cov = np.reshape(message["covariance"], (6, 6)), snap["ego.pose_cov"]
    assert np.array_equal(matrix, matrix.T)
    assert matrix[0, 5] == pytest.approx(cov[2]) and matrix[1, 5] == pytest.approx(cov[4])
    assert np.diag(matrix) == pytest.approx([cov[0], cov[3], snap["ego.z_var"], 0, 0, cov[5]])
    assert message["sigma"] == pytest.approx(np.sqrt(np.diag(matrix)[[0, 1, 2, 5]]))
    assert message["error"] == pytest.approx([0.01, 0.01, 0.01, 0.0], abs=2e-6)


def test_the_final_step_shows_the_obstacles_even_off_their_rate(tmp_path):
    episode.record(tmp_path / "a.mcap", 13, maps=False)
    times = [m.time_s for m in read_messages(tmp_path / "a.mcap", ["/obstacles/truth"])]
    assert times == pytest.approx([0.0, 0.1, 0.2, 0.26])


def test_times_are_simulation_time_from_zero(log_path):
    stamps = {}
    for topic, _, log_time, publish_time, _ in messages(log_path):
        assert log_time == publish_time
        stamps.setdefault(topic, []).append(log_time)
    assert stamps["/pose"] == [round(step * episode.DT * 1e9) for step in range(N_STEP + 1)]


def test_metadata_and_attachments_come_first_and_the_result_last(log_path):
    with log_path.open("rb") as file:
        kinds = [type(record) for record in StreamReader(file, emit_chunks=True).records]
    assert kinds[: kinds.index(Chunk)] == [Header, Metadata, Attachment, Attachment]
    behind = kinds[len(kinds) - kinds[::-1].index(Chunk) :]
    assert Metadata in behind and Attachment not in behind
    head = read_head(log_path)
    run, result = head.metadata["uuv.run"], head.metadata["uuv.result"]
    assert {
        "version", "git_sha", "seed", "episode", "config_sha256", "checkpoint_sha256", "frames",
    } <= run.keys()  # fmt: skip
    assert run["config_sha256"] == hashlib.sha256(head.attachments["config.yaml"]).hexdigest()
    assert {"outcome", "return", "time_s", "min_clearance_m", "replans"} <= result.keys()
    assert (result["outcome"], result["replans"], float(result["return"])) == ("success", "3", 12.5)
    assert json.loads(head.attachments["scenario.json"]) == episode.scenario()


def test_chunks_hold_a_hundredth_of_the_messages_or_one_step(log_path):
    written = 0
    for chunk in chunks_of(log_path):
        stamps = [record.log_time for record in breakup_chunk(chunk) if isinstance(record, Message)]
        written += len(stamps)
        assert chunk.compression == "zstd" and (len(set(stamps)) == 1 or len(stamps) <= 0.01 * written)
    assert written == len(messages(log_path))


def chunks_of(path):
    with path.open("rb") as file:
        return [
            record for record in StreamReader(file, emit_chunks=True).records if isinstance(record, Chunk)
        ]


def test_sonar_is_logged_as_sensed(log_path, snaps):
    scans, dopplers = by_topic(log_path, "/sonar/scan"), by_topic(log_path, "/sonar/doppler")
    snap, scan, doppler = snaps[10], scans[10], dopplers[10]
    hit = snap["scan.hit"] == 1
    ranges = np.array(scan["ranges"], np.float32)
    assert hit.any() and not hit.all()
    np.testing.assert_array_equal(ranges[hit], snap["scan.range_m"][hit])
    assert (ranges[~hit] == episode.MAX_RANGE_M).all()
    np.testing.assert_array_equal(np.array(scan["intensities"]) > 0, hit)
    assert scan["start_angle"] == 0 and scan["end_angle"] == pytest.approx(2 * math.pi * 255 / 256, abs=1e-15)
    np.testing.assert_array_equal(
        np.array(doppler["velocity"], np.float32)[hit], snap["scan.doppler_m_s"][hit]
    )


def test_a_late_scan_carries_the_time_of_its_ping(tmp_path, snaps):
    late = snaps[40] | {"scan.ping_step": 35}
    with McapEpisodeLog(tmp_path / "a.mcap", episode.header()) as log:
        log.write(late)
        log.write(snaps[41] | {"scan.fresh": 0})
        log.close(episode.result(41))
    (scan,) = read_messages(tmp_path / "a.mcap", ["/sonar/scan"])
    assert scan.time_s == pytest.approx(0.8)
    assert scan.data["timestamp"] == {"sec": 0, "nsec": 700_000_000}


def test_maps_keep_exact_values_and_the_corner_of_their_first_cell(log_path, snaps):
    static, dynamic = (occupancy(snaps[-1][name]) for name in LAYERS[:2])
    clearance = clearance_m(snaps[-1]["clearance.site"], episode.config())
    weights = episode.config().clearance
    risk = weights.risk_clearance / (clearance + weights.risk_epsilon_m)
    risk = risk + weights.risk_static * static + weights.risk_dynamic * dynamic
    maps = {"static": static, "dynamic": dynamic, "clearance": clearance, "risk": risk}
    for name, values in maps.items():
        grid = by_topic(log_path, f"/map/{name}")[-1]
        rounding = RISK_ROUNDING if name == "risk" else 0.0
        np.testing.assert_allclose(grid_values(grid), values, rtol=rounding)
        assert (grid["pose"]["position"]["x"], grid["pose"]["position"]["y"]) == episode.ORIGIN
        assert [(f["name"], f["offset"], f["type"]) for f in grid["fields"]] == [
            ("red", 0, 1), ("green", 1, 1), ("blue", 2, 1), ("alpha", 3, 1), ("value", 4, 7),
        ]  # fmt: skip
        assert grid["row_stride"] == grid["column_count"] * grid["cell_stride"]
    red = np.frombuffer(base64.b64decode(by_topic(log_path, "/map/dynamic")[-1]["data"]), np.uint8).reshape(
        *episode.SHAPE, 8
    )
    peak = np.unravel_index(dynamic.argmax(), episode.SHAPE)
    assert red[peak][0] > 200 and red[peak][3] > 100


def large(metres):
    """The first step of an episode in a tank of that (width, length), its maps full of what may be there."""
    cells = np.resize(np.linspace(0, 1, 997, dtype=np.float32), [10 * side + 8 for side in metres])
    occupied = kept(cells)
    maps = {LAYERS[0]: occupied, LAYERS[1]: occupied, LAYERS[2]: np.full(cells.shape, NO_SITE, np.int16)}
    return next(episode.snapshots(1, maps=False)) | maps


def test_the_maps_of_a_large_tank_are_read_again(tmp_path):
    with McapEpisodeLog(tmp_path / "a.mcap", episode.header()) as log:
        log.write(snap := large((100, 200)))
        log.close(episode.result(1))
    assert repair(tmp_path / "a.mcap", tmp_path / "b.mcap").complete
    (found,) = read_messages(tmp_path / "b.mcap", ["/map/static"])
    assert (grid_values(found.data) == occupancy(snap["grid_map.static_occ"])).all()


def test_a_map_that_nobody_could_read_again_is_refused_at_once(tmp_path):
    with (
        pytest.raises(LogError, match=r"more than the .* make it coarser: --set mapping.cell_m=0.2"),
        McapEpisodeLog(tmp_path / "a.mcap", episode.header()) as log,
    ):
        log.write(large((250, 400)))
    assert not (tmp_path / "a.mcap").exists()


def test_clearance_carries_the_time_of_its_map(tmp_path, snaps):
    """The map of every fifth step: of step 30 where a new route asks for one in step 33."""
    with McapEpisodeLog(tmp_path / "a.mcap", episode.header()) as log:
        log.write(snaps[33] | {name: snaps[0][name] for name in LAYERS})
        log.close(episode.result(33))
    stamps = {
        topic: by_topic(tmp_path / "a.mcap", f"/map/{topic}")[0]["timestamp"]["nsec"]
        for topic in ("static", "clearance", "risk")
    }
    assert stamps == {"static": 660_000_000, "clearance": 600_000_000, "risk": 600_000_000}


def test_depth_images_are_millimetres(log_path, snaps):
    image = logged_image(by_topic(log_path, "/camera/depth")[2])
    assert image.dtype == np.uint16
    np.testing.assert_allclose(image, snaps[50]["image.depth_m"] * 1000.0, atol=DEPTH_ROUNDING_MM)


def test_frames_chain_from_the_world_to_a_level_sonar_and_an_optical_camera(log_path, snaps):
    transforms = {t["child_frame_id"]: t for t in by_topic(log_path, "/tf")[77]["transforms"]}
    assert {name: t["parent_frame_id"] for name, t in transforms.items()} == {
        "base": "world",
        "sonar": "base",
        "camera": "base",
    }
    rotation = {name: _matrix(t["rotation"]) for name, t in transforms.items()}
    yaw = snaps[77]["ego.rpy"][2]
    level = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(rotation["base"] @ rotation["sonar"], level, atol=1e-6)
    np.testing.assert_allclose(rotation["camera"] @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # depth along body x
    # image right = body right
    np.testing.assert_allclose(rotation["camera"] @ [1, 0, 0], [0, -1, 0], atol=1e-12)


def _matrix(q):
    w, x, y, z = (q[name] for name in "wxyz")
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_the_scenario_gives_every_obstacle_at_any_time(log_path):
    scenario = read_head(log_path).scenario
    for message in read_messages(log_path, ["/obstacles/truth"]):
        for body, seen in zip(scenario["obstacles"], message.data["obstacles"], strict=True):
            at = obstacle_positions(body, np.array([message.time_s]))[0]
            np.testing.assert_allclose([seen["x"], seen["y"], seen["z"]], at, atol=CLOSED_FORM_M)
            assert seen["kind"] == body["kind"]
            if body["path"]:
                np.testing.assert_allclose(at[:2], path_position(body["path"], message.time_s), atol=1e-12)
                assert math.hypot(seen["vx"], seen["vy"]) == pytest.approx(
                    body["path"]["speed_m_s"], abs=2e-3
                )


def test_null_stands_only_where_something_does_not_exist(log_path):
    safety, policy, action = (by_topic(log_path, topic) for topic in ("/safety", "/policy", "/action"))
    assert safety[0]["ttc_s"] == pytest.approx(2.3) and safety[1]["ttc_s"] is None
    assert policy[0]["value"] is None and policy[0]["alive"] == pytest.approx(0.01)
    assert policy[0]["reward"] == pytest.approx(sum(policy[0][name] for name in episode.TERMS))
    assert action[0]["policy"] is None and action[0]["behavior"] == pytest.approx([0.8, 0.0, 0.1, -0.2])
    assert action[75]["leaf"] == "Evade"


def test_replans_say_who_planned_and_why(log_path):
    first, second = by_topic(log_path, "/plan/info")
    assert (first["planner"], first["trigger"], first["fallback"]) == ("voronoi", "initial", "")
    assert (second["planner"], second["trigger"], second["fallback"]) == ("rrt", "stuck", "disconnected")
    lines = [entry["message"] for entry in by_topic(log_path, "/log")]
    assert "stuck" in lines[1] and "rrt" in lines[1] and lines[-1] == "outcome: success"


def test_tree_names_stay_apart(log_path):
    assert dataclasses.replace(episode.header(), tree_nodes=("A", "B", "A")).nodes == ("A", "B", "A#2")
    assert by_topic(log_path, "/tree")[0] == {
        "Root": "SUCCESS",
        "Emergency": "FAILURE",
        "Back off": "IDLE",
        "Evade": "FAILURE",
        "Follow": "SUCCESS",
        "Follow#5": "IDLE",
    }


def test_kinds_are_those_of_the_simulator():
    assert KIND_NAMES == {geometry.SPHERE: "sphere", geometry.CYLINDER: "cylinder", geometry.BOX: "box"}


@pytest.mark.parametrize("field", [
    "vehicle.pos_w", "ego.pos_w", "scan.range_m", "vehicle.rpm", "world.pos_w", "tracks.state",
])  # fmt: skip
@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_numbers_that_are_not_finite_are_refused(tmp_path, snaps, field, bad):
    with (
        McapEpisodeLog(tmp_path / "a.mcap", episode.header()) as log,
        pytest.raises(ValueError, match="not finite"),
    ):
        log.write(snaps[0] | {field: np.full_like(snaps[0][field], bad)})


def test_due_asks_for_maps_at_2_hz_on_replans_and_at_the_end(tmp_path, snaps):
    def due(log, step, **changes):
        signs = {name: snaps[step][name] for name in SIGNS} | {"route.plan_step": -1} | changes
        return {topic.name for topic in log.due(signs)}

    with McapEpisodeLog(tmp_path / "a.mcap", episode.header(), depth_images=True) as log:
        asked = []
        for step, snap in enumerate(snaps[:60]):
            asked += [step] if "/map/static" in due(log, step) else []
            log.write(snap | {name: snaps[0][name] for name in LAYERS})
        assert asked == [0, 25, 50]
        assert "/map/static" not in due(log, 60)
        assert "/map/static" in due(log, 60, **{"route.plan_step": 60})
        assert {"/map/static", "/obstacles", "/log"} <= due(log, 60, **{"termination.outcome": 1})
        assert "/camera/depth" in due(log, 75) and "/camera/depth" not in due(log, 74)
        assert "/camera/depth" not in due(log, 75, **{"image.fresh": 0})
    with McapEpisodeLog(tmp_path / "b.mcap", episode.header()) as log:
        assert "/camera/depth" not in due(log, 0) and "/camera/line" in due(log, 0)


def test_every_topic_reads_what_the_state_has():
    """A name that is wrong would leave its topic out of logs written by hand; here it is found."""
    structs = typing.get_type_hints(SimState)
    outputs = {"agent.applied", *NO_POLICY}
    for topic in TOPICS:
        for name in {*topic.reads, *topic.when.reads} - outputs:
            struct, field = name.split(".")
            fields = {f.name for f in dataclasses.fields(structs[struct])}
            assert field in fields, f"{topic.name} reads {name}"
    assert len({topic.name for topic in TOPICS}) == len(TOPICS)


def test_encoders_look_at_what_their_row_says_and_nothing_else(snaps):
    """So the recorder reads it: what is not named is not there."""
    always = {"clock.step"}
    for topic in TOPICS:
        named = {name: snaps[0][name] for name in {*always, *topic.reads, *topic.when.reads}}
        seen = Watched(named)
        topic.encode(Moment(episode.header(), seen))
        assert seen.asked | always >= set(topic.reads), (
            f"{topic.name} needs no {set(topic.reads) - seen.asked}"
        )


class Watched(dict):
    """Remembers what was asked for."""

    def __init__(self, values):
        super().__init__(values)
        self.asked = set()

    def __getitem__(self, name):
        self.asked.add(name)
        return super().__getitem__(name)


@pytest.mark.parametrize("world", ["pool", "netpen", "maze"])
def test_the_map_lies_where_the_kernels_put_it(world):
    config = load_config(world)
    tank, cell_m = config.world.tank, config.mapping.cell_m
    assert map_origin(config, grid.grid_shape(tank, cell_m)) == grid.grid_origin(tank, cell_m)


# ---------------------------------------------------------------------------------------------------- viewers


def test_schemas_keep_to_what_the_viewers_parse(log_path):
    """Lichtblick's: one plain type per property or a choice of numbers; flat lists."""

    def check(schema, where):
        assert schema["type"] == "object", where
        for name, inner in schema["properties"].items():
            if "oneOf" in inner:
                assert all(isinstance(choice["const"], int) for choice in inner["oneOf"]), (where, name)
                continue
            assert inner["type"] in ("boolean", "string", "number", "integer", "object", "array"), (
                where,
                name,
            )
            if inner["type"] == "object":
                check(inner, f"{where}.{name}")
            if inner["type"] == "array":
                assert inner["items"]["type"] in ("boolean", "string", "number", "integer", "object"), (
                    where,
                    name,
                )
                if inner["items"]["type"] == "object":
                    check(inner["items"], f"{where}.{name}")

    with log_path.open("rb") as file:
        schemas = make_reader(file).get_summary().schemas.values()
    assert len(schemas) == len({topic.schema_for(episode.header())["title"] for topic in TOPICS}) >= 17
    for schema in schemas:
        check(json.loads(schema.data), schema.name)


def test_the_viewers_own_reader_decodes_everything(log_path):
    found = read_by_viewer(log_path)
    assert found["unlikeOfficial"] == []
    assert found["counts"] == {entry["topic"]: entry["messages"] for entry in info(log_path)["topics"]}
    assert found["metadata"] == ["uuv.run", "uuv.result"]
    assert found["attachments"] == ["config.yaml", "scenario.json"]


def test_the_layout_shows_only_topics_that_exist():
    layout = json.loads(
        (Path(sys.modules["uuvtai"].__file__).parent / "presets/layout/navigation.json").read_text()
    )
    panels = layout["configById"]
    topics = set(panels["3D!scene"]["topics"])
    for panel in panels.values():
        topics |= {path["value"].partition(".")[0] for path in panel.get("paths", [])}
    topics.add(panels["RawMessages!tree"]["topicPath"])
    assert topics <= {*SCHEMAS, "/plan/lookahead"}
    assert _leaves(layout["layout"]) == set(panels)


def _leaves(node):
    return {node} if isinstance(node, str) else _leaves(node["first"]) | _leaves(node["second"])


# ----------------------------------------------------------------------------------------- kills and failures


def test_the_file_gets_its_name_only_when_it_is_complete(tmp_path, snaps):
    path = tmp_path / "new" / "a.mcap"
    log = McapEpisodeLog(path, episode.header())
    log.write(snaps[0])
    (part,) = path.parent.iterdir()
    assert part.match("a.mcap.????????.part")
    log.close(episode.result(0))
    assert path.exists() and not part.exists()


def test_an_abandoned_log_stays_as_part_and_can_be_repaired(tmp_path, snaps):
    path = tmp_path / "a.mcap"
    with pytest.raises(KeyboardInterrupt), McapEpisodeLog(path, episode.header()) as log:
        for snap in snaps[:30]:
            log.write(snap)
        raise KeyboardInterrupt
    assert not path.exists()
    (part,) = tmp_path.iterdir()
    saved = repair(part, path)
    assert part.exists()
    assert saved.last_time_s == pytest.approx(29 * episode.DT) and not saved.complete
    assert len(by_topic(path, "/pose")) == 30


CHILD = """
import sys
from pathlib import Path
from tests.oracles import logs as episode
from tests.oracles.world import path_position
from uuvtai.logs import container
from uuvtai.logs.writer import McapEpisodeLog
sent, add = 0, container.McapFile.add_message
def counted(self, *arguments):
    global sent
    sent += 1
    print(sent, flush=True)
    add(self, *arguments)
container.McapFile.add_message = counted
with McapEpisodeLog(Path(sys.argv[1]), episode.header()) as log:
    for snap in episode.snapshots(3000, maps=False):
        log.write(snap)
"""


def test_sigkill_loses_at_most_one_percent(tmp_path):
    path, kill_at = tmp_path / "a.mcap", 3001
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path)], cwd=root, env=environment, stdout=subprocess.PIPE
    ) as child:
        for line in child.stdout:
            if int(line) >= kill_at:
                child.send_signal(signal.SIGKILL)
                break
        sent = int((child.stdout.read().split() or [kill_at])[-1])
    (part,) = tmp_path.iterdir()
    before = part.read_bytes()
    saved = repair(part)
    assert saved.path == tmp_path / "a.repaired.mcap"
    assert part.read_bytes() == before
    assert saved.messages >= 0.99 * sent
    # the official reader agrees, with indexes and checksums
    assert len(messages(saved.path)) == saved.messages
    head = read_head(saved.path)
    assert next(iter(head.metadata)) == "uuv.run" and "uuv.result" not in head.metadata
    assert head.metadata["uuv.repair"]["messages"] == str(saved.messages)
    assert info(saved.path)["outcome"] is None


def test_a_file_cut_anywhere_gives_back_a_prefix(log_path, tmp_path):
    """Every chunk that is whole, and nothing else."""
    whole, data = log_path.read_bytes(), [m[4] for m in messages(log_path)]
    with log_path.open("rb") as file:
        ends = [
            (index.chunk_start_offset + index.chunk_length)
            for index in make_reader(file).get_summary().chunk_indexes
        ]
    sizes = [
        sum(isinstance(record, Message) for record in breakup_chunk(chunk)) for chunk in chunks_of(log_path)
    ]
    recovered = []
    for i, cut in enumerate(np.linspace(ends[0], len(whole), 6).astype(int)):
        path = tmp_path / f"{i}.mcap"
        path.write_bytes(whole[:cut])
        saved = repair(path, tmp_path / f"{i}.out.mcap")
        assert [m[4] for m in messages(saved.path)] == data[: saved.messages]
        assert saved.messages == sum(size for size, end in zip(sizes, ends, strict=True) if end <= cut)
        assert saved.complete == (cut == len(whole)) == ("uuv.repair" not in read_head(saved.path).metadata)
        recovered.append(saved.messages)
    assert recovered == sorted(recovered) and recovered[-1] == len(data)


@pytest.mark.parametrize("number", [0, 4])
def test_a_damaged_chunk_costs_only_itself(log_path, tmp_path, number):
    """The first one too, which declares the channels: the summary repeats them."""
    with log_path.open("rb") as file:
        index = make_reader(file).get_summary().chunk_indexes[number]
    spoiled = bytearray(log_path.read_bytes())
    middle = index.chunk_start_offset + index.chunk_length // 2
    spoiled[middle : middle + 8] = b"\xff" * 8
    (tmp_path / "a.mcap").write_bytes(spoiled)
    with pytest.raises(LogError, match="uuv log repair"):
        info(tmp_path / "a.mcap")
    saved = repair(tmp_path / "a.mcap")
    original = {(m[0], m[2], m[4]) for m in messages(log_path)}
    kept = {(m[0], m[2], m[4]) for m in messages(saved.path)}
    assert kept < original and len(saved.damages) == 1
    lost = {time for _, time, _ in original - kept}
    assert min(lost) >= index.message_start_time and max(lost) <= index.message_end_time
    assert read_head(saved.path).metadata["uuv.result"]["outcome"] == "success"


def test_repair_never_overwrites(log_path, tmp_path):
    (tmp_path / "b.mcap").write_text("mine")
    before = log_path.read_bytes()
    with pytest.raises(FileError, match="already there"):
        repair(log_path, tmp_path / "b.mcap")
    assert (tmp_path / "b.mcap").read_text() == "mine"
    for force in (False, True):
        with pytest.raises(FileError, match="is what is read here"):
            repair(log_path, log_path, force)
    assert log_path.read_bytes() == before
    assert repair(log_path, tmp_path / "b.mcap", force=True).complete


@pytest.mark.parametrize(
    "content", [b"", b"\x89MCAP0\r\n", b"not a log at all", b"\x89MCAP0\r\n" + b"\x07" * 300]
)
def test_files_without_anything_in_them(tmp_path, content):
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(LogError, match=r"a\.mcap") as refused:
        info(tmp_path / "a.mcap")
    assert ("is not an MCAP file" in str(refused.value)) is not content.startswith(b"\x89MCAP0\r\n")
    assert ("uuv log repair" in str(refused.value)) is content.startswith(b"\x89MCAP0\r\n")
    with pytest.raises(LogError, match=r"nothing can be recovered|is not an MCAP file"):
        repair(tmp_path / "a.mcap", tmp_path / "out.mcap")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize(
    "tool",
    [info, repair, lambda path: export(path, path.parent / "out"), lambda path: list(read_messages(path))],
)
def test_a_missing_file_is_named(tmp_path, tool):
    with pytest.raises(LogError, match=r"nowhere\.mcap.*cannot open"):
        tool(tmp_path / "nowhere.mcap")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def full_disk(monkeypatch):
    """/dev/full takes the place of unfinished files."""
    monkeypatch.setattr(
        "uuvtai.logs.container.open_new", lambda _path: os.fdopen(os.open("/dev/full", 1), "wb")
    )


WRITERS = {
    "recording": lambda out: _recorded(McapFile(out)),
    "repair": lambda out: repair(_sound(out), out),
    "picture": lambda out: save_image(np.zeros((8, 8, 3), np.uint8), out),
    "result": lambda out: write_atomic(out, b"new"),
    "export": lambda out: export(_sound(out), out),
}
"""of unfinished files beside ``out``"""


def _recorded(file):
    file.add_message(file.add_channel("/t", 0), 0, b"{}")
    file.finish()


def _sound(out):
    _recorded(McapFile(out.parent.parent / "sound.mcap"))
    return out.parent.parent / "sound.mcap"


@pytest.mark.parametrize("kind", WRITERS)
def test_an_unfinished_file_is_never_somebody_elses(tmp_path, monkeypatch, kind):
    """Where its random part was guessed, too, a planted link is not written through, and no file is lost."""
    out, mine = tmp_path / "archive" / "a.mcap", tmp_path / "mine"
    out.parent.mkdir()
    mine.write_text("precious")
    names = [
        f"{hidden}a.mcap{token}{ending}"
        for hidden in ("", ".")
        for token in ("", ".00000000", f".{os.getpid()}")
        for ending in (".part", ".tmp", ".repairing", ".partial")
    ]
    for name in names[::2]:
        (out.parent / name).symlink_to(mine)
    for name in names[1::2]:
        (out.parent / name).write_text("precious")
    with monkeypatch.context() as guessed, pytest.raises((FileExistsError, LogError)):
        guessed.setattr("secrets.token_hex", lambda _n: "00000000")
        WRITERS[kind](out)
    WRITERS[kind](out)
    assert mine.read_text() == "precious" and out.exists()
    assert sorted(path.name for path in out.parent.iterdir()) == sorted([*names, "a.mcap"])
    assert all((out.parent / name).read_text() == "precious" for name in names)


def test_a_full_disk_leaves_nothing(tmp_path, snaps, full_disk):
    path = tmp_path / "a.mcap"
    with (
        pytest.raises(LogError, match=r"a\.mcap: cannot write the log \(No space left"),
        McapEpisodeLog(path, episode.header()) as log,
    ):
        for snap in snaps:
            log.write(snap)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_during_repair_leaves_nothing(log_path, tmp_path, full_disk):
    with pytest.raises(LogError, match="cannot write the repaired log"):
        repair(log_path, tmp_path / "b.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(LogError, match="cannot write the log"):
        McapEpisodeLog(tmp_path / "file" / "logs" / "a.mcap", episode.header())


# ---------------------------------------------------------------------------------------------- other writers


@pytest.mark.parametrize("words", [
    {"use_chunking": False},
    {"compression": CompressionType.LZ4},
    {"compression": CompressionType.NONE, "enable_data_crcs": True},
    {"index_types": IndexType.NONE, "repeat_channels": False, "use_statistics": False},
], ids=str)  # fmt: skip
def test_records_of_other_writers_are_read(tmp_path, words):
    """Small messages, and one of 24.9 MB, as a raw image of 3840 x 2160 pixels has."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, **words)
        writer.start()
        schema = writer.register_schema("uuv.Safety", "jsonschema", b"{}")
        channel = writer.register_channel("/safety", "json", schema)
        for i, size in enumerate((5, 24_900_000, 7)):
            writer.add_message(channel, i, json.dumps({"x": "-" * size}).encode(), i)
        writer.finish()
    assert [len(m.data["x"]) for m in read_messages(path)] == [5, 24_900_000, 7]
    assert repair(path).complete


# ----------------------------------------------------------------------------------------------------- export


def test_export_as_json_lines(log_path, tmp_path):
    found = export(log_path, tmp_path / "out")
    files = {path.name: path for path in found}
    lines = [json.loads(line) for line in files["safety.jsonl"].read_text().splitlines()]
    expected = [{"t": m.time_s, **m.data} for m in read_messages(log_path, ["/safety"])]
    assert lines == expected
    assert {"config.yaml", "scenario.json", "metadata.json", "map_static.jsonl"} <= files.keys()
    assert files["config.yaml"].read_bytes() == episode.header().config_yaml.encode()
    assert sorted(path for path in (tmp_path / "out").rglob("*") if path.is_file()) == found
    assert files["config.yaml"].parent == tmp_path / "out" / "attachments"


def test_export_as_csv(log_path, tmp_path):
    files = {path.name: path for path in export(log_path, tmp_path / "out", ["/state", "/safety"], fmt="csv")}
    head, first, second = files["safety.csv"].read_text().splitlines()[:3]
    assert head == "t,clearance_m,ttc_s,path_risk,replan_trigger"
    assert first.split(",")[2] == "2.29999995" and second.split(",")[2] == ""  # null is empty
    table = np.genfromtxt(files["state.csv"], delimiter=",", names=True)
    assert len(table) == N_STEP + 1 and table["position0"][0] == pytest.approx(episode.START[0])


def test_export_as_arrays(log_path, tmp_path, snaps):
    topics = ["/sonar/scan", "/map/static", "/camera/depth", "/log", "/safety"]
    files = {path.name: path for path in export(log_path, tmp_path / "out", topics, fmt="npz")}
    scan, grid, image, events, safety = (
        np.load(files[f"{name}.npz"])
        for name in ("sonar_scan", "map_static", "camera_depth", "log", "safety")
    )
    assert scan["ranges"].shape == (N_STEP + 1, episode.N_RAY)
    np.testing.assert_array_equal(grid["value"][-1], occupancy(snaps[-1]["grid_map.static_occ"]))
    assert image["depth_mm"].shape[1:] == (72, 128)
    assert events["file"].shape == (3,)
    assert np.isnan(safety["ttc_s"][1])


def test_export_of_an_unknown_topic_or_format(log_path, tmp_path):
    with pytest.raises(LogError, match=r"/nothing; it has .*/pose"):
        export(log_path, tmp_path / "out", ["/nothing"])
    with pytest.raises(LogError, match="json, csv, npz"):
        export(log_path, tmp_path / "out", fmt="xls")
    assert not (tmp_path / "out").exists()


def test_export_where_nothing_can_be_written(log_path, tmp_path):
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(FileError, match="is already there"):
        export(log_path, tmp_path / "out")
    with pytest.raises(LogError, match="cannot write the export"):
        export(log_path, tmp_path / "out" / "deeper")
    assert (tmp_path / "out").read_text() == "in the way"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def hostile_log(path, topic="/a", data=b'{"x":1}', names=()):
    file = McapFile(path)
    for name in names:
        file.add_attachment(name, "text/plain", name.encode())
    file.add_message(file.add_channel(topic, file.add_schema("s", "jsonschema", b"{}")), 0, data)
    file.finish()
    return path


def test_names_in_a_log_cannot_leave_the_folder(tmp_path):
    names = ["../../evil", "/etc/evil", "..\\evil", "..", "a/b", ".hidden", "x" * 300, "metadata.json"]
    path = hostile_log(tmp_path / "a.mcap", topic="/../../outside", names=names)
    out = tmp_path / "deep" / "out"
    files = export(path, out)
    assert len(files) == len(names) + 2
    assert {file.parent for file in files} == {out, out / "attachments"}
    assert all(file.is_file() and not file.name.startswith(".") for file in files)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.mcap", "deep"]
    assert file_name("..") == file_name("/") == file_name("") == "unnamed"


@pytest.mark.parametrize("data", [b"not json", b'{"cell_stride":8}', b'{"format":"png","data":"AAAA"}'])
def test_messages_unlike_their_schema_are_reported(tmp_path, data):
    path = hostile_log(tmp_path / "a.mcap", data=data)
    with pytest.raises(LogError):
        export(path, tmp_path / "out", fmt="npz")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


def test_info_counts_what_is_there(log_path):
    found = info(log_path)
    assert found["messages"] == len(messages(log_path)) == sum(entry["messages"] for entry in found["topics"])
    assert found["duration_s"] == pytest.approx(N_STEP * episode.DT) and found["outcome"] == "success"
    assert found["bytes"] == log_path.stat().st_size
    json.dumps(found, allow_nan=False)
