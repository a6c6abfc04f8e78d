"""A browser without a window, in which tests look at pages: chromium, spoken to by its DevTools protocol."""

import itertools
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DESK, PHONE = (1280, 900), (375, 812)
"""Sizes of a window, pixels."""
_SECONDS = 240.0
_FAULTS = {
    # It reaches over the side of the window; or its section is to be scrolled, which nobody sees.
    "cut": """
        [...document.querySelectorAll("html, body *")].filter(e => {
            const box = e.getBoundingClientRect(), width = document.documentElement.clientWidth;
            if (!box.width || e.closest("#map")) return false;
            const scrolls = e.matches("html, .scroll, section") && e.scrollWidth > e.clientWidth;
            return scrolls || box.right > width + .5 || box.left < -.5;
        }).map(e => e.outerHTML.slice(0, 80))""",
    # Words in charts, on the screen.
    "smaller than 10.5 pixels": """
        [...document.querySelectorAll(".chart text")].filter(e => {
            const size = e.getScreenCTM()?.a * parseFloat(getComputedStyle(e).fontSize);
            return e.getBoundingClientRect().width && size < 10.5;
        }).map(e => e.textContent)""",
    # WCAG, level AA.
    "contrast below 4.5 : 1": """
        (() => {
            const linear = v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
            const light = colour => {
                const [r, g, b] = colour.match(/[\\d.]+/g).map(v => linear(v / 255));
                return .2126 * r + .7152 * g + .0722 * b;
            };
            const behind = e => {
                const colour = getComputedStyle(e).backgroundColor;
                if (/^rgb\\(/.test(colour)) return colour;
                return e.parentElement ? behind(e.parentElement) : "rgb(255, 255, 255)";
            };
            const words = document.querySelectorAll("h1, h2, p, th, td, dt, dd, figcaption, label, .badge");
            return [...words].filter(e => e.getBoundingClientRect().width).filter(e => {
                const [a, b] = [getComputedStyle(e).color, behind(e)].map(light).sort((x, y) => x - y);
                return (b + .05) / (a + .05) < 4.5;
            }).map(e => e.textContent);
        })()""",
}


@dataclass
class Browser:
    """One page at a time; `complaints` is all that it wrote to the console."""

    socket: ClientConnection
    complaints: list[str] = field(default_factory=list)
    _number: Iterator[int] = field(default_factory=itertools.count)
    _happened: list[str] = field(default_factory=list)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One call of the protocol, and what it returns."""
        number = next(self._number)
        self.socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (said := self._next()).get("id") != number:
            pass
        assert "error" not in said, (method, said["error"])
        result: dict[str, Any] = said["result"]
        return result

    def show(self, url: str, size: tuple[int, int] = DESK, *, dark: bool = False) -> None:
        """Open a page and wait until it has loaded."""
        width, height = size
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip
        self.call("Emulation.setScrollbarsHidden", hidden=True)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self._go("about:blank")  # what the page before still does is no complaint about this one
        self.complaints.clear()
        self._go(url)

    def _go(self, url: str) -> None:
        self._happened.clear()
        self.call("Page.navigate", url=url)
        while "Page.loadEventFired" not in self._happened:
            self._next()

    def evaluate(self, code: str) -> Any:
        """The value of an expression on the page; of a promise what it brings."""
        said = self.call("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in said, said["exceptionDetails"]
        return said["result"].get("value")

    def wait(self, code: str) -> None:
        """Until an expression on the page is true."""
        end_s = time.monotonic() + _SECONDS
        while not self.evaluate(code):
            assert time.monotonic() < end_s, code
            time.sleep(0.05)

    def faults(self) -> list[str]:
        """What a reader of the page would miss: what is cut at the side, small or faint."""
        return [f"{fault}: {what}" for fault, code in _FAULTS.items() for what in self.evaluate(code)]

    def _next(self) -> dict[str, Any]:
        said: dict[str, Any] = json.loads(self.socket.recv(timeout=_SECONDS))
        method, told = said.get("method", ""), said.get("params", {})
        self._happened.append(method)
        if method == "Runtime.exceptionThrown":
            self.complaints.append(told["exceptionDetails"]["exception"]["description"])
        elif method == "Runtime.consoleAPICalled":
            self.complaints.append(str([value.get("value") for value in told["args"]]))
        elif method == "Log.entryAdded":
            self.complaints.append(told["entry"]["text"])
        return said


@contextmanager
def browser_in(folder: Path) -> Iterator[Browser]:
    """A browser that keeps its files in a folder."""
    assert CHROMIUM is not None
    command = (
        *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"),
        *(f"--user-data-dir={folder}", "about:blank"),
    )
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            begin = "DevTools listening on ws://"
            (line,) = itertools.islice((line for line in process.stderr if begin in line), 1)
            address = line.partition("ws://")[2].partition("/")[0]
            yield from _first_page(address)
        finally:
            process.kill()


def _first_page(address: str) -> Iterator[Browser]:
    from urllib.request import urlopen

    with urlopen(f"http://{address}/json/list") as reply:
        (page, *_) = [target for target in json.load(reply) if target["type"] == "page"]
    # On a busy machine the browser may be slow to answer a ping; each call has a limit of its own.
    with connect(page["webSocketDebuggerUrl"], max_size=None, ping_interval=None) as socket:
        browser = Browser(socket)
        for domain in ("Page", "Runtime", "Log"):
            browser.call(f"{domain}.enable")
        yield browser
