"""`pc2grid convert`: recordings and maps become a database."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pc2grid import extras
from pc2grid.errors import ConfigError, DatabaseError, one_line
from pc2grid.observer import Observer, Observers
from pc2grid.time_span import TimeSpan
from pc2grid_cli import console, data_loss
from pc2grid_cli import options as options
from pc2grid_cli.output_files import check_database, check_database_name
from pc2grid_cli.plural import counted
from pc2grid_cli.rerun_target import require_target, url_of

if TYPE_CHECKING:
    from pc2grid.model import SessionMap
    from pc2grid_cli.json_schemas import Convert, Converted
    from signature.config import Config
    from signature.conversion_jobs import Job
    from signature.database import Label, Provenance
    from signature.database.protocol import Entry


def convert_command(
    context: typer.Context,
    inputs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG|MAP...", help="recordings, or maps: .yaml of nav2, .pcd, .ply, a mesh"),
    ],
    output: options.WrittenDatabase,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    name: Annotated[
        str | None, typer.Option("--name", help="of the session; default: the file's name")
    ] = None,
    building: Annotated[
        str | None, typer.Option("--building", metavar="NAME", help="where it was recorded; answers name it")
    ] = None,
    floor: Annotated[
        str | None,
        typer.Option(
            "--floor", metavar="NAME", help="the same, within it; of several floors: A,B,A in order"
        ),
    ] = None,
    points: Annotated[
        float | None,
        typer.Option(
            "--points", metavar="VOXEL_M", min=0.01, max=1.0, help="keep the 3D points too, one a voxel"
        ),
    ] = None,
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
    preset: options.Preset = options.PresetName.default,
    force: options.Force = False,
    recover: options.Recover = False,
    strict: options.Strict = False,
    assume_identity: options.AssumeIdentity = False,
    json: options.AsJson = False,
) -> None:
    """Make a submap database from recordings or maps; several become a session each.

    Of several, each is stored when it is done: after an interruption the same command continues from there.

    Example: pc2grid convert monday.mcap -o building.submaps
    """
    from signature.conversion_jobs import LOCAL
    from signature.database import Label, maintenance

    parallel = dask is not None or jobs is not None
    if rerun is not None:
        _check_rerun(rerun, several=len(inputs) > 1, parallel=parallel)
    extras.require(
        ({} if rerun is None else {"viz": "--rerun"})
        | ({} if not parallel else {"cluster": "--dask" if jobs is None else "--jobs"})
        | extras.of_addresses(output)
    )
    settings = options.make_config(
        config,
        set_,
        topic=topic,
        odometry=odometry,
        assume_identity=assume_identity,
        points_voxel_m=points,
        preset=preset,
    )
    if rerun is not None:
        require_target(rerun, force)
    span, label = TimeSpan(start, duration), Label(building=building, floor=floor)
    wanted = _jobs(inputs, name, settings, span=span, recover=recover, label=label)
    stored = _stored(output, wanted, add=add, force=force)
    if any(job.name not in stored for job in wanted):
        check_database(output)
    done = _convert_all(
        [replace(job, stored=stored.get(job.name)) for job in wanted],
        output,
        console.of(context),
        keep=add or bool(stored),
        force=force,
        dask=LOCAL if dask is None and jobs is not None else dask,
        processes=jobs or os.cpu_count() or 1,
        rerun=rerun,
        quiet=json,
        strict=strict,
    )
    where = maintenance.shown(output)
    if json:
        console.print_json(_document(where, done))
    elif Path(output).is_file():
        print(f"{where}: {Path(output).stat().st_size / 1e6:.1f} MB")
    for warning in done.warnings:
        console.warn(warning)
    if done.failed:
        console.warn(f"{len(done.failed)} of {len(inputs)} failed: {', '.join(done.failed)}")
    if len(done.failed) == len(inputs):
        raise typer.Exit(console.FAILED)
    if done.severe:
        raise typer.Exit(console.LOSSY)


def _check_rerun(target: str, *, several: bool, parallel: bool) -> None:
    """Raises ConfigError if such a conversion cannot be streamed to this target."""
    if parallel:
        raise ConfigError("--rerun shows what is done in this process: not with --dask or --jobs")
    if several and url_of(target) is None:
        raise ConfigError(
            "--rerun writes one recording to a file, but there are several inputs",
            hint="watch them in the viewer: --rerun, or --rerun HOST:PORT",
        )


def _jobs(
    inputs: list[Path],
    name: str | None,
    settings: Config,
    *,
    span: TimeSpan,
    recover: bool,
    label: Label,
) -> list[Job]:
    """A job for each input. Raises ConfigError if two of them have the same name."""
    from signature.conversion_jobs import Job

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
class _Done:
    """The results of all inputs so far.

    lossy : data was lost, or an input failed. severe : so much that the exit code is 3.
    """

    sessions: list[Converted] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    lossy: bool = False
    severe: bool = False


def _document(database: str, done: _Done) -> Convert:
    return {
        "schema_version": 1,
        "database": database,
        "lossy": done.lossy,
        "sessions": done.sessions,
        "unchanged": done.unchanged,
        "failed": done.failed,
    }


def _convert_all(
    jobs: list[Job],
    output: str,
    terminal: console.Console,
    *,
    keep: bool,
    force: bool,
    dask: str | None,
    processes: int,
    rerun: str | None,
    quiet: bool,
    strict: bool,
) -> _Done:
    """Convert, here or on a cluster, and store each result in a transaction of its own, in order."""
    from signature import conversion_jobs
    from signature.database import maintenance

    done = _Done()
    with contextlib.ExitStack() as stack:
        if len(jobs) > 1:
            stack.enter_context(_note_stored(terminal, done, len(jobs)))
        shown = None
        observer: Observer = terminal.observer()
        if rerun is not None:
            from pc2grid_cli.rerun_stream import Conversions

            shown = stack.enter_context(Conversions(rerun))
            observer = Observers(observer, shown)
        if dask is None:
            outcomes = conversion_jobs.here(jobs, observer)
        else:
            outcomes = conversion_jobs.on_cluster(jobs, dask, min(processes, len(jobs)), observer)
            stack.enter_context(observer.step(f"convert {len(jobs)} recordings"))
        # If this block is left early, the cluster ends before anything is printed about it.
        stack.enter_context(contextlib.closing(outcomes))
        for outcome in outcomes:
            error = outcome.error
            if outcome.entries:
                try:
                    maintenance.store(output, outcome.entries, keep=keep, force=force)
                    keep = True
                    for entry in outcome.entries:
                        _tell(done, entry, quiet=quiet, strict=strict)
                        terminal.note(_odometry_as_text(entry[0]), level=1)
                        if shown is not None:
                            shown.show(entry[0], outcome.job.config)
                except DatabaseError as refusal:
                    if type(refusal) is not DatabaseError:  # a subclass: the database itself cannot be used
                        raise
                    error = refusal
            if error is not None:
                if len(jobs) == 1:
                    raise error
                terminal.report_error(error)
                done.failed.append(str(outcome.job.path))
                done.lossy = done.severe = True
            elif not outcome.entries:
                terminal.note(f"{outcome.job.name}: stored already")
                done.unchanged.append(outcome.job.name)
    return done


@contextlib.contextmanager
def _note_stored(terminal: console.Console, done: _Done, count: int) -> Iterator[None]:
    """If the block fails, print how many sessions are stored: they stay."""
    try:
        yield
    except BaseException:
        ready = len(done.sessions) + len(done.unchanged)
        terminal.note(f"{ready} of {count} are stored; the same command continues from there")
        raise


def _tell(done: _Done, entry: Entry, *, quiet: bool, strict: bool) -> None:
    """Keep and print a session made of one input."""
    session, _, origin = entry
    document = summary(session, origin)
    done.sessions.append(document)
    if not quiet:
        print(one_line(_as_text(document)), flush=True)
    done.warnings += [f"{session.session}: {warning}" for warning in session.report.warnings]
    if not session.submaps:
        done.warnings.append(f"{session.session}: no free space to cut submaps from: nothing is found in it")
    if session.report.lossy:
        done.warnings.append(f"{session.session}: {data_loss.sentence(session.report)}")
        done.lossy = True
        done.severe = done.severe or data_loss.ends_with_3(session.report, strict)


def _odometry_as_text(session: SessionMap) -> str:
    """One line on how well the odometry of a session agrees with its scans."""
    check, trajectory = session.odometry, session.trajectory
    if check is None or not check.compared:
        return f"{session.session}: no odometry to compare with the scans"
    text = f"{session.session}: the scans overruled odometry in {check.overruled} of {check.compared} scans"
    if not check.stretches:
        return text
    worst, start_ns = check.stretches[0], int(trajectory.stamps_ns[0])
    from_s, to_s = ((stamp - start_ns) * 1e-9 for stamp in (worst.from_ns, worst.to_ns))
    return (
        f"{text}, most {from_s:.1f} to {to_s:.1f} s after the first scan: by up to {worst.distance_m:.2f} m "
        f"and {math.degrees(worst.turn_rad):.0f} degrees from one scan to the next"
    )


def _stored(output: str, jobs: list[Job], *, add: bool, force: bool) -> dict[str, Provenance]:
    """Provenance of the sessions that are stored already and stay; without any, a new database is made.

    Raises OutputError if a database exists that the inputs must not be written to.
    """
    from pc2grid.errors import OutputError
    from pc2grid.model import is_part_of
    from signature.database import maintenance, open_database
    from signature.database.postgres.server import is_url

    where = maintenance.shown(output)
    there = maintenance.exists(output)
    if not is_url(output) and not (there and add):
        check_database_name(output)
    if not there or (force and not add):
        return {}
    try:
        with open_database(output) as opened:
            # A database may hold a whole fleet: for adding, only sessions of the same names matter.
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
    others = {
        name for name in present if not any(name == job.name or is_part_of(name, job.name) for job in jobs)
    }
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


def summary(session: SessionMap, origin: Provenance) -> Converted:
    """The session made of one input, as the JSON document describes it."""

    from pc2grid_cli.session_documents import consistency_document, odometry_document, precision_document

    path_m = session.trajectory.path_m()
    grid = session.grid
    stamps = session.trajectory.stamps_ns
    report = session.report
    return {
        "session": session.session,
        "building": origin.label.building,
        "floor": origin.label.floor,
        "floor_height_m": origin.label.floor_height_m,
        "source": origin.source,
        "digest": origin.digest,
        "sensor": session.sensor,
        "scans": len(session.trajectory),
        "path_m": round(float(path_m[-1]), 2) if len(path_m) else 0.0,
        "duration_s": round(float(stamps[-1] - stamps[0]) / 1e9, 2) if len(stamps) else 0.0,
        "area_m2": round(grid.free_m2, 1),
        "submaps": len(session.submaps),
        "consistency": consistency_document(session.consistency),
        "odometry": odometry_document(session.odometry),
        "precision": precision_document(session.precision),
        "report": {
            "scans_read": report.scans_read,
            "points_dropped": report.points_dropped,
            "scans_skipped": report.scans_skipped,
            "bytes_lost": report.bytes_lost,
            "warnings": list(report.warnings),
            "lossy": report.lossy,
        },
    }


def _difference(present: Mapping[str, Provenance], jobs: Sequence[Job]) -> str:
    """How a stored session differs from the one that is asked for, as the end of a sentence; empty: not.

    The content of the input is compared only if there is one input; of several, each job compares its own.
    """
    from pc2grid.errors import Pc2GridError
    from signature.sessions import digest_of

    for job in jobs:
        if job.name not in present:
            continue
        was = present[job.name]
        asked = job.made_from(was.digest)
        if not _label_kept(was.label, asked.label):
            return (
                f"; its session {job.name!r} has the label {str(was.label)!r}, this one would have"
                f" {str(asked.label)!r} (--building, --floor)"
            )
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
                return ""  # the input cannot be read; with --force its error is shown
            if digest != was.digest:
                return other
    return ""


def _label_kept(was: Label, asked: Label) -> bool:
    """Whether a stored session, the first of its recording, has the label that is asked for.

    The floors of a recording may have got names of their own; several names may be given, see `on_floors`.
    """
    if was.told_apart or (asked.floor is not None and was.floor == asked.floor.split(",")[0].strip()):
        return was.building == asked.building
    return was == asked


def _as_text(d: Converted) -> str:
    travel = (
        f"{counted(d['scans'], d['sensor'] + ' scan')}, {d['path_m']:.1f} m in {d['duration_s']:.0f} s, "
        if d["scans"]
        else ""
    )
    floor = "" if d["floor"] is None else f" (floor {d['floor']})"
    return f"{d['session']}{floor}: {travel}{d['area_m2']:.0f} m2 free, {counted(d['submaps'], 'submap')}"
