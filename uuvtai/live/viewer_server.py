"""A WebSocket server that Foxglove and Lichtblick connect to, by Foxglove's SDK (its protocol is
``foxglove.sdk.v1``). It listens to nothing but subscriptions from those who connect."""

from __future__ import annotations

import importlib.util
import json
import logging
import threading
from collections.abc import Callable, Collection, Mapping
from typing import Any

from uuvtai.endings import say
from uuvtai.errors import UserError
from uuvtai.live.doorkeeper import Doorkeeper, private_host
from uuvtai.logs.schemas import Schema
from uuvtai.logs.topic_stream import TopicMessage

EXTRA = "uuvtai[live]"
BACKLOG = 64
"""messages that wait for a client; when more do, the oldest are dropped"""
_NEEDED = "foxglove.websocket"
_MOST_TOLD = 300
"""characters"""


class LiveError(UserError, RuntimeError):
    """Episodes cannot be shown live: what, where, why, what to type next."""


class ViewerServer:
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
            raise LiveError(
                f"ws://{host}:{port}: cannot listen there ({error}); another program may hold the port: "
                f"--port {port + 1 if port < 65535 else 8765}"
            ) from None
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
        """Let go of the port and of all who are connected."""
        self._server.stop()
        self._door.close()

    def __enter__(self) -> ViewerServer:
        return self

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
