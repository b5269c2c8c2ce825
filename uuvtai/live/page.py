"""The server of the page with running episodes: the page over HTTP, and over its WebSocket whatever it is
told to show; who may look, and who steers. It has a thread of its own: no client holds up the episodes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Coroutine
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from uuvtai.common.files import FileError, parsed_json
from uuvtai.live.server import MOST_CLIENTS, OWN_NAMES, cannot_listen

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

MOST_TANKS = 16  # side by side
STALE_S = 0.3  # a command that is older than this means: stop [s]
_BACKLOG = 300  # messages that wait for a client; who has more is dropped, and its page asks for all anew
_MESSAGE_BYTES = 1024
_MOST_SOCKETS = 4 * MOST_CLIENTS  # whether they have sent a request already or not
_REQUEST_S, _CLOSE_S, _MOMENT_S = 5.0, 1.0, 0.02
_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": "frame-ancestors 'none'",  # beside the page's own, which allows its one script
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
STOP = (0.0, 0.0, 0.0, 0.0)
Command = tuple[float, float, float, float]
"""surge, sway, heave, yaw rate, each in [-1, 1] of the vehicle's limits"""


class _Client:
    """A page that looks."""

    def __init__(self, socket: ServerConnection) -> None:
        self.socket, self.tank = socket, -1
        self.waiting: deque[str] = deque()
        self.wake = asyncio.Event()
        self.is_local = str((socket.remote_address or ("",))[0]) in OWN_NAMES


class PageServer(contextlib.AbstractContextManager["PageServer"]):
    """Serves a page and tells it what is shown. The oldest page of this machine has the helm: it alone may
    pause, steer and ask for the truth. Use as a context: it ends with it."""

    def __init__(
        self,
        page: str,
        host: str = "127.0.0.1",
        port: int = 8765,
        origins: Collection[str] = (),
        steered: bool = False,
        stale_s: float = STALE_S,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """``port`` 0: a free one, see ``url``; ``origins``: addresses by which it is reached too;
        ``steered``: a vehicle waits for who has the helm, and the truth is hidden. Raises LiveError."""
        self._page, self._origins, self.steered = page, origins, steered
        self._stale_s, self._now = stale_s, now
        self._changed = threading.Condition()
        self._clients: list[_Client] = []
        self._asked: list[tuple[Any, int]] = []
        self._sockets: set[Any] = set()
        self._command, self._heard_s = STOP, 0.0
        self._held, self._note = "", ""
        self.with_truth, self.truth_was_seen = not steered, False
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            self._server = self._done(self._opened(host, port))
        except (OSError, OverflowError) as error:
            self._end()
            raise cannot_listen("http", host, port, error) from None
        self.url = f"http://{self._at('127.0.0.1' if host in ('0.0.0.0', '::') else host)}"

    # ------------------------------------------------------------------------------ for who runs the episodes

    def asked(self) -> list[tuple[Any, int]]:
        """As of ``report.running.Audience``."""
        with self._changed:
            asked, self._asked = self._asked, []
        return asked

    def followed(self) -> set[int]:
        """Tanks that somebody follows."""
        with self._changed:
            return {client.tank for client in self._clients}

    def tell(self, message: str, tank: int | None = None, to: Any = None) -> None:
        """A message for all, for those who follow a tank, or for one."""
        with self._changed:
            for client in [*self._clients]:
                if to in (None, client) and tank in (None, client.tank):
                    self._put(client, message)

    def is_held(self, at_start: bool = False) -> bool:
        """Whether the episode has to wait, of which a moment has been waited. A vehicle that is steered waits
        ``at_start`` for the first command, and while nobody has the helm."""
        with self._changed:
            if self.steered and (at_start or not self._helm()) and not self._held:
                self._hold("start")
            if self._held:
                self._changed.wait(_MOMENT_S)
            return bool(self._held)

    def command(self) -> Command:
        """The newest command; ``STOP`` where it is too old."""
        with self._changed:
            return self._command if self._now() - self._heard_s <= self._stale_s else STOP

    def note(self, text: str) -> None:
        """Say it on the page."""
        with self._changed:
            self._note = text
            self._tell_roles()

    def close(self) -> None:
        """Turn all pages away."""
        self._done(self._closed())
        self._end()

    def __exit__(self, *_: object) -> None:
        self.close()

    # --------------------------------------------------------------------------------- in the server's thread

    async def _opened(self, host: str, port: int) -> Any:
        from websockets.asyncio.server import serve

        quiet = logging.getLogger("uuvtai.live.page")
        quiet.setLevel(logging.CRITICAL + 1)  # whatever a client does is no news
        server = await serve(
            self._serve, host, port, process_request=self._answer, compression=None, logger=quiet,
            max_size=_MESSAGE_BYTES, open_timeout=_REQUEST_S, close_timeout=_CLOSE_S, server_header=None,
            create_connection=self._connection(),
        )  # fmt: skip
        self.port: int = next(iter(server.sockets)).getsockname()[1]
        self._hosts = {self._at(name) for name in (host, *OWN_NAMES)}
        self._hosts |= {urlsplit(origin).netloc for origin in self._origins}
        return server

    def _at(self, host: str) -> str:
        return f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}"

    def _connection(self) -> type[ServerConnection]:
        """Connections of which there is a bounded number."""
        from websockets.asyncio.server import ServerConnection

        sockets = self._sockets

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

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page, or why not; None = let the WebSocket open."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        wants_socket = request.headers.get_all("Upgrade") != []
        allowed = self._hosts | {self._at(connection.local_address[0])}
        if len(hosts) != 1 or hosts[0].lower() not in allowed:
            return connection.respond(HTTPStatus.FORBIDDEN, f"open {self.url}, or allow it with --origin\n")
        if not {*origins} <= {f"http://{host}" for host in allowed} | {*self._origins}:
            return connection.respond(HTTPStatus.FORBIDDEN, "that page may not connect\n")
        if request.path != ("/live" if wants_socket else "/"):
            return connection.respond(HTTPStatus.NOT_FOUND, "there is one page: /\n")
        if wants_socket:
            is_full = len(self._clients) >= MOST_CLIENTS
            why = f"more than {MOST_CLIENTS} pages look on\n"
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, why) if is_full else None
        page = connection.respond(HTTPStatus.OK, self._page)
        del page.headers["Content-Type"]
        page.headers.update(_HEADERS)
        return page

    async def _serve(self, socket: ServerConnection) -> None:
        """One page from its first to its last message."""
        from websockets.exceptions import ConnectionClosed

        client = _Client(socket)
        with self._changed:
            if len(self._clients) >= MOST_CLIENTS:
                return
            self._clients.append(client)
            self._asked.append((client, -1))
            self._tell_roles()
        sender = asyncio.ensure_future(self._send(client))
        try:
            async for message in socket:
                if not self._hear(client, message):
                    await socket.close(1008, "no message of the page")
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            with self._changed:
                if client is self._helm():
                    self._command = STOP
                self._clients.remove(client)
                self._tell_roles()

    async def _send(self, client: _Client) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while True:
                await client.wake.wait()
                client.wake.clear()
                while client.waiting:
                    await client.socket.send(client.waiting.popleft())

    def _hear(self, client: _Client, message: str | bytes) -> bool:
        """Do what a page asks for; whether it is a message of ours."""
        try:
            asked = parsed_json(message, "a message")
        except FileError:
            return False
        if not isinstance(asked, dict) or len(asked) != 1:
            return False
        ((what, value),) = asked.items()
        with self._changed:
            may = client is self._helm()
            if what == "follow" and type(value) is int and -1 <= value < MOST_TANKS:
                client.tank = value
                self._asked += [(client, value)] if value >= 0 else []
            elif what == "steer" and self.steered and (command := _command(value)) is not None:
                if may:
                    self._steer(command)
            elif what == "pause" and type(value) is bool:
                if may:
                    self._hold("pause" if value else "")
            elif what == "truth" and type(value) is bool:
                if may:
                    self._show_truth(value)
            else:
                return False
        return True

    # --------------------------------------------------------------------------------- where the lock is held

    def _helm(self) -> _Client | None:
        return next((client for client in self._clients if client.is_local), None)

    def _steer(self, command: Command) -> None:
        self._command, self._heard_s = command, self._now()
        if self._held == "start" and command != STOP:
            self._hold("")

    def _hold(self, why: str) -> None:
        self._held = why
        self._changed.notify_all()
        self._tell_roles()

    def _show_truth(self, with_truth: bool) -> None:
        self.with_truth = with_truth
        self.truth_was_seen |= with_truth
        self._asked += [(client, -1) for client in self._clients]
        self._asked += [(client, client.tank) for client in self._clients if client.tank >= 0]
        self._tell_roles()

    def _tell_roles(self) -> None:
        """Tell every page what it may do, and what goes on."""
        for client in [*self._clients]:
            role = {
                "kind": "role", "helm": client is self._helm(), "held": self._held, "steered": self.steered,
                "truth": self.with_truth, "note": self._note,
            }  # fmt: skip
            self._put(client, json.dumps(role))

    def _put(self, client: _Client, message: str) -> None:
        client.waiting.append(message)
        slow = len(client.waiting) > _BACKLOG
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(client.socket.transport.abort if slow else client.wake.set)

    # --------------------------------------------------------------------------------------------- the thread

    def _done(self, work: Coroutine[Any, Any, Any]) -> Any:
        """What the server's thread makes of it."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _closed(self) -> None:
        end_s = time.monotonic() + _CLOSE_S
        while any(client.waiting for client in self._clients) and time.monotonic() < end_s:
            await asyncio.sleep(_MOMENT_S)  # what was told last
        self._server.close()
        await self._server.wait_closed()

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def _command(value: Any) -> Command | None:
    """Four numbers (``parsed_json`` gives finite ones), cut off at -1 and 1; None for anything else."""
    if not isinstance(value, list) or len(value) != len(STOP):
        return None
    if not all(type(one) in (int, float) for one in value):
        return None
    surge, sway, heave, yaw = (min(max(float(one), -1.0), 1.0) for one in value)
    return surge, sway, heave, yaw
