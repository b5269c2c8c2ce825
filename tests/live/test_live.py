"""Episodes served while they run: a client gets what the log gets, late ones too; refusals; the clock."""

import contextlib
import json
import resource
import socket
import struct
import threading
import time
from types import SimpleNamespace

import pytest
from mcap.reader import make_reader
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

from uuvtai.evaluation.episodes import Job
from uuvtai.live.server import BACKLOG, MOST_CLIENTS, Broadcast, LiveError, RealTime, ViewerServer
from uuvtai.logs.writer import EpisodeRecorder, TopicMessage

STEPS = 30
END = SimpleNamespace(
    outcome="cut", episode_return=0.0, time_s=0.6, min_clearance_m=1.0, replans={}, planned_by={}
)


def open_socket(port, **options):
    place = f"ws://127.0.0.1:{port}"
    return connect(
        place, subprotocols=["foxglove.sdk.v1"], max_size=None, ping_interval=None, close_timeout=1, **options
    )


class Viewer:
    """A client of the protocol, by a library that knows nothing of Foxglove."""

    def __init__(self, port):
        self.socket = open_socket(port)
        self.info, self.channels = json.loads(self.socket.recv(10)), {}
        self.messages, self.sessions, self.time_ns = [], [self.info["sessionId"]], 0

    def subscribe(self, server):
        """To everything; returns when the server knows."""
        while not self.channels:
            self._take(self.socket.recv(10))
        wanted = [{"id": number, "channelId": number} for number in self.channels]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        end = time.monotonic() + 30
        while len(server._clients[-1].topics) < len(wanted):
            assert time.monotonic() < end, "subscriptions never came"
            time.sleep(0.005)

    def receive(self, count, wait=10):
        """Until so many messages have come, or the server has gone."""
        with contextlib.suppress(ConnectionClosed):
            while len(self.messages) < count:
                self._take(self.socket.recv(wait))
        return self.messages

    def _take(self, frame):
        if isinstance(frame, str):
            told = json.loads(frame)
            if told["op"] == "advertise":
                self.channels |= {channel["id"]: channel for channel in told["channels"]}
            if told["op"] == "serverInfo":
                self.sessions.append(told["sessionId"])
        elif frame[0] == 1:
            number, time_ns = struct.unpack_from("<IQ", frame, 1)
            self.messages.append((self.channels[number]["topic"], time_ns, frame[13:]))
        elif frame[0] == 2:
            (self.time_ns,) = struct.unpack_from("<Q", frame, 1)


@pytest.fixture
def server():
    with ViewerServer(port=0) as found:
        yield found


def played(small, observers, job, steps=STEPS):
    """An episode in row 0, cut."""
    small.sim.sleep()
    small.begin([job.episode], seed=job.seed)
    for observer in observers:
        observer.begin(small.sim, 0, job)
    for _ in range(steps):
        small.sim.step()
        for observer in observers:
            observer.step(small.sim)
    for observer in observers:
        observer.end(small.sim, 0, END)


def test_a_viewer_gets_what_the_log_gets(small, server, tmp_path):
    job = Job(77001, 3)
    recorder = EpisodeRecorder(tmp_path, "pool", "bt", [job])
    shown = Broadcast(server, "pool", "bt")
    server.begin(shown.sink_for(small.sim, 0, job)._stream.schemas())
    viewer = Viewer(server.port)
    viewer.subscribe(server)
    reader = threading.Thread(target=viewer.receive, args=(10**6, None))  # who lags loses the oldest
    reader.start()
    played(small, [shown, recorder], job)
    logged = [(m.topic, m.time_ns, m.data) for m in logged_messages(recorder.paths[job])]
    end = time.monotonic() + 30
    while len(viewer.messages) < len(logged) and time.monotonic() < end:
        time.sleep(0.01)
    got = viewer.messages
    server.close()
    reader.join()
    assert sorted(got) == sorted(logged) and len(logged) > 10 * STEPS
    poses = [time_ns for topic, time_ns, _ in got if topic == "/pose"]
    assert poses == [round(step * 0.02e9) for step in range(STEPS + 1)], "50 Hz, more than the 20 of a viewer"
    for channel in viewer.channels.values():
        assert channel["encoding"] == "json" and channel["schemaEncoding"] == "jsonschema"
        assert json.loads(channel["schema"])["title"] == channel["schemaName"]
    assert viewer.time_ns == STEPS * 20_000_000 and "time" in viewer.info["capabilities"]


def logged_messages(path):
    """(topic, time_ns, data) of a log's messages, as they lie in the file."""
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            yield SimpleNamespace(topic=channel.topic, time_ns=message.log_time, data=message.data)


def test_who_comes_late_gets_the_newest_of_what_is_rare(small, server):
    job, shown = Job(77001, 3), Broadcast(server, "pool", "bt")
    small.sim.sleep()
    small.begin([job.episode], seed=job.seed)
    shown.begin(small.sim, 0, job)
    small.sim.step()
    shown.step(small.sim)
    viewer = Viewer(server.port)
    viewer.subscribe(server)
    small.sim.step()
    shown.step(small.sim)
    got = viewer.receive(len(viewer.channels) - 2)
    assert {"/map/static", "/goal", "/obstacles", "/pose"} <= {topic for topic, _, _ in got}
    assert [time_ns for topic, time_ns, _ in got if topic == "/map/static"] == [0]


def test_another_episode_is_another_session(small, server):
    shown = Broadcast(server, "pool", "bt")
    played(small, [shown], Job(77001, 3), 2)
    viewer = Viewer(server.port)
    viewer.subscribe(server)
    played(small, [shown], Job(77001, 4), 2)
    while len(set(viewer.sessions)) < 2:
        viewer._take(viewer.socket.recv(10))
    viewer.receive(len(viewer.messages) + 20)
    assert viewer.messages[-1][1] < 3 * 20_000_000, "time begins again"


def test_a_port_that_is_taken_is_refused(server):
    with pytest.raises(LiveError, match=rf"{server.port}: cannot listen there .* --port {server.port + 1}"):
        ViewerServer(port=server.port)


def test_other_protocols_are_turned_away(server):
    with pytest.raises(InvalidHandshake):
        connect(f"ws://127.0.0.1:{server.port}", subprotocols=["mqtt"])


@pytest.mark.parametrize(
    ("origin", "is_let_in"),
    [
        (None, True),
        ("http://localhost:5173", True),
        ("http://127.0.0.1", True),
        ("file://", True),
        ("https://app.foxglove.dev", True),
        ("https://evil.example", False),
        ("null", False),
        ("http://localhost.evil.example", False),
        ("http://127.0.0.1.evil.example:8765", False),
        ("http://[", False),
        ("https://app.foxglove.dev.evil.example", False),
        ("http://localhost@evil.example", False),
    ],
)
def test_a_web_page_of_elsewhere_is_turned_away(origin, is_let_in):
    with ViewerServer(port=0, origins=["https://app.foxglove.dev"]) as server:
        if is_let_in:
            assert json.loads(open_socket(server.port, origin=origin).recv(10))["op"] == "serverInfo"
        else:
            with pytest.raises(InvalidHandshake, match="403"):
                open_socket(server.port, origin=origin)


@pytest.mark.parametrize("name", ["localhost.evil.example", "evil.example"])
def test_a_name_that_leads_here_is_no_origin_of_ours(server, name):
    """DNS rebinding: page and request name the same host."""
    host = f"{name}:{server.port}"
    with pytest.raises(InvalidHandshake, match="403"):
        open_socket(server.port, origin=f"http://{host}", additional_headers={"Host": host})


@pytest.mark.parametrize(
    "request_line",
    [
        b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
        b"\0" * 20_000,
        b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n Origin: x\r\n\r\n",
    ],
)
def test_what_is_no_websocket_is_answered_and_ended(server, request_line):
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as client:
        client.sendall(request_line)
        assert client.recv(100)[:10] in (b"HTTP/1.1 4", b"")


def test_the_number_of_clients_is_bounded_and_a_place_becomes_free(server):
    clients = [open_socket(server.port) for _ in range(MOST_CLIENTS)]
    with pytest.raises(InvalidHandshake, match="503"):
        open_socket(server.port)
    clients[0].close()
    end = time.monotonic() + 30
    while True:
        try:
            return open_socket(server.port).close()
        except (InvalidHandshake, ConnectionClosed):
            assert time.monotonic() < end
            time.sleep(0.05)


def test_who_never_reads_takes_no_more_than_the_backlog(small, server):
    shown = Broadcast(server, "pool", "bt")
    played(small, [shown], Job(77001, 3), 2)
    viewer = Viewer(server.port)
    viewer.subscribe(server)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for n in range(3 * BACKLOG):
        server.send(TopicMessage("/pose", n, bytes(1 << 20)))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < (BACKLOG + 40) << 10, "KiB"


def test_nonsense_from_a_client_ends_nothing(small, server):
    shown = Broadcast(server, "pool", "bt")
    strange = open_socket(server.port)
    for frame in ("{", '{"op": "subscribe"}', '{"op": "no such"}', b"", b"\xff" * 40, "x" * 100_000):
        strange.send(frame)
    played(small, [shown], Job(77001, 3), 2)
    viewer = Viewer(server.port)
    viewer.subscribe(server)
    played(small, [shown], Job(77001, 3), 2)
    assert viewer.receive(10)


def test_who_leaves_leaves_no_trace(small, server, capfd):
    shown = Broadcast(server, "pool", "bt")
    played(small, [shown], Job(77001, 3), 2)
    viewer = Viewer(server.port)
    viewer.subscribe(server)
    viewer.receive(16)  # the library wants room for its farewell
    viewer.socket.close()
    server.close()
    assert capfd.readouterr() == ("", "")


# ----------------------------------------------------------------------------------------------------- clock


class Clock:
    """Time that passes by sleeping and by working."""

    def __init__(self):
        self.s, self.slept = 100.0, 0.0

    def now(self):
        return self.s

    def sleep(self, seconds):
        assert seconds > 0
        self.s, self.slept = self.s + seconds, self.slept + seconds


@pytest.mark.parametrize(("rate", "taken"), [(1.0, 2.0), (4.0, 0.5)])
def test_a_step_takes_its_time(rate, taken):
    clock = Clock()
    pace = RealTime(0.02, rate, clock.now, clock.sleep)
    pace.begin(None, 0, None)
    for _ in range(100):
        clock.s += 0.001
        pace.step(None)
    assert clock.s - 100.0 == pytest.approx(taken) and pace.real_time_factor == pytest.approx(rate)


def test_short_delays_are_caught_up_and_long_ones_are_not():
    clock = Clock()
    pace = RealTime(0.02, 1.0, clock.now, clock.sleep)
    pace.begin(None, 0, None)
    for work in (0.1, *[0.0] * 9):
        clock.s += work
        pace.step(None)
    assert clock.s == pytest.approx(100.2), "five steps late, then on time again"
    clock.s += 3.0
    pace.step(None)
    begun = clock.s
    pace.step(None)
    assert clock.s - begun == pytest.approx(0.02), "no rush after a pause"


def test_as_fast_as_it_goes():
    clock = Clock()
    pace = RealTime(0.02, 0.0, clock.now, clock.sleep)
    for _ in range(10):
        clock.s += 0.001
        pace.step(None)
    assert clock.slept == 0
