"""`pc2grid convert`: recordings and maps become a database."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pc2grid_cli import console
from pc2grid_cli import settings as options

if TYPE_CHECKING:
    from pc2grid.model import OccupancyGrid, SessionMap
    from signature.config import Config
    from signature.database import Label, Provenance


def convert_command(
    inputs: Annotated[list[Path], typer.Argument(metavar="LOG|MAP.yaml...", help="recordings, or nav2 maps")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="BUILDING.submaps", help="what to write")],
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
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    force: options.Force = False,
    recover: options.Recover = False,
    assume_identity: options.AssumeIdentity = False,
    json: options.AsJson = False,
) -> None:
    """Make a submap database from recordings or maps.

    Example: pc2grid convert monday.mcap -o building.submaps
    """
    from pc2grid.errors import ConfigError, OutputError
    from signature.build import add_sessions
    from signature.database import Label

    settings = options.make_config(
        config, set_, topic=topic, odometry=odometry, assume_identity=assume_identity
    )
    if name is not None and len(inputs) > 1:
        raise ConfigError("--name names one session, but there are several inputs")
    names = [name or path.stem for path in inputs]
    label = Label(building=building, floor=floor)
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(
            f"two inputs would both be the session {twice[0]!r}", hint="convert one later with --add --name"
        )
    if not add and not force and output.exists() and not (output.is_file() and output.stat().st_size == 0):
        raise OutputError(
            f"{output}: exists already{_difference(output, inputs, names, label, settings, start, duration)}",
            hint="--force replaces it, --add adds to it",
        )
    if not output.parent.is_dir():
        raise OutputError(
            f"{output}: cannot write: no folder {output.parent}", hint="create the folder first"
        )
    if add and output.exists():
        from signature.database import open_database

        open_database(output).close()
    sessions = [
        build_session(
            path, session, settings, start_s=start, duration_s=duration, recover=recover, label=label
        )
        for path, session in zip(inputs, names, strict=True)
    ]
    with console.progress("describe") as update:
        add_sessions(output, sessions, settings, keep=add, force=force, progress=update)
    documents = [summary(session, origin) for session, origin in sessions]
    lossy = any(session.report.lossy for session, _ in sessions)
    if json:
        console.print_json(
            {"schema_version": 1, "database": str(output), "lossy": lossy, "sessions": documents}
        )
    else:
        for document in documents:
            print(_as_text(document))
        print(f"{output}: {output.stat().st_size / 1e6:.1f} MB")
    for session, _ in sessions:
        for warning in session.report.warnings:
            console.warn(f"{session.session}: {warning}")
        if session.report.lossy:
            console.warn(f"{session.session}: data was lost: {_losses(session)}")
    if lossy:
        raise typer.Exit(console.LOSSY)


def build_session(
    path: Path,
    name: str,
    config: Config,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    recover: bool = False,
    label: Label | None = None,
) -> tuple[SessionMap, Provenance]:
    """One input as a session map and what it came from."""
    from pc2grid.io.nav2_map import is_map_file
    from signature.build import provenance

    if is_map_file(path):
        session_map, digest = _import_map(path, name, config)
        return session_map, provenance(path, digest, config, label=label)

    from pc2grid.io import open_log
    from pc2grid.pipeline import build_map

    with open_log(path, config.read, recover=recover) as log:
        choice = log.choose()
        console.note(f"{path}: {choice.topic} ({choice.sensor}): {choice.reason}", level=1)
        with console.progress(f"map {path.name}", duration_s or log.info.duration_s) as update:
            session_map = build_map(
                log, config, session=name, start_s=start_s, duration_s=duration_s, progress=update
            )
        origin = provenance(path, log.digest(), config, start_s=start_s, duration_s=duration_s, label=label)
    return session_map, origin


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


def _difference(
    output: Path,
    inputs: list[Path],
    names: list[str],
    label: Label,
    config: Config,
    start_s: float,
    duration_s: float | None,
) -> str:
    """What tells an existing database from the one that was asked for, as the end of a sentence."""
    from pc2grid.errors import DatabaseError, Pc2GridError
    from pc2grid.io.nav2_map import is_map_file
    from signature.database import open_database

    try:
        with open_database(output) as opened:
            present = {info.name: info.provenance for info in opened.sessions()}
    except DatabaseError:
        return ""
    if present.keys() != set(names):
        there = ", ".join(map(repr, sorted(present))) or "no session"
        return f" and holds {there} instead of {', '.join(map(repr, sorted(names)))}"
    for path, name in zip(inputs, names, strict=True):
        origin = present[name]
        if origin.label != label:
            return f", {name!r} with {origin.label} instead of {label} (--building, --floor)"
        part = (origin.start_s, origin.duration_s)
        if not is_map_file(path) and part != (start_s, duration_s):
            return f", {name!r} made from another part of the recording (--start, --duration)"
        for section, settings in config:
            for key, value in settings:
                was = getattr(getattr(origin.config, section), key)
                if was != value:
                    return f", {name!r} made with {section}.{key} = {was!r}, not {value!r}"
        try:
            digest = _digest(path, config)
        except Pc2GridError:
            return ""  # an input that cannot be read: the next attempt with --force says so
        if digest != origin.digest:
            return f", {name!r} made from a file {origin.source!r} with other content"
    return " and is made from the same input with the same settings"


def _digest(path: Path, config: Config) -> str:
    from pc2grid.io.nav2_map import is_map_file, load_map

    if is_map_file(path):
        return _map_digest(path, load_map(path))
    from pc2grid.io import open_log

    with open_log(path, config.read) as log:
        return log.digest()


def _map_digest(path: Path, grid: OccupancyGrid) -> str:
    """Of the text and of the cells: the image may be of another format and say the same."""
    import hashlib

    return hashlib.sha256(path.read_bytes() + grid.cells.tobytes()).hexdigest()


def _import_map(path: Path, name: str, config: Config) -> tuple[SessionMap, str]:
    """A nav2 map as a session in the map's own frame."""
    import numpy as np

    from pc2grid.io.nav2_map import load_map
    from pc2grid.model import SessionMap, Trajectory
    from pc2grid.partition import partition

    grid = load_map(path)
    digest = _map_digest(path, grid)
    empty = Trajectory(stamps_ns=np.empty(0, np.int64), T_map_base=np.empty((0, 4, 4)))
    submaps = partition(grid, config.partition)
    return SessionMap(session=name, sensor="map", grid=grid, submaps=submaps, trajectory=empty), digest


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
