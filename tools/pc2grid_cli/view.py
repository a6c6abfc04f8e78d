"""`pc2grid view`: a database in the browser, and recordings that are dropped there, located at once.

`Locator` locates, `Events` passes what happens on to all pages that look on (server-sent events), and
`ViewServer` serves the pages, takes an upload, and sends the events, for this machine only.

Other web sites that are open in the same browser must not reach it: it listens on the loopback address, all
paths begin with a random token, and requests with a foreign `Host` (DNS rebinding) or `Origin` are refused.
An upload is stored under a name of ours and removed when its work ends, however that ends.
"""

from __future__ import annotations

import contextlib
import http.server
import json
import os
import queue
import re
import secrets
import select
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pc2grid import libraries
from pc2grid.display import plain
from pc2grid.errors import ConfigError, LogTruncated, OutputError, Pc2GridError
from pc2grid.geometry import SE2
from pc2grid.io.live.live_log import open_live
from pc2grid.model import Health, RegisteredScan
from pc2grid.observer import Observer, seldom
from pc2grid_cli import console, known_pose, options
from pc2grid_cli.console import json_text
from pc2grid_cli.watch import feed
from signature.config import Config
from signature.database import SubmapDatabase
from signature.localization.answer import Answer
from signature.localization.localizer import Follower, Localizer
from signature.places.map_index import MapIndex
from signature.sessions import find, query_config
from signature.shown.page import page

_META = '<meta http-equiv="Content-Security-Policy"'


def run(given: options.ViewDatabase, terminal: console.Console) -> None:
    """Serve the pages until the program is stopped."""
    libraries.require(libraries.of_addresses(given.source, given.database))
    settings, most_bytes = given.settings(), round(given.most_gb * 1e9)
    with (
        known_pose.searched(given) as (opened, _),
        tempfile.TemporaryDirectory(prefix="pc2grid-view-") as folder,
    ):
        locator = Locator(opened, settings)
        try:
            server = ViewServer(given.port, locator.events, Path(folder), locator.work, most_bytes=most_bytes)
        except OSError as error:
            raise OutputError(
                f"port {given.port}: {error.strerror}", hint="--port 0 takes any port that is free"
            ) from error
        locator.pages = server.pages
        server.pages[""] = live_page(opened)
        try:
            print(server.url, flush=True)
            if given.source is None:
                terminal.note("drop a recording onto the page; Ctrl-C ends this")
            if not given.no_browser:
                _open_browser(server.url)
            if given.source is None:
                server.serve_forever()
                return
            with server.in_background():
                locator.follow(given.source)
                terminal.note("the page stays as it is; Ctrl-C ends this")
                threading.Event().wait()
        finally:
            server.stop()


class Locator:
    """Locates one recording after another in a database, and reports the progress to the pages."""

    def __init__(self, database: SubmapDatabase, settings: Config) -> None:
        self._database, self._settings = database, settings
        self.events = Events()
        self.pages: dict[str, bytes] = {}

    def work(self, path: Path, asked: Options, check: Callable[[], None]) -> dict[str, Any]:
        """Locate a recording: a `pc2grid_cli.view.Work`.

        asked : `near`, x,y,radius in metres, and `session`, whose map frame they are in.
        """
        events, progress = self.events, Progress(self.events)
        events.publish("begin", {"source": path.name})

        def see(registered: RegisteredScan, answer: Answer | None) -> None:
            check()
            progress.add(registered)
            if answer is not None:
                progress.tell(answer)

        try:
            known = options.KnownPose(near=_near(asked.get("near")), session=asked.get("session"))
            found = find(
                path,
                self._database,
                self._settings,
                observer=progress,
                see=see,
                prior=lambda log, span: known_pose.prior(known, log, span),
                index=self._index,
            )
            progress.flush()
            self.pages["answer"] = live_page(self._database, found=found)
        except BaseException as error:
            told: dict[str, Any] = {"error": "internal error; the terminal shows it", "hint": None}
            if isinstance(error, Pc2GridError):
                # Messages name the recording as the user does, not the place of our copy.
                error.message = error.message.replace(str(path), path.name)
                told = {"error": error.message, "hint": error.hint}
            elif isinstance(error, Cancelled):
                told["error"] = "stopped"
            events.publish("end", {"source": path.name, **told})
            raise
        told = {"status": found.status, "session": found.session, "confidence": found.confidence}
        events.publish("end", {"source": path.name, **told})
        return plain({**found.to_json(), "query": found.about})

    def follow(self, source: str) -> None:
        """Show a running robot until its source ends.

        source : as `pc2grid watch` takes it. Raises the errors of `pc2grid.io.live.live_log.open_live`.
        """
        config = query_config(self._database, self._settings)
        localizer, progress = Localizer(self._index), Progress(self.events)
        with (
            open_live(source, config.read) as live,
            Follower(localizer, beside=True, step_m=config.relocalize.step_m) as follower,
        ):
            self.events.publish("begin", {"source": source})
            feed(live, follower, config, lambda answer, lock: progress.tell(answer), see=progress.add)
            progress.flush()
        self.events.publish("end", {"source": source, "error": "the source has ended", "hint": None})

    @cached_property
    def _index(self) -> MapIndex:
        """Return the maps, prepared once for all recordings."""
        return MapIndex.of(self._database, query_config(self._database, self._settings))


def live_page(database: SubmapDatabase, **answer: Any) -> bytes:
    """Return the page of a report, with the part that takes recordings and shows events."""
    html = page(database, **answer)
    live = files("pc2grid_cli").joinpath("view.html").read_text(encoding="utf-8")
    # The policy of a report allows no connection; the server sends one that allows those to itself.
    before, _, rest = html.partition(_META)
    html = before + rest.partition(">")[2] if rest else before
    main = html.index("<main")
    script = html.rindex("</body>")
    panel, _, code = live.partition("<!-- behind the page -->")
    return (html[:main] + panel + html[main:script] + code + html[script:]).encode()


def _near(text: str | None) -> tuple[float, float, float] | None:
    """Return x, y, radius of a request. Raises ConfigError."""
    if text is None:
        return None
    try:
        x, y, radius = map(float, text.split(","))
    except ValueError:
        raise ConfigError(f"near: expected x,y,radius in metres, found {text!r:.40}") from None
    return x, y, radius


def _open_browser(url: str) -> None:
    """Open a browser where there is a screen; one for text terminals would take this terminal."""
    import webbrowser

    if sys.platform == "linux" and not any(os.environ.get(v) for v in ("DISPLAY", "WAYLAND_DISPLAY")):
        return
    webbrowser.open(url)


_MOST_WAITING = 1000
"""Events that wait for a page that does not read them; older ones are dropped."""
_MOST_SCANS = 4000
"""Scans of the path so far, for pages that come later; of a longer path every second one is left out."""


class Events:
    """Passes events on to any number of pages."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pages: list[queue.Queue[bytes | None]] = []
        self._last: dict[str, bytes] = {}
        self._scans: list[Any] = []
        self._closed = False

    def publish(self, kind: str, data: Any) -> None:
        """Send an event; the last one of each kind, and all scans, are kept for pages that come later."""
        event = _event(kind, data)
        with self._lock:
            if kind == "begin":  # what was before is over
                self._last.clear()
                self._scans.clear()
            if kind == "scans":
                self._scans.extend(data)
                if len(self._scans) > _MOST_SCANS:
                    del self._scans[1::2]
            else:
                self._last[kind] = event
            for page in self._pages:
                _put(page, event)

    @contextlib.contextmanager
    def subscribed(self) -> Iterator[queue.Queue[bytes | None]]:
        """Yield what was, then the events as they come, then None at the end."""
        page: queue.Queue[bytes | None] = queue.Queue(_MOST_WAITING)
        with self._lock:
            for kind, event in self._last.items():
                _put(page, event)
                if kind == "begin" and self._scans:
                    _put(page, _event("scans", self._scans))
            if self._closed:
                _put(page, None)
            self._pages.append(page)
        try:
            yield page
        finally:
            with self._lock:
                self._pages.remove(page)

    def close(self) -> None:
        """Tell all pages that no more events come."""
        with self._lock:
            self._closed = True
            for page in self._pages:
                _put(page, None)


def _event(kind: str, data: Any) -> bytes:
    return f"event: {kind}\ndata: {json.dumps(data, allow_nan=False)}\n\n".encode()


def _put(page: queue.Queue[bytes | None], event: bytes | None) -> None:
    """Add an event, in place of the oldest one if the page does not keep up."""
    while True:
        try:
            page.put_nowait(event)
            return
        except queue.Full:
            with contextlib.suppress(queue.Empty):
                page.get_nowait()


class Progress(Observer):
    """Publishes the scans of one query, its answers, and the share of the recording that is done.

    Events: `scans`, a list of x, y, yaw in the query's own frame, and 1 where another such frame begins,
    because registration was lost; `moment`, the state of the answer with the pose in the map and the base in
    the query's frame, from which a page draws the path on the map.
    """

    def __init__(self, events: Events) -> None:
        """Publish as `events`."""
        self.events = events
        self._waiting: list[list[float]] = []
        self._base = (0.0, 0.0, 0.0)
        self._send = seldom(lambda share: self.flush())
        self._publish_share = seldom(lambda share: events.publish("share", {"share": round(share, 4)}))

    def on_progress(self, share: float) -> None:
        """See `Observer.on_progress`."""
        self._publish_share(share)

    def add(self, registered: RegisteredScan | None) -> None:
        """Add the next scan; None: what follows does not go on from what was before."""
        if registered is None:
            self._waiting.append([*self._base, 1])
            return
        self._base = _planar(SE2.from_matrix(registered.T_session_base))
        self._waiting.append([*self._base, int(registered.health is Health.LOST)])
        self._send(0.0)

    def tell(self, answer: Answer) -> None:
        """Publish an answer; if it is not located, with the best place all the same."""
        self.flush()
        pose = answer.pose
        self.events.publish(
            "moment",
            {
                "path_m": answer.path_m,
                "status": answer.status,
                "session": answer.best_session,
                "confidence": answer.confidence,
                "pose": pose and [pose.x, pose.y, pose.yaw],
                "base": _planar(answer.T_odom_base),
            },
        )

    def flush(self) -> None:
        """Send the scans that wait."""
        if self._waiting:
            self.events.publish("scans", self._waiting)
        self._waiting = []


def _planar(base: SE2) -> tuple[float, float, float]:
    """Return x, y, yaw of the base in the query's frame, as finely as it can be seen."""
    return round(base.x, 3), round(base.y, 3), round(base.yaw, 4)


_ADDRESS = "127.0.0.1"
_BLOCK_BYTES = 1 << 20
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


@dataclass(eq=False)
class Refused(Exception):
    """A request that is not answered, and what to do instead."""

    status: HTTPStatus
    error: str
    hint: str | None = None


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
        """Listen on this machine alone.

        port : 0 for any that is free. Raises OSError if the port is taken.
        """
        super().__init__((_ADDRESS, port), _Handler)
        self.token = secrets.token_urlsafe(16)
        self.pages: dict[str, bytes] = {}
        self.events, self.folder, self.work, self.most_bytes = events, folder, work, most_bytes
        self.busy = threading.Lock()
        self.stopping = threading.Event()

    @property
    def url(self) -> str:
        """Return the address of the first page."""
        return f"http://{_ADDRESS}:{self.server_port}/{self.token}/"

    @contextlib.contextmanager
    def in_background(self) -> Iterator[None]:
        """Serve in a thread of its own; no recordings are taken meanwhile."""
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
        """Print an error, unless the client went away."""
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
        """Print nothing of requests."""

    def do_GET(self) -> None:
        """Send a page, or the events."""
        self._answered(self._get)

    def do_POST(self) -> None:
        """Locate the recording in the body of the request."""
        self._answered(self._post)

    def _answered(self, answer: Callable[[str], None]) -> None:
        """Answer a request; an error of the program is printed, and the client is told that there was one.

        answer : is called with the name of what is asked for.
        """
        try:
            answer(self._allowed())
        except Refused as refusal:
            self._send_refusal(refusal)
        except (ConnectionError, TimeoutError, Cancelled):
            return  # nobody is there to be answered
        except Exception:
            self.server.handle_error(self.request, self.client_address)
            if not self._begun:
                status, hint = HTTPStatus.INTERNAL_SERVER_ERROR, "the terminal of pc2grid view shows it"
                self._send_refusal(Refused(status, "internal error", hint))

    def _get(self, name: str) -> None:
        if name == "events":
            self._send_events()
        elif name in self.server.pages:
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.pages[name])
        else:
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such page")

    def _post(self, name: str) -> None:
        if name != "locate":
            raise Refused(HTTPStatus.NOT_FOUND, "recordings are sent to locate")
        if self.server.stopping.is_set() or not self.server.busy.acquire(blocking=False):
            raise Refused(HTTPStatus.CONFLICT, "something else is being located", "wait until it is done")
        try:
            answer = self._locate()
        finally:
            self.server.busy.release()
        # Behind the work: whoever has the answer may send the next recording at once.
        self._send_json(HTTPStatus.OK, answer)

    # --- who asks -------------------------------------------------------------------------------------

    def _allowed(self) -> str:
        """Return the name of what is asked for, without the token. Raises Refused."""
        try:
            path = urlsplit(self.path).path
        except ValueError as error:  # a host in brackets that is no address
            raise Refused(HTTPStatus.BAD_REQUEST, f"not an address: {error}") from None
        _, token, name = f"{path}//".split("/", 2)
        ours = secrets.compare_digest(token.encode(), self.server.token.encode())
        hosts = {f"{host}:{self.server.server_port}" for host in (_ADDRESS, "localhost")}
        origins = {None, *(f"http://{host}" for host in hosts)}
        if not ours or self.headers.get("Host") not in hosts or self.headers.get("Origin") not in origins:
            raise Refused(HTTPStatus.FORBIDDEN, "not allowed", "open the address that pc2grid view printed")
        return name.strip("/")

    def _is_gone(self) -> bool:
        """Return whether the client has closed the connection. It sends nothing more after the recording."""
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

    def _send_refusal(self, refusal: Refused) -> None:
        self._send_json(refusal.status, {"error": refusal.error, "hint": refusal.hint})

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

    def _locate(self) -> Any:
        """Return the answer. Raises Refused, and Cancelled if nobody waits for it."""
        options = {key: values[-1] for key, values in parse_qs(urlsplit(self.path).query).items()}
        text = self.headers.get("Content-Length", "")
        if not re.fullmatch(r"[0-9]{1,18}", text):
            raise Refused(HTTPStatus.LENGTH_REQUIRED, "the size of the recording is not said")
        size = int(text)
        if size > self.server.most_bytes:
            raise Refused(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"the recording has {size / 1e9:.1f} GB; the limit is {self.server.most_bytes / 1e9:.1f} GB",
                "pc2grid view --most-gb, or pc2grid relocalize, which needs no copy",
            )
        path = self.server.folder / safe_name(options.get("name", ""))
        try:
            self._receive(path, size)
            return self.server.work(path, options, self._check)
        except Pc2GridError as error:
            raise Refused(HTTPStatus.UNPROCESSABLE_ENTITY, error.message, error.hint) from error
        finally:
            path.unlink(missing_ok=True)

    def _receive(self, path: Path, size: int) -> None:
        with path.open("wb", buffering=0) as file:
            while size:
                if self.server.stopping.is_set():
                    raise Cancelled
                block = self.rfile.read(min(size, _BLOCK_BYTES))
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


def safe_name(name: str) -> str:
    """Return a name for the file of an upload: the last part of the client's name, of harmless characters.

    >>> safe_name("../../etc/passwd"), safe_name("C:\\\\logs\\\\run 1.mcap"), safe_name("..")
    ('passwd', 'run_1.mcap', 'recording')
    """
    last = re.split(r"[/\\]", name)[-1]
    return re.sub(r"[^A-Za-z0-9._-]", "_", last)[-100:].lstrip(".-") or "recording"
