"""What the user sees: errors, exit codes, notes, progress. stdout is the result, stderr the rest."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import typer

from pc2grid.errors import one_line
from pc2grid.observer import Observer

OK, FAILED, USAGE, LOSSY, UNSURE, INTERRUPTED = 0, 1, 2, 3, 4, 130
PIPE_CLOSED = 128 + signal.SIGPIPE
_LEAST_S, _LEAST_SHARE = 2.0, 0.03
"""Time and share of the work that must pass before the time left is estimated; chosen by hand."""
_LINE_EVERY_S = 10.0
"""How often progress is printed where there is no terminal; chosen by hand."""
_SENT_AGAIN_S = 0.05
"""How long after a signal whose exception was dropped it is sent again; chosen by hand."""
_COMPILING = "compiling what runs for the first time here; later runs do not wait for it"
_INTERRUPTED = "pc2grid: interrupted: each file is complete, or as it was before"


class Console:
    """The terminal of one run of the program, with what the global options say.

    verbose : how often -v was given. quiet : -q. debug : --debug, or PC2GRID_DEBUG is set.
    compiling : whether the user knows that functions are compiled.
    """

    def __init__(self) -> None:
        self.verbose = 0
        self.quiet = False
        self.debug = bool(os.environ.get("PC2GRID_DEBUG"))
        self.compiling = False
        self._pace: _Pace | None = None

    def apply(self, word: str) -> bool:
        """Apply a word of the command line if it is a global option; returns whether it is one."""
        if word in ("-v", "-vv", "--verbose"):
            self.verbose += word.count("v") if word != "--verbose" else 1
        elif word in ("-q", "--quiet"):
            self.quiet = True
        elif word == "--debug":
            self.debug = True
        else:
            return False
        return True

    def note(self, message: str, *, level: int = 0) -> None:
        """A line for the user, unless -q is given; one of level 1 is only printed with -v."""
        if not self.quiet and self.verbose >= level:
            print(f"pc2grid: {message}", file=sys.stderr)

    @contextlib.contextmanager
    def progress(self, what: str, recorded_s: float | None = None) -> Iterator[Callable[[float], None]]:
        """Show the share 0..1 of the work that is done: a bar on a terminal, else a line every ten seconds.

        recorded_s : length of the recording that is worked through, for a pace in multiples of real time.
        """
        if self.quiet:
            yield lambda share: None
            return
        pace = self._pace = _Pace(recorded_s)
        if not sys.stderr.isatty():
            yield _plain_progress(what, pace)
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[pace]}"),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(what, total=1.0, pace="")
            yield lambda share: bar.update(task, completed=share, pace=pace.told(share))

    def compiling_begins(self) -> None:
        """Tell the user, once, that functions are compiled."""
        if not self.compiling:
            self.compiling = True
            self.note(_COMPILING)

    def compiling_ends(self) -> None:
        """Measure the pace again: the time for compiling is no measure for the rest of the work."""
        if self._pace is not None:
            self._pace.restart()

    def observer(self) -> ConsoleObserver:
        """Shows the news of some work on this console."""
        return ConsoleObserver(self)

    def report_error(self, error: BaseException) -> int:
        """Print what went wrong in one line, and what to do next in another; returns the exit code."""
        from pc2grid.errors import Pc2GridError

        if self.debug:
            import traceback

            traceback.print_exception(error)
        if isinstance(error, Pc2GridError):
            message, hint, code = error.message, error.hint, error.exit_code
        elif isinstance(error, MemoryError):
            message, hint, code = "out of memory", "try a shorter part: --start and --duration", FAILED
        elif isinstance(error, OSError):
            where = f"{error.filename}: " if error.filename else ""
            message, hint, code = f"{where}{error.strerror or error}", None, FAILED
        else:
            message = f"internal error: {type(error).__name__}: {error}"
            hint, code = "this is a bug; run again with --debug and report what it prints", FAILED
        print(f"pc2grid: error: {one_line(message)}", file=sys.stderr)
        if hint:
            print(f"hint: {one_line(hint)}", file=sys.stderr)
        return code

    def run(self, command: Callable[[], Any]) -> int:
        """Run a command; its result or error becomes an exit code."""
        stop = _StopSignal()
        if isinstance(sys.stdout, io.TextIOWrapper):  # names of files may hold undecodable bytes
            sys.stdout.reconfigure(errors="backslashreplace")
        try:
            result = command()
            sys.stdout.flush()
            return result if isinstance(result, int) else OK
        except KeyboardInterrupt:
            print(_INTERRUPTED, file=sys.stderr)
            return INTERRUPTED
        except BrokenPipeError:
            return _pipe_closed()
        except SystemExit as request:
            if isinstance(request.__context__, BrokenPipeError):  # click turns it into exit code 1
                return _pipe_closed()
            raise
        except Exception as error:
            if stop.number == signal.SIGINT:
                print(_INTERRUPTED, file=sys.stderr)
                return INTERRUPTED
            if stop.number is not None:
                return 128 + stop.number
            if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # a usage error of typer's
                return _report_usage(error)
            return self.report_error(error)


def of(context: typer.Context) -> Console:
    """The console of the run that a command belongs to."""
    return context.ensure_object(Console)


def warn(message: str) -> None:
    """Print what the user should know although the command worked; also with -q."""
    print(f"pc2grid: warning: {one_line(message)}", file=sys.stderr)


def print_json(document: Any) -> None:
    """Print the document of a command to stdout."""
    print(json_text(document), flush=True)


def print_json_line(document: Any) -> None:
    """Print a document of a stream of them to stdout, as one line."""
    print(json.dumps(_finite(document), ensure_ascii=False, allow_nan=False), flush=True)


def json_text(document: Any) -> str:
    """A document as JSON. JSON has no NaN and no infinity: such a value becomes null."""
    return json.dumps(_finite(document), indent=1, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return value


class ConsoleObserver(Observer):
    """Shows the news of some work on stderr: progress, warnings, and notes with -v."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._update: Callable[[float], None] | None = None

    def step(self, what: str, recorded_s: float | None = None) -> contextlib.AbstractContextManager[None]:
        """Shows the progress of a step."""
        return self._shown(what, recorded_s)

    @contextlib.contextmanager
    def _shown(self, what: str, recorded_s: float | None) -> Iterator[None]:
        with self._console.progress(what, recorded_s) as self._update, _compiling_noted(self._console):
            yield
        self._update = None

    def on_progress(self, share: float) -> None:
        """See `Observer.on_progress`."""
        if self._update is not None:
            self._update(share)

    def on_note(self, text: str) -> None:
        """See `Observer.on_note`."""
        self._console.note(text, level=1)

    def on_warning(self, text: str) -> None:
        """See `Observer.on_warning`."""
        warn(text)


@contextlib.contextmanager
def _compiling_noted(console: Console) -> Iterator[None]:
    """Print a note, once, when numba begins to compile a function that is not in its cache."""
    from numba.core import event

    class Note(event.Listener):
        def on_start(self, event: Any) -> None:
            console.compiling_begins()

        def on_end(self, event: Any) -> None:
            console.compiling_ends()

    with event.install_listener("numba:compile", Note()):
        yield


def _plain_progress(what: str, pace: _Pace) -> Callable[[float], None]:
    last = time.monotonic()

    def update(share: float) -> None:
        nonlocal last
        told = pace.told(share)
        if time.monotonic() - last >= _LINE_EVERY_S:
            last = time.monotonic()
            print(f"pc2grid: {what}: {share:.0%}{', ' if told else ''}{told}", file=sys.stderr)

    return update


class _Pace:
    """Estimates how fast the work goes and how long the rest takes at that pace."""

    def __init__(self, recorded_s: float | None) -> None:
        self._recorded_s = recorded_s
        self._first: tuple[float, float] | None = None

    def restart(self) -> None:
        """Measure from the next share on."""
        self._first = None

    def told(self, share: float) -> str:
        """Pace and time left in words; nothing while too little is done to estimate them.

        The pace is measured from the first share reported, because the preparations before are not part of
        it. The time left goes up where the work turns out to be slower than before.
        """
        now = time.monotonic()
        begin, done_before = self._first = self._first or (now, share)
        spent_s, done = now - begin, share - done_before
        if spent_s < _LEAST_S or done < _LEAST_SHARE:
            return ""
        rate = f"{done * self._recorded_s / spent_s:.1f}x real time, " if self._recorded_s else ""
        return f"{rate}{_duration(spent_s * (1.0 - share) / done)} left"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _pipe_closed() -> int:
    """The exit code after the reader of our output has closed it, as of any other program in a pipe.

    Nothing is printed. The code is not 0, because the rest of the output (of `db check`) was not read.
    """
    # Otherwise Python prints an error when it flushes stdout at exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return PIPE_CLOSED


def _report_usage(error: Any) -> int:
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        print(error.ctx.get_help(), file=sys.stderr)
        return USAGE
    message = " ".join(error.format_message().split())  # click lists choices on lines of their own
    print(f"pc2grid: error: {one_line(message)}", file=sys.stderr)
    if context is not None:
        hint = getattr(error, "suggestion", None) or f"{context.command_path} --help"
        print(f"hint: {one_line(hint)}", file=sys.stderr)
    return USAGE


class _StopSignal:
    """Ends the program when SIGINT or SIGTERM arrives, and remembers which one did.

    The exception that the handler raises may arrive as another one: an extension that was running returns a
    result all the same, and Python then raises SystemError in its place. Python drops it where the handler
    runs within a callback of an extension (numba loads compiled functions in one): the signal is sent again.

    number : the signal that arrived, None before.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._report = sys.unraisablehook
        sys.unraisablehook = self._dropped
        signal.signal(signal.SIGTERM, self._stop)
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # a shell's background job ignores Ctrl-C
            signal.signal(signal.SIGINT, self._stop)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.number = number
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    def _dropped(self, unraisable: Any) -> None:
        """What Python calls (`sys.unraisablehook`) for an exception that it cannot raise further."""
        if self.number is None or not isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):
            self._report(unraisable)
            return
        main_thread = threading.main_thread().ident
        threading.Timer(_SENT_AGAIN_S, signal.pthread_kill, (main_thread, self.number)).start()
