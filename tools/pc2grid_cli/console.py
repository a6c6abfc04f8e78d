"""What the user sees: errors, exit codes, notes, progress. stdout is the result, stderr the rest."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer

from pc2grid.errors import Pc2GridError, one_line
from pc2grid.observer import ProgressBars, bars_on_stderr, seldom

if TYPE_CHECKING:
    from rich.progress import Task

OK, FAILED, USAGE, LOSSY, UNSURE, INTERRUPTED = 0, 1, 2, 3, 4, 130
PIPE_CLOSED = 128 + signal.SIGPIPE
_LINE_EVERY_S = 10.0
"""How often progress is printed where there is no terminal; chosen by hand."""
_SENT_AGAIN_S = 0.05
"""How long after a signal whose exception was dropped it is sent again; chosen by hand."""
_COMPILING = "compiling what runs for the first time here; later runs do not wait for it"


class Console(ProgressBars):
    """The terminal of one run of the program, with what the global options say.

    As an observer it shows the news of some work on stderr: progress, warnings, and notes with -v.

    verbose : how often -v was given. quiet : -q. debug : --debug, or PC2GRID_DEBUG is set.
    compiling : whether the user knows that functions are compiled.
    """

    def __init__(self) -> None:
        super().__init__()
        self.verbose = 0
        self.quiet = False
        self.debug = bool(os.environ.get("PC2GRID_DEBUG"))
        self.compiling = False

    def note(self, message: str, *, level: int = 0) -> None:
        """Print a line for the user, unless -q is given; one of level 1 only with -v."""
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
        from rich.progress import BarColumn, TextColumn

        percent = TextColumn("{task.percentage:>3.0f}%{task.fields[pace]}")
        last_s = time.monotonic()
        with bars_on_stderr("{task.description}", BarColumn(), percent) as bar:
            bar.add_task(what, pace="", total=1.0)
            (task,) = bar.tasks

            def update(share: float) -> None:
                nonlocal last_s
                bar.update(task.id, completed=share)
                bar.update(task.id, pace=_pace(task, recorded_s))
                if bar.disable and time.monotonic() - last_s >= _LINE_EVERY_S:
                    last_s = time.monotonic()
                    print(f"pc2grid: {what}: {share:.0%}{task.fields['pace']}", file=sys.stderr)

            yield seldom(update)

    @contextlib.contextmanager
    def step(self, what: str, recorded_s: float | None = None) -> Iterator[None]:
        """Show the progress of a step."""
        with self.progress(what, recorded_s) as self._update, _compiling_noted(self):
            yield
        self._update = None

    def on_note(self, text: str) -> None:
        """See `Observer.on_note`."""
        self.note(text, level=1)

    def on_warning(self, text: str) -> None:
        """See `Observer.on_warning`."""
        warn(text)

    def report_error(self, error: BaseException) -> int:
        """Print what went wrong in one line, and what to do next in another; returns the exit code."""
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
        _print_error(message, hint)
        return code

    def run(self, command: Callable[[], Any]) -> int:
        """Run a command; its result or error becomes an exit code."""
        stop = _StopSignal()
        if isinstance(sys.stdout, io.TextIOWrapper):  # names of files may hold undecodable bytes
            sys.stdout.reconfigure(errors="backslashreplace")
        try:
            result = command()
            sys.stdout.flush()
            if result == INTERRUPTED:  # what typer makes of KeyboardInterrupt
                raise KeyboardInterrupt
            return result if isinstance(result, int) else OK
        except BaseException as error:
            code = self._ended_by(error, stop.number)
        if stop.number is not None:
            _leave(code)
        return code

    def _ended_by(self, error: BaseException, signal_number: int | None) -> int:
        """Return the exit code of a command that ended by an error or a signal, after printing what is to be
        said."""
        if isinstance(error, KeyboardInterrupt) or signal_number == signal.SIGINT:
            print("pc2grid: interrupted: each file is complete, or as it was before", file=sys.stderr)
            return INTERRUPTED
        if isinstance(error, BrokenPipeError) or isinstance(error.__context__, BrokenPipeError):
            return _pipe_closed()  # click turns it into SystemExit(1)
        if signal_number is not None:
            return 128 + signal_number
        if isinstance(error, SystemExit):
            raise error
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # a usage error of typer's
            return _report_usage(error)
        return self.report_error(error)


def _leave(code: int) -> None:
    """End the process at once.

    A signal may have come in the middle of anything, the import of an extension for example: Python's own end
    would wait for threads, and take down what was never set up, which crashes.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def of(context: typer.Context) -> Console:
    """Return the console of the run that a command belongs to."""
    return context.ensure_object(Console)


def warn(message: str) -> None:
    """Print what the user should know although the command worked; also with -q."""
    print(f"pc2grid: warning: {one_line(message)}", file=sys.stderr)


def print_result(result: Any, indent: int | None = 1) -> None:
    """Print the result of a command to stdout: a text, or a document as JSON; indent None: in one line."""
    print(result if isinstance(result, str) else json_text(result, indent), flush=True)


def json_text(document: Any, indent: int | None = 1) -> str:
    """Return a document as JSON. JSON has no NaN and no infinity: such a value becomes null."""
    from pydantic_core import to_jsonable_python

    finite = to_jsonable_python(document, inf_nan_mode="null")
    return json.dumps(finite, indent=indent, ensure_ascii=False, allow_nan=False)


@contextlib.contextmanager
def _compiling_noted(console: Console) -> Iterator[None]:
    """Print a note, once, when numba begins to compile a function that is not in its cache."""
    from numba.core import event

    class Note(event.Listener):
        def on_start(self, event: Any) -> None:
            if not console.compiling:
                console.compiling = True
                console.note(_COMPILING)

        def on_end(self, event: Any) -> None:
            """Do nothing."""

    with event.install_listener("numba:compile", Note()):
        yield


def _pace(task: Task, recorded_s: float | None) -> str:
    """Return how fast the work goes, and how long the rest takes at that pace; nothing while that is not
    known.

    The pace is that of the last half minute, as rich measures it. It begins with the first share reported,
    because the preparations before are not part of it.
    """
    if not task.speed or task.time_remaining is None:
        return ""
    rate = f", {task.speed * recorded_s:.1f}x real time" if recorded_s else ""
    return f"{rate}, {timedelta(seconds=task.time_remaining)} left"


def _pipe_closed() -> int:
    """Return the exit code after the reader of our output has closed it, as of any other program in a pipe.

    Nothing is printed. The code is not 0, because the rest of the output (of `db check`) was not read.
    """
    # Otherwise Python prints an error when it flushes stdout at exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return PIPE_CLOSED


def _report_usage(error: Any) -> int:
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        print(error.ctx.get_help(), file=sys.stderr)
    else:  # click lists choices on lines of their own
        _print_error(" ".join(error.format_message().split()), context and f"{context.command_path} --help")
    return USAGE


def _print_error(message: str, hint: str | None) -> None:
    """Print what went wrong in one line, and what to do next in another."""
    print(f"pc2grid: error: {one_line(message)}", file=sys.stderr)
    if hint:
        print(f"hint: {one_line(hint)}", file=sys.stderr)


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
        """Send the signal again if Python could not raise its exception further (`sys.unraisablehook`)."""
        if self.number is None or not isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):
            self._report(unraisable)
            return
        main_thread = threading.main_thread().ident
        threading.Timer(_SENT_AGAIN_S, signal.pthread_kill, (main_thread, self.number)).start()
