"""`pc2grid view`: a database in the browser, and recordings that are dropped there, located at once."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pc2grid.errors import ConfigError, Pc2GridError
from pc2grid.io.live.targets import open_live
from pc2grid.observer import Observer
from pc2grid_cli import console
from pc2grid_cli import options as options
from pc2grid_cli.followed import run
from pc2grid_cli.known_pose import KnownPose
from pc2grid_cli.view_events import Events, Progress
from pc2grid_cli.view_server import Cancelled, Options, ViewServer
from signature.files import find, query_config
from signature.localization.follower import Follower
from signature.localization.localizer import Localizer
from signature.localization.map_index import MapIndex
from signature.localization.shown.report import page

if TYPE_CHECKING:
    from pc2grid.model import RegisteredScan
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.localization.localizer import Estimate

_SHARES_EVERY_S = 0.2
_META = '<meta http-equiv="Content-Security-Policy"'


def serve(
    server: ViewServer, locator: Locator, source: str | None, terminal: console.Console, *, browser: bool
) -> None:
    """Serve the pages until the program is stopped."""
    print(server.url, flush=True)
    if source is None:
        terminal.note("drop a recording onto the page; Ctrl-C ends this")
    if browser:
        _open_browser(server.url)
    if source is None:
        server.serve_forever()
        return
    with server.in_background():
        locator.follow(source)
        terminal.note("the page stays as it is; Ctrl-C ends this")
        threading.Event().wait()


class Locator:
    """Locates one recording after another in a database, and reports the progress to the pages."""

    def __init__(self, database: SubmapDatabase, settings: Config) -> None:
        self._database, self._settings = database, settings
        self._index: MapIndex | None = None
        self.events = Events()
        self.pages: dict[str, bytes] = {}

    def work(self, path: Path, options: Options, check: Callable[[], None]) -> dict[str, Any]:
        """Locate a recording: a `pc2grid_cli.view_server.Work`.

        options : `near`, x,y,radius in metres, and `session`, whose map frame they are in.
        """
        events, progress = self.events, Progress(self.events)
        events.publish("begin", {"source": path.name})

        def see(registered: RegisteredScan, estimate: Estimate | None) -> None:
            check()
            progress.add(registered)
            if estimate is not None:
                progress.tell(estimate)

        try:
            known = KnownPose(near=_near(options.get("near")), session=options.get("session"))
            found = find(
                path,
                self._database,
                self._settings,
                observer=_Shares(events),
                see=see,
                prior=known.prior,
                index=self._prepared(),
            )
            progress.flush()
            accept = self._settings.relocalize.accept
            self.pages["answer"] = live_page(self._database, found=found, accept=accept)
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
        answer = found.answer
        told = {"status": answer.status, "session": answer.session, "confidence": answer.confidence}
        events.publish("end", {"source": path.name, **told})
        return {**answer.to_json(), "query": found.about}

    def follow(self, source: str) -> None:
        """Show a running robot until its source ends.

        source : as `pc2grid watch` takes it. Raises the errors of `pc2grid.io.live.targets.open_live`.
        """
        config = query_config(self._database, self._settings)
        localizer, progress = Localizer(self._prepared()), Progress(self.events)
        with (
            open_live(source, config.read) as live,
            Follower(localizer, beside=True, step_m=config.relocalize.step_m) as follower,
        ):

            def poll() -> bool:
                for sentence in live.news.take():
                    console.warn(sentence)
                for estimate in follower.take():
                    progress.tell(estimate)
                return False

            self.events.publish("begin", {"source": source})
            run(live, follower, config, poll, see=progress.add)
            progress.flush()
        self.events.publish("end", {"source": source, "error": "the source has ended", "hint": None})

    def _prepared(self) -> MapIndex:
        """The maps, prepared once for all recordings."""
        if self._index is None:
            self._index = MapIndex.of(self._database, query_config(self._database, self._settings))
        return self._index


class _Shares(Observer):
    """Publishes the share of the recording that is done."""

    def __init__(self, events: Events) -> None:
        self._events, self._told_s = events, 0.0

    def on_progress(self, share: float) -> None:
        """See `Observer.on_progress`."""
        if time.monotonic() - self._told_s >= _SHARES_EVERY_S:
            self._told_s = time.monotonic()
            self._events.publish("share", {"share": round(share, 4)})


def live_page(database: SubmapDatabase, **answer: Any) -> bytes:
    """The page of a report, with the part that takes recordings and shows events."""
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
    """x,y,radius of a request. Raises ConfigError."""
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
