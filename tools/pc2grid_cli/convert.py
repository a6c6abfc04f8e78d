"""`pc2grid convert`: recordings and maps become a database."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pc2grid.errors import DatabaseError, one_line
from pc2grid_cli import console
from pc2grid_cli import settings as options

if TYPE_CHECKING:
    from pc2grid.model import SessionMap
    from signature.cluster import Job
    from signature.database import Provenance
    from signature.database.protocol import Entry


def convert_command(
    inputs: Annotated[list[Path], typer.Argument(metavar="LOG|MAP.yaml...", help="recordings, or nav2 maps")],
    output: options.WrittenDatabase,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    name: Annotated[
        str | None, typer.Option("--name", help="of the session; default: the file's name")
    ] = None,
    building: Annotated[
        str | None, typer.Option("--building", metavar="NAME", help="where it was recorded; answers say so")
    ] = None,
    floor: Annotated[str | None, typer.Option("--floor", metavar="NAME", help="the same, within it")] = None,
    add: Annotated[bool, typer.Option("--add", help="add to an existing database")] = False,
    dask: Annotated[
        str | None,
        typer.Option("--dask", metavar="[ADDRESS]", help="of a scheduler; none: processes on this machine"),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, help="how many processes; default: as many as cores")
    ] = None,
    rerun: options.Rerun = None,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    force: options.Force = False,
    recover: options.Recover = False,
    assume_identity: options.AssumeIdentity = False,
    json: options.AsJson = False,
) -> None:
    """Make a submap database from recordings or maps; several become a session each.

    Of several, each is stored when it is done: after an interruption the same command goes on from there.

    Example: pc2grid convert monday.mcap -o building.submaps
    """
    from pc2grid.errors import ConfigError
    from signature.cluster import LOCAL, Job
    from signature.database import Label, transfer

    settings = options.make_config(
        config, set_, topic=topic, odometry=odometry, assume_identity=assume_identity
    )
    if rerun is not None:
        from pc2grid_cli.rerun_target import require_target, url_of

        if dask is not None or jobs is not None:
            raise ConfigError("--rerun shows what is done in this process: not with --dask or --jobs")
        if len(inputs) > 1 and url_of(rerun) is None:
            raise ConfigError(
                "--rerun writes one recording to a file, but there are several inputs",
                hint="watch them in the viewer: --rerun, or --rerun HOST:PORT",
            )
        require_target(rerun, force)
    if name is not None and len(inputs) > 1:
        raise ConfigError("--name names one session, but there are several inputs")
    wanted = [
        Job(
            path=path,
            name=name or path.stem,
            config=settings,
            start_s=start,
            duration_s=duration,
            recover=recover,
            label=Label(building=building, floor=floor),
        )
        for path in inputs
    ]
    names = [job.name for job in wanted]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(
            f"two inputs would both be the session {twice[0]!r}", hint="convert one later with --add --name"
        )
    stored = _stored(output, wanted, add=add, force=force)
    if dask is None and jobs is not None:
        dask = LOCAL
    done = _convert_all(
        [replace(job, stored=stored.get(job.name)) for job in wanted],
        output,
        keep=add or bool(stored),
        force=force,
        dask=dask,
        processes=jobs or os.cpu_count() or 1,
        rerun=rerun,
        quiet=json,
    )
    where = transfer.shown(output)
    if json:
        console.print_json(
            {
                "schema_version": 1,
                "database": where,
                "lossy": done.lossy,
                "sessions": done.sessions,
                "unchanged": done.unchanged,
                "failed": done.failed,
            }
        )
    else:
        path = Path(output)
        if path.is_file():
            print(f"{where}: {path.stat().st_size / 1e6:.1f} MB")
    for warning in done.warnings:
        console.warn(warning)
    if done.failed:
        console.warn(f"{len(done.failed)} of {len(inputs)} failed: {', '.join(done.failed)}")
    if len(done.failed) == len(inputs):
        raise typer.Exit(console.FAILED)
    if done.lossy:
        raise typer.Exit(console.LOSSY)


@dataclass(kw_only=True)
class _Done:
    """What became of all inputs."""

    sessions: list[dict[str, Any]] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    lossy: bool = False


def _convert_all(
    jobs: list[Job],
    output: str,
    *,
    keep: bool,
    force: bool,
    dask: str | None,
    processes: int,
    rerun: str | None,
    quiet: bool,
) -> _Done:
    """Convert, here or on a cluster, and store what comes back, in order, a transaction each."""
    from signature import cluster
    from signature.database import transfer

    done = _Done()
    with contextlib.ExitStack() as stack:
        if len(jobs) > 1:
            stack.enter_context(_say_how_far(done, len(jobs)))
        shown = None
        if rerun is not None:
            from pc2grid_cli.rerun_stream import Conversions

            shown = stack.enter_context(Conversions(rerun))
        if dask is None:
            watch = None if shown is None else shown.watch
            outcomes = cluster.here(jobs, console.progress, lambda line: console.note(line, level=1), watch)
        else:
            outcomes = cluster.on_cluster(jobs, dask, min(processes, len(jobs)), console.warn)
            update = stack.enter_context(console.progress(f"convert {len(jobs)} recordings"))
        # Whatever ends this early ends the cluster too, before anything is said about it.
        stack.enter_context(contextlib.closing(outcomes))
        for number, outcome in enumerate(outcomes, start=1):
            error = outcome.error
            if outcome.entry is not None:
                try:
                    transfer.store(output, [outcome.entry], keep=keep, force=force)
                    keep = True
                    _tell(done, outcome.entry, quiet)
                    if shown is not None:
                        shown.show(outcome.entry[0], outcome.job.config)
                except DatabaseError as refusal:
                    if type(refusal) is not DatabaseError:  # the database itself is in trouble
                        raise
                    error = refusal
            if error is not None:
                if len(jobs) == 1:
                    raise error
                console.report_error(error)
                done.failed.append(str(outcome.job.path))
                done.lossy = True
            elif outcome.entry is None:
                console.note(f"{outcome.job.name}: stored already")
                done.unchanged.append(outcome.job.name)
            if dask is not None:
                update(number / len(jobs))
    return done


@contextlib.contextmanager
def _say_how_far(done: _Done, count: int) -> Iterator[None]:
    """What is stored stays when the rest is given up."""
    try:
        yield
    except BaseException:
        ready = len(done.sessions) + len(done.unchanged)
        console.note(f"{ready} of {count} are stored; the same command goes on from there")
        raise


def _tell(done: _Done, entry: Entry, quiet: bool) -> None:
    """Remember and print what became of one input."""
    session, _, origin = entry
    document = summary(session, origin)
    done.sessions.append(document)
    if not quiet:
        print(one_line(_as_text(document)), flush=True)
    done.warnings += [f"{session.session}: {warning}" for warning in session.report.warnings]
    if not session.submaps:
        done.warnings.append(f"{session.session}: no free space to cut submaps from: nothing is found in it")
    if session.report.lossy:
        done.warnings.append(f"{session.session}: data was lost: {_losses(session)}")
        done.lossy = True


def _stored(output: str, jobs: list[Job], *, add: bool, force: bool) -> dict[str, Provenance]:
    """Sessions that are there already and shall stay as they are; without any, a new database is made.

    Raises OutputError if there is a database that the inputs must not be written to.
    """
    from pc2grid.errors import OutputError
    from signature.database import open_database, transfer
    from signature.database.postgres_schema import is_url

    where = transfer.shown(output)
    if not is_url(output) and not Path(output).parent.is_dir():
        raise OutputError(
            f"{output}: cannot write: no folder {Path(output).parent}", hint="create the folder first"
        )
    if not transfer.exists(output) or (force and not add):
        return {}
    try:
        with open_database(output) as opened:
            # Of what a whole fleet has stored, only namesakes matter for adding.
            known = opened.sessions([job.name for job in jobs] if add else None)
        present = {info.name: info.provenance for info in known}
    except DatabaseError:
        if add:
            raise
        raise OutputError(f"{where}: exists already", hint="--force replaces it") from None
    if force:
        return {}
    difference = _difference(present, jobs)
    if add and difference:
        raise DatabaseError(
            f"{where}: holds the session{difference}",
            hint="--force replaces it; --name gives this one another name",
        )
    others = present.keys() - {job.name for job in jobs}
    if not add and (difference or others or len(jobs) == 1):
        if others:
            difference = f" and holds {', '.join(map(repr, sorted(present)))}"
            difference += f" instead of {', '.join(repr(job.name) for job in jobs)}"
        same = " and is made from the same input with the same settings"
        raise OutputError(
            f"{where}: exists already{difference or same}",
            hint="--force replaces it, --add adds to it",
        )
    return present


def summary(session: SessionMap, origin: Provenance) -> dict[str, Any]:
    """What became of one input, plain types only."""
    from dataclasses import asdict

    import numpy as np

    path_m = session.trajectory.path_m()
    grid = session.grid
    stamps = session.trajectory.stamps_ns
    return {
        "session": session.session,
        "building": origin.label.building,
        "floor": origin.label.floor,
        "source": origin.source,
        "digest": origin.digest,
        "sensor": session.sensor,
        "scans": len(session.trajectory),
        "path_m": round(float(path_m[-1]), 2) if len(path_m) else 0.0,
        "duration_s": round(float(stamps[-1] - stamps[0]) / 1e9, 2) if len(stamps) else 0.0,
        "area_m2": round(float(np.count_nonzero(grid.free)) * grid.resolution_m**2, 1),
        "submaps": len(session.submaps),
        "report": {**asdict(session.report), "lossy": session.report.lossy},
    }


def _difference(present: Mapping[str, Provenance], jobs: Sequence[Job]) -> str:
    """What tells a session that is there from the one that was asked for, as the end of a sentence.

    Of several inputs the content is not looked at: whoever converts them does that.
    """
    from pc2grid.errors import Pc2GridError
    from signature.build import digest_of

    for job in jobs:
        if job.name not in present:
            continue
        was = present[job.name]
        asked = job.made_from(was.digest)
        if was.label != asked.label:
            return f", {job.name!r} with {was.label} instead of {asked.label} (--building, --floor)"
        if (was.start_s, was.duration_s) != (asked.start_s, asked.duration_s):
            return f", {job.name!r} made from another part of the recording (--start, --duration)"
        for section, settings in job.config:
            for key, value in settings:
                old = getattr(getattr(was.config, section), key)
                if old != value:
                    return f", {job.name!r} made with {section}.{key} = {old!r}, not {value!r}"
        for library in sorted({*was.versions, *asked.versions}):
            old, new = was.versions.get(library), asked.versions.get(library)
            if old != new:
                return f", {job.name!r} made with {library} {old}, not {new}"
        other = f", {job.name!r} made from a file {was.source!r} with other content"
        if was.source != asked.source:
            return other
        if len(jobs) == 1:
            try:
                digest = digest_of(job.path, job.config)
            except Pc2GridError:
                return ""  # an input that cannot be read: the next attempt with --force says so
            if digest != was.digest:
                return other
    return ""


def _as_text(d: dict[str, Any]) -> str:
    travel = (
        f"{d['scans']} {d['sensor']} scans, {d['path_m']:.1f} m in {d['duration_s']:.0f} s, "
        if d["scans"]
        else ""
    )
    return f"{d['session']}: {travel}{d['area_m2']:.0f} m2 free, {d['submaps']} submaps"


def _losses(session: SessionMap) -> str:
    report = session.report
    parts = [f"{count} scans skipped ({reason})" for reason, count in report.scans_skipped.items()]
    if report.bytes_lost:
        parts.append(f"{report.bytes_lost} bytes unreadable")
    return ", ".join(parts)
