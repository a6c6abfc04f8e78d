"""Commands of pc2grid as processes of their own, as a user runs them, with their processor time."""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pc2grid_lab.experiments.program import ROOT
from pc2grid_lab.experiments.stored import write_text

_CLI = "from pc2grid_cli.main import main; main()"
_ANSWERED = (0, 3, 4)
"""Exit codes of a command that did its work: done, with loss of data, without a confident answer."""
_STOPPED = (130, 143)
"""Exit codes of a command that was interrupted or asked to end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """What became of one command.

    code : its exit code, negative if a signal ended it. cpu_s : processor time, user and system, of all its
        processes.
    document : the JSON document on its standard output; None if there is none. error : the last line of its
        standard error, if it did not do its work.
    """

    code: int
    cpu_s: float
    document: Any
    error: str = ""

    @property
    def stopped(self) -> bool:
        """Whether somebody stopped it, so that nothing is known of what it would have done."""
        return self.code in _STOPPED

    @property
    def failed(self) -> bool:
        """Whether there is no result."""
        return self.code not in _ANSWERED or self.document is None


def pc2grid(*arguments: str | Path, limit_s: float = 1800.0) -> Finished:
    """Run `pc2grid` with these arguments; after `limit_s` of elapsed time it is stopped."""
    return run((sys.executable, "-c", _CLI, *map(str, arguments)), limit_s=limit_s)


def python_module(name: str, *arguments: str | Path, limit_s: float = 1800.0) -> Finished:
    """Run a module of this laboratory in a process of its own."""
    return run((sys.executable, "-m", name, *map(str, arguments)), limit_s=limit_s)


def run(command: Sequence[str], *, limit_s: float = math.inf) -> Finished:
    """Run a command that prints a JSON document; its paths are absolute."""
    # Byte code is kept, as it is where pc2grid is installed.
    environment = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"},
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tools"))),
    }
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        # `python -c` imports from the current folder first.
        child = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment
        )
        try:
            used = _wait(child, time.monotonic() + limit_s)
        except BaseException:
            child.kill()
            child.wait()
            raise
        out.seek(0)
        err.seek(0)
        document, complaint = _parsed(out.read()), err.read().decode(errors="replace")
    finished = Finished(
        code=child.returncode,
        cpu_s=used.ru_utime + used.ru_stime,
        document=document,
    )
    return replace(finished, error=_error(finished.code, complaint)) if finished.failed else finished


def _wait(child: subprocess.Popen[bytes], end_s: float) -> resource.struct_rusage:
    """Wait for a process, and end it after `end_s` of the monotonic clock; what it has used."""
    # `wait4` alone tells the time of this child, and not of all that ended so far.
    while True:
        pid, status, used = os.wait4(child.pid, os.WNOHANG)
        if pid:
            child.returncode = os.waitstatus_to_exitcode(status)
            return used
        if time.monotonic() > end_s:
            child.kill()
        time.sleep(0.02)


def _parsed(text: bytes) -> Any:
    """A JSON document, or several of them, one a line, as a list; None if it is neither."""
    for parse in (json.loads, lambda lines: [json.loads(line) for line in lines.splitlines()] or None):
        with contextlib.suppress(ValueError):
            return parse(text)
    return None


def _error(code: int, complaint: str) -> str:
    """Why a command failed: the error that it names, or the last that it said."""
    lines = [line for line in complaint.splitlines() if line.strip()] or ["nothing was printed"]
    said = next((line for line in lines if "error:" in line), lines[-1])
    return f"ended by signal {-code}" if code < 0 else said


def kept(file: Path) -> Finished | None:
    """What `keep` wrote to a file; None if it is not there."""
    return Finished(**json.loads(file.read_text())) if file.exists() else None


def keep(file: Path, finished: Finished) -> None:
    """Write a result to a file, completely or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_text(file, json.dumps(asdict(finished)))
