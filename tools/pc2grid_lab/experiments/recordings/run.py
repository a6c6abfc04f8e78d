"""All recordings become maps and all windows are located: the results of the commands, in a folder.

Nothing is judged here. A command that fails is a result like any other, and a result that the folder holds
already is not computed again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from pc2grid.errors import Pc2GridError
from pc2grid.io import open_log
from pc2grid.time_span import TimeSpan
from pc2grid_lab.experiments.recordings.catalogue import Catalogue, Pair, Recording
from pc2grid_lab.experiments.recordings.children import Finished, keep, kept, pc2grid, python_module
from pc2grid_lab.experiments.recordings.driven import digest_of_drive, write_drive
from pc2grid_lab.experiments.recordings.mcap_copy import write_thinned
from pc2grid_lab.experiments.stored import in_processes, run_in
from signature.config import ShortlistBy

_RESULTS = ("maps", "bare", "answers", "followed")
"""Folders of results."""
_BARE = "pc2grid_lab.experiments.recordings.bare_kiss"


@dataclass(frozen=True, slots=True)
class Folder:
    """Where the maps and answers of one run are.

    data : the folder of recordings. work : of everything that is made. Both are absolute, as the commands
        run in another folder. shortlist : `signature.config.RelocalizeConfig.shortlist_by` of the answers.
    """

    data: Path
    work: Path
    shortlist: ShortlistBy = "signatures"

    def source(self, recording: Recording) -> Path:
        """The file that the commands read; if it is thinned or driven, `_make` makes it.

        Drives are kept beside the work of all versions: they are made again when they would differ.
        """
        file = self.data / recording.file
        if recording.drive is not None:
            made = f"{plain(recording.name)}.{digest_of_drive(file, recording.drive)}.mcap"
            return self.work.parents[1] / "drives" / made
        if recording.every > 1:
            return self.work / "thinned" / f"{file.stem}_{recording.every}{file.suffix}"
        return file

    def truth(self, recording: Recording) -> Path | None:
        """The file of `Recording.truth`."""
        return self._true(recording, recording.truth)

    def poses(self, recording: Recording) -> Path | None:
        """The file of `Recording.poses`."""
        return self._true(recording, recording.poses)

    def _true(self, recording: Recording, file: str | None) -> Path | None:
        if file is None:
            return None
        return self.data / file if recording.drive is None else self.source(recording).with_suffix(".tum")

    def map(self, name: str) -> Path:
        """The database of a map, beside the result of `convert`."""
        return self.work / "maps" / f"{plain(name)}.submaps"

    def result(self, name: str) -> Path:
        """The result of `convert` for a map."""
        return self.map(name).with_suffix(".json")

    def bare(self, name: str) -> Path:
        """The result of bare KISS-ICP."""
        return self.work / "bare" / f"{plain(name)}.json"

    def has_bare(self, recording: Recording) -> bool:
        """Whether bare KISS-ICP is asked: it knows lidars, and real ones are there to be compared."""
        return recording.sensor == "lidar" and recording.drive is None and not self.missing(recording)

    def answer(self, pair: Pair, window: TimeSpan) -> Path:
        """The result of `relocalize` for a window."""
        named = f"{plain(pair.query)}.in.{plain(pair.map_name)}"
        answers = "answers" if self.shortlist == "signatures" else f"answers_{self.shortlist}"
        return self.work / answers / f"{named}.{window.start_s:.2f}s.{window.duration_s:g}s.json"

    def missing(self, recording: Recording) -> bool:
        """Whether the data folder lacks the recording, so that it is a gap of the page."""
        return not (self.data / recording.file).exists()

    def gaps(self, catalogue: Catalogue, pair: Pair) -> list[str]:
        """The files of a pair that the data folder lacks."""
        recordings = (catalogue.recordings[name] for name in (pair.query, pair.map))
        return [recording.file for recording in recordings if self.missing(recording)]

    def cpu_s(self) -> float:
        """Processor time of all commands whose result is here."""
        results = (kept(file) for kind in _RESULTS for file in (self.work / kind).glob("*.json"))
        return sum(done.cpu_s for done in results if done is not None)

    def length_s(self, recording: Recording) -> float:
        """How long a recording lasts. Raises the errors of `open_log`."""
        with open_log(self.source(recording)) as opened:
            return (opened.info.end_ns - opened.info.start_ns) * 1e-9


def plain(name: str) -> str:
    """A name as a part of the name of a file."""
    return "".join(c if c.isalnum() or c in "-.+" else "_" for c in name)


@dataclass(frozen=True, slots=True)
class Task:
    """One command: where its result is kept, what is done, and a guess of its time that orders the tasks."""

    file: Path
    do: Callable[[], Finished]
    weight: float


def run_all(
    catalogue: Catalogue,
    folder: Folder,
    *,
    mapped: Collection[str],
    further: Sequence[Task],
    jobs: int,
    advance: Callable[[float], None],
) -> None:
    """Run every command whose result the folder does not hold.

    further : commands beside those of the catalogue, in the maps of the recordings `mapped`. advance : called
        with the share of the commands that is done.
    """
    pairs = [p for p in catalogue.pairs if not folder.gaps(catalogue, p)]
    maps = _maps(catalogue, folder, pairs)
    maps |= {name: (catalogue.recordings[name], None) for name in mapped}
    read = {recording.name: recording for recording, _ in maps.values()}
    read |= {pair.query: catalogue.recordings[pair.query] for pair in pairs}
    waiting = [(folder, one) for one in read.values() if not folder.source(one).exists()]
    in_processes(_make, waiting, jobs=jobs, advance=lambda share: None)
    tasks = [_convert(folder, name, recording, until_s) for name, (recording, until_s) in maps.items()]
    tasks += [_bare(folder, one) for one in catalogue.mapped if folder.has_bare(one)]
    count = len(tasks) + sum(pair.windows for pair in pairs) + len(further)
    _run(tasks, jobs, lambda done: advance(done / count))
    questions = [task for pair in pairs for task in _questions(catalogue, folder, pair)]
    _run([*questions, *further], jobs, lambda done: advance((len(tasks) + done) / count))


def _maps(
    catalogue: Catalogue, folder: Folder, pairs: Sequence[Pair]
) -> dict[str, tuple[Recording, float | None]]:
    """The maps that are made, by name: of what recording, and of how much of it."""
    maps: dict[str, tuple[Recording, float | None]] = {}
    maps |= {r.name: (r, None) for r in catalogue.mapped if not folder.missing(r)}
    for pair in pairs:
        maps[pair.map_name] = (catalogue.recordings[pair.map], pair.until_s)
        query = catalogue.recordings[pair.query]
        if pair.kind != "elsewhere" and query.mapped:  # the trajectory of all of it places its windows
            maps[pair.query] = (query, None)
    return maps


def _make(folder: Folder, recording: Recording) -> None:
    """Make a recording that is thinned or driven."""
    file, target = folder.data / recording.file, folder.source(recording)
    if recording.drive is not None:
        for old in target.parent.glob(f"{plain(recording.name)}.*"):
            old.unlink()
        write_drive(file, target, recording.drive)
    elif recording.every > 1:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_thinned(file, target, recording.every)


def _questions(catalogue: Catalogue, folder: Folder, pair: Pair) -> list[Task]:
    """A task a window; none where there is no map, or where the recording cannot be opened."""
    query = catalogue.recordings[pair.query]
    if not folder.map(pair.map_name).exists():
        return []
    try:
        windows = catalogue.windows(pair, folder.length_s(query))
    except (Pc2GridError, OSError):
        return []
    return [_locate(folder, query, pair, window) for _, window in windows]


def _run(tasks: Sequence[Task], jobs: int, advance: Callable[[float], None]) -> None:
    """Do the tasks whose result is not there, the longest first. advance : called with how many are done."""
    waiting = sorted((task for task in tasks if kept(task.file) is None), key=lambda task: -task.weight)
    there = len(tasks) - len(waiting)
    run_in(
        ThreadPoolExecutor(jobs),
        _do,
        [(task,) for task in waiting],
        lambda share: advance(there + share * len(waiting)),
    )


def _do(task: Task) -> None:
    done = task.do()
    if not done.stopped:  # else the next run does it
        keep(task.file, done)


def _convert(folder: Folder, name: str, recording: Recording, until_s: float | None) -> Task:
    database, source = folder.map(name), folder.source(recording)
    options = [*recording.options, "--name", "map", "--json", "--force", "-o", str(database)]
    if until_s is not None:
        options += ["--duration", f"{until_s:g}"]

    def do() -> Finished:
        database.parent.mkdir(parents=True, exist_ok=True)
        database.unlink(missing_ok=True)
        return pc2grid("-q", "convert", source, *options)

    size = source.stat().st_size if source.exists() else 0
    return Task(folder.result(name), do, float(size))


def _bare(folder: Folder, recording: Recording) -> Task:
    truth = folder.truth(recording)
    poses = () if truth is None or truth.suffix != ".tum" else (truth,)
    return Task(
        folder.bare(recording.name), lambda: python_module(_BARE, folder.source(recording), *poses), 0.0
    )


def _locate(folder: Folder, recording: Recording, pair: Pair, window: TimeSpan) -> Task:
    span = ("--start", f"{window.start_s:.3f}", "--duration", f"{window.duration_s:g}")
    options = (*recording.options, *span, "--set", f"relocalize.shortlist_by={folder.shortlist}")
    where = (folder.source(recording), "-d", folder.map(pair.map_name))
    return Task(
        folder.answer(pair, window), lambda: pc2grid("-q", "relocalize", *where, *options, "--json"), 0.0
    )
