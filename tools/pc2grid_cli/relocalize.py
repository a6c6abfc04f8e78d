"""`pc2grid relocalize`: where in the database was this recorded?"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from pc2grid import extras
from pc2grid.display import probability
from pc2grid.errors import ConfigError, NotALog, one_line
from pc2grid.io.nav2_map import is_map_file
from pc2grid.io.trajectory import write_trajectory
from pc2grid.mapping.drawn_map import is_drawn_map
from pc2grid.mapping.precision import PRECISION
from pc2grid.observer import Observer
from pc2grid.sensor_model import SENSOR_MODELS
from pc2grid.time_span import TimeSpan
from pc2grid_cli import console, data_loss
from pc2grid_cli import options as options
from pc2grid_cli.check_pose import check_log, report_check
from pc2grid_cli.foxglove import write_answer, write_located_map
from pc2grid_cli.known_pose import KnownPose
from pc2grid_cli.locate import find_log, find_map, in_map, searched
from pc2grid_cli.nav2_pose import write_initialpose
from pc2grid_cli.output_files import check_file
from pc2grid_cli.windows import Window, find_all, show, windows_of
from signature.database.maintenance import is_database
from signature.localization.in_building import answer_in_building
from signature.localization.shown.picture import draw_answer, draw_answers
from signature.localization.shown.report import Found, write_report

if TYPE_CHECKING:
    from pc2grid.model import ReadReport, Trajectory
    from pc2grid_cli.json_schemas import Relocalize
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.database.protocol import BuildingFrame
    from signature.localization.answer import Answer
    from signature.localization.hypotheses import Hypothesis


@dataclass(frozen=True, slots=True, kw_only=True)
class _Outputs:
    """What the command writes, beside the answer on stdout."""

    trajectory: Path | None
    initialpose: Path | None
    output: Path | None
    plot: Path | None
    report: Path | None
    force: bool

    def check(self) -> None:
        """Raises OutputError if a file cannot be written, or exists and must not be replaced."""
        for option in ("trajectory", "initialpose", "output", "plot", "report"):
            check_file(option, getattr(self, option), self.force)

    def of_answer(self) -> list[Path]:
        """The files that only an answer can fill."""
        return [path for path in (self.trajectory, self.initialpose, self.output) if path is not None]

    def written(self, *, located: bool) -> list[Path]:
        """The files that are there after the answer."""
        always = [path for path in (self.plot, self.report) if path is not None]
        return [*self.of_answer(), *always] if located else always

    def refuse(self, reason: str, hint: str, *, but: tuple[str, ...] = ()) -> None:
        """Raises ConfigError if there is any file, but for these."""
        files = ("trajectory", "initialpose", "output", "plot", "report")
        given = [f"--{option}" for option in files if option not in but and getattr(self, option) is not None]
        if given:
            raise ConfigError(f"{given[0]}: {reason}", hint=hint)


def relocalize_command(
    context: typer.Context,
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG|MAP...", help="recordings or maps to locate: .yaml, .pcd, .ply, a mesh"),
    ],
    database: options.SearchedDatabase,
    building: options.Building = None,
    floor: options.Floor = None,
    near: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            "--near", metavar="X Y RADIUS", help="the robot is within RADIUS metres of X, Y of the map"
        ),
    ] = None,
    near_pose: Annotated[
        str | None,
        typer.Option(
            "--near-pose",
            metavar="FILE|TOPIC",
            help="the robot is where this pose with covariance says: /initialpose in the log, or in a file",
        ),
    ] = None,
    check: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--check", metavar="X Y YAW_DEG", help="is this pose at the last scan right?"),
    ] = None,
    check_topic: Annotated[
        str | None,
        typer.Option("--check-topic", metavar="TOPIC", help="the same, of the last on /amcl_pose or /tf"),
    ] = None,
    session: Annotated[
        str | None,
        typer.Option("--session", metavar="NAME", help="whose map frame these poses are in, of several"),
    ] = None,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    imu: options.ImuTopic = None,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    every: Annotated[
        float | None,
        typer.Option(
            "--every",
            metavar="S",
            min=0.1,
            help="locate a window every S seconds, as long as --duration, else S",
        ),
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option("--trajectory", metavar="OUT.tum", help="the query's poses in the map")
    ] = None,
    initialpose: Annotated[
        Path | None,
        typer.Option("--initialpose", metavar="OUT.json", help="the pose in the form that nav2 takes"),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT.mcap", help="map, pose, path for Foxglove, rerun"),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="OUT.png", help="a picture of the answer")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="OUT.html", help="a page to look into the answer")
    ] = None,
    frame: options.Frame = options.FrameName.building,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    force: options.Force = False,
    recover: options.Recover = False,
    strict: options.Strict = False,
    assume_identity: options.AssumeIdentity = False,
    json: options.AsJson = False,
) -> None:
    """Find where a recording was made. Exit code 4: there is no confident single answer.

    Of several recordings, and with --every, each query has a line: of a table, or with --json a document.

    With --near or --near-pose, places elsewhere are no answers. With --check or --check-topic, no place is
    found, but a pose is judged: fine, lost, or unsure; exit code 4 unless it is fine.

    Example: pc2grid relocalize tuesday.mcap --database building.submaps
    """
    outputs = _Outputs(
        trajectory=trajectory,
        initialpose=initialpose,
        output=output,
        plot=plot,
        report=report,
        force=force,
    )
    known = KnownPose(near=near, near_pose=near_pose, check=check, check_topic=check_topic, session=session)
    several = every is not None or len(logs) > 1
    _check_options(logs, database, outputs, known, several=several)
    settings = options.make_config(
        config, set_, topic=topic, odometry=odometry, imu=imu, assume_identity=assume_identity
    )
    span, terminal = TimeSpan(start, duration), console.of(context)
    windows = windows_of(logs, every, span, settings, recover=recover)
    log, observer = logs[0], terminal.observer()
    with searched(database, building, floor) as (opened, left_out):
        where = opened.location
        for damage in left_out:
            console.warn(f"{where}: damaged and left out: {damage}")
        frames = opened.frames() if frame is options.FrameName.building else {}
        if known.is_check:
            checked, document = check_log(
                log,
                opened,
                settings,
                known,
                span=span,
                recover=recover,
                observer=observer,
            )
            raise typer.Exit(report_check(checked, document, as_json=json))
        if several:
            found_in_turn = find_all(windows, opened, settings, known, recover=recover, observer=observer)
            code = _tell_all(found_in_turn, opened, frames, left_out, plot=plot, strict=strict, as_json=json)
            if plot is not None:
                terminal.note(f"wrote {plot}")
            raise typer.Exit(code)
        found, located = _find(
            log,
            opened,
            settings,
            span=span,
            recover=recover,
            observer=observer,
            known=known,
        )
        # Printed first: a file that cannot be written must not cost the answer.
        stated = answer_in_building(found.answer, frames)
        _print(found, stated, where, left_out, map_sigma_m(found.answer, opened), as_json=json)
        _write(outputs, opened, found, stated, located, settings)
        for path in outputs.written(located=located is not None):
            terminal.note(f"wrote {path}")
        _warn_of_missing_points(found, opened)
        _warn_of_unjoined(found.answer, opened)
    if located is None:
        for path in outputs.of_answer():
            console.warn(f"{path}: not written, there is no answer to put into it")
    for warning in found.about["warnings"]:
        console.warn(warning)
    _warn_of_prior(stated)
    lossy = _warn_of_losses(log, found.report, strict) or bool(left_out)
    if found.answer.status != "located":
        raise typer.Exit(console.UNSURE)
    if lossy:
        raise typer.Exit(console.LOSSY)


def _check_options(
    logs: Sequence[Path], database: str, outputs: _Outputs, known: KnownPose, *, several: bool
) -> None:
    """Raises what is wrong with the options before any work is done. several : queries at once."""
    extras.require(extras.of_addresses(database))
    outputs.check()
    if several:
        outputs.refuse("is of one query", "leave it out, or give one recording and no --every", but=("plot",))
    for log in logs:
        _check_options_for_maps(log, outputs)
        known.validate(is_map=is_map_file(log))
        _check_not_swapped(log, database)
    if known.is_check:
        outputs.refuse("--check judges a pose and finds none", "leave it out, or ask without --check")
        if several:
            raise ConfigError("--check: judges one pose", hint="give one recording, and no --every")


def _warn_of_losses(log: Path, report: ReadReport | None, strict: bool) -> bool:
    """Say what of the recording was lost; whether that is to end with exit code 3."""
    if report is None:
        return False
    if report.lossy:
        console.warn(f"{log.name}: {data_loss.sentence(report)}")
    return data_loss.ends_with_3(report, strict)


def _check_not_swapped(log: Path, database: str) -> None:
    """Raises NotALog if a database is given in place of the recording."""
    if is_database(str(log)):
        raise NotALog(
            f"{log}: a submap database, where a recording or a map is expected",
            hint=f"are they swapped? pc2grid relocalize {database} -d {log}",
        )


def _check_options_for_maps(log: Path, outputs: _Outputs) -> None:
    """Raises ConfigError for options that need a robot, if the query is a map."""
    given = {"--trajectory": outputs.trajectory, "--initialpose": outputs.initialpose}
    for option, value in given.items():
        if value is not None and is_drawn_map(log):
            raise ConfigError(
                f"{option}: there is no robot in a map", hint="--json and --output have its pose"
            )


def _find(
    log: Path,
    database: SubmapDatabase,
    settings: Config,
    *,
    span: TimeSpan,
    recover: bool,
    observer: Observer,
    known: KnownPose,
) -> tuple[Found, Trajectory | None]:
    """The answer, and the query's poses in the map."""
    if is_drawn_map(log):
        found = find_map(log, database, settings)
        return found, in_map(found.poses, found.answer)
    found = find_log(
        log,
        database,
        settings,
        span=span,
        recover=recover,
        observer=observer,
        known=known,
    )
    return found, in_map(found.poses, found.answer)


def _write(
    outputs: _Outputs,
    database: SubmapDatabase,
    found: Found,
    stated: Answer,
    located: Trajectory | None,
    settings: Config,
) -> None:
    """Write the files; without an answer only the picture and the page.

    stated : the answer as it is given. What shows the map of a session is in the frame of that map, whatever
    frame the answer is given in.
    """
    answer = found.answer
    if located is not None:
        if outputs.trajectory is not None:
            write_trajectory(outputs.trajectory, in_map(found.poses, stated) or located)
        if outputs.initialpose is not None:
            write_initialpose(outputs.initialpose, stated)
        if outputs.output is not None:
            if found.drawn is not None:
                write_located_map(outputs.output, database, answer, found.drawn, outputs.force)
            else:
                write_answer(outputs.output, database, answer, located, outputs.force)
    if outputs.plot is not None:
        draw_answer(outputs.plot, database, answer, found.poses)
    if outputs.report is not None:
        write_report(outputs.report, database, found=found, accept=settings.relocalize.accept)


def map_sigma_m(answer: Answer, database: SubmapDatabase) -> float | None:
    """Standard deviation (m) of the map itself where the query is; None if it is not known or not located.

    The covariance of the answer is about the walls there. Where these lie in the map is another question.
    """
    if answer.T_map_base is None or answer.session is None:
        return None
    (info,) = database.sessions([answer.session])
    trajectory = database.trajectory(answer.session)
    if info.precision is None or not info.precision.stamps_ns or not len(trajectory):
        return None
    x, y, _ = trajectory.planar().T
    nearest = int(np.argmin(np.hypot(x - answer.T_map_base.x, y - answer.T_map_base.y)))
    return info.precision.at(int(trajectory.stamps_ns[nearest]))


def _about_map(sigma_m: float | None) -> str:
    """A line about the map where it is not known well enough to rely on; else nothing."""
    if sigma_m is None or sigma_m <= PRECISION.promised_m:
        return ""
    return (
        f"\n  the map itself may be off by {sigma_m:.1f} m here (standard deviation), see `pc2grid db info`"
    )


def _print(
    found: Found,
    stated: Answer,
    where: str,
    left_out: list[str],
    sigma_m: float | None,
    *,
    as_json: bool,
) -> None:
    """The answer on stdout. stated : as it is given. sigma_m : of the map where the query is."""
    if as_json:
        console.print_json(_document(found, stated, where, left_out, sigma_m))
    else:
        text = as_text(stated, is_map=found.drawn is not None)
        print(text + _about_map(sigma_m), flush=True)


def _document(
    found: Found, stated: Answer, where: str, left_out: list[str], sigma_m: float | None
) -> Relocalize:
    """What `--json` prints; see `_print`."""
    answer = stated.to_json()
    return {
        **answer,
        "query": found.about,
        "database": {**answer["database"], "path": where, "left_out": left_out},
        "map_sigma_m": None if sigma_m is None else round(sigma_m, 3),
    }


def _tell_all(
    found_in_turn: Generator[tuple[Window, Found | None]],
    database: SubmapDatabase,
    frames: Mapping[str, BuildingFrame],
    left_out: list[str],
    *,
    plot: Path | None,
    strict: bool,
    as_json: bool,
) -> int:
    """Print the answers to several queries, and draw them; returns the exit code.

    The documents are printed one by one, the table at the end, also if the work is interrupted."""
    told: list[tuple[Window, Answer | None]] = []
    all_found: list[Found] = []
    with contextlib.ExitStack() as stack:
        if not as_json:
            stack.callback(show, told)
        for window, found in stack.enter_context(contextlib.closing(found_in_turn)):
            stated = None if found is None else answer_in_building(found.answer, frames)
            told.append((window, stated))
            if found is not None and stated is not None:
                all_found.append(found)
                if as_json:
                    sigma_m = map_sigma_m(found.answer, database)
                    document = _document(found, stated, database.location, left_out, sigma_m)
                    console.print_json_line(document)
    if plot is not None:
        draw_answers(plot, database, all_found)
    for warning in dict.fromkeys(f"{f.about['source']}: {w}" for f in all_found for w in f.about["warnings"]):
        console.warn(warning)
    losses = [_warn_of_losses(Path(f.about["source"]), f.report, strict) for f in all_found]
    if not all_found:
        return console.FAILED
    if all(found.answer.status != "located" for found in all_found):
        return console.UNSURE
    return console.LOSSY if any(losses) or left_out or len(all_found) < len(told) else console.OK


def _warn_of_prior(answer: Answer) -> None:
    """Say what the known pose had to do with the answer, if that is not what the user expects."""
    if answer.prior == "lapsed":
        console.warn("registration was lost after the time of --near-pose, so that pose was not used")
    excluded = answer.excluded
    if excluded is None or excluded.pose is None:
        return
    pose = excluded.pose
    where = f"{one_line(excluded.session or '')}: x {pose.x:.2f} m, y {pose.y:.2f} m"
    how = "is certain" if excluded.status == "located" else "fits better"
    console.warn(
        f"a place that --near excludes {how}: {where}, confidence {probability(excluded.confidence)}"
    )


def _warn_of_missing_points(found: Found, database: SubmapDatabase) -> None:
    """Say what would tell more, where an answer is not certain and points in space were not kept."""
    in_space = {kind for kind, model in SENSOR_MODELS.items() if not model.planar}
    if found.answer.status == "located" or found.about["sensor"] not in in_space:
        return
    infos = [info for info in database.sessions() if info.sensor in in_space]
    if infos and not any(info.provenance.config.projection.points_voxel_m for info in infos):
        console.warn(
            "the map keeps no points in space; `pc2grid convert --points 0.05` keeps them: what the sensor"
            " sees above and below the plane of the map then tells places apart, too"
        )


def _warn_of_unjoined(answer: Answer, database: SubmapDatabase) -> None:
    """Say what may make one place of two, where the best of them are in sessions that are not joined."""
    if answer.status != "ambiguous" or 1 not in answer.places:
        return
    a, b = sorted(answer.hypotheses[answer.places.index(place)].session_index for place in (0, 1))
    one, other = answer.sessions[a], answer.sessions[b]
    frames = database.frames()
    joined = one in frames and other in frames and frames[one].name == frames[other].name
    if one == other or joined or answer.labels[a].contradicts(answer.labels[b]):
        return
    console.warn(
        f"{one_line(one)} and {one_line(other)} are not joined: if they show one building, `pc2grid db join"
        f" {database.location}` makes one place of these two"
    )


def as_text(answer: Answer, *, is_map: bool = False) -> str:
    """The answer in a few lines; of a map as the query, the pose is that of its frame."""
    after = "" if is_map else f" after {answer.path_m:.1f} m"
    near = " near the given one" if answer.prior == "used" else ""
    if answer.T_map_base is not None:
        pose = answer.T_map_base
        of_what = "for the map's own frame" if is_map else "at the last scan"
        travel = "" if is_map else f", after {answer.path_m:.1f} m of travel"
        return (
            f"located in {_named(answer, answer.hypotheses[0])}:{_frame(answer)}"
            f" x {pose.x:.2f} m, y {pose.y:.2f} m,"
            f" yaw {math.degrees(pose.yaw):.1f} deg {of_what},"
            f" confidence {probability(answer.confidence)}{travel}" + _in_space(answer)
        )
    lines = [
        {
            "ambiguous": f"ambiguous: {len(set(answer.places))} places fit{after}",
            "not_found": f"not found: no place{near} fits well enough{after}",
        }[answer.status]
    ]
    for h in answer.hypotheses[:5]:
        pose = h.fit.T_map_query @ answer.T_odom_base
        lines.append(f"  {_named(answer, h)}: x {pose.x:.2f} m, y {pose.y:.2f} m, score {h.fit.score:.2f}")
    return "\n".join(lines) + _in_space(answer)


def _in_space(answer: Answer) -> str:
    """A line about the pose in space, if both sides have points; else nothing."""
    pose = answer.in_space
    if pose is None:
        return ""
    shares = f"{pose.on:.0%} of {pose.rays} rays end on surfaces of the map"
    if answer.T_map_base is None:
        return f"\n  a place that fits in the plane was turned down in space: {shares}"
    roll, pitch, _ = (math.degrees(angle) for angle in pose.rpy_rad)
    sigma_m = float(max(pose.covariance[k, k] for k in range(3))) ** 0.5
    return (
        f"\n  in space: z {pose.T_map_base[2, 3]:.2f} m, roll {roll:.1f} deg, pitch {pitch:.1f} deg,"
        f" standard deviation {100.0 * sigma_m:.1f} cm; {shares}"
    )


def _frame(answer: Answer) -> str:
    """The frame of the building that the pose is in; nothing if it is in that of the session."""
    inside = answer.frame is None or answer.frame == answer.session
    return "" if inside else one_line(f" in the frame of {answer.frame},")


def _named(answer: Answer, hypothesis: Hypothesis) -> str:
    """The session whose map a hypothesis is in, with its building and floor if they are known."""
    session = answer.sessions[hypothesis.session_index]
    label = answer.labels[hypothesis.session_index]
    return one_line(f"{session} ({label})" if label.building or label.floor else session)
