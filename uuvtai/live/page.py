"""The server of the page with running episodes: the page over HTTP, and over its WebSocket whatever it is
told to show; who may look, and who steers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from uuvtai.live.server import OWN_NAMES, Answer, Client, LiveServer

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

MOST_TANKS = 16  # side by side
STALE_S = 0.3  # a command that is older than this means: stop [s]
_MOMENT_S = 0.02
_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": "frame-ancestors 'none'",  # beside the page's own, which allows its one script
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
STOP = (0.0, 0.0, 0.0, 0.0)
Command = tuple[float, ...]
"""surge, sway, heave, yaw rate, each in [-1, 1] of the vehicle's limits"""


class PageServer(LiveServer):
    """Serves a page and tells it what is shown. The oldest page of this machine has the helm: it alone may
    pause, steer and ask for the truth."""

    scheme, path = "http", "/live"

    def __init__(
        self,
        page: str,
        host: str = "127.0.0.1",
        port: int = 8765,
        origins: Collection[str] = (),
        steered: bool = False,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """``origins``: addresses by which it is reached too; ``steered``: a vehicle waits for who has the
        helm, and the truth is hidden. Raises LiveError."""
        self._page, self.steered, self._now = page, steered, now
        self._names = {host, *OWN_NAMES}
        self._asked: dict[Client, bool] = {}
        self._driver: Client | None = None
        self._command, self._heard_s = STOP, 0.0
        self._held, self._note = "", ""
        self.with_truth, self.truth_was_seen = not steered, False
        super().__init__(host, port, origins)

    # ------------------------------------------------------------------------------ for who runs the episodes

    def asked(self) -> dict[Client, bool]:
        """Clients that have come or follow another ``tank`` since the last call, and whether they are to be
        told all: one entry each, however often they ask."""
        with self._lock:
            asked, self._asked = self._asked, {}
        return asked

    def followed(self) -> set[int]:
        """Tanks that somebody follows."""
        with self._lock:
            return {client.tank for client in self._clients}

    def tell(self, message: str, tank: int | None = None, to: Any = None) -> None:
        """A message for all, for those who follow a tank, or for one."""
        with self._lock:
            for client in self._clients:
                if to in (None, client) and tank in (None, client.tank):
                    self.put(client, message)

    def is_held(self, at_start: bool = False) -> bool:
        """Whether the episode has to wait, of which a moment has been waited. A vehicle that is steered waits
        ``at_start`` for the first command, and while nobody has the helm."""
        with self._lock:
            if self.steered and (at_start or not self._helm()) and not self._held:
                self._hold("start")
            if self._held:
                self._lock.wait(_MOMENT_S)
            return bool(self._held)

    def command(self) -> Command:
        """The newest command; ``STOP`` where it is too old."""
        with self._lock:
            return self._command if self._now() - self._heard_s <= STALE_S else STOP

    def note(self, text: str) -> None:
        """Say it on the page."""
        with self._lock:
            self._note = text
            self._tell_roles()

    # --------------------------------------------------------------------------------- in the server's thread

    def refusal(self, connection: ServerConnection, request: Request) -> Answer | None:
        """Another host's name, which may lead here, and pages of elsewhere."""
        allowed = {self.at(name) for name in (*self._names, connection.local_address[0])}
        allowed |= {urlsplit(origin).netloc for origin in self._origins}
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or hosts[0].lower() not in allowed:
            return HTTPStatus.FORBIDDEN, f"open {self.url}, or allow this name with --origin\n"
        if not {*origins} <= {f"http://{host}" for host in allowed} | self._origins:
            return HTTPStatus.FORBIDDEN, "that page may not connect\n"
        return None

    def document(self, connection: ServerConnection) -> Response:
        """The page."""
        page = connection.respond(HTTPStatus.OK, self._page)
        del page.headers["Content-Type"]
        page.headers.update(_HEADERS)
        return page

    def arrived(self, client: Client) -> None:
        """Tell the new client everything, and who may do what."""
        self._asked[client] = True
        self._tell_roles()

    def left(self, client: Client) -> None:
        """The next may have the helm, and begins with a vehicle that stops."""
        if client is self._driver:
            self._command = STOP
        self._tell_roles()

    def heard(self, client: Client, asked: Any) -> bool:
        """Do what a page asks for, if it may; whether it is a message of ours."""
        what, value = next(iter(asked.items())) if asked and len(asked) == 1 else ("", None)
        may = client is self._helm()
        if what == "follow" and type(value) is int and -1 <= value < MOST_TANKS:
            client.tank = value
            self._asked.setdefault(client, False)
        elif what == "steer" and self.steered and (command := _command(value)) is not None:
            if may:
                self._steer(client, command)
        elif what == "pause" and type(value) is bool:
            if may:
                self._hold("pause" if value else "")
        elif what == "truth" and type(value) is bool:
            if may:
                self.with_truth = value
                self.truth_was_seen |= value
                self._asked |= dict.fromkeys(self._clients, True)
                self._tell_roles()
        else:
            return False
        return True

    # --------------------------------------------------------------------------------- where the lock is held

    def _helm(self) -> Client | None:
        return next((client for client in self._clients if client.is_local), None)

    def _steer(self, client: Client, command: Command) -> None:
        self._driver, self._command, self._heard_s = client, command, self._now()
        if self._held == "start" and command != STOP:
            self._hold("")

    def _hold(self, why: str) -> None:
        self._held = why
        self._lock.notify_all()
        self._tell_roles()

    def _tell_roles(self) -> None:
        """Tell every page what it may do, and what goes on."""
        for client in self._clients:
            role = {
                "kind": "role", "helm": client is self._helm(), "held": self._held, "steered": self.steered,
                "truth": self.with_truth, "note": self._note,
            }  # fmt: skip
            self.put(client, json.dumps(role))


def _command(value: Any) -> Command | None:
    """Four numbers (``parsed_json`` gives finite ones), cut off at -1 and 1; None for anything else."""
    is_list = isinstance(value, list) and len(value) == len(STOP)
    if not is_list or not all(type(part) in (int, float) for part in value):
        return None
    return tuple(min(max(float(part), -1.0), 1.0) for part in value)
