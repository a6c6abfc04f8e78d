"""Parts of every measurement: rows of the table, interleaved timing, processes and their memory."""

from __future__ import annotations

import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[3]
LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless", "open3d-cpu", "kiss-icp", "faiss-cpu")

# VmHWM starts at zero in each program; getrusage would count the pages of the parent too.
_PEAK = (
    "import atexit, sys; atexit.register(lambda: print(next(line for line in open('/proc/self/status')"
    " if line.startswith('VmHWM')), file=sys.stderr))\n"
)
_CLI = "from pc2grid_cli.main import main; main()"


@dataclass(frozen=True, slots=True)
class Time:
    """Elapsed seconds, and seconds of processor time (user and system, all threads)."""

    wall: float
    cpu: float

    def times(self, factor: float) -> tuple[float, float]:
        """Both times in another unit."""
        return factor * self.wall, factor * self.cpu


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the table.

    goal : largest (with `at_least`: smallest) figure that is good enough; None if there is no goal.
    measured : a median, in `unit`; None if it could not be measured, then `note` gives the reason.
    cpu : the same by processor time, which is about what an idle machine would measure.
    """

    what: str
    measured: float | None
    unit: str
    goal: float | None = None
    at_least: bool = False
    cpu: float | None = None
    note: str = ""

    @property
    def verdict(self) -> str:
        """Whether the goal is reached; empty without a goal."""
        if self.goal is None:
            return ""
        if self.measured is None:
            return "not measured"
        if self._reached(self.measured):
            return "ok"
        return "ok by cpu" if self.cpu is not None and self._reached(self.cpu) else "missed"

    def _reached(self, value: float) -> bool:
        assert self.goal is not None
        return value >= self.goal if self.at_least else value <= self.goal

    def cells(self) -> tuple[str, ...]:
        """The row as it is printed."""
        goal = "" if self.goal is None else f"{'>=' if self.at_least else '<='} {self.goal:g} {self.unit}"
        return self.what, goal, self._number(self.measured), self._number(self.cpu), self.verdict, self.note

    def _number(self, value: float | None) -> str:
        if value is None:
            return ""
        return f"{value:.0f} {self.unit}" if abs(value) >= 1000 else f"{value:.3g} {self.unit}"

    def to_json(self) -> dict[str, Any]:
        """The row in plain types."""
        return {**asdict(self), "verdict": self.verdict}


def timed(action: Callable[[], object]) -> Time:
    """The time of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    action()
    return Time(time.perf_counter() - wall, time.process_time() - cpu)


def median(times: Iterable[Time]) -> Time:
    """Medians of elapsed and of processor time, computed separately."""
    taken = list(times)
    return Time(statistics.median(t.wall for t in taken), statistics.median(t.cpu for t in taken))


def interleaved(actions: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, Time]:
    """Median time of each action. They take turns, so that other load on the machine affects all equally."""
    taken: dict[str, list[Time]] = {name: [] for name in actions}
    for _ in range(rounds):
        for name, action in actions.items():
            taken[name].append(timed(action))
    return {name: median(times) for name, times in taken.items()}


@dataclass(frozen=True, slots=True)
class Child:
    """A finished process: its time, its peak resident memory, its output."""

    time: Time
    peak_mb: float
    stdout: str


def program(*arguments: str | Path, environment: Mapping[str, str] | None = None) -> Child:
    """Run `pc2grid` as a process of its own, as a user does. environment : additional variables."""
    return run_python(_PEAK + _CLI, *arguments, environment=environment)


def run_python(code: str, *arguments: str | Path, environment: Mapping[str, str] | None = None) -> Child:
    """Run Python code as a process of its own. environment : additional variables.

    Byte code is kept, as it is where pc2grid is installed: to compile 200 modules takes 0.4 s each time.

    Raises RuntimeError if it fails; exit codes 3 and 4 of the program are results, not failures.
    """
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={
            **{name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"},
            "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tools"))),
            **(environment or {}),
        },
    )
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if done.returncode not in (0, 3, 4):
        raise RuntimeError(f"{arguments}: {done.stderr[-2000:]}")
    peaks = [line for line in done.stderr.splitlines() if line.startswith("VmHWM")]
    peak_mb = int(peaks[-1].split()[1]) / 1000 if peaks else float("nan")
    return Child(Time(wall, cpu), peak_mb, done.stdout)


def machine() -> dict[str, str]:
    """The machine and the versions."""
    cpu = next(
        (
            line.split(":")[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if "model name" in line
        ),
        platform.machine(),
    )
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, check=False, capture_output=True, text=True
    ).stdout.strip()
    return {
        "cpu": f"{os.cpu_count()} x {cpu}",
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "commit": commit,
        "threads": os.environ.get("OMP_NUM_THREADS", "default"),
        **{name: _version(name) for name in LIBRARIES},
    }


def _version(library: str) -> str:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return "not installed"


def table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    lines = [("what", "goal", "measured", "by cpu time", "", "note"), *(row.cells() for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(6)]
    text = ["| " + " | ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) + " |" for line in lines]
    text.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(text)
