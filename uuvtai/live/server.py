"""A WebSocket server that Foxglove and Lichtblick connect to, by Foxglove's SDK (its protocol is
``foxglove.sdk.v1``). It listens to nothing but subscriptions from those who connect."""

from __future__ import annotations

import contextlib
import importlib.util
import ipaddress
import json
import logging
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol
from urllib.parse import urlsplit

from uuvtai.common.errors import UserError
from uuvtai.common.exits import say
from uuvtai.logs.encode import EpisodeEnd, EpisodeHeader, Topic, Values
from uuvtai.logs.schemas import Schema
from uuvtai.logs.writer import EpisodeReader, PolicyNote, Recordable, RecordedJob, TopicMessage, TopicStream

# ---- Running episodes as messages for viewers: the topics of the log, no faster than the clock.


class Viewers(Protocol):
    """Whoever is shown episodes as messages."""

    def begin(self, schemas: Mapping[str, Schema]) -> None:
        """Another episode."""

    def tell_time(self, time_ns: int) -> None:
        """It is now this late in the episode."""

    def send(self, message: TopicMessage) -> None:
        """Show a message."""


class LiveEpisode:
    """One episode for viewers; an ``EpisodeSink``."""

    def __init__(self, viewers: Viewers, header: EpisodeHeader, depth_images: bool) -> None:
        self._viewers, self._stream = viewers, TopicStream(header, depth_images)
        self._dt_s = header.config.episode.control_dt_s
        viewers.begin(self._stream.schemas())

    def due(self, values: Values) -> list[Topic]:
        return self._stream.due(values)

    def write(self, values: Values) -> None:
        self._viewers.tell_time(round(int(values["clock.step"]) * self._dt_s * 1e9))
        for message in self._stream.messages(values):
            self._viewers.send(message)

    def close(self, result: EpisodeEnd) -> None:
        """Its last messages have told how it ended."""

    def abandon(self) -> None:
        """Nothing is kept."""


class Broadcast(EpisodeReader):
    """Shows every episode of row 0; an ``EpisodeObserver``."""

    def __init__(
        self,
        viewers: Viewers,
        world: str,
        agent: str,
        depth_images: bool = False,
        policy: PolicyNote | None = None,
    ) -> None:
        super().__init__(world, agent, policy)
        self._viewers, self._depth_images = viewers, depth_images

    def sink_for(self, sim: Recordable, row: int, job: RecordedJob) -> LiveEpisode | None:
        """Viewers look at one vehicle."""
        return (
            LiveEpisode(self._viewers, self.header(sim, row, job), self._depth_images) if row == 0 else None
        )


_FORGIVEN_S = 0.25  # who is later than this does not catch up: a viewer would see a jump


class RealTime:
    """Makes every control step take its time; an ``EpisodeObserver``."""

    def __init__(
        self,
        dt_s: float,
        rate: float = 1.0,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """``rate``: seconds of the episode in one of the clock's; 0 = as fast as it goes."""
        self._dt_s, self._period_s, self._now, self._sleep = dt_s, dt_s / rate if rate else 0.0, now, sleep
        self._due_s = self._begun_s = now()
        self._steps = 0

    def begin(self, sim: Any, row: int, job: Any) -> None:
        """An episode begins."""
        self._due_s = self._begun_s = self._now()
        self._steps = 0

    def step(self, sim: Any) -> None:
        """A control step has been done: wait until it is over."""
        self._steps += 1
        self._due_s += self._period_s
        late = self._now() - self._due_s
        if late < 0:
            self._sleep(-late)
        elif late > _FORGIVEN_S:
            self._due_s += late

    def end(self, sim: Any, row: int, result: Any) -> None:
        """The episode is over."""

    @property
    def real_time_factor(self) -> float:
        """Seconds of the episode in one of the clock's, since the episode began."""
        spent = self._now() - self._begun_s
        return self._steps * self._dt_s / spent if spent > 0 else 0.0


# ---- Who may connect to the server of episodes: a relay in front of it, which looks at each request and
# passes bytes on. The SDK's own server takes any web page's script, and any number of clients.

MOST_CLIENTS = 8  # at once, whether they have sent a request already or not
_REQUEST_S, _REQUEST_BYTES = 5.0, 16 << 10
_SLOW_S = 10.0  # a client that takes nothing for as long is dropped [s]
_BUFFER = 256 << 10  # [bytes] that the system keeps for each side of a client
OWN_NAMES = ("localhost", "127.0.0.1", "::1")
_DESKTOP = "file://"  # origin of Foxglove's and Lichtblick's programs; no web page can name it


class Doorkeeper:
    """Listens at an address and lets clients through to ``inner``; ends with ``close``."""

    def __init__(self, host: str, port: int, inner: tuple[str, int], origins: Collection[str]) -> None:
        """``origins``: of web pages that may connect beside those of this host ('https://app.foxglove.dev').
        Raises OSError where the address cannot be listened at."""
        self._inner, self._origins, self._host = inner, {*origins}, host
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family)
        self.port: int = self._listener.getsockname()[1]
        self._open: set[socket.socket] = set()
        self._slots = threading.BoundedSemaphore(MOST_CLIENTS)
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        for place in (self._listener, *self._open):
            _ended(place)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:  # closed
                return
            if self._slots.acquire(blocking=False):
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()
            else:
                _refuse(client, f"503 More than {MOST_CLIENTS} viewers")

    def _serve(self, client: socket.socket) -> None:
        """One client from its request to its end."""
        self._open.add(client)
        try:
            request = _request(client)
            if why := self._refusal(request, client.getsockname()[0]):
                _refuse(client, why)
                return
            with socket.create_connection(self._inner) as server:
                for place in (client, server):
                    place.settimeout(_SLOW_S)
                    place.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
                    place.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                server.sendall(request)
                back = threading.Thread(target=_relay, args=(server, client), daemon=True)
                back.start()
                _relay(client, server)
                back.join()
        except OSError:
            pass
        finally:
            self._open.discard(client)
            _ended(client)
            self._slots.release()

    def _refusal(self, request: bytes, address: str) -> str:
        """Why not, as an HTTP status; '' = let it through."""
        head, end, _ = request.partition(b"\r\n\r\n")
        lines = [line.decode("latin-1") for line in head.split(b"\r\n")[1:]]
        if not end or any(line[:1] in (" ", "\t") for line in lines):
            return "400 Bad Request"
        named = [
            (name.strip().lower(), value.strip()) for name, _, value in (x.partition(":") for x in lines)
        ]
        if ("upgrade", "websocket") not in [(name, value.lower()) for name, value in named]:
            return "426 Upgrade Required"
        own = {*OWN_NAMES, self._host, address}
        known = all(self._is_known(value, own) for name, value in named if name == "origin")
        return "" if known else "403 Forbidden: that page may not connect; allow it with --origin"

    def _is_known(self, origin: str, own: set[str]) -> bool:
        try:
            host = urlsplit(origin).hostname
        except ValueError:
            return False
        return origin in {_DESKTOP, *self._origins} or host in own


def private_host() -> str:
    """A loopback address that no web page guesses, where the system has more than one."""
    number = int(ipaddress.ip_address("127.1.0.0")) + secrets.randbelow(250 << 16)
    return str(ipaddress.ip_address(number)) if sys.platform == "linux" else "127.0.0.1"


def _request(client: socket.socket) -> bytes:
    """Up to the end of its head; what is longer or later is cut. Raises OSError."""
    end, request = time.monotonic() + _REQUEST_S, b""
    while b"\r\n\r\n" not in request and len(request) < _REQUEST_BYTES:
        client.settimeout(max(0.01, end - time.monotonic()))
        part = client.recv(4096)
        if not part:
            break
        request += part
    return request


def _relay(source: socket.socket, target: socket.socket) -> None:
    """Pass bytes on until one side ends or takes nothing for ``_SLOW_S``; then both end."""
    with contextlib.suppress(OSError):
        while True:
            try:
                part = source.recv(1 << 16)
            except TimeoutError:  # silent, as viewers are
                continue
            if not part:
                break
            target.sendall(part)
    for place in (source, target):
        with contextlib.suppress(OSError):
            place.shutdown(socket.SHUT_RDWR)


def _refuse(client: socket.socket, status: str) -> None:
    with contextlib.suppress(OSError):  # what is left unread resets the connection before its answer is read
        client.settimeout(0.2)
        client.recv(_REQUEST_BYTES)
    with contextlib.suppress(OSError):
        client.sendall(f"HTTP/1.1 {status}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode())
    _ended(client)


def _ended(place: socket.socket) -> None:
    """Shut down, which wakes who waits for it, and close."""
    with contextlib.suppress(OSError):
        place.shutdown(socket.SHUT_RDWR)
    place.close()


EXTRA = "uuvtai[live]"
BACKLOG = 64  # messages that wait for a client; when more do, the oldest are dropped
_NEEDED = "foxglove.websocket"
_MOST_TOLD = 300  # characters


class LiveError(UserError, RuntimeError):
    """Episodes cannot be shown live: what, where, why, what to type next."""


def cannot_listen(scheme: str, host: str, port: int, error: Exception) -> LiveError:
    """The error of an address that is taken, or not this machine's."""
    return LiveError(
        f"{scheme}://{host}:{port}: cannot listen there ({error}); another program may hold the port: "
        f"--port {port + 1 if port < 65535 else 8765}"
    )


class ViewerServer(contextlib.AbstractContextManager["ViewerServer"]):
    """Sends messages to whoever has subscribed to their topic. Use as a context: it ends with it."""

    def __init__(self, host: str = "127.0.0.1", port: int = 8765, origins: Collection[str] = ()) -> None:
        """``port`` 0: a free one, see ``port``; ``origins``: as of ``Doorkeeper``. Raises LiveError."""
        _require_sdk()
        import foxglove
        from foxglove.websocket import Capability

        log = logging.getLogger("foxglove")
        log.handlers, log.propagate = [_Told()], False
        log.setLevel(logging.ERROR)
        self._foxglove, self._context = foxglove, foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._newest: dict[str, TopicMessage] = {}
        self._lock = threading.Lock()
        self._asked: set[str] = set()
        inner = private_host()
        try:
            self._server = foxglove.start_server(
                name="uuvtai",
                host=inner,
                port=0,
                capabilities=[Capability.Time],
                server_listener=_listener(self._ask),
                context=self._context,
                message_backlog_size=BACKLOG,
            )
            try:
                self._door = Doorkeeper(host, port, (inner, self._server.port), origins)
            except BaseException:
                self._server.stop()
                raise
        except (RuntimeError, OSError, ValueError) as error:
            raise cannot_listen("ws", host, port, error) from None
        self.port: int = self._door.port

    def begin(self, schemas: Mapping[str, Schema]) -> None:
        """Another episode: viewers forget the one before."""
        if self._newest:
            self._newest.clear()
            self._server.clear_session()
        for topic, schema in schemas.items():
            if topic not in self._channels:
                text = json.dumps(schema, separators=(",", ":")).encode()
                declared = self._foxglove.Schema(name=schema["title"], encoding="jsonschema", data=text)
                self._channels[topic] = self._foxglove.Channel(
                    topic, message_encoding="json", schema=declared, context=self._context
                )

    def send(self, message: TopicMessage) -> None:
        """To those who want its topic."""
        self._newest[message.topic] = message
        self._channels[message.topic].log(message.data, log_time=message.time_ns)

    def tell_time(self, time_ns: int) -> None:
        """It is now this late in the episode. Whoever has come since the last call gets the newest message of
        every topic it wants, for some come once a minute."""
        with self._lock:
            asked, self._asked = self._asked, set()
        for topic in sorted(asked):
            if topic in self._newest:
                self.send(self._newest[topic])
        self._server.broadcast_time(time_ns)

    def _ask(self, topic: str) -> None:
        """Somebody has subscribed; on a thread of the SDK's."""
        with self._lock:
            self._asked.add(topic)

    def close(self) -> None:
        self._server.stop()
        self._door.close()

    def __exit__(self, *_: object) -> None:
        self.close()


class _Told(logging.Handler):
    """What the SDK says of its clients, who may have worded it; the first lines of it."""

    left = 20

    def emit(self, record: logging.LogRecord) -> None:
        if self.left > 0:
            self.left -= 1
            say(f"a viewer: {' '.join(record.getMessage()[:_MOST_TOLD].split())}")


def _require_sdk() -> None:
    try:
        found = importlib.util.find_spec(_NEEDED)
    except ImportError:
        found = None
    if found is None:
        raise LiveError(f"a viewer is served by Foxglove's SDK, which is not here: pip install '{EXTRA}'")


def _listener(ask: Callable[[str], None]) -> Any:
    """Tells ``ask`` of subscriptions; all other callbacks do nothing, as the SDK's own class has them."""
    from foxglove.websocket import ServerListener

    class Arrivals(ServerListener):
        def on_subscribe(self, client: Any, channel: Any) -> None:
            ask(channel.topic)

    return Arrivals()
