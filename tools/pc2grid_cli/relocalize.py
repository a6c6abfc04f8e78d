"""`pc2grid relocalize`: where in the database was this recorded?"""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pc2grid.errors import one_line
from pc2grid_cli import console
from pc2grid_cli import settings as options
from pc2grid_cli.answer_files import write_initialpose
from pc2grid_cli.finding import find_log, find_map, in_map

if TYPE_CHECKING:
    from signature.relocalize import Answer
    from signature.verify import Hypothesis


def relocalize_command(
    log: Annotated[Path, typer.Argument(metavar="LOG|MAP.yaml", help="the recording or nav2 map to locate")],
    database: Annotated[
        str, typer.Option("--database", "-d", metavar=options.DATABASE, help="where to look")
    ],
    building: Annotated[
        str | None, typer.Option("--building", metavar="NAME", help="look only in sessions labelled so")
    ] = None,
    floor: Annotated[str | None, typer.Option("--floor", metavar="NAME", help="the same, of a floor")] = None,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    top_k: Annotated[int | None, typer.Option("--top-k", min=1, help="candidates to align with")] = None,
    trajectory: Annotated[
        Path | None, typer.Option("--trajectory", metavar="OUT.tum", help="the query's poses in the map")
    ] = None,
    initialpose: Annotated[
        Path | None, typer.Option("--initialpose", metavar="OUT.json", help="the pose as nav2 wants it")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", metavar="OUT.mcap", help="map, pose and path for Foxglove")
    ] = None,
    rerun: options.Rerun = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="OUT.png", help="a picture of the answer")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="OUT.html", help="a page to look into the answer")
    ] = None,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    force: options.Force = False,
    recover: options.Recover = False,
    assume_identity: options.AssumeIdentity = False,
    json: options.AsJson = False,
) -> None:
    """Find where a recording was made. Exit code 4: there is no confident single answer.

    Example: pc2grid relocalize tuesday.mcap --database building.submaps
    """
    from pc2grid.errors import ConfigError
    from pc2grid.io.atomic import refuse_existing
    from pc2grid.io.nav2_map import is_map_file
    from signature.database import open_database

    for path in (trajectory, initialpose, output, plot, report):
        if path is not None:
            refuse_existing(path, force)
    for option, asked in (("--trajectory", trajectory), ("--initialpose", initialpose), ("--rerun", rerun)):
        if asked is not None and is_map_file(log):
            raise ConfigError(
                f"{option}: there is no robot in a map", hint="--json and --output have its pose"
            )
    if rerun is not None:
        from pc2grid_cli.rerun_target import require_target

        require_target(rerun, force)
    settings = options.make_config(
        config, set_, topic=topic, odometry=odometry, assume_identity=assume_identity
    )
    if top_k is not None:
        settings = settings.model_copy(
            update={"relocalize": settings.relocalize.model_copy(update={"top_k": top_k})}
        )
    with open_database(database) as opened, contextlib.ExitStack() as stack:
        where = opened.location
        if building is not None or floor is not None:
            opened.keep_only(building=building, floor=floor)
        left_out = [f"{problem.where}: {problem.what}" for problem in opened.leave_out_damaged()]
        shown = None
        if rerun is not None:
            from pc2grid_cli.rerun_stream import Search, stream_to

            shown = Search(stack.enter_context(stream_to(rerun, log.stem)), opened)
        if is_map_file(log):
            found = find_map(log, opened, settings)
        else:
            found = find_log(
                log,
                opened,
                settings,
                start_s=start,
                duration_s=duration,
                recover=recover,
                watch=None if shown is None else shown.watch,
            )
        answer = found.answer
        located = in_map(found.poses, answer)
        if located is not None:
            if trajectory is not None:
                from pc2grid.io.trajectory import write_trajectory

                write_trajectory(trajectory, located)
            if initialpose is not None:
                write_initialpose(initialpose, answer)
            if output is not None:
                from pc2grid_cli.foxglove import write_answer, write_located_map

                if found.drawn is not None:
                    write_located_map(output, opened, answer, found.drawn, force)
                else:
                    write_answer(output, opened, answer, located, force)
            if shown is not None:
                shown.show(answer, located)
        if plot is not None:
            from pc2grid_cli.picture import draw_answer

            draw_answer(plot, opened, answer, found.poses)
        if report is not None:
            from pc2grid_cli.report import write_report

            write_report(report, opened, found=found, accept=settings.relocalize.accept)
    for path in (trajectory, initialpose, output):
        if path is not None and located is None:
            console.warn(f"{path}: not written, there is no answer to put into it")
    if json:
        about_database = {"path": where, "left_out": left_out}
        console.print_json(answer.to_json(query=found.about, database=about_database))
    else:
        print(as_text(answer, is_map=found.drawn is not None))
    for warning in found.about["warnings"]:
        console.warn(warning)
    for damage in left_out:
        console.warn(f"{where}: damaged and left out: {damage}")
    if answer.status != "located":
        raise typer.Exit(console.UNSURE)
    if found.about["lossy"] or left_out:
        raise typer.Exit(console.LOSSY)


def as_text(answer: Answer, *, is_map: bool = False) -> str:
    """The answer in a few lines; of a map as the query, the pose is that of its frame."""
    after = "" if is_map else f" after {answer.path_m:.1f} m"
    if answer.T_map_base is not None:
        pose = answer.T_map_base
        of_what = "for the map's own frame" if is_map else "at the last scan"
        travel = "" if is_map else f", after {answer.path_m:.1f} m of travel"
        return (
            f"located in {_named(answer, answer.hypotheses[0])}: x {pose.x:.2f} m, y {pose.y:.2f} m,"
            f" yaw {math.degrees(pose.yaw):.1f} deg {of_what},"
            f" confidence {answer.confidence:.2f}{travel}"
        )
    lines = [
        {
            "ambiguous": f"ambiguous: {len(set(answer.places))} places fit{after}",
            "not_found": f"not found: no place fits well enough{after}",
        }[answer.status]
    ]
    for h in answer.hypotheses[:5]:
        pose = h.fit.T_map_query @ answer.T_odom_base
        lines.append(f"  {_named(answer, h)}: x {pose.x:.2f} m, y {pose.y:.2f} m, score {h.fit.score:.2f}")
    return "\n".join(lines)


def _named(answer: Answer, hypothesis: Hypothesis) -> str:
    """The session whose map a hypothesis is in, with its building and floor if they were ever told."""
    session = answer.sessions[hypothesis.session_index]
    label = answer.labels[hypothesis.session_index]
    return one_line(f"{session} ({label})" if label.building or label.floor else session)
