"""The page of running episodes: who may look and who steers, what is shown, and the whole in Chromium."""

import base64
import contextlib
import json
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

from tests import browser
from tests.command import uuv
from tests.small_sim import SmallSim
from uuvtai.evaluation.episodes import Job
from uuvtai.live import server as live_server
from uuvtai.live.page import STALE_S, STOP, PageServer
from uuvtai.live.server import MOST_CLIENTS, MOST_WAITING, LiveError
from uuvtai.logs.reader import read_messages
from uuvtai.report.evaluation import limit_of_p, who_arrived
from uuvtai.report.html import live_page
from uuvtai.report.running import RunningEpisodes


@pytest.fixture
def server():
    with PageServer("<p>a page", port=0) as found:
        yield found


@pytest.fixture
def helm():
    """A server whose vehicle is steered, and the clock that it goes by."""
    clock = SimpleNamespace(s=100.0)
    with PageServer("<p>a page", port=0, steered=True, now=lambda: clock.s) as found:
        yield found, clock


def look(server, **options):
    return connect(f"ws{server.url[4:]}/live", max_size=None, ping_interval=None, **options)


def role(client):
    """The newest of all that have come."""
    found = json.loads(client.recv(10))
    with contextlib.suppress(TimeoutError):
        while True:
            found = json.loads(client.recv(0.3))
    assert found["kind"] == "role"
    return found


def until(holds):
    end = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def got(server, path="/", **headers):
    """(status, headers, text)"""
    try:
        with urllib.request.urlopen(
            urllib.request.Request(server.url + path, headers=headers), timeout=20
        ) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read().decode()


def test_the_page_comes_whole_and_may_not_be_framed_or_kept():
    page = live_page("bt in pool", "live")
    with PageServer(page, port=0) as server:
        status, headers, text = got(server)
    assert (status, text) == (200, page) and headers["Content-Type"].startswith("text/html")
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1].replace("&#39;", "'")
    assert policy.startswith("default-src 'none';") and policy.endswith("connect-src 'self'")
    assert not re.search(r"(src|href)=\"?(http|//)", page)


FOREIGN = ["https://evil.example", "null", "http://127.0.0.1:1", "http://127.0.0.1.evil.example", "file://"]


@pytest.mark.parametrize("origin", FOREIGN)
def test_a_page_of_elsewhere_is_turned_away(server, origin):
    with pytest.raises(InvalidHandshake, match="403"):
        look(server, origin=origin)
    assert got(server, Origin=origin)[0] == 403


@pytest.mark.parametrize("host", ["evil.example", "localhost.evil.example", "localhost", "127.0.0.1:1", ""])
def test_a_name_that_leads_here_is_not_served(server, host):
    """DNS rebinding: what is asked for is another host's page."""
    status, _, text = got(server, Host=host)
    assert (status, text) in ((403, f"open {server.url}, or allow this name with --origin\n"), (400, text))
    assert "a page" not in text


def test_names_of_this_host_and_those_allowed_are_served():
    with PageServer("<p>a page", port=0, origins=["http://tank.example:80"]) as server:
        for host in (f"localhost:{server.port}", f"127.0.0.1:{server.port}", "tank.example:80"):
            assert got(server, Host=host)[0] == 200
        with look(server, origin=f"http://localhost:{server.port}") as client:
            assert role(client)["helm"]
        assert got(server, "/etc/passwd")[0] == 404


def test_the_number_of_pages_is_bounded_and_a_place_becomes_free(server):
    clients = [look(server) for _ in range(MOST_CLIENTS)]
    with pytest.raises(InvalidHandshake, match="503"):
        look(server)
    clients[0].close()
    until(lambda: len(server._clients) < MOST_CLIENTS)
    look(server).close()


def test_who_says_nothing_holds_no_place_for_long(server, monkeypatch):
    monkeypatch.setattr(live_server, "_MOST_SOCKETS", 3)
    silent = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(3)]
    until(lambda: len(server._sockets) == 3)
    with pytest.raises((OSError, urllib.error.URLError)):
        got(server)
    for one in silent:
        one.close()
    until(lambda: not server._sockets)
    assert got(server)[0] == 200


def test_four_look_one_never_reads_and_holds_up_nobody(server):
    *readers, never = [look(server) for _ in range(4)]
    until(lambda: len(server._clients) == 4)
    text = json.dumps({"kind": "frame", "tanks": ["x" * 100_000]})
    received = [0, 0, 0]
    for _ in range(3 * MOST_WAITING):
        server.tell(text)
        for i, reader in enumerate(readers):
            while json.loads(reader.recv(30))["kind"] != "frame":
                pass
            received[i] += 1
    assert received == [3 * MOST_WAITING] * 3, "nothing was left out for those who read"
    until(lambda: len(server._clients) == 3)
    with pytest.raises(ConnectionClosed):
        while True:
            never.recv(10)


NONSENSE = [
    "{", "[]", "3", "{}", '{"follow": 16}', '{"follow": true}', '{"follow": 1, "pause": true}',
    '{"pause": 1}', '{"steer": [0, 0, 0]}', '{"steer": [0, 0, 0, NaN]}', '{"steer": [0, 0, 0, 1e999]}',
    '{"steer": "abcd"}', '{"steer": [0, 0, 0, true]}', '{"' + 900 * "[", 900 * "[", b"\xff\xfe",
]  # fmt: skip
HUGE = ["x" * 2000, b"\0" * 100_000]


@pytest.mark.parametrize(
    ("message", "code"), [*((one, 1008) for one in NONSENSE), *((one, 1009) for one in HUGE)]
)
def test_nonsense_ends_the_page_that_says_it_and_nothing_else(helm, message, code):
    server, _ = helm
    good, strange = look(server), look(server)
    strange.send(message)
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            strange.recv(10)
    assert closed.value.rcvd.code == code
    good.send('{"steer": [1, 0, 0, 0]}')
    until(lambda: server.command() == (1.0, 0.0, 0.0, 0.0))


def test_a_page_that_is_opened_twice_has_one_helm(helm):
    server, _ = helm
    first = look(server)
    assert role(first)["helm"]
    second = look(server)
    assert not role(second)["helm"]
    for asked in ({"steer": [1, 1, 1, 1]}, {"truth": True}, {"pause": False}, {"follow": 0}):
        second.send(json.dumps(asked))
    until(lambda: server.followed() == {-1, 0})
    assert server.command() == STOP and not server.with_truth
    first.send('{"steer": [0.5, 0, 0, -2]}')
    until(lambda: server.command() == (0.5, 0.0, 0.0, -1.0))
    first.close()
    until(lambda: server.command() == STOP)
    assert role(second)["helm"]


def test_who_asks_over_and_over_is_answered_once(server):
    with look(server) as client:
        until(lambda: server._clients)
        for i in range(1000):
            client.send(json.dumps({"follow": i % 16}))
        until(lambda: server.followed() == {999 % 16})
        assert [*server.asked().values()] == [True] and server.asked() == {}


def test_who_is_on_another_machine_looks_and_steers_not(helm):
    server, _ = helm
    with look(server, source_address=("127.9.9.9", 0)) as far:
        assert not role(far)["helm"]


def test_a_command_that_is_too_old_means_stop(helm):
    server, clock = helm
    look(server).send('{"steer": [1, 0, 0, 0]}')
    until(lambda: server.command() != STOP)
    clock.s += STALE_S - 0.01
    assert server.command() != STOP
    clock.s += 0.02
    assert server.command() == STOP


def test_a_steered_vehicle_waits_for_the_first_command_and_for_somebody(helm):
    server, _ = helm
    driver = look(server)
    assert server.is_held(at_start=True) and server.is_held()
    driver.send('{"steer": [0, 0, 0, 0]}')
    driver.send('{"follow": 0}')
    until(lambda: server.followed() == {0})
    assert server.is_held()
    driver.send('{"steer": [0, 0, 0.1, 0]}')
    until(lambda: not server.is_held())
    driver.send('{"pause": true}')
    until(server.is_held)
    driver.send('{"pause": false}')
    until(lambda: not server.is_held())
    driver.close()
    until(server.is_held)


def test_a_port_that_is_taken_is_refused(server):
    with pytest.raises(LiveError, match=rf"http://127.0.0.1:{server.port}: cannot listen there .* --port"):
        PageServer("", port=server.port)


# ---------------------------------------------------------------------------------------------- what is shown


@dataclass(frozen=True)
class Follower:
    tank: int


class Audience:
    """Keeps what it is told; follows tank 0."""

    def __init__(self, with_truth=True):
        self.with_truth, self.newcomers, self.messages = with_truth, {}, []

    def asked(self):
        newcomers, self.newcomers = self.newcomers, {}
        return newcomers

    def followed(self):
        return {0}

    def tell(self, message, tank=None, to=None):
        self.messages.append(json.loads(message))

    def note(self, text):
        pass

    def is_held(self, at_start=False):
        return False

    def of(self, kind):
        return [message for message in self.messages if message["kind"] == kind]


END = SimpleNamespace(outcome="ttc", time_s=1.0)


def shown(small, audience, steps=50, rate=1.0):
    """Two episodes side by side, for a second."""
    small.sim.sleep()
    small.begin([3, 4], seed=77001)
    running = RunningEpisodes(audience, "pool", ["bt"], rate)
    for row, number in enumerate((3, 4)):
        running.begin(small.sim, row, Job(77001, number))
    for _ in range(steps):
        small.sim.step()
        running.step(small.sim)
    return running


@pytest.mark.parametrize(("rate", "count"), [(1.0, 20), (4.0, 5), (0.25, 50)])
def test_twenty_frames_come_in_a_second_of_the_clock(small, rate, count):
    audience = Audience()
    shown(small, audience, rate=rate)
    frames = audience.of("frame")
    assert len(frames) == count and all([tank for tank, _ in frame["tanks"]] == [0, 1] for frame in frames)


def test_a_frame_is_what_the_simulator_has(small):
    audience = Audience()
    running = shown(small, audience)
    sim = small.sim
    newest = dict(audience.of("frame")[-1]["tanks"])
    for row in (0, 1):
        time_s, x, y, z, _yaw, clearance, ttc, _speed, leaf, places = newest[row]
        assert time_s == 1.0 and [x, y, z] == pytest.approx(sim.rows(sim.s.vehicle.pos_w)[row], abs=1e-3)
        assert clearance == pytest.approx(sim.rows(sim.s.termination.clearance_m)[row], abs=1e-3)
        assert ttc == -1 or 0 <= ttc < 1e4
        assert leaf == sim.rows(sim.s.behavior.leaf)[row]
        moving = [one["slot"] for one in audience.of("begin")[row]["scene"]["obstacles"] if one["moves"]]
        assert places == pytest.approx(sim.rows(sim.s.world.pos_w)[row][moving, :2].ravel(), abs=0.01)
    detail = audience.of("detail")
    assert {one["tank"] for one in detail} == {0} and len(detail) == 20
    maps = [one for one in detail if "map" in one]
    assert len(maps) == 2
    cells = np.frombuffer(base64.b64decode(maps[-1]["map"][0]), np.uint8)
    grid = audience.of("begin")[0]["grid"]
    assert cells.size == grid["rows"] * grid["columns"] and 0 < cells.max() <= 31
    assert len(detail[-1]["echoes"]) > 50 and detail[-1]["route"]
    seen = np.frombuffer(base64.b64decode(detail[-1]["camera"]), np.uint8).reshape(36, 64)
    nearest_m = np.minimum(sim.rows(sim.s.image.depth_m)[0].reshape(36, 2, 64, 2).mean(axis=(1, 3)), 10)
    assert seen * 10 / 31 == pytest.approx(nearest_m, abs=1)
    planned = [one["replan"] for one in audience.of("replan") if one["tank"] == 0]
    assert planned[0] == [0, "initial"] and len(planned) == sim.rows(sim.s.route.replans)[0].sum()
    running.end(sim, 0, END)
    assert audience.of("end")[0]["end"] == {"outcome": "TTC stop", "failed": True, "time": 1.0}


def test_who_comes_late_is_told_all_there_was(small):
    audience = Audience()
    running = shown(small, audience)
    audience.messages.clear()
    audience.newcomers = {Follower(1): True, Follower(7): False}
    small.sim.step()
    running.step(small.sim)
    first, second = audience.of("begin")
    assert len(first["rows"]) == 21 and first["rows"][0][0] == 0
    assert second["title"] == "seed 77001, episode 4"
    assert [one["tank"] for one in audience.of("detail")] == [1] and "map" in audience.of("detail")[0]


def test_without_the_truth_nothing_of_it_is_told(small):
    """What is told does not change with what the vehicle cannot know."""
    told = []
    for poison in (False, True):
        audience = Audience(with_truth=False)
        running = shown(small, audience, 10)
        if poison:
            s = small.sim.s
            for field in (s.vehicle.pos_w, s.vehicle.vel_b, s.world.pos_w, s.termination.clearance_m):
                field.fill(7.0)
        audience.messages.clear()
        audience.newcomers = {Follower(-1): True}
        running._show([*running._tanks.values()])
        running._wait()
        told.append(audience.messages)
    assert told[0] == told[1] and told[0][-1]["scene"]["obstacles"] == []
    audience.messages.clear()
    running.end(small.sim, 0, END)
    assert audience.of("begin")[0]["scene"]["obstacles"], "when it is over it does no harm"


# -------------------------------------------------------------------------------------------------- the whole


@contextlib.contextmanager
def command(*typed):
    """A command that serves a page: (process, address)."""
    words = [sys.executable, "-m", "uuvtai.cli", *map(str, typed), "--port", "0"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process, re.search(r"open (\S+) in a browser", process.stderr.readline())[1]
        finally:
            process.send_signal(signal.SIGTERM)


def test_a_wall_of_tanks_in_a_browser():
    """Two agents side by side in the same episodes."""
    browser.require()
    typed = ("--agent", "planner,bt", "--tanks", SmallSim.N, "-S", 4, "-D", 3, *SmallSim.OPTIONS[2:4])
    with command("watch", *typed) as (_, address):
        seen = browser.told("live.mjs", "wall", address)
    assert seen["errors"] == [] and seen["requests"] == []
    who = [name.partition(":")[0] for name in seen["names"]]
    assert who == [f"{a}, seed 0, episode {i}" for i in range(SmallSim.N) for a in ("planner", "bt")]
    past = seen["past"]
    assert len(past) - 1 == pytest.approx(20 * (past[-1] - past[0]), abs=2), "20 in a second of the episode"
    assert seen["seen"]["tank"] == 1 and seen["seen"]["echoes"] > 0
    assert seen["other"]["helm"] is False and seen["other"]["end"] == seen["paused"], "paused for both"
    assert seen["back"]["now"] is False and seen["back"]["time"] < seen["paused"]
    assert seen["walled"] == {"tank": -1, "hidden": True}


def test_driving_in_a_browser(tmp_path):
    browser.require()
    folder = tmp_path / "driven"
    short = ("--set", "episode.horizon_steps=125")
    typed = ("drive", "--sensors", "ping360", "-S", 2, "-D", 1, *short, "--run-dir", folder)
    with command(*typed) as (process, address):
        seen = browser.told("live.mjs", "drive", address)
        out, err = process.communicate(timeout=300)
    assert process.returncode == 0 and seen["errors"] == []
    assert seen["begun"]["end"] == 0 and seen["begun"]["held"] == "start", "the second page starts nothing"
    assert seen["begun"]["words"].startswith("The first command starts")
    assert seen["begun"]["truth"] == 0 and seen["driven"]["clearance"] is None
    assert seen["driven"]["speed"] > 0.05 and seen["driven"]["said"] == "ahead 100 %"
    assert seen["touched"] == [False, 2], "pads are there where the screen is touched"
    assert f"Report: {folder}/report.html" in seen["note"]
    *_, report = err.strip().splitlines()
    assert re.search(r"^(bt|human) reached the goal in [01] of 1 episode.*, (bt|human) in [01]", out, re.M)
    assert report == f"report: {folder / 'report.html'}"
    assert "human \u2020" in out and "the page showed what no vehicle senses" in out
    log = folder / "logs/human_seed0_episode0.mcap"
    actions = [message.data["applied"] for message in read_messages(log, ["/action"])]
    first = next(step for step, action in enumerate(actions) if any(action))
    assert first <= 5 and actions[first] == [1, 0, 0, 0]
    assert any(not any(action) for action in actions[first:]), "space stopped it"
    assert [-1, 0, 0, 0] in actions and len(list((folder / "logs").iterdir())) == 2


def test_two_policies_of_ones_own_say_nothing_about_the_way_to_train():
    bt, built_in, one, two = {}, {"path": "built-in"}, {"path": "runs/a"}, {"path": "runs/b"}
    rows = [{"checkpoint": found} if found else {} for found in (bt, built_in, one, two)]
    assert "train each with several --seed" in limit_of_p(rows) and limit_of_p(rows[:3]) == ""


def test_who_arrived_sooner_is_named_first():
    slow, fast = ({"name": name, "episodes": 1, "outcomes": {"success": 1}} for name in ("bt", "human"))
    slow["time_to_success_mean_s"], fast["time_to_success_mean_s"] = 20.0, 18.0
    lost = {"name": "dwa", "episodes": 1, "outcomes": {"success": 0}, "time_to_success_mean_s": None}
    assert who_arrived([slow, lost, fast]) == (
        "human reached the goal in 1 of 1 episode (18.0 s), bt in 1 (20.0 s), dwa in 0."
    )


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        (("watch", "--tanks", "17"), "--tanks 17: 1 to 16"),
        (("watch", "--tanks", "0"), "--tanks 0: 1 to 16"),
        (("watch", "--agent", "bt,planner", "--tanks", "9"), "--tanks 9: 1 to 8 with 2 agents"),
        (("watch", "--tanks", "2", "--foxglove"), "1 with --foxglove"),
        (("watch", "--open", "--foxglove"), "--open: is of the page"),
        (("watch", "--depth-images"), "--depth-images: is of --foxglove"),
        (("watch", "--host", "no.such.host.invalid"), "cannot listen there"),
        (("watch", "--rate", "-1"), "--rate -1"),
        (("watch", "--rate", "nan"), "--rate nan"),
        (("watch", "--port", "70000"), "--port 70000"),
        (("watch", "--episodes", "-1"), "--episodes -1"),
        (("watch", "--agent", "oracle"), "drives no vehicle"),
        (("drive", "--episodes", "0"), "--episodes 0"),
        (("drive", "--port", "-1"), "--port -1"),
        (("drive", "--agent", "nobody"), "--agent nobody: is no preset"),
    ],
)
def test_what_makes_no_sense_is_refused(typed, told, capfd):
    code, out, err = uuv(capfd, *typed)
    assert (code, out) == (2, "") and told in err


def test_an_agent_of_the_same_name_is_refused(tmp_path, monkeypatch, capfd):
    (tmp_path / "human.py").write_text("def load(about):\n    return lambda obs: obs[:, :4] * 0\n")
    monkeypatch.chdir(tmp_path)
    code, _, err = uuv(capfd, "drive", "--agent", "human.py:load", "--port", "0")
    assert code == 2 and "--agent human: somebody else has that name" in err
    assert not (tmp_path / "runs").exists()
