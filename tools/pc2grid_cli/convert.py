"""What `pc2grid convert` does: jobs for its inputs, their results stored one after the other.

What a database holds already of the sessions that `convert` would make.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer

from pc2grid.display import counted
from pc2grid.errors import ConfigError, DatabaseError, OutputError, Pc2GridError, one_line
from pc2grid.model import is_part_of
from pc2grid.observer import Observer, TimeSpan
from pc2grid_cli import console
from pc2grid_cli import output as data_loss
from pc2grid_cli.documents import Converted, JoinedSession, OfDatabase, joined_document, session_document
from pc2grid_cli.output import check_database_name
from signature import conversion_jobs
from signature.config import Config
from signature.conversion_jobs import Job
from signature.database import Label, Provenance, maintenance, open_database
from signature.database.postgres import is_url
from signature.database.protocol import Entry
from signature.localization.answer_json import plain
from signature.localization.joining.building import join_sessions
from signature.sessions import digest_of


class Convert(OfDatabase):
    """`pc2grid convert --json`. unchanged: sessions that were stored already; failed: inputs left out.
    joined: where those of the new sessions lie in a building that were joined with others."""

    lossy: bool
    sessions: list[Converted]
    unchanged: list[str]
    failed: list[str]
    joined: list[JoinedSession]


def jobs_of(
    inputs: list[Path],
    name: str | None,
    settings: Config,
    *,
    span: TimeSpan,
    recover: bool,
    label: Label,
) -> list[Job]:
    """A job for each input. Raises ConfigError if two of them have the same name."""
    if name is not None and len(inputs) > 1:
        raise ConfigError("--name names one session, but there are several inputs")
    names = [name or path.stem for path in inputs]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(
            f"two inputs would both be the session {twice[0]!r}", hint="convert one later with --add --name"
        )
    return [
        Job(path=path, name=session, config=settings, span=span, recover=recover, label=label)
        for path, session in zip(inputs, names, strict=True)
    ]


@dataclass(kw_only=True)
class Done:
    """The results of all inputs so far.

    lossy : data was lost, or an input failed. severe : so much that the exit code is 3. joined : where those
    of the new sessions lie in a building that were joined with others.
    """

    sessions: list[Converted] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    joined: list[JoinedSession] = field(default_factory=list)
    lossy: bool = False
    severe: bool = False

    def document(self, database: str) -> Any:
        """What `--json` prints."""
        document: Convert = {
            "database": database,
            "lossy": self.lossy,
            "sessions": self.sessions,
            "unchanged": self.unchanged,
            "failed": self.failed,
            "joined": self.joined,
        }
        return plain(Convert, document)

    def add(self, entry: Entry, *, quiet: bool, strict: bool) -> None:
        """Keep and print a session made of one input."""
        session, _, origin = entry
        document = session_document(session, origin)
        self.sessions.append(document)
        if not quiet:
            print(one_line(_as_text(document)), flush=True)
        name, report = session.session, session.report
        self.warnings += [f"{name}: {warning}" for warning in report.warnings]
        if not session.submaps:
            self.warnings.append(f"{name}: no free space to cut submaps from: nothing is found in it")
        if report.lossy:
            self.warnings.append(f"{name}: {data_loss.sentence(report)}")
            self.lossy = True
            self.severe = self.severe or data_loss.ends_with_3(report, strict)

    def fail(self, job: Job) -> None:
        """Count an input that failed while others go on."""
        self.failed.append(str(job.path))
        self.lossy = self.severe = True


def convert_all(
    jobs: list[Job],
    output: str,
    terminal: console.Console,
    *,
    keep: bool,
    force: bool,
    dask: str | None,
    processes: int | None,
    quiet: bool,
    strict: bool,
) -> Done:
    """Convert, here or on a cluster, and store each result in a transaction of its own, in order."""
    done = Done()
    with contextlib.ExitStack() as stack:
        if len(jobs) > 1:
            stack.enter_context(_note_stored(terminal, done, len(jobs)))
        # If this block is left early, the cluster ends before anything is printed about it.
        for outcome in stack.enter_context(_outcomes(jobs, dask, processes, terminal.observer())):
            error = _store(outcome, output, keep=keep, force=force)
            if error is not None and len(jobs) == 1:
                raise error
            if error is not None:
                terminal.report_error(error)
                done.fail(outcome.job)
            elif not outcome.entries:
                terminal.note(f"{outcome.job.name}: stored already")
                done.unchanged.append(outcome.job.name)
            else:
                keep = True
                for entry in outcome.entries:
                    done.add(entry, quiet=quiet, strict=strict)
    return done


@contextlib.contextmanager
def _outcomes(
    jobs: list[Job], dask: str | None, processes: int | None, observer: Observer
) -> Iterator[Iterator[conversion_jobs.Outcome]]:
    """The results of the jobs as they come, in their order; leaving the block ends what is not done."""
    if dask is None and processes is None:
        with contextlib.closing(conversion_jobs.here(jobs, observer)) as outcomes:
            yield outcomes
        return
    workers = (
        conversion_jobs.on_cluster(dask)
        if dask is not None
        else conversion_jobs.processes_here(min(processes or 1, len(jobs)))
    )
    at_once = conversion_jobs.at_once(jobs, workers, observer)
    with observer.step(f"convert {len(jobs)} recordings"), contextlib.closing(at_once) as outcomes:
        yield outcomes


def _store(outcome: conversion_jobs.Outcome, output: str, *, keep: bool, force: bool) -> Exception | None:
    """Store what a job made, if anything. Returns why it failed, or why its result is refused."""
    if not outcome.entries:
        return outcome.error
    try:
        maintenance.store(output, outcome.entries, keep=keep, overwrite=force)
    except DatabaseError as refusal:
        if type(refusal) is not DatabaseError:  # a subclass: the database itself cannot be used
            raise
        return refusal
    return outcome.error


@contextlib.contextmanager
def _note_stored(terminal: console.Console, done: Done, count: int) -> Iterator[None]:
    """If the block fails, print how many sessions are stored: they stay."""
    try:
        yield
    except BaseException:
        ready = len(done.sessions) + len(done.unchanged)
        terminal.note(f"{ready} of {count} are stored; the same command continues from there")
        raise


def _as_text(d: Converted) -> str:
    travel = (
        f"{counted(d['scans'], d['sensor'] + ' scan')}, {d['path_m']:.1f} m in {d['duration_s']:.0f} s, "
        if d["scans"]
        else ""
    )
    floor = "" if d["floor"] is None else f" (floor {d['floor']})"
    return f"{d['session']}{floor}: {travel}{d['area_m2']:.0f} m2 free, {counted(d['submaps'], 'submap')}"


def join_added(
    output: str,
    done: Done,
    terminal: console.Console,
    *,
    wanted: bool | None,
) -> None:
    """Join the new sessions with those that the database holds.

    wanted : None: only if the database holds sessions that are joined already.
    """
    names = [document["session"] for document in done.sessions]
    if wanted is False or not names:
        return
    with open_database(output) as opened:
        if wanted is None and not opened.frames():
            return
        found = join_sessions(opened, only=names, observer=terminal.observer())
    maintenance.place(output, found.frames)
    done.joined = [joined_document(name, found.frames[name]) for name in names if name in found.frames]
    for document in done.joined:
        terminal.note(f"{document['session']}: joined, in the frame of {document['frame']}")
    alone = [name for name in names if name not in found.frames]
    if alone:
        done.warnings.append(f"{', '.join(alone)}: not joined with another session; see `pc2grid db join`")


def conclude(output: str, done: Done, count: int, *, json: bool) -> None:
    """Print what there is now, and what is to be said of it; end with the exit code."""
    where = maintenance.shown(output)
    if json:
        console.print_result(done.document(where))
    elif Path(output).is_file():
        print(f"{where}: {Path(output).stat().st_size / 1e6:.1f} MB")
    for warning in done.warnings:
        console.warn(warning)
    if done.failed:
        console.warn(f"{len(done.failed)} of {count} failed: {', '.join(done.failed)}")
    if len(done.failed) == count:
        raise typer.Exit(console.FAILED)
    if done.severe:
        raise typer.Exit(console.LOSSY)


def stored_sessions(output: str, jobs: Sequence[Job], *, add: bool, force: bool) -> dict[str, Provenance]:
    """Provenance of the sessions that are stored already and stay; without any, a new database is made.

    Raises OutputError if a database exists that the inputs must not be written to, DatabaseError if one that
    they are added to has a session of the same name that was made otherwise.
    """
    there = maintenance.exists(output)
    if not is_url(output) and not (there and add):
        check_database_name(output)
    if not there or (force and not add):
        return {}
    present = _present(output, jobs, add=add)
    if force:
        return {}
    difference = _difference(present, jobs)
    if not add:
        _refuse_others(output, present, jobs, difference)
    elif difference:
        raise DatabaseError(
            f"{maintenance.shown(output)}: holds the session{difference}",
            hint="--force replaces it; --name gives this one another name",
        )
    return present


def _present(output: str, jobs: Sequence[Job], *, add: bool) -> dict[str, Provenance]:
    """Provenance of the stored sessions by name."""
    try:
        with open_database(output) as opened:
            # A database may hold a whole fleet: for adding, only sessions of the same names matter.
            known = opened.sessions([job.name for job in jobs] if add else None)
        return {info.name: info.provenance for info in known}
    except DatabaseError:
        if add:
            raise
        where = maintenance.shown(output)
        raise OutputError(f"{where}: exists already", hint="--force replaces it") from None


def _refuse_others(
    output: str, present: Mapping[str, Provenance], jobs: Sequence[Job], difference: str
) -> None:
    """Raises OutputError unless the database is what an interrupted conversion of these jobs left behind."""
    others = {
        name for name in present if not any(name == job.name or is_part_of(name, job.name) for job in jobs)
    }
    if others:
        difference = f" and holds {', '.join(map(repr, sorted(present)))}"
        difference += f" instead of {', '.join(repr(job.name) for job in jobs)}"
    elif len(jobs) == 1 and not difference:
        difference = " and is made from the same input with the same settings"
    if difference:
        raise OutputError(
            f"{maintenance.shown(output)}: exists already{difference}",
            hint="--force replaces it, --add adds to it",
        )


def _difference(present: Mapping[str, Provenance], jobs: Sequence[Job]) -> str:
    """How a stored session differs from the one that would be made, as the end of a sentence; empty: none."""
    for job in jobs:
        if job.name not in present:
            continue
        was = present[job.name]
        old, new = _settings(was), _settings(job.made_from(was.digest))
        for key in (*new, *(old.keys() - new.keys())):
            if old.get(key) != new.get(key):
                return f", {job.name!r} made with {key} = {old.get(key)!r}, not {new.get(key)!r}"
        # Of several inputs each job compares its own content.
        if was.source != job.path.name or (len(jobs) == 1 and _changed(was, job)):
            return f", {job.name!r} made from a file {was.source!r} with other content"
    return ""


def _settings(origin: Provenance) -> dict[str, Any]:
    """What a session is made with: label, part of the recording, settings, versions of the libraries."""
    found: dict[str, Any] = {"start": origin.start_s, "duration": origin.duration_s}
    found |= {"building": origin.label.building, "floor": origin.label.floor}
    found |= {f"{section}.{key}": value for section, part in origin.config for key, value in part}
    return found | dict(origin.versions)


def _changed(was: Provenance, job: Job) -> bool:
    """Whether the input has other content than that of the stored session."""
    try:
        return digest_of(job.path, job.config) != was.digest
    except Pc2GridError:
        return False  # the input cannot be read; with --force its error is shown
