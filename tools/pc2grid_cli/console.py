"""What the user sees: one-line errors, exit codes, notes, progress. stdout is the result, stderr the rest."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

from pc2grid.errors import one_line

OK, FAILED, USAGE, LOSSY, UNSURE, INTERRUPTED = 0, 1, 2, 3, 4, 130
PIPE_CLOSED = 128 + signal.SIGPIPE
_LEAST_S, _LEAST_DONE = 2.0, 0.03  # of work, before anything is said about the rest of it


class State:
    """What the global options say; set once by `main`."""

    verbosity = 0
    debug = bool(os.environ.get("PC2GRID_DEBUG"))


def note(message: str, *, level: int = 0) -> None:
    """A line for the user; level 0 unless -q, level 1 with -v."""
    if State.verbosity >= level:
        print(f"pc2grid: {message}", file=sys.stderr)


def warn(message: str) -> None:
    """Something that the user should know although it worked; shown even with -q."""
    print(f"pc2grid: warning: {one_line(message)}", file=sys.stderr)


def print_json(document: Any) -> None:
    """The one document on stdout."""
    print(json_text(document))


def json_text(document: Any) -> str:
    """A document as JSON. That knows no NaN and no infinity: what is not known is null."""
    return json.dumps(_finite(document), indent=1, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return value


@contextlib.contextmanager
def progress(what: str, recorded_s: float | None = None) -> Iterator[Callable[[float], None]]:
    """Report a share 0..1 of the work: a bar on a terminal, otherwise a line every ten seconds.

    recorded_s : length of the recording that is worked through, to say how much faster than it was made.
    """
    if State.verbosity < 0:
        yield lambda share: None
        return
    if not sys.stderr.isatty():
        yield _plain_progress(what, recorded_s)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[pace]}"),
    )
    pace = _Pace(recorded_s)
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=1.0, pace="")
        yield lambda share: bar.update(task, completed=share, pace=pace.told(share))


def _plain_progress(what: str, recorded_s: float | None) -> Callable[[float], None]:
    last = time.monotonic()
    pace = _Pace(recorded_s)

    def update(share: float) -> None:
        nonlocal last
        told = pace.told(share)
        if time.monotonic() - last >= 10.0:
            last = time.monotonic()
            print(f"pc2grid: {what}: {share:.0%}{', ' if told else ''}{told}", file=sys.stderr)

    return update


class _Pace:
    """How fast work goes, and how long it will take at that, once that can be said."""

    def __init__(self, recorded_s: float | None) -> None:
        self._recorded_s = recorded_s
        self._first: tuple[float, float] | None = None

    def told(self, share: float) -> str:
        """In words; nothing while too little is done to judge by.

        Measured from the first share reported: what was prepared before is not part of the pace.
        """
        now = time.monotonic()
        begin, done_before = self._first = self._first or (now, share)
        spent_s, done = now - begin, share - done_before
        if spent_s < _LEAST_S or done < _LEAST_DONE:
            return ""
        rate = f"{done * self._recorded_s / spent_s:.1f}x real time, " if self._recorded_s else ""
        return f"{rate}{_duration(spent_s * (1.0 - share) / done)} left"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def report_error(error: BaseException) -> int:
    """Say what went wrong in one line, and what to do next in another; returns the exit code."""
    from pc2grid.errors import Pc2GridError

    if State.debug:
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


def run(command: Callable[[], Any]) -> int:
    """Run a command and turn everything that can happen into an exit code."""
    signal.signal(signal.SIGTERM, _terminate)
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files need not be text
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        result = command()
        sys.stdout.flush()
        return result if isinstance(result, int) else OK
    except KeyboardInterrupt:
        print("pc2grid: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        return _pipe_closed()
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):  # click turns it into exit code 1
            return _pipe_closed()
        raise
    except Exception as error:
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # a usage error of typer's
            return _report_usage(error)
        return report_error(error)


def _pipe_closed() -> int:
    """Whoever read our output has seen enough: end like any other program whose reader has gone.

    Quietly, and not with 0: what the rest would have said (`db check`) is not known to anybody.
    """
    # Python must not complain at exit either.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return PIPE_CLOSED


def _report_usage(error: Any) -> int:
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        print(error.ctx.get_help(), file=sys.stderr)
        return USAGE
    print(f"pc2grid: error: {one_line(error.format_message())}", file=sys.stderr)
    if context is not None:
        print(f"hint: {context.command_path} --help", file=sys.stderr)
    return USAGE


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + signum)
