"""`pc2grid convert`: jobs for its inputs, whose results are stored one after the other.

Before that it is compared with what the database holds already: a stored session that was made of the same
input with the same settings stays, and any other of its name is refused.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pc2grid import libraries
from pc2grid.display import counted, plain
from pc2grid.errors import ConfigError, DatabaseError, OutputError, Pc2GridError, one_line
from pc2grid.model import is_part_of
from pc2grid.observer import Observer
from pc2grid_cli import console, options, output
from pc2grid_cli.output import Document, joined_document, session_document
from signature import conversion_jobs
from signature.conversion_jobs import Job
from signature.database import Label, Provenance, maintenance, open_database
from signature.database.postgres import is_url
from signature.database.protocol import Entry
from signature.join.building import join_sessions
from signature.sessions import digest_of


@dataclass(kw_only=True)
class ConvertedInputs:
    """What became of the inputs, as far as they are done.

    lossy : data was lost, or an input failed. severe : so much that the exit code is 3.
    """

    database: str
    lossy: bool = False
    sessions: list[Document] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    joined: list[Document] = field(default_factory=list)
    severe: bool = False
    warnings: list[str] = field(default_factory=list)

    def add(self, entry: Entry, given: options.Convert) -> None:
        """Keep and print a session made of one input."""
        session, _, origin = entry
        document = session_document(session, origin)
        self.sessions.append(document)
        if not given.json:
            print(one_line(_as_text(document)), flush=True)
        name, report = session.session, session.report
        self.warnings += [f"{name}: {warning}" for warning in report.warnings]
        if not session.submaps:
            self.warnings.append(f"{name}: no free space to cut submaps from: nothing is found in it")
        if report.lossy:
            self.warnings.append(f"{name}: {output.sentence(report)}")
            self.lossy = True
            self.severe = self.severe or output.ends_with_3(report, given.strict)


def run(given: options.Convert, terminal: console.Console) -> int | None:
    """Convert and store what is not stored yet, join it, and print what there is. Return the exit code."""
    if given.dask is not None and (given.jobs is not None or "://" not in given.dask):
        raise ConfigError(
            "--dask ADDRESS names the scheduler of a cluster", hint="--jobs N: processes of this machine"
        )
    cluster = {} if given.dask is None else {"cluster": "--dask"}
    libraries.require(cluster | libraries.of_addresses(given.output))
    jobs = _jobs(given)
    stored = _stored_sessions(given, jobs)
    if any(job.name not in stored for job in jobs):
        output.check_database(given.output)
    jobs = [replace(job, stored=stored.get(job.name)) for job in jobs]
    done = _convert_all(jobs, given, terminal, keep=given.add or bool(stored))
    _join_added(done, given, terminal)
    return _conclude(done, given)


def _jobs(given: options.Convert) -> list[Job]:
    """Return a job for each input. Raises ConfigError if two of them have the same name."""
    if given.name is not None and len(given.inputs) > 1:
        raise ConfigError("--name names one session, but there are several inputs")
    names = [given.name or path.stem for path in given.inputs]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(
            f"two inputs would both be the session {twice[0]!r}", hint="convert one later with --add --name"
        )
    settings = given.settings(preset=given.preset, points=not given.no_points)
    label = Label(building=given.building, floor=given.floor)
    return [
        Job(path=path, name=name, config=settings, span=given.span, recover=given.recover, label=label)
        for path, name in zip(given.inputs, names, strict=True)
    ]


def _convert_all(
    jobs: Sequence[Job], given: options.Convert, terminal: console.Console, *, keep: bool
) -> ConvertedInputs:
    """Convert, here or on a cluster, and store each result in a transaction of its own, in order.

    keep : the sessions that the database holds.
    """
    done = ConvertedInputs(database=maintenance.shown(given.output))
    try:
        # If this block is left early, the cluster ends before anything is printed about it.
        with _outcomes(jobs, given, terminal) as outcomes:
            for outcome in outcomes:
                error = _store(outcome, given, keep=keep)
                if error is not None and len(jobs) == 1:
                    raise error
                if error is not None:
                    terminal.report_error(error)
                    done.failed.append(str(outcome.job.path))
                    done.lossy = done.severe = True
                elif not outcome.entries:
                    terminal.note(f"{outcome.job.name}: stored already")
                    done.unchanged.append(outcome.job.name)
                else:
                    keep = True
                    for entry in outcome.entries:
                        done.add(entry, given)
    except BaseException:
        if len(jobs) > 1:
            ready = len(done.sessions) + len(done.unchanged)
            terminal.note(f"{ready} of {len(jobs)} are stored; the same command continues from there")
        raise
    return done


@contextlib.contextmanager
def _outcomes(
    jobs: Sequence[Job], given: options.Convert, observer: Observer
) -> Iterator[Iterator[conversion_jobs.Outcome]]:
    """Yield the results of the jobs in their order, as they come; leaving the block ends what is not done."""
    if given.dask is None and given.jobs is None:
        with contextlib.closing(conversion_jobs.here(jobs, observer)) as outcomes:
            yield outcomes
        return
    workers = (
        conversion_jobs.on_cluster(given.dask)
        if given.dask is not None
        else conversion_jobs.processes_here(min(given.jobs or 1, len(jobs)))
    )
    at_once = conversion_jobs.at_once(jobs, workers, observer)
    with observer.step(f"convert {len(jobs)} recordings"), contextlib.closing(at_once) as outcomes:
        yield outcomes


def _store(outcome: conversion_jobs.Outcome, given: options.Convert, *, keep: bool) -> Exception | None:
    """Store what a job made, if anything. Return why it failed, or why its result is refused."""
    if not outcome.entries:
        return outcome.error
    try:
        maintenance.store(given.output, outcome.entries, keep=keep, overwrite=given.force)
    except DatabaseError as refusal:
        if type(refusal) is not DatabaseError:  # a subclass: the database itself cannot be used
            raise
        return refusal
    return outcome.error


def _as_text(d: Document) -> str:
    travel = (
        f"{counted(d['scans'], d['sensor'] + ' scan')}, {d['path_m']:.1f} m in {d['duration_s']:.0f} s, "
        if d["scans"]
        else ""
    )
    floor = "" if d["floor"] is None else f" (floor {d['floor']})"
    return f"{d['session']}{floor}: {travel}{d['area_m2']:.0f} m2 free, {counted(d['submaps'], 'submap')}"


def _join_added(done: ConvertedInputs, given: options.Convert, terminal: console.Console) -> None:
    """Join the new sessions with those that the database holds.

    Without --join and --no-join: only if the database holds sessions that are joined already.
    """
    names = [document["session"] for document in done.sessions]
    if given.join is False or not names:
        return
    with open_database(given.output) as opened:
        if given.join is None and not opened.frames():
            return
        found = join_sessions(opened, only=names, observer=terminal)
    maintenance.store_frames(given.output, found.frames)
    done.joined = [joined_document(name, found.frames[name]) for name in names if name in found.frames]
    for document in done.joined:
        terminal.note(f"{document['session']}: joined, in the frame of {document['frame']}")
    alone = [name for name in names if name not in found.frames]
    if alone:
        done.warnings.append(f"{', '.join(alone)}: not joined with another session; see `pc2grid db join`")


def _conclude(done: ConvertedInputs, given: options.Convert) -> int | None:
    """Print what there is now, and what is to be said of it. Return the exit code."""
    count, path = len(given.inputs), Path(given.output)
    if given.json:
        document = {
            "database": done.database,
            "lossy": done.lossy,
            "sessions": done.sessions,
            "unchanged": done.unchanged,
            "failed": done.failed,
            "joined": done.joined,
        }
        console.print_result(plain(document))
    elif path.is_file():
        print(f"{done.database}: {path.stat().st_size / 1e6:.1f} MB")
    for warning in done.warnings:
        console.warn(warning)
    if done.failed:
        console.warn(f"{len(done.failed)} of {count} failed: {', '.join(done.failed)}")
    if len(done.failed) == count:
        return console.FAILED
    return console.LOSSY if done.severe else None


def _stored_sessions(given: options.Convert, jobs: Sequence[Job]) -> dict[str, Provenance]:
    """Return the provenance of the sessions that are stored already and stay; {}: a new database is made.

    Raises OutputError if a database exists that the inputs must not be written to, DatabaseError if one that
    they are added to has a session of the same name that was made otherwise.
    """
    add, force = given.add, given.force
    there = maintenance.exists(given.output)
    if not is_url(given.output) and not (there and add):
        output.check_database_name(given.output)
    if not there or (force and not add):
        return {}
    present = _present(given.output, jobs, add=add)
    if force:
        return {}
    difference = _difference(present, jobs)
    if not add:
        _refuse_others(given.output, present, jobs, difference)
    elif difference:
        raise DatabaseError(
            f"{maintenance.shown(given.output)}: holds the session{difference}",
            hint="--force replaces it; --name gives this one another name",
        )
    return present


def _present(database: str, jobs: Sequence[Job], *, add: bool) -> dict[str, Provenance]:
    """Return the provenance of the stored sessions by name."""
    try:
        with open_database(database) as opened:
            # A database may hold a whole fleet: for adding, only sessions of the same names matter.
            known = opened.sessions([job.name for job in jobs] if add else None)
        return {info.name: info.provenance for info in known}
    except DatabaseError:
        if add:
            raise
        text = f"{maintenance.shown(database)}: exists already"
        raise OutputError(text, hint="--force replaces it") from None


def _refuse_others(
    database: str, present: Mapping[str, Provenance], jobs: Sequence[Job], difference: str
) -> None:
    """Raise OutputError unless the database is what an interrupted conversion of these jobs left behind."""
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
            f"{maintenance.shown(database)}: exists already{difference}",
            hint="--force replaces it, --add adds to it",
        )


def _difference(present: Mapping[str, Provenance], jobs: Sequence[Job]) -> str:
    """Return the end of a sentence on how a stored session differs from the one that would be made, or ""."""
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
    """Return what a session is made with: label, part of the recording, settings, versions of libraries."""
    found: dict[str, Any] = {"start": origin.start_s, "duration": origin.duration_s}
    found |= {"building": origin.label.building, "floor": origin.label.floor}
    found |= {f"{section}.{key}": value for section, part in origin.config for key, value in part}
    return found | dict(origin.versions)


def _changed(was: Provenance, job: Job) -> bool:
    """Return whether the input has other content than that of the stored session."""
    try:
        return digest_of(job.path, job.config) != was.digest
    except Pc2GridError:
        return False  # the input cannot be read; with --force its error is shown
