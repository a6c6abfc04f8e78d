"""`pc2grid relocalize`: where in the database was this recorded?"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pc2grid_cli import console
from pc2grid_cli.settings import (
    AsJson,
    Assignments,
    AssumeIdentity,
    ConfigFile,
    Duration,
    Force,
    OdometryTopic,
    Recover,
    Start,
    Topic,
    make_config,
)

if TYPE_CHECKING:
    from pc2grid.io import Log
    from pc2grid.model import RegisteredScan, Trajectory
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.relocalize import Answer


def relocalize_command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="the recording to locate")],
    database: Annotated[
        str, typer.Option("--database", "-d", metavar="BUILDING.submaps", help="where to look")
    ],
    topic: Topic = None,
    odometry: OdometryTopic = None,
    start: Start = 0.0,
    duration: Duration = None,
    top_k: Annotated[int | None, typer.Option("--top-k", min=1, help="candidates to align with")] = None,
    trajectory: Annotated[
        Path | None, typer.Option("--trajectory", metavar="OUT.tum", help="the query's poses in the map")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", metavar="OUT.mcap", help="map, pose and path for Foxglove")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="OUT.png", help="a picture of the answer")
    ] = None,
    config: ConfigFile = None,
    set_: Assignments = None,
    force: Force = False,
    recover: Recover = False,
    assume_identity: AssumeIdentity = False,
    json: AsJson = False,
) -> None:
    """Find where a recording was made. Exit code 4: there is no confident single answer.

    Example: pc2grid relocalize tuesday.mcap --database building.submaps
    """
    from pc2grid.io import open_log
    from pc2grid.io.atomic import refuse_existing
    from signature.database import open_database

    for path in (trajectory, output, plot):
        if path is not None:
            refuse_existing(path, force)
    settings = make_config(config, set_, topic=topic, odometry=odometry, assume_identity=assume_identity)
    if top_k is not None:
        settings = settings.model_copy(
            update={"relocalize": settings.relocalize.model_copy(update={"top_k": top_k})}
        )
    with open_database(database) as opened, open_log(log, settings.read, recover=recover) as query:
        answer, poses = locate(query, opened, settings, start_s=start, duration_s=duration)
        report = query.report()
        document = answer.to_json(
            query={
                "source": log.name,
                "scans": len(poses),
                "sensor": query.choose().sensor,
                "lossy": report.lossy,
                "warnings": list(report.warnings),
            },
            database={"path": database},
        )
        located = in_map(poses, answer)
        if trajectory is not None and located is not None:
            from pc2grid.io.trajectory import write_tum

            write_tum(trajectory, located)
        if output is not None and located is not None:
            _write_mcap(output, opened, answer, located, force)
        if plot is not None:
            from pc2grid_cli.picture import draw_answer

            draw_answer(plot, opened, answer, poses)
    for path in (trajectory, output):
        if path is not None and located is None:
            console.warn(f"{path}: not written, there is no answer to put into it")
    if json:
        console.print_json(document)
    else:
        print(as_text(answer))
    for warning in report.warnings:
        console.warn(warning)
    if answer.status != "located":
        raise typer.Exit(console.UNSURE)
    if report.lossy:
        raise typer.Exit(console.LOSSY)


def locate(
    query: Log,
    database: SubmapDatabase,
    config: Config,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
) -> tuple[Answer, Trajectory]:
    """The answer for a recording, and its poses in its own odometry frame.

    The query is registered and drawn with the settings that made the database; only how to read the
    recording and how to search are the caller's.
    """
    import numpy as np

    from pc2grid.model import Trajectory
    from pc2grid.pipeline import follow
    from signature.relocalize import relocalize

    made_with = database.config()
    config = made_with.model_copy(
        update={"read": config.read, "relocalize": config.relocalize, "registration": config.registration}
    )
    seen: list[RegisteredScan] = []
    begin_ns = query.info.start_ns + int(start_s * 1e9)
    span_ns = max(query.info.end_ns - begin_ns if duration_s is None else int(duration_s * 1e9), 1)
    with console.progress("locate") as update:

        def keep() -> Any:
            for registered, sweep in follow(query.scans(start_s, duration_s), config):
                seen.append(_without_points(registered))
                update(min((registered.scan.stamp_ns - begin_ns) / span_ns, 1.0))
                yield registered, sweep

        answer = relocalize(keep(), database, config)
    poses = Trajectory(
        stamps_ns=np.array([s.scan.stamp_ns for s in seen], np.int64),
        T_map_base=np.array([s.T_map_base for s in seen]).reshape(-1, 4, 4),
        health=tuple(s.health for s in seen),
    )
    return answer, poses


def in_map(poses: Trajectory, answer: Answer) -> Trajectory | None:
    """The query's poses in the map frame; None without an answer."""
    from dataclasses import replace

    if answer.T_map_odom is None:
        return None
    return replace(poses, T_map_base=answer.T_map_odom.lift() @ poses.T_map_base)


def as_text(answer: Answer) -> str:
    """The answer in a few lines."""
    if answer.T_map_base is not None:
        pose = answer.T_map_base
        return (
            f"located in {answer.session}: x {pose.x:.2f} m, y {pose.y:.2f} m,"
            f" yaw {math.degrees(pose.yaw):.1f} deg at the last scan,"
            f" confidence {answer.confidence:.2f}, after {answer.path_m:.1f} m of travel"
        )
    lines = [
        {
            "ambiguous": f"ambiguous: {len(answer.hypotheses)} places fit after {answer.path_m:.1f} m",
            "not_found": f"not found: no place fits well enough after {answer.path_m:.1f} m",
        }[answer.status]
    ]
    for h in answer.hypotheses[:5]:
        pose = h.fit.T_map_query @ answer.T_odom_base
        session = answer.sessions[h.session_index]
        lines.append(f"  {session}: x {pose.x:.2f} m, y {pose.y:.2f} m, score {h.fit.score:.2f}")
    return "\n".join(lines)


def _without_points(registered: RegisteredScan) -> RegisteredScan:
    """Only the pose is needed later; a long query must not keep all its points."""
    from dataclasses import replace

    import numpy as np

    scan = replace(registered.scan, points_m=np.empty((0, 3), np.float32), offsets_s=None)
    return replace(registered, scan=scan)


def _write_mcap(
    path: Path, database: SubmapDatabase, answer: Answer, located: Trajectory, force: bool
) -> None:
    """What Foxglove's 3D panel shows at once: map, path, pose and map -> odom."""
    from pc2grid.io.mcap_out import LogWriter

    assert answer.session is not None
    assert answer.T_map_base is not None
    assert answer.T_map_odom is not None
    assert answer.covariance is not None
    first, last = int(located.stamps_ns[0]), int(located.stamps_ns[-1])
    with LogWriter(path, force=force) as writer:
        writer.occupancy_grid("/map", first, database.grid(answer.session))
        writer.tf(first, "map", "odom", answer.T_map_odom.lift())
        writer.path("/path", located)
        for stamp_ns, T_map_base in zip(located.stamps_ns, located.T_map_base, strict=True):
            T_odom_base = answer.T_map_odom.inverse().lift() @ T_map_base
            writer.tf(int(stamp_ns), "odom", "base_link", T_odom_base)
        writer.pose_with_covariance("/pose", last, answer.T_map_base, answer.covariance)
        writer.pose_with_covariance("/initialpose", last, answer.T_map_base, answer.covariance)
