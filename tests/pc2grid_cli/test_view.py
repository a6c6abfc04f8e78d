"""`pc2grid view`: what the server gives, and to whom; an upload from its first byte to its answer."""

import contextlib
import functools
import http.client
import json
import os
import queue
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.errors import NoScans
from pc2grid.io.trajectory import read_tum
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app
from pc2grid_cli.view import Events, Locator, Options, ViewServer, live_page, safe_name
from signature.config import Config
from signature.database import open_database
from tests.helpers.browser import DESK, PHONE, Browser
from tests.helpers.interruptible import interruptible
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import office

ROOT = Path(__file__).resolve().parents[2]


@shared_folder("office_folder")
def desk(folder: Path) -> None:
    """office.submaps, and drive.mcap, a laser's 3 m in the office."""
    (folder / "b.submaps").rename(folder / "office.submaps")
    config = SimulationConfig(length_m=3.0, seed=4, clutter=0)
    simulate_session(folder / "drive.mcap", sensor="laser", grid=office(), config=config, overwrite=True)


class Served:
    """A server that runs in a thread."""

    def __init__(self, folder: Path, work: Any, events: Events, most_bytes: int = 10_000_000) -> None:
        self.server = ViewServer(0, events, folder, work, most_bytes=most_bytes)
        self.server.pages[""] = b"<p>first page</p>"
        self.url, self.folder = self.server.url, folder
        self._thread = threading.Thread(
            target=functools.partial(self.server.serve_forever, poll_interval=0.01), daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        self.server.shutdown()
        self._thread.join()
        self.server.stop()

    def get(self, name: str = "", **headers: str) -> tuple[int, bytes, http.client.HTTPMessage]:
        return ask(urllib.request.Request(self.url + name, headers=headers))

    def post(self, body: bytes, query: str = "name=run.mcap", **headers: str) -> tuple[int, Any]:
        request = urllib.request.Request(f"{self.url}locate?{query}", data=body, headers=headers)
        status, text, _ = ask(request)
        return status, json.loads(text)


def ask(request: urllib.request.Request) -> tuple[int, bytes, http.client.HTTPMessage]:
    try:
        with urllib.request.urlopen(request, timeout=280) as reply:
            return reply.status, reply.read(), reply.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.headers


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Served]]:
    running = []

    def start(
        work: Any = lambda path, options, check: {}, events: Events | None = None, **limits: int
    ) -> Served:
        running.append(Served(tmp_path, work, events or Events(), **limits))
        return running[-1]

    yield start
    for served in running:
        served.stop()


def wait_until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


# --- to whom ----------------------------------------------------------------------------------------------


def test_only_this_machine_with_the_token_is_served(serve: Callable[..., Served]) -> None:
    served = serve()
    host = served.server.server_address[0]
    assert host == "127.0.0.1"
    assert served.get()[:2] == (200, b"<p>first page</p>")
    bare = served.url.replace(served.server.token + "/", "")
    for url in (bare, bare + "locate", bare + "x" * len(served.server.token) + "/", bare + "/"):
        assert ask(urllib.request.Request(url))[0] == 403
        assert ask(urllib.request.Request(url, data=b"abc"))[0] == 403
    assert len(served.server.token) >= 20 and serve().server.token != served.server.token


@pytest.mark.parametrize("header", ["Origin", "Host"])
def test_other_web_sites_are_refused_even_with_the_token(serve: Callable[..., Served], header: str) -> None:
    """A page of another site sends its own Origin; a name that was pointed to this machine is in Host."""
    worked = []
    served = serve(lambda path, options, check: worked.append(path) or {})
    own = served.url.split("/")[2]
    value = {"Origin": "http://evil.example", "Host": own.replace("127.0.0.1", "evil.example")}[header]
    assert served.get(**{header: value})[0] == 403
    assert served.post(b"abc", **{header: value})[0] == 403
    assert not worked
    mine = {"Origin": f"http://{own}", "Host": own.replace("127.0.0.1", "localhost")}[header]
    assert served.get(**{header: mine})[0] == 200
    assert served.post(b"abc", **{header: mine})[0] == 200 and worked


def test_answers_are_not_cached_sniffed_or_framed(serve: Callable[..., Served]) -> None:
    headers = serve().get()[2]
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "connect-src 'self'" in policy
    assert "frame-ancestors 'none'" in policy
    assert headers["Cache-Control"] == "no-store" and headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"  # the token stands in the address


@pytest.mark.parametrize("name", ["../../../etc/passwd", "%2e%2e/%2e%2e/etc/passwd", "answer", "..", "none"])
def test_there_are_no_files_behind_the_pages(serve: Callable[..., Served], name: str) -> None:
    served = serve()
    connection = http.client.HTTPConnection("127.0.0.1", served.server.server_port)
    connection.request("GET", f"/{served.server.token}/{name}")  # urllib would tidy the path
    reply = connection.getresponse()
    assert reply.status == 404 and b"root:" not in reply.read()


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("run.mcap", "run.mcap"),
        ("../../etc/passwd", "passwd"),
        ("C:\\logs\\run 1.mcap", "run_1.mcap"),
        ("/", "recording"),
        ("..", "recording"),
        (".hidden", "hidden"),
        ("", "recording"),
        ("a\0b\n<b>.mcap", "a_b__b_.mcap"),
        ("x" * 300 + ".mcap", "x" * 95 + ".mcap"),
    ],
)
def test_names_of_uploads_are_harmless(name: str, safe: str) -> None:
    assert safe_name(name) == safe


# --- an upload --------------------------------------------------------------------------------------------


def test_an_upload_is_worked_on_and_removed(serve: Callable[..., Served], tmp_path: Path) -> None:
    seen: list[tuple[str, bytes, Options]] = []

    def work(path: Path, options: Options, check: Callable[[], None]) -> dict[str, Any]:
        check()
        assert path.parent == tmp_path
        seen.append((path.name, path.read_bytes(), options))
        return {"status": "located", "share": float("nan")}

    status, document = serve(work).post(b"abc" * 1_000_000, "name=..%2Frun.mcap&near=1,2,3")
    assert status == 200 and document == {"status": "located", "share": None}
    assert [(name, len(data)) for name, data, _ in seen] == [("run.mcap", 3_000_000)]
    assert seen[0][2]["near"] == "1,2,3"
    assert list(tmp_path.iterdir()) == []


def test_errors_are_told_with_their_advice_and_leave_nothing(
    serve: Callable[..., Served], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def fail(path: Path, options: Options, check: Callable[[], None]) -> dict[str, Any]:
        raise NoScans("no scans", hint="record some")

    assert serve(fail).post(b"abc") == (422, {"error": "no scans", "hint": "record some"})

    def break_down(path: Path, options: Options, check: Callable[[], None]) -> dict[str, Any]:
        raise ZeroDivisionError

    broken = serve(break_down)
    status, told = broken.post(b"abc")
    assert status == 500 and "terminal" in told["hint"]
    assert "ZeroDivisionError" in capfd.readouterr().err
    assert broken.get()[0] == 200  # it goes on, and takes the next recording
    assert not broken.server.busy.locked()
    assert list(tmp_path.iterdir()) == []


def test_what_is_too_large_or_has_no_size_is_refused_before_it_is_read(serve: Callable[..., Served]) -> None:
    served = serve(most_bytes=1000)
    status, told = served.post(b"x" * 1001)
    assert status == 413 and "--most-gb" in told["hint"]
    for length in ("", "-1", "1e3", "9" * 30):
        connection = http.client.HTTPConnection("127.0.0.1", served.server.server_port)
        connection.putrequest("POST", f"/{served.server.token}/locate")
        if length:
            connection.putheader("Content-Length", length)
        connection.endheaders()
        assert connection.getresponse().status == 411


def say(served: Served, request: bytes) -> bytes:
    """All that is answered to the bytes of a request, which ends behind them."""
    with socket.create_connection(("127.0.0.1", served.server.server_port), timeout=60) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        answer = b""
        while block := connection.recv(1 << 16):
            answer += block
    return answer


def test_fuzzed_requests_are_answered_and_nothing_is_printed(
    serve: Callable[..., Served], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Requests with bytes changed, left out, inserted, doubled; in the line, the headers and the body."""
    served = serve(lambda path, options, check: {"size": path.stat().st_size, "near": options.get("near")})
    served.server.events.close()  # otherwise pages would wait for them
    own, token = f"127.0.0.1:{served.server.server_port}", served.server.token
    page = f"GET /{token}/ HTTP/1.1\r\nHost: {own}\r\nOrigin: http://{own}\r\nAccept: */*\r\n\r\n".encode()
    upload = (
        f"POST /{token}/locate?name=a%20b.mcap&near=1,2,3 HTTP/1.1\r\nHost: {own}\r\n"
        "Content-Type: application/octet-stream\r\nContent-Length: 20\r\n\r\n01234567890123456789"
    ).encode()
    assert b" 200 " in say(served, page).splitlines()[0]
    assert json.loads(say(served, upload).partition(b"\r\n\r\n")[2]) == {"size": 20, "near": "1,2,3"}
    rng = random.Random(1)
    pieces = [
        b"\0", b"\r\n", b"\n", b" ", b":", b"%", b"[", b"//", b"//[::1", b"\xff\xfe", b"\xe2\x84\x80",
        b"9" * 30, b"-1",
        b"A" * 70_000, b"X: y\r\n" * 200, b"HTTP/9.9", b"HEAD ", b"Expect: 100-continue\r\n", b"\r\n\r\n",
        b"Transfer-Encoding: chunked\r\n", b"Content-Length: 99\r\n", b"HTTP/1.\xb2", b"&" * 2000, b";=%zz",
    ]  # fmt: skip
    statuses = set()
    for _ in range(int(os.environ.get("PC2GRID_FUZZ", "150"))):
        request = bytearray(rng.choice((page, upload)))
        for _ in range(rng.randint(1, 4)):
            # Half of the changes are in the first line, where most is read.
            end = len(request) if rng.random() < 0.5 else request.find(b"\n") + 1
            at = rng.randrange(max(1, end))
            change = rng.randrange(5)
            if change == 0:
                request[at : at + 1] = bytes([rng.randrange(256)])
            elif change == 1:
                del request[at : at + rng.randint(1, 30)]
            elif change == 2:
                request[at:at] = rng.choice(pieces)
            elif change == 3:
                request[at:at] = request[at : at + rng.randint(1, 60)]
            else:
                del request[at:]
        if not request.partition(b"\n")[0].decode("latin-1").split():
            continue  # an empty line asks for nothing
        answer = say(served, bytes(request))
        status = re.match(rb"HTTP/1\.0 (\d+) ", answer)
        assert status or b"error" in answer.lower() or b"first page" in answer, bytes(
            request
        )  # HTTP/0.9 has none
        statuses |= {int(status[1])} if status else set()
    assert capfd.readouterr() == ("", "")
    assert {200, 400, 403, 404} <= statuses and 500 not in statuses
    assert served.get()[0] == 200 and not served.server.busy.locked()
    assert list(tmp_path.iterdir()) == []


def test_a_refusal_arrives_although_the_recording_was_not_read(serve: Callable[..., Served]) -> None:
    """Unread bytes reset a connection, and take the answer with them."""
    served = serve(most_bytes=1000)
    for _ in range(5):
        status, told = served.post(b"x" * 8_000_000)
        assert status == 413 and "--most-gb" in told["hint"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full disk here")
def test_a_disk_that_fills_up_is_told(
    serve: Callable[..., Served], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.mcap").symlink_to("/dev/full")
    status, told = serve().post(b"abc")
    assert status == 422 and "No space left" in told["error"] and "TMPDIR" in told["hint"]
    assert capfd.readouterr() == ("", "") and list(tmp_path.iterdir()) == []


class Slow:
    """Work that goes on until it is cancelled or let go."""

    def __init__(self) -> None:
        self.begun, self.go_on, self.ended = threading.Event(), threading.Event(), threading.Event()

    def __call__(self, path: Path, options: Options, check: Callable[[], None]) -> dict[str, Any]:
        self.begun.set()
        try:
            while not self.go_on.wait(0.01):
                check()
        finally:
            self.ended.set()
        return {}


def begin_upload(served: Served, size: int, sent: bytes) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", served.server.server_port))
    own = f"127.0.0.1:{served.server.server_port}"
    head = (
        f"POST /{served.server.token}/locate?name=a.mcap HTTP/1.1",
        f"Host: {own}",
        f"Content-Length: {size}",
    )
    connection.sendall("\r\n".join([*head, "", ""]).encode() + sent)
    return connection


def test_one_recording_at_a_time(serve: Callable[..., Served]) -> None:
    slow = Slow()
    served = serve(slow)
    first = threading.Thread(target=lambda: served.post(b"abc"))
    first.start()
    assert slow.begun.wait(120)
    status, told = served.post(b"abc")
    assert status == 409 and "something else" in told["error"]
    assert served.get()[0] == 200  # pages are served meanwhile
    slow.go_on.set()
    first.join()
    assert served.post(b"abc")[0] == 200


@pytest.mark.parametrize("when", ["while it is sent", "while it is worked on"])
def test_who_goes_away_cancels_the_work(serve: Callable[..., Served], tmp_path: Path, when: str) -> None:
    slow = Slow()
    served = serve(slow)
    connection = begin_upload(served, 1000 if when == "while it is sent" else 3, b"abc")
    if when == "while it is sent":
        wait_until(lambda: any(tmp_path.iterdir()))
    else:
        assert slow.begun.wait(120)
    connection.close()
    wait_until(lambda: not served.server.busy.locked())
    assert slow.begun.is_set() == slow.ended.is_set() == (when != "while it is sent")
    assert list(tmp_path.iterdir()) == []


def test_the_end_of_the_server_cancels_the_work(serve: Callable[..., Served], tmp_path: Path) -> None:
    slow, events = Slow(), Events()
    served = Served(tmp_path, slow, events)
    connection = begin_upload(served, 3, b"abc")
    assert slow.begun.wait(120)
    with events.subscribed() as page:
        served.stop()
        assert slow.ended.is_set() and page.get(timeout=5) is None
    connection.close()
    assert list(tmp_path.iterdir()) == []


# --- events -----------------------------------------------------------------------------------------------


def drain(page: queue.Queue[bytes | None]) -> list[tuple[str, Any]]:
    found = []
    with contextlib.suppress(queue.Empty):
        while (event := page.get_nowait()) is not None:
            kind, data = re.fullmatch(rb"event: (\w+)\ndata: (.*)\n\n", event).groups()
            found.append((kind.decode(), json.loads(data)))
    return found


def test_a_page_that_comes_later_is_told_what_was(monkeypatch: pytest.MonkeyPatch) -> None:
    events = Events()
    events.publish("begin", {"source": "old"})
    events.publish("end", {})
    events.publish("begin", {"source": "new"})
    for k in range(3):
        events.publish("scans", [[k, 0, 0, 0]])
        events.publish("moment", {"path_m": k})
    with events.subscribed() as page:
        told = drain(page)
        assert told == [
            ("begin", {"source": "new"}),
            ("scans", [[0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0]]),
            ("moment", {"path_m": 2}),
        ]
        events.publish("scans", [[3, 0, 0, 0]])
        assert drain(page) == [("scans", [[3, 0, 0, 0]])]


def test_memory_is_bounded_however_long_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    events = Events()
    with events.subscribed() as page:
        for k in range(20_000):
            events.publish("scans", [[k, 0, 0, 0]])
        assert page.qsize() <= 1000
        assert drain(page)[-1] == ("scans", [[19_999, 0, 0, 0]])
    events.publish("begin", {})
    for k in range(20_000):
        events.publish("scans", [[k, 0, 0, 0]])
    with events.subscribed() as page:
        scans = drain(page)[1][1]
        assert 1000 < len(scans) <= 4000 and scans[0][0] == 0 and scans[-1][0] >= 19_990


# --- a database -------------------------------------------------------------------------------------------


def test_a_recording_is_located_while_a_page_looks_on(desk: Path, serve: Callable[..., Served]) -> None:
    with open_database(desk / "office.submaps") as database:
        locator = Locator(database, Config())
        served = serve(locator.work, locator.events)
        locator.pages = served.server.pages
        served.server.pages[""] = live_page(database)
        page = served.get()[1].decode()
        assert "http-equiv" not in page  # its policy would forbid the events
        assert page.count("</script>") == 2 and 'id="live"' in page and "office.submaps" in page
        assert served.get("answer")[0] == 404

        recording = (desk / "drive.mcap").read_bytes()
        with locator.events.subscribed() as looking_on:
            status, document = served.post(recording, "name=drive.mcap")
            told = drain(looking_on)
        assert status == 200 and document["status"] in ("located", "ambiguous")
        assert document["query"]["source"] == "drive.mcap"
        kinds = [kind for kind, _ in told]
        assert kinds[0] == "begin" and kinds[-1] == "end" and {"share", "scans", "moment"} <= set(kinds)
        scans = [row for kind, data in told if kind == "scans" for row in data]
        assert len(scans) == document["query"]["scans"]
        moments = [data for kind, data in told if kind == "moment"]
        # The history of the answer, which ends with the answer itself.
        history = [m["path_m"] for m in document["history"]]
        assert [m["path_m"] for m in moments] in (history, history[:-1])
        assert told[-1][1]["status"] == document["status"]
        assert b"drive.mcap" in served.get("answer")[1]

        far = served.post(recording, "name=drive.mcap&near=-90,-90,1&session=office")[1]
        assert far["status"] == "not_found" and far["prior"]["status"] == "used"
        status, told_error = served.post(b"no recording", "name=x.mcap")
        assert status == 422 and told_error["error"].startswith("x.mcap: ")
        assert served.post(recording, "name=drive.mcap&near=1,2")[0] == 422


def test_a_robot_is_followed(desk: Path, tmp_path: Path) -> None:
    """Its recording stands for it: test_watch.py shows that a robot gives the same looks."""
    with open_database(desk / "office.submaps") as database:
        locator = Locator(database, Config())
        server = ViewServer(0, locator.events, tmp_path, locator.work, most_bytes=1000)
        server.pages[""] = live_page(database)
        with locator.events.subscribed() as looking_on:
            with server.in_background():
                locator.follow(str(desk / "drive.mcap"))
                status, body, _ = ask(urllib.request.Request(server.url + "locate", data=b"abc"))
                assert status == 409 and b"something else" in body
                assert ask(urllib.request.Request(server.url))[0] == 200
            told = drain(looking_on)
        server.stop()
    assert told[0][0] == "begin" and told[-1][1]["error"] == "the source has ended"
    scans = [row for kind, data in told if kind == "scans" for row in data]
    truth = read_tum(desk / "drive.tum").planar()
    assert len(scans) > 0.9 * len(truth)
    # Each pose lies on the path that was driven, and the last one near its end.
    moments = [data for kind, data in told if kind == "moment" and data["status"] == "located"]
    assert moments
    for moment in moments:
        assert np.hypot(*(truth[:, :2] - moment["pose"][:2]).T).min() < 2 * RESOLUTION_M
    assert np.hypot(*(truth[-1, :2] - moments[-1]["pose"][:2])) < 1.5


def test_the_command_prints_its_address_and_stops_with_ctrl_c(desk: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}", "TMPDIR": str(tmp_path)}
    view = subprocess.Popen(
        [sys.executable, "-c", "from pc2grid_cli.main import main; main()",
         "view", str(desk / "office.submaps"), "--no-browser"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        preexec_fn=interruptible,
    )  # fmt: skip
    try:
        assert view.stdout is not None
        url = view.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]+/", url)
        assert ask(urllib.request.Request(url))[0] == 200
        port = int(url.split(":")[2].split("/")[0])
        taken = CliRunner().invoke(
            app, ["view", str(desk / "office.submaps"), "--no-browser", "--port", str(port)]
        )
        assert taken.exit_code != 0 and f"port {port}" in str(taken.exception)
        view.send_signal(signal.SIGINT)
        _, errors = view.communicate(timeout=240)
        assert view.returncode == 130 and "Traceback" not in errors
        assert not list(tmp_path.glob("pc2grid-view-*"))
    finally:
        view.kill()
        view.wait()


BEGUN = {
    "begin": {"source": "run.mcap"},
    "scans": [[0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0]],
    "moment": {
        "path_m": 2.0, "status": "located", "session": "office", "confidence": 0.97,
        "pose": [5.0, 7.0, 0.0], "base": [2.0, 0.0, 0.0],
    },
}  # fmt: skip


def begun(desk: Path, serve: Callable[..., Served], **moment: str) -> tuple[Served, Events]:
    """A server of the page of the office, which was told how a search begins."""
    events = Events()
    served = serve(events=events)
    with open_database(desk / "office.submaps") as database:
        served.server.pages[""] = live_page(database)
    for kind, told in BEGUN.items():
        events.publish(kind, {**told, **moment} if kind == "moment" else told)
    return served, events


@pytest.mark.parametrize("end", [None, "located", "ambiguous", "error"])
def test_a_browser_shows_what_happens(
    desk: Path, serve: Callable[..., Served], browser: Browser, end: str | None
) -> None:
    unsure = end in ("ambiguous", "error")
    served, events = begun(desk, serve, **({"status": "ambiguous"} if unsure else {}))
    if end == "error":
        events.publish("end", {"source": "run.mcap", "error": "stopped", "hint": None})
    elif end:
        events.publish("end", {"source": "run.mcap", "status": end, "confidence": 0.97})
    browser.show(served.url)
    said = {None: "after 2.0 m", "error": "stopped"}.get(end, f"run.mcap: {end}")
    browser.wait(f"$('told').textContent.startsWith('{said}')")
    if unsure:
        browser.evaluate("new Promise(seen => setTimeout(seen, 100))")
        assert browser.evaluate("$('trace')") is None, "an arrow at a place that is no answer"
        return
    if end is None:
        words = "after 2.0 m: located, confidence 0.97; best place: office, x 5.00 m, y 7.00 m"
        assert browser.evaluate("$('told').textContent") == words
    browser.wait("!!$('trace')")
    # The path of the query, laid on the map: it began 2 m to the left of where the robot is.
    assert "M3 7 4 7 5 7" in browser.evaluate("$('trace').outerHTML")


@pytest.mark.parametrize(("size", "dark"), [(DESK, False), (DESK, True), (PHONE, False), (PHONE, True)])
def test_the_page_is_whole_in_light_in_dark_and_on_a_phone(
    desk: Path, serve: Callable[..., Served], browser: Browser, size: tuple[int, int], dark: bool
) -> None:
    served, _ = begun(desk, serve)
    browser.show(served.url, size, dark=dark)
    browser.wait("!!$('trace')")
    assert browser.evaluate("innerWidth") == size[0]
    assert browser.faults() == [] and browser.complaints == []
