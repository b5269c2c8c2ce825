"""The player of recorded episodes: what it holds is the log's, small, harmless, and drawn in its place."""

import base64
import copy
import hashlib
import json
import re
import struct
import zlib
from importlib.resources import files

import numpy as np
import pytest

from tests import browser
from tests import report_samples as samples
from tests.oracles import logs as episode
from uuvtai.common.obstacle_motion import obstacle_positions
from uuvtai.logs import drawing
from uuvtai.logs.encode import LogError
from uuvtai.logs.writer import McapEpisodeLog
from uuvtai.report import recorded
from uuvtai.report.build import media, report
from uuvtai.report.recorded import Fact, packed_agent, packed_episode, packed_scene

N_STEP = 160
TEN = np.linspace(0.0, N_STEP * episode.DT, 10)
FACT = Fact("late detection", "seen too late", 4)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with two agents on one recorded episode; ``straight`` failed."""
    folder = tmp_path_factory.mktemp("player") / "run"
    cause = samples.CAUSE | {"label": "late_detection", "meaning": "seen too late"}
    row = {"seed": 0, "episode": 3, "label": "late_detection", "touched": {"slot": 4}}
    straight = samples.agent("straight", 3, 5, causes=[cause], explain=[row])
    samples.write_run(folder, eval__result=samples.evaluation_document(samples.agent("bt"), straight))
    (folder / "logs").mkdir()
    episode.record(folder / "logs/bt_seed0_episode3.mcap", N_STEP)
    described = episode.header("straight")
    episode.record(folder / "logs/straight_seed0_episode3.mcap", 90, described, "collision", sway=-0.9)
    return folder


@pytest.fixture(scope="module")
def log(run):
    return drawing.load_recording(run / "logs/bt_seed0_episode3.mcap")


def unpacked(blob):
    """(header, arrays (rows, columns)) of a blob."""
    raw = zlib.decompress(base64.b64decode(blob, validate=True))
    (length,) = struct.unpack_from("<I", raw)
    header, data, arrays = json.loads(raw[4 : 4 + length]), raw[4 + length :], {}
    for name, entry in header["arrays"].items():
        n, width = entry["rows"] * entry["columns"], entry["bytes"]
        planes = np.frombuffer(data, np.uint8, n * width, entry["at"]).reshape(width, n)
        flat = np.ascontiguousarray(planes.T).view(f"<i{width}").reshape(entry["columns"], -1).T
        arrays[name] = np.cumsum(flat.astype(np.int64), axis=0) * entry["step"]
    return header, arrays


def as_of(arrays, name, time_s):
    """(index, rows) of the newest moment's rows of a series."""
    i = int(np.searchsorted(arrays[f"{name}.time"][:, 0], time_s + 1e-6)) - 1
    ends = np.cumsum(arrays[f"{name}.rows"][:, 0]).astype(int)
    return i, arrays[f"{name}.of"][ends[i - 1] if i else 0 : ends[i]] if i >= 0 else None


@pytest.fixture(scope="module")
def held(log):
    """(header, arrays) of what the player is given of the log."""
    return unpacked(packed_agent(log, "#0072b2", FACT))


@pytest.mark.parametrize("time_s", TEN)
def test_a_frame_is_the_logs(log, held, time_s):
    header, arrays = held
    step = int(np.searchsorted(arrays["time"][:, 0], time_s + 1e-6)) - 1
    pose, safety = log["/pose"].at(time_s), log["/safety"].at(time_s)
    assert arrays["pose"][step] == pytest.approx(pose, abs=recorded.PLACE_M)
    assert arrays["clearance"][step, 0] == pytest.approx(safety[0], abs=recorded.PLACE_M)
    assert arrays["ttc"][step, 0] == pytest.approx(
        -1 if safety[1] is None else min(safety[1], 100), abs=0.006
    )
    assert arrays["speed"][step, 0] == pytest.approx(log["/state"].at(time_s), abs=recorded.SPEED_M_S)
    assert header["leaves"][int(arrays["leaf"][step, 0])] == log["/action"].at(time_s)
    route, _ = log["/plan/info"].at(time_s)
    assert as_of(arrays, "route", time_s)[1] == pytest.approx(route, abs=0.011)
    assert arrays["ahead"][step] == pytest.approx(log["/plan/lookahead"].at(time_s), abs=0.011)


@pytest.mark.parametrize("time_s", TEN)
def test_a_map_is_the_logs(log, held, time_s):
    header, arrays = held
    grid = header["grid"]
    for name, step in (("static", recorded.SHARE), ("dynamic", recorded.SHARE), ("clearance", 0.1)):
        layer, cells = log[f"/map/{name}"].at(time_s), np.zeros(grid["rows"] * grid["columns"])
        times = arrays[f"map_{name}.time"][:, 0]
        n_shown = np.searchsorted(times, time_s + 1e-6)
        n_change = int(arrays[f"map_{name}.rows"][:n_shown].sum())
        for cell, value in zip(
            arrays[f"map_{name}.of"][:n_change, 0], arrays[f"map_{name}.value"][:n_change, 0], strict=True
        ):
            cells[int(cell)] = value * step
        assert cells == pytest.approx(layer.values.ravel(), abs=step / 2 + 1e-6)


def test_returns_tracks_and_forecasts_are_the_logs(log, held):
    _, arrays = held
    for time_s in arrays["echoes.time"][:, 0]:
        assert as_of(arrays, "echoes", time_s)[1] == pytest.approx(log.echoes(time_s), abs=0.011)
    for time_s in arrays["tracks.time"][:, 0]:
        tracks = log["/tracks"].at(time_s)
        assert as_of(arrays, "tracks", time_s)[1] == pytest.approx(tracks[:, :6], abs=recorded.TRACK_M)
    assert len(arrays["tracks.cov"]) == len(arrays["tracks.of"]) > 50
    assert len(arrays["futures.weight"]) == len(arrays["futures.of"]) > 0


def test_what_the_camera_saw_is_the_logs(tmp_path):
    with McapEpisodeLog(tmp_path / "a.mcap", episode.header(), depth_images=True) as written:
        for snap in episode.snapshots(60):
            written.write(snap)
        written.close(episode.result(60))
    log = drawing.load_recording(tmp_path / "a.mcap")
    _, arrays = unpacked(packed_agent(log, "#0072b2", FACT))
    images = log["/camera/depth"]
    assert arrays["camera.time"][:, 0] == pytest.approx(images.times, abs=1e-3) and len(images.times) > 1
    for packed_m, image_mm in zip(arrays["camera.of"] * 10 / 31, images.values, strict=True):
        coarse_m = image_mm.reshape(36, 2, 64, 2).mean(axis=(1, 3)) / 1000
        assert packed_m.reshape(36, 64) == pytest.approx(coarse_m, abs=5 / 31 + 0.001)


def test_obstacles_are_where_the_log_says(log):
    header, arrays = unpacked(packed_scene([log]))
    moving = [one for one in log.scenario["obstacles"] if one["path"]]
    for obstacle, columns in zip(moving, np.split(arrays["places"], len(moving), axis=1), strict=True):
        wanted = obstacle_positions(obstacle, arrays["time"][:, 0])[:, :2]
        assert columns == pytest.approx(wanted, abs=recorded.PLACE_M)
    assert [one["moves"] for one in header["obstacles"]] == [False, False, False, True, True]


def test_an_episode_is_small(run, log):
    blobs = packed_episode(sorted(run.glob("logs/*.mcap")), ["bt"], lambda name: FACT)
    assert len(blobs) == 3 and max(map(len, blobs)) < 20_000 * log.duration_s


def test_what_is_too_much_is_left_out(log, monkeypatch):
    monkeypatch.setattr(recorded, "RECORDING_BYTES", 9_000)
    blob = packed_agent(log, "#0072b2", FACT)
    header, arrays = unpacked(blob)
    assert len(blob) <= 9_000 and header["left_out"][0] == "echoes"
    assert "pose" in arrays and "echoes.of" not in arrays


def test_of_a_replay_nothing_is_told_that_nobody_knows(log):
    replayed = copy.deepcopy(log)
    replayed.head.metadata["uuv.result"] = {"outcome": drawing.REPLAYED}
    told, known = (unpacked(packed_agent(one, "#0072b2", FACT))[1] for one in (replayed, log))
    assert known.keys() - told.keys() == {"clearance", "ttc"} and "speed" in told


EVIL = "</script><script>alert(1)</script>"
CRAFTED = {
    "a name": lambda log: log.head.metadata.update({"uuv.run": {"agent": EVIL}}),
    "an outcome": lambda log: log.head.metadata.update({"uuv.result": {"outcome": EVIL * 1000}}),
    "a node": lambda log: log["/action"].values.__setitem__(3, EVIL),
    "a kind": lambda log: log.scenario["obstacles"][0].update(kind=EVIL),
    "a shape": lambda log: log.scenario["tank"].update(shape=EVIL),
    "zeros": lambda log: log["/tracks"].values.__setitem__(0, np.zeros((500_000, 9))),
}  # fmt: skip
REFUSED = {
    "no number": lambda log: log["/pose"].values.__setitem__(1, (float("nan"),) * 4),
    "far away": lambda log: log["/pose"].values.__setitem__(1, (1e300,) * 4),
    "a depth": lambda log: log.scenario["tank"].update(z_m=[0, 0]),
    "a goal": lambda log: log.scenario.update(goal=["x", "y", "z"]),
    "a radius": lambda log: log.scenario.update(goal_radius_m=float("inf")),
    "maps": lambda log: log["/map/dynamic"].values.__setitem__(
        1, drawing.Layer.of(np.zeros((3, 3)), (0, 0), 0.1)
    ),
}


def packed(run, change):
    log = drawing.load_recording(run / "logs/straight_seed0_episode3.mcap")
    change(log)
    with drawing.drawing(log.path):
        return [packed_scene([log]), packed_agent(log, "#0072b2", FACT)]


@pytest.mark.parametrize("change", CRAFTED.values(), ids=CRAFTED)
def test_what_a_log_says_is_bounded_and_no_markup(run, change):
    for blob, most in zip(packed(run, change), (recorded.SCENE_BYTES, recorded.RECORDING_BYTES), strict=True):
        assert len(blob) <= most and re.fullmatch(rb"[A-Za-z0-9+/=]+", blob)
        _, arrays = unpacked(blob)
        assert sum(values.size for values in arrays.values()) < 4_000_000


@pytest.mark.parametrize("change", REFUSED.values(), ids=REFUSED)
def test_a_log_that_cannot_be_shown_says_so(run, change):
    with pytest.raises(LogError, match="cannot be drawn"):
        packed(run, change)


# ------------------------------------------------------------------------------------------------------- page


@pytest.fixture(scope="module")
def page(run):
    return report([run]).page


def test_the_one_script_is_the_packages_and_allowed_by_its_digest(page):
    html = page.read_text()
    scripts = re.findall(r"<script([^>]*)>(.*?)</script>", html, re.DOTALL)
    assert [attributes for attributes, _ in scripts][-1] == ' type="module"'
    assert all('type="text/plain"' in attributes for attributes, _ in scripts[:-1])
    digest = base64.b64encode(hashlib.sha256(scripts[-1][1].encode()).digest()).decode()
    assert f"script-src &#39;sha256-{digest}&#39;" in html or f"script-src 'sha256-{digest}'" in html
    modules = [m.read_text() for m in (files("uuvtai") / "report" / "player").iterdir()]
    assert sum(map(len, modules)) < 150_000
    asks = r"\bfetch\b|XMLHttpRequest|innerHTML|\beval\b|https?:"
    assert not re.search(asks + "|WebSocket", scripts[-1][1]), "a report asks nobody for anything"
    for module in modules:
        assert "</script" not in module and "<!--" not in module and not re.search(asks, module)


def test_the_report_begins_with_what_it_says(page):
    html = page.read_text()
    places = [
        html.index(words)
        for words in (
            "bt reached the goal in 6 of 8 episodes (12.0 s on average), straight in 3 (10.5 s).",
            "World pool", 'class="player"', "Agents. Collision counts", "Planning",
        )
    ]  # fmt: skip
    assert places == sorted(places)
    assert "<h1>bt, straight in pool</h1>" in html


def test_a_damaged_log_is_named_and_its_picture_shown(run, tmp_path):
    folder = samples.write_run(
        tmp_path / "cut", eval__result=samples.evaluation_document(samples.agent("bt"))
    )
    for place in ("logs", "pictures"):
        (folder / place).mkdir()
    content = (run / "logs/bt_seed0_episode3.mcap").read_bytes()
    (folder / "logs/bt_seed0_episode3.mcap").write_bytes(content[: len(content) // 2])
    (folder / "pictures/seed0_episode3.png").write_bytes(b"PNG")
    player, _, pictures = media(folder, samples.evaluation_document(samples.agent("bt")))
    assert player.episodes == [] and "bt_seed0_episode3.mcap (cannot be shown" in player.note
    assert [item.name for item in pictures.items] == ["pictures/seed0_episode3.png"]


def test_the_modules_without_a_page():
    done = browser.node("--test", "player.test.mjs")
    assert done.returncode == 0, done.stdout


def test_the_player_in_a_browser_shows_the_log(page, log):
    """At ten moments the vehicle is where the log says, to the pixel; keys do what they say."""
    seen = browser.told("play.mjs", page)
    assert seen["errors"] == [] and seen["requests"] == []
    for moment in seen["moments"]:
        x, y, z, yaw = log["/pose"].at(moment["time"])
        assert moment["pose"] == pytest.approx([x, y, z, yaw], abs=recorded.PLACE_M)
        assert moment["clearance"] == pytest.approx(
            log["/safety"].at(moment["time"])[0], abs=recorded.PLACE_M
        )
        place = moment["left"] + moment["scale"] * x, moment["top"] + moment["scale"] * (6.0 - y)
        assert moment["middle"] == pytest.approx(place, abs=0.5)
    pressed = seen["pressed"]
    times = [round(pressed[key]["time"], 3) for key in ("Home", "ArrowRight", "Shift+ArrowRight", "End", "x")]
    assert times == [0, 0.1, 1.1, pytest.approx(log.duration_s, abs=0.01), pytest.approx(1.8, abs=0.05)]
    assert pressed["x"]["words"].startswith("straight: collision after 1.8 s. Late detection: seen too late")
    assert (pressed["2"]["agent"], pressed["+"]["speed"], pressed["l"]["open"]) == (1, 2, False)
    whole, wide, dragged, tapped, again, back = seen["touched"]
    assert whole["metres"] / wide["metres"] == pytest.approx(3) and wide["x"] > 2
    assert dragged["x"] - wide["x"] == pytest.approx(200 / seen["moments"][0]["scale"] / 3, abs=0.02)
    assert [one["playing"] for one in (dragged, tapped, again)] == [False, True, False] and back == whole
