"""A WebSocket server in a thread of its own, so that no client holds up the episodes; and what Foxglove and
Lichtblick are served by it (protocol ``foxglove.sdk.v1``): they look, and say what they want to see."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import struct
import threading
import time
import uuid
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Coroutine, Mapping
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from uuvtai.common.errors import UserError
from uuvtai.common.files import json_object
from uuvtai.logs.encode import EpisodeHeader, Topic, Values
from uuvtai.logs.schemas import Schema
from uuvtai.logs.writer import (
    EpisodeReader,
    EpisodeSink,
    PolicyNote,
    Recordable,
    RecordedJob,
    TopicMessage,
    TopicStream,
)

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

# ---- Running episodes as messages for viewers: the topics of the log, no faster than the clock.


class LiveEpisode(EpisodeSink):
    """One episode for viewers; its last messages have told how it ended."""

    def __init__(self, viewers: ViewerServer, header: EpisodeHeader, depth_images: bool) -> None:
        self._viewers, self._stream = viewers, TopicStream(header, depth_images)
        self._dt_s = header.config.episode.control_dt_s
        viewers.begin(self._stream.schemas())

    def due(self, values: Values) -> list[Topic]:
        return self._stream.due(values)

    def write(self, values: Values) -> None:
        self._viewers.tell_time(round(int(values["clock.step"]) * self._dt_s * 1e9))
        for message in self._stream.messages(values):
            self._viewers.send(message)


class Broadcast(EpisodeReader):
    """Shows every episode of row 0; an ``EpisodeObserver``."""

    def __init__(
        self,
        viewers: ViewerServer,
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


# ---- A server: who may connect, and messages that wait for those who are slow.

MOST_CLIENTS = 8  # at once
OWN_NAMES = ("localhost", "127.0.0.1", "::1")
BACKLOG, MOST_WAITING = 64, 300  # messages that wait: of bytes the oldest go; with more the client goes
_MOST_SOCKETS = 4 * MOST_CLIENTS  # whether they have sent a request already or not
_REQUEST_S, _CLOSE_S, _MOMENT_S = 5.0, 1.0, 0.02
Answer = tuple[HTTPStatus, str]


class LiveError(UserError, RuntimeError):
    """Episodes cannot be shown live: what, where, why, what to type next."""


class Client:
    """Somebody who is connected."""

    def __init__(self, socket: ServerConnection) -> None:
        self.socket, self.waiting, self.wake = socket, deque[Any](), asyncio.Event()
        self.is_local = str((socket.remote_address or ("",))[0]) in OWN_NAMES
        self.tank = -1  # that is followed on the page
        self.topics: dict[int, int] = {}  # subscriptions by channel


class LiveServer(contextlib.AbstractContextManager["LiveServer"]):
    """Tells its clients what it is told to. Use as a context: it ends with it."""

    scheme, path, protocols, most_bytes = "ws", "/", None, 1024

    def __init__(self, host: str, port: int, origins: Collection[str]) -> None:
        """``port`` 0: a free one, see ``port``; ``origins``: of web pages that may connect beside those of
        this host. Raises LiveError."""
        if not host:
            raise LiveError(
                "--host: is empty, which would serve the whole network; leave it out for 127.0.0.1"
            )
        self._origins, self._lock = {*origins}, threading.Condition()
        self._clients: list[Client] = []
        self._sockets: set[Any] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            self._server = self._done(self._opened(host, port))
        except (OSError, OverflowError) as error:
            self._end()
            raise LiveError(
                f"{self.scheme}://{host}:{port}: cannot listen there ({error}); another program may hold the "
                f"port: --port {port + 1 if port < 65535 else 8765}"
            ) from None
        shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        self.url = f"{self.scheme}://{self.at(shown)}"

    def at(self, host: str) -> str:
        """host:port"""
        return f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}"

    def close(self) -> None:
        """Turn all away."""
        if not self._loop.is_closed():
            self._done(self._closed())
            self._end()

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def refusal(self, connection: ServerConnection, request: Request) -> Answer | None:
        """Why a client may not connect; None = it may."""

    def document(self, connection: ServerConnection) -> Response:
        """For who opens no WebSocket."""
        return connection.respond(HTTPStatus.UPGRADE_REQUIRED, "a WebSocket is served here\n")

    def arrived(self, client: Client) -> None:
        """A client has come; the lock is held."""

    @abstractmethod
    def heard(self, client: Client, asked: Any) -> bool:
        """A client says something, an object of JSON (None: it is none); whether it may stay. The lock is
        held."""

    def left(self, client: Client) -> None:
        """A client has gone and is in the list no more; the lock is held."""

    # ------------------------------------------------------------------------------------ the server's thread

    def put(self, client: Client, message: str | bytes) -> None:
        """Have a message wait for a client."""
        waiting = client.waiting
        if len(waiting) >= BACKLOG and isinstance(waiting[0], bytes):
            waiting.popleft()
        waiting.append(message)
        with contextlib.suppress(RuntimeError):  # the loop has ended
            is_lost = len(waiting) > MOST_WAITING
            self._loop.call_soon_threadsafe(client.socket.transport.abort if is_lost else client.wake.set)

    async def _opened(self, host: str, port: int) -> Any:
        from websockets.asyncio.server import serve

        quiet = logging.getLogger("uuvtai.live")
        quiet.setLevel(logging.CRITICAL + 1)  # whatever a client does is no news
        server = await serve(
            self._serve, host, port, process_request=self._answer, compression=None, logger=quiet,
            max_size=self.most_bytes, open_timeout=_REQUEST_S, close_timeout=_CLOSE_S, server_header=None,
            create_connection=_counted(self._sockets), subprotocols=self.protocols,
        )  # fmt: skip
        self.port: int = next(iter(server.sockets)).getsockname()[1]
        return server

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """What is no WebSocket, or why not; None = let it open."""
        wants_socket = request.headers.get_all("Upgrade") != []
        if why := self.refusal(connection, request):
            return connection.respond(*why)
        if request.path != (self.path if wants_socket else "/"):
            return connection.respond(HTTPStatus.NOT_FOUND, "nothing is here\n")
        if not wants_socket:
            return self.document(connection)
        is_full = len(self._clients) >= MOST_CLIENTS
        why = HTTPStatus.SERVICE_UNAVAILABLE, f"more than {MOST_CLIENTS} look on\n"
        return connection.respond(*why) if is_full else None

    async def _serve(self, socket: ServerConnection) -> None:
        """One client from the first to the last message."""
        client = Client(socket)
        with self._lock:
            if len(self._clients) >= MOST_CLIENTS:
                return
            self._clients.append(client)
            self.arrived(client)
        sender = asyncio.ensure_future(self._send(client))
        try:
            with _ended():
                async for message in socket:
                    with self._lock:
                        stays = self.heard(client, json_object(message))
                    if not stays:
                        await socket.close(1008, "no message of ours")
        finally:
            sender.cancel()
            with self._lock:
                self._clients.remove(client)
                self.left(client)

    async def _send(self, client: Client) -> None:
        with _ended():
            while True:
                await client.wake.wait()
                client.wake.clear()
                while client.waiting:
                    with self._lock:
                        message = client.waiting.popleft()
                    await client.socket.send(message)

    def _done(self, work: Coroutine[Any, Any, Any]) -> Any:
        """What the server's thread makes of it."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _closed(self) -> None:
        end_s = time.monotonic() + _CLOSE_S
        while any(client.waiting for client in self._clients) and time.monotonic() < end_s:
            await asyncio.sleep(_MOMENT_S)  # what was told last
        self._server.close()
        self._loop.call_later(_CLOSE_S, lambda: [one.transport.abort() for one in [*self._sockets]])
        await self._server.wait_closed()

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def _counted(sockets: set[Any]) -> type[ServerConnection]:
    """Connections of which there is a bounded number."""
    from websockets.asyncio.server import ServerConnection

    class Counted(ServerConnection):
        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            sockets.add(self)
            if len(sockets) > _MOST_SOCKETS:
                transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            sockets.discard(self)
            super().connection_lost(exc)

    return Counted


def _ended() -> contextlib.AbstractContextManager[None]:
    from websockets.exceptions import ConnectionClosed

    return contextlib.suppress(ConnectionClosed)


# ---- For Foxglove and Lichtblick.

_DESKTOP = "file://"  # origin of Foxglove's and Lichtblick's programs; no web page can name it
_DATA, _TIME = struct.Struct("<BIQ"), struct.Struct("<BQ")  # heads of messages: code, subscription, time [ns]


class ViewerServer(LiveServer):
    """Sends messages to whoever has subscribed to their topic."""

    protocols, most_bytes = ("foxglove.sdk.v1", "foxglove.websocket.v1"), 1 << 16

    def __init__(self, host: str = "127.0.0.1", port: int = 8765, origins: Collection[str] = ()) -> None:
        """``origins``: such as 'https://app.foxglove.dev'. Raises LiveError."""
        self._host, self._session = host, str(uuid.uuid4())
        self._channels: dict[str, dict[str, Any]] = {}
        self._newest: dict[str, TopicMessage] = {}
        super().__init__(host, port, origins)

    def begin(self, schemas: Mapping[str, Schema]) -> None:
        """Another episode: viewers forget the one before."""
        with self._lock:
            if self._newest:
                self._newest.clear()
                self._session = str(uuid.uuid4())
                for client in self._clients:
                    self.put(client, self._info())
            new = [topic for topic in schemas if topic not in self._channels]
            for topic in new:
                schema = schemas[topic]
                self._channels[topic] = {
                    "id": len(self._channels) + 1, "topic": topic, "encoding": "json",
                    "schemaName": schema["title"], "schemaEncoding": "jsonschema",
                    "schema": json.dumps(schema, separators=(",", ":")),
                }  # fmt: skip
            for client in self._clients if new else ():
                self.put(client, self._advertised(new))

    def send(self, message: TopicMessage) -> None:
        """To those who want its topic."""
        with self._lock:
            self._newest[message.topic] = message
            for client in self._clients:
                self._give(client, message)

    def tell_time(self, time_ns: int) -> None:
        """It is now this late in the episode."""
        with self._lock:
            for client in self._clients:
                self.put(client, _TIME.pack(2, time_ns))

    def refusal(self, connection: ServerConnection, request: Request) -> Answer | None:
        """Web pages of elsewhere; programs name no origin."""
        own = {*OWN_NAMES, self._host, connection.local_address[0]}
        for origin in request.headers.get_all("Origin"):
            if origin not in {_DESKTOP, *self._origins} and _host_of(origin) not in own:
                return HTTPStatus.FORBIDDEN, "that page may not connect; allow it with --origin\n"
        return None

    def arrived(self, client: Client) -> None:
        """Say what there is."""
        self.put(client, self._info())
        self.put(client, self._advertised([*self._channels]))

    def heard(self, client: Client, asked: Any) -> bool:
        """Subscriptions; who comes late gets the newest message at once, for some come once a minute. All
        else is left alone: viewers ask for much that is not served here."""
        topics = {channel["id"]: topic for topic, channel in self._channels.items()}
        for one in _listed(asked, "subscribe", "subscriptions"):
            wanted = (one.get("channelId"), one.get("id")) if isinstance(one, dict) else (None, None)
            channel, number = (part if type(part) is int and 0 <= part < 1 << 32 else -1 for part in wanted)
            if channel in topics and number >= 0:
                client.topics[channel] = number
                if newest := self._newest.get(topics[channel]):
                    self._give(client, newest)
        for one in _listed(asked, "unsubscribe", "subscriptionIds"):
            client.topics = {channel: number for channel, number in client.topics.items() if number != one}
        return True

    def _give(self, client: Client, message: TopicMessage) -> None:
        subscription = client.topics.get(self._channels[message.topic]["id"])
        if subscription is not None:
            self.put(client, _DATA.pack(1, subscription, message.time_ns) + message.data)

    def _info(self) -> str:
        info = {"op": "serverInfo", "name": "uuvtai", "capabilities": ["time"], "sessionId": self._session}
        return json.dumps(info | {"supportedEncodings": [], "metadata": {}})

    def _advertised(self, topics: Collection[str]) -> str:
        return json.dumps({"op": "advertise", "channels": [self._channels[topic] for topic in topics]})


def _listed(asked: Any, what: str, of: str) -> list[Any]:
    found = asked.get(of) if asked and asked.get("op") == what else None
    return found if isinstance(found, list) else []


def _host_of(origin: str) -> str | None:
    try:
        return urlsplit(origin).hostname
    except ValueError:
        return None
