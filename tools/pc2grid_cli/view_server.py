"""The server of `pc2grid view`: pages, an upload, and events, for this machine only.

Other web sites that are open in the same browser must not reach it: it listens on the loopback address, all
paths begin with a random token, and requests with a foreign `Host` (DNS rebinding) or `Origin` are refused.
An upload is stored under a name of ours and removed when its work ends, however that ends.
"""

from __future__ import annotations

import contextlib
import http.server
import queue
import re
import secrets
import select
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pc2grid.errors import LogTruncated, OutputError, Pc2GridError
from pc2grid_cli.console import json_text
from pc2grid_cli.view_events import Events

_ADDRESS = "127.0.0.1"
_BLOCK_BYTES = 1 << 20
_POLL_S = 0.2
"""How often the server looks whether it is to stop."""
_SILENCE_S = 60.0
"""A client that sends nothing for so long is gone."""
_LINGER_S = 1.0
_MOST_UNREAD_BYTES = 16 << 20
"""So long, and so much, is read of a request that was refused."""
_HEARTBEAT_S = 5.0
"""After so long without an event a comment is sent, which shows whether the page is still there."""
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Cancelled(Exception):
    """The client is gone, or the server stops: the work ends without an answer."""


Options = Mapping[str, str]
Work = Callable[[Path, Options, Callable[[], None]], dict[str, Any]]
"""Locates an uploaded file with options; calls the function now and then, which raises Cancelled. Returns the
document of the answer. Raises Pc2GridError."""


class ViewServer(http.server.ThreadingHTTPServer):
    """Serves pages, and locates one upload at a time.

    pages : by name, "" is the first one; may be changed at any time. folder : where uploads are stored.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, port: int, events: Events, folder: Path, work: Work, *, most_bytes: int) -> None:
        """port : 0 for any that is free. Raises OSError if the port is taken."""
        super().__init__((_ADDRESS, port), _Handler)
        self.token = secrets.token_urlsafe(16)
        self.pages: dict[str, bytes] = {}
        self.events, self.folder, self.work, self.most_bytes = events, folder, work, most_bytes
        self.busy = threading.Lock()
        self.stopping = threading.Event()

    @property
    def url(self) -> str:
        """The address of the first page."""
        return f"http://{_ADDRESS}:{self.server_port}/{self.token}/"

    def serve_forever(self, poll_interval: float = _POLL_S) -> None:
        """Serve until the process is interrupted."""
        super().serve_forever(poll_interval)

    @contextlib.contextmanager
    def in_background(self) -> Iterator[None]:
        """Serves in a thread of its own; no recordings are taken meanwhile."""
        thread = threading.Thread(target=self.serve_forever, daemon=True)
        with self.busy:
            thread.start()
            try:
                yield
            finally:
                self.shutdown()
                thread.join()

    def stop(self, wait_s: float = 10.0) -> None:
        """Cancel the work that is going on, wait for its end, and close the socket."""
        self.stopping.set()
        self.events.close()
        if self.busy.acquire(timeout=wait_s):
            self.busy.release()
        self.server_close()

    def shutdown_request(self, request: Any) -> None:
        """Close a connection. What the client still sends is read first: unread, it would reset the
        connection, and the answer would be lost."""
        with contextlib.suppress(OSError):
            request.shutdown(socket.SHUT_WR)
            request.settimeout(_LINGER_S)
            left = _MOST_UNREAD_BYTES
            while left > 0 and (block := request.recv(min(left, 1 << 16))):
                left -= len(block)
        self.close_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no error of ours; anything else is printed."""
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Handler(http.server.BaseHTTPRequestHandler):
    server: ViewServer
    server_version = "pc2grid"
    sys_version = ""
    timeout = _SILENCE_S
    _begun = False
    """Whether an answer was begun. A connection carries one request: HTTP/1.0."""

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not printed."""

    def do_GET(self) -> None:
        """A page, or the events."""
        self._answered(self._get)

    def do_POST(self) -> None:
        """Locate the recording in the body of the request."""
        self._answered(self._post)

    def _answered(self, answer: Callable[[], None]) -> None:
        """Answer a request; an error of the program is printed, and the client is told that there was one."""
        try:
            answer()
        except (ConnectionError, TimeoutError):
            raise  # nobody is there to be answered
        except Exception:
            self.server.handle_error(self.request, self.client_address)
            if not self._begun:
                status = HTTPStatus.INTERNAL_SERVER_ERROR
                self._refuse(status, "internal error", "the terminal of pc2grid view shows it")

    def _get(self) -> None:
        name = self._allowed()
        if name is None:
            return
        if name == "events":
            self._send_events()
        elif name in self.server.pages:
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.pages[name])
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")

    def _post(self) -> None:
        name = self._allowed()
        if name is None:
            return
        if name != "locate":
            self._refuse(HTTPStatus.NOT_FOUND, "recordings are sent to locate")
            return
        if self.server.stopping.is_set() or not self.server.busy.acquire(blocking=False):
            self._refuse(HTTPStatus.CONFLICT, "something else is being located", "wait until it is done")
            return
        try:
            reply = self._locate()
        finally:
            self.server.busy.release()
        # Behind the work: whoever has the answer may send the next recording at once.
        if reply is not None:
            self._send_json(*reply)

    # --- who asks -------------------------------------------------------------------------------------

    def _allowed(self) -> str | None:
        """The name of what is asked for, without the token; None, and an answer, if it is not allowed."""
        port = self.server.server_port
        hosts = {f"{host}:{port}" for host in (_ADDRESS, "localhost")}
        origin = self.headers.get("Origin")
        try:
            path = urlsplit(self.path).path
        except ValueError as error:  # a host in brackets that is no address
            self._refuse(HTTPStatus.BAD_REQUEST, f"not an address: {error}")
            return None
        _, token, name = f"{path}//".split("/", 2)
        ours = secrets.compare_digest(token.encode(), self.server.token.encode())
        from_here = self.headers.get("Host") in hosts and (
            origin is None or origin in {f"http://{host}" for host in hosts}
        )
        if not ours or not from_here:
            self._refuse(HTTPStatus.FORBIDDEN, "not allowed", "open the address that pc2grid view printed")
            return None
        return name.strip("/")

    def _is_gone(self) -> bool:
        """Whether the client has closed the connection. It sends nothing more after the recording."""
        try:
            readable, _, _ = select.select([self.connection], [], [], 0)
            return bool(readable) and not self.connection.recv(1, socket.MSG_PEEK)
        except OSError:
            return True

    def _check(self) -> None:
        if self.server.stopping.is_set() or self._is_gone():
            raise Cancelled

    # --- answers --------------------------------------------------------------------------------------

    def _begin(self, status: HTTPStatus, kind: str, size: int | None = None) -> None:
        self._begun = True
        self.send_response(status)
        self.send_header("Content-Type", kind)
        if size is not None:
            self.send_header("Content-Length", str(size))
        for name, value in (
            ("Cache-Control", "no-store"),
            ("Content-Security-Policy", _POLICY),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
            ("X-Content-Type-Options", "nosniff"),
        ):
            self.send_header(name, value)
        self.end_headers()

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self._begin(status, kind, len(body))
        self.wfile.write(body)

    def _send_json(self, status: HTTPStatus, document: Any) -> None:
        self._send(status, "application/json", json_text(document).encode())

    def _refuse(self, status: HTTPStatus, error: str, hint: str | None = None) -> None:
        self._send_json(*_refusal(status, error, hint))

    def _send_events(self) -> None:
        with self.server.events.subscribed() as events:
            self._begin(HTTPStatus.OK, "text/event-stream")
            while True:
                try:
                    event = events.get(timeout=_HEARTBEAT_S)
                except queue.Empty:
                    event = b": nothing new\n\n"
                if event is None:
                    return
                self.wfile.write(event)

    # --- an upload ------------------------------------------------------------------------------------

    def _locate(self) -> tuple[HTTPStatus, Any] | None:
        """The answer, or why there is none; None if nobody waits for it."""
        options = {key: values[-1] for key, values in parse_qs(urlsplit(self.path).query).items()}
        text = self.headers.get("Content-Length", "")
        if not re.fullmatch(r"[0-9]{1,18}", text):
            return _refusal(HTTPStatus.LENGTH_REQUIRED, "the size of the recording is not said")
        size = int(text)
        if size > self.server.most_bytes:
            return _refusal(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"the recording has {size / 1e9:.1f} GB; the limit is {self.server.most_bytes / 1e9:.1f} GB",
                "pc2grid view --most-gb, or pc2grid relocalize, which needs no copy",
            )
        path = self.server.folder / safe_name(options.get("name", ""))
        try:
            self._receive(path, size)
            return HTTPStatus.OK, self.server.work(path, options, self._check)
        except Pc2GridError as error:
            return _refusal(HTTPStatus.UNPROCESSABLE_ENTITY, error.message, error.hint)
        except Cancelled:
            self.close_connection = True
            return None
        finally:
            path.unlink(missing_ok=True)

    def _receive(self, path: Path, size: int) -> None:
        with path.open("wb", buffering=0) as file:
            while size:
                if self.server.stopping.is_set():
                    raise Cancelled
                try:
                    block = self.rfile.read(min(size, _BLOCK_BYTES))
                except (ConnectionError, TimeoutError):
                    raise Cancelled from None
                if not block:
                    raise LogTruncated(f"{path.name}: {size} bytes of it were not sent")
                try:
                    file.write(block)
                except OSError as error:
                    raise OutputError(
                        f"the recording cannot be copied: {error.strerror or error}",
                        hint="set TMPDIR to a larger disk, or use pc2grid relocalize, which needs no copy",
                    ) from error
                size -= len(block)


def _refusal(status: HTTPStatus, error: str, hint: str | None = None) -> tuple[HTTPStatus, Any]:
    return status, {"error": error, "hint": hint}


def safe_name(name: str) -> str:
    """A name for the file of an upload: the last part of what the client calls it, of harmless characters.

    >>> safe_name("../../etc/passwd"), safe_name("C:\\\\logs\\\\run 1.mcap"), safe_name("..")
    ('passwd', 'run_1.mcap', 'recording')
    """
    last = re.split(r"[/\\]", name)[-1]
    return re.sub(r"[^A-Za-z0-9._-]", "_", last)[-100:].lstrip(".-") or "recording"
