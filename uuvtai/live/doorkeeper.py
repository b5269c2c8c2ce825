"""Who may connect to the server of episodes: a relay in front of it, which looks at each request and passes
bytes on. The SDK's own server takes any web page's script, and any number of clients."""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
import socket
import sys
import threading
import time
from collections.abc import Collection
from urllib.parse import urlsplit

MOST_CLIENTS = 8
"""at once, whether they have sent a request already or not"""
_REQUEST_S, _REQUEST_BYTES = 5.0, 16 << 10
_SLOW_S = 10.0
"""a client that takes nothing for as long is dropped [s]"""
_BUFFER = 256 << 10
"""[bytes] that the system keeps for each side of a client"""
_OWN_NAMES = ("localhost", "127.0.0.1", "::1")
_DESKTOP = "file://"
"""origin of Foxglove's and Lichtblick's programs; no web page can name it"""


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
        """Let go of the port and of all who are connected."""
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
        own = {*_OWN_NAMES, self._host, address}
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
