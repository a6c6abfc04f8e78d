"""The commands of `pc2grid` as they are typed: what each takes, and what its help says.

Only what help needs is imported here: a command imports what does its work when it runs.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from pc2grid import libraries as extras
from pc2grid.errors import ConfigError, OutputError, one_line
from pc2grid.observer import TimeSpan
from pc2grid_cli import console
from pc2grid_cli import options as options
from pc2grid_cli.options import DATABASE, OUTPUT_FOLDER


def demo_command(
    context: typer.Context,
    out: Annotated[Path, typer.Option(*OUTPUT_FOLDER, metavar="DIR", help="where to leave the files")] = Path(
        "demo_out"
    ),
    force: options.Force = False,
) -> None:
    """Map a simulated office with a lidar, then find a robot with a depth camera in it.

    Example: pc2grid demo
    """
    from pc2grid_cli import demo

    demo.run(out, console.of(context), force=force)


def simulate_command(
    context: typer.Context,
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="[BUILDING] OUT.mcap",
            help="MAP.yaml, or a real building as .pcd, .ply, .obj or .stl (default: an office);"
            " and what to write",
        ),
    ],
    sensor: Annotated[Literal["lidar", "laser", "depth"], typer.Option(help="what the robot carries")],
    length: Annotated[float, typer.Option(min=0.1, metavar="M", help="metres to drive")] = 40.0,
    seed: Annotated[int, typer.Option(min=0, help="route, clutter, noise and odometry")] = 0,
    clutter: Annotated[int, typer.Option(min=0, help="movable objects in the way")] = 30,
    start: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="where to start in the map; default: anywhere"),
    ] = None,
    building_seed: Annotated[int, typer.Option(min=0, help="which office, when no building is given")] = 0,
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="leave odometry out of the log")] = False,
    force: options.Force = False,
    json: options.AsJson = False,
) -> None:
    """Drive a robot through a building and record it: OUT.mcap, and OUT.tum with the true poses.

    A cloud or a mesh of a real building is driven through as it is: its floor is found and levelled, and
    rays hit its surfaces.

    Example: pc2grid simulate map.yaml drive.mcap --sensor depth --length 20
    """
    from pc2grid_cli import demo as simulate

    simulate.run_simulate(
        files,
        sensor,
        console.of(context),
        force=force,
        json=json,
        length_m=length,
        seed=seed,
        clutter=clutter,
        start_m=start,
        building_seed=building_seed,
        odometry=not no_odometry,
    )


def info_command(
    log: Annotated[
        str,
        typer.Argument(
            metavar="LOG|MAP|DATABASE", help="recording, map (.yaml, .pcd, .ply, mesh) or database"
        ),
    ],
    topic: options.Topic = None,
    recover: options.Recover = False,
    set_: options.Assignments = None,
    json: options.AsJson = False,
) -> None:
    """Say what is in a recording, and which topic convert would use and why; or in a map, or a database.

    Example: pc2grid info monday.mcap
    """
    from pc2grid_cli import info

    info.run(log, topic, set_, recover=recover, json=json)


_Inputs = Annotated[
    list[Path],
    typer.Argument(metavar="LOG|MAP...", help="recordings, or maps: .yaml of nav2, .pcd, .ply, a mesh"),
]
_Name = Annotated[str | None, typer.Option("--name", help="of the session; default: the file's name")]
_Building = Annotated[
    str | None, typer.Option("--building", metavar="NAME", help="where it was recorded; answers name it")
]
_Floor = Annotated[str | None, typer.Option("--floor", metavar="NAME", help="the same, within it")]
_NoPoints = Annotated[
    bool,
    typer.Option("--no-points", help="leave out the 3D points of lidars and depth cameras"),
]
_Add = Annotated[bool, typer.Option("--add", help="add to an existing database")]
_Join = Annotated[
    bool | None,
    typer.Option("--join/--no-join", help="join what is new (db join); default: if others are joined"),
]


def convert_command(
    context: typer.Context,
    inputs: _Inputs,
    output: options.WrittenDatabase,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    imu: options.ImuTopic = None,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    name: _Name = None,
    building: _Building = None,
    floor: _Floor = None,
    no_points: _NoPoints = False,
    add: _Add = False,
    join: _Join = None,
    dask: options.Dask = None,
    jobs: options.JobCount = None,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    preset: options.Preset = "default",
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
    if dask is not None and (jobs is not None or "://" not in dask):
        raise ConfigError(
            "--dask ADDRESS names the scheduler of a cluster", hint="--jobs N: processes of this machine"
        )
    extras.require(({} if dask is None else {"cluster": "--dask"}) | extras.of_addresses(output))
    from pc2grid_cli import convert as conversion
    from pc2grid_cli.convert import stored_sessions
    from pc2grid_cli.output import check_database
    from signature.database import Label

    settings = options.make_config(
        config,
        set_,
        topic=topic,
        odometry=odometry,
        imu=imu,
        assume_identity=assume_identity,
        no_points=no_points,
        preset=preset,
    )
    label, span = Label(building=building, floor=floor), TimeSpan(start, duration)
    wanted = conversion.jobs_of(inputs, name, settings, span=span, recover=recover, label=label)
    stored = stored_sessions(output, wanted, add=add, force=force)
    if any(job.name not in stored for job in wanted):
        check_database(output)
    done = conversion.convert_all(
        [replace(job, stored=stored.get(job.name)) for job in wanted],
        output,
        console.of(context),
        keep=add or bool(stored),
        force=force,
        dask=dask,
        processes=jobs,
        quiet=json,
        strict=strict,
    )
    conversion.join_added(output, done, console.of(context), wanted=join)
    conversion.conclude(output, done, len(inputs), json=json)


_Logs = Annotated[
    list[Path],
    typer.Argument(metavar="LOG|MAP...", help="recordings or maps to locate: .yaml, .pcd, .ply, a mesh"),
]
_NearPose = Annotated[
    str | None,
    typer.Option(
        "--near-pose",
        metavar="FILE|TOPIC",
        help="the robot is where this pose with covariance says: /initialpose in the log, or in a file",
    ),
]
_Check = Annotated[
    tuple[float, float, float] | None,
    typer.Option("--check", metavar="X Y YAW_DEG", help="is this pose at the last scan right?"),
]
_Every = Annotated[
    float | None,
    typer.Option(
        "--every", metavar="S", min=0.1, help="locate a window every S seconds, as long as --duration, else S"
    ),
]
_InitialPose = Annotated[
    Path | None,
    typer.Option("--initialpose", metavar="OUT.json", help="the pose as nav2 takes it"),
]
_Csv = Annotated[
    Path | None, typer.Option("--csv", metavar="OUT.csv", help="a line for each query, with its pose")
]
_Trajectory = Annotated[
    Path | None,
    typer.Option(
        "--trajectory",
        metavar="OUT.tum",
        help="poses of the base, for evo; of several queries, where each was located",
    ),
]
_Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="OUT.mcap", help="map, pose, path for Foxglove, rerun"),
]


def relocalize_command(
    context: typer.Context,
    logs: _Logs,
    database: options.SearchedDatabase,
    building: options.Building = None,
    floor: options.Floor = None,
    near: options.Near = None,
    near_pose: _NearPose = None,
    check: _Check = None,
    check_topic: options.CheckTopic = None,
    session: options.KnownSession = None,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    imu: options.ImuTopic = None,
    start: options.Start = 0.0,
    duration: options.Duration = None,
    every: _Every = None,
    trajectory: _Trajectory = None,
    csv: _Csv = None,
    initialpose: _InitialPose = None,
    output: _Output = None,
    plot: options.Plot = None,
    report: options.Report = None,
    frame: options.Frame = "building",
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    force: options.Force = False,
    recover: options.Recover = False,
    strict: options.Strict = False,
    assume_identity: options.AssumeIdentity = False,
    json: options.AsJson = False,
) -> None:
    """Find where a recording was made. Exit code 4: there is no confident single answer.

    Of several recordings, and with --every, each query has a line: of a table, of --csv, or with --json a
    document.

    With --near or --near-pose, places elsewhere are no answers. With --check or --check-topic, no place is
    found, but a pose is judged: fine, lost, or unsure; exit code 4 unless it is fine.

    Example: pc2grid relocalize tuesday.mcap --database building.submaps
    """
    from pc2grid_cli import relocalize
    from pc2grid_cli.check_pose import check_log, report_check
    from pc2grid_cli.known_pose import KnownPose, searched
    from pc2grid_cli.output import files_of
    from pc2grid_cli.windows import find_all, windows_of
    from signature.sessions import find

    wanted = files_of(
        trajectory=trajectory, csv=csv, initialpose=initialpose, output=output, plot=plot, report=report
    )
    known = KnownPose(near=near, near_pose=near_pose, check=check, check_topic=check_topic, session=session)
    several = every is not None or len(logs) > 1
    relocalize.check_options(logs, database, wanted, force, known, several=several)
    settings = options.make_config(
        config, set_, topic=topic, odometry=odometry, imu=imu, assume_identity=assume_identity
    )
    windows = windows_of(logs, every, TimeSpan(start, duration), settings, recover=recover)
    with searched(database, building, floor) as (opened, left_out):
        frames = opened.frames() if frame == "building" else {}
        told = relocalize.Told(opened, frames, left_out, strict=strict, as_json=json)
        given: Any = {"recover": recover, "observer": console.of(context).observer()}
        if known.is_check:
            judged = check_log(logs[0], opened, settings, known, span=windows[0].span, **given)
            code = report_check(*judged, as_json=json)
        elif several:
            found_in_turn = find_all(windows, opened, settings, known, **given)
            code = relocalize.tell_all(found_in_turn, told, wanted, console.of(context))
        else:
            found = find(logs[0], opened, settings, span=windows[0].span, prior=known.prior, **given)
            code = relocalize.tell_one(windows[0], found, told, wanted, force, settings, console.of(context))
    raise typer.Exit(code)


_Source = Annotated[
    str,
    typer.Argument(
        metavar="ws://ROBOT:8765|RECORDING",
        help="a robot with foxglove_bridge, or a finished recording, of which every scan is used",
    ),
]
_First = Annotated[bool, typer.Option("--first", help="stop when it is located for the first time")]
_Publish = Annotated[
    options.Publish,
    typer.Option(
        "--publish",
        help="tell the robot: /initialpose when it is located, first and again; or the transform map -> odom",
    ),
]
_PublishMap = Annotated[bool, typer.Option("--publish-map", help="also /map, the map in which it is located")]
_MapFrame = Annotated[
    str, typer.Option("--map-frame", metavar="FRAME", help="the frame of what is published")
]
_RealTime = Annotated[
    bool,
    typer.Option(
        "--real-time", help="replay the recording at its own pace; scans may be dropped, as of a robot"
    ),
]
_Timeout = Annotated[
    float | None, typer.Option("--timeout", min=0.0, metavar="S", help="stop after so many seconds")
]
_AsJson = Annotated[bool, typer.Option("--json", help="a JSON document on each line, one a search")]


def watch_command(
    context: typer.Context,
    source: _Source,
    database: options.SearchedDatabase,
    building: options.Building = None,
    floor: options.Floor = None,
    near: options.Near = None,
    check_topic: options.CheckTopic = None,
    session: options.KnownSession = None,
    first: _First = False,
    publish: _Publish = "none",
    publish_map: _PublishMap = False,
    map_frame: _MapFrame = "map",
    frame: options.Frame = "building",
    real_time: _RealTime = False,
    timeout: _Timeout = None,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    imu: options.ImuTopic = None,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    assume_identity: options.AssumeIdentity = False,
    json: _AsJson = False,
) -> None:
    """Find where a running robot is, while it drives, or was while it was recorded: each metre, until it is
    stopped or to the end of the recording. Exit code 4: at last it was not located.

    With --check-topic, say after each metre whether it is where it believes to be. Exit code 4: at last it
    was not.

    Example: pc2grid watch ws://robot:8765 --database building.submaps --publish initialpose
    """
    from pc2grid_cli import watch
    from pc2grid_cli.known_pose import KnownPose, searched
    from pc2grid_cli.windows import followed
    from signature.sessions import query_config

    extras.require(extras.of_addresses(source, database))
    settings = options.make_config(
        config, set_, topic=topic, odometry=odometry, imu=imu, assume_identity=assume_identity
    )
    known = KnownPose(near=near, check_topic=check_topic, session=session)
    prior = known.at_start()
    if first and (publish == "tf" or check_topic is not None):
        goes_on = "--publish tf" if publish == "tf" else "--check-topic"
        raise ConfigError(f"--first: {goes_on} goes on until it is stopped", hint="leave --first out")
    if publish != "none" or publish_map:
        watch.check_publishes(source, check_topic)
    terminal = console.of(context)
    end_s = math.inf if timeout is None else time.monotonic() + timeout
    with (
        searched(database, building, floor) as (opened, _),
        followed(source, settings.read, real_time=real_time) as drive,
    ):
        following = watch.Following(drive, opened, query_config(opened, settings), end_s, terminal)
        if check_topic is not None:
            good = watch.check(following, check_topic, session, as_json=json)
        else:
            frames = opened.frames() if frame == "building" else {}
            with watch.robot_of(drive, opened, publish, publish_map, map_frame, frames) as robot:
                good = watch.search(following, robot, prior, first=first, as_json=json)
        watch.summarize(drive, terminal)
    if not good:
        raise typer.Exit(console.UNSURE)


_Map = Annotated[Path | None, typer.Option("--map", metavar="STEM", help="STEM.yaml and STEM.pgm for nav2")]
_MapOf = Annotated[
    Literal["everything", "walls", "raw"] | None,
    typer.Option(
        "--map-of",
        help="of --map and --mcap; default: everything that stands there is an obstacle; walls: furniture"
        " is unknown; raw: percent, which nav2 takes for free below 100",
    ),
]
_Format = Annotated[
    options.TrajectoryFormat | None,
    typer.Option("--format", help="of the trajectory; default: kitti for OUT.kitti, else tum"),
]
_Cloud = Annotated[
    Path | None,
    typer.Option(
        "--cloud",
        metavar="OUT.ply|.pcd",
        help="the 3D points of the session, if it has any, else the walls at z = 0",
    ),
]
_Graph = Annotated[
    Path | None,
    typer.Option("--graph", metavar="OUT.graphml", help="junctions, ends, and the ways between"),
]
_G2o = Annotated[
    Path | None, typer.Option("--g2o", metavar="OUT.g2o", help="the pose graph: steps and loops")
]
_Mcap = Annotated[
    Path | None, typer.Option("--mcap", metavar="OUT.mcap", help="map, path, submaps for Foxglove, rerun")
]
_Session = Annotated[str | None, typer.Option("--session", help="which, if there are several")]


def export_command(
    context: typer.Context,
    database: options.Database,
    map_: _Map = None,
    map_of_: _MapOf = None,
    trajectory: options.TrajectoryFile = None,
    format_: _Format = None,
    cloud: _Cloud = None,
    graph: _Graph = None,
    g2o: _G2o = None,
    mcap: _Mcap = None,
    plot: options.Plot = None,
    report: options.Report = None,
    session: _Session = None,
    building: options.Building = None,
    floor: options.Floor = None,
    frame: options.Frame = "building",
    force: options.Force = False,
    json: options.AsJson = False,
) -> None:
    """Write a session's map, trajectory or picture, or a page that shows all sessions.

    Of sessions that are joined (`db join`), --map, --cloud and --plot show all that are on a floor as one,
    unless --session names one. Maps, clouds and trajectories are in the frame of the building; pages,
    graphs, the picture of a session and the files of other viewers are in the session's own map frame.

    Example: pc2grid export building.submaps --map building --trajectory building.tum
    """
    from pc2grid_cli import export
    from pc2grid_cli.output import files_of, map_stem, written_files
    from signature.database import open_database
    from signature.localization.answer_json import plain

    terminal = console.of(context)
    outputs = files_of(
        trajectory=trajectory,
        cloud=cloud,
        graph=graph,
        g2o=g2o,
        mcap=mcap,
        plot=plot,
        map=map_ and map_stem(map_),
        report=report,
    )
    export.check(outputs, map_of_, format_, force)
    as_told = export.As(of=map_of_ or "everything", format=format_, force=force)
    extras.require(extras.of_addresses(database))
    with open_database(database) as opened:
        if building is not None or floor is not None:
            opened.keep_only(building=building, floor=floor)
        frames = opened.frames() if frame == "building" else {}
        name = export.write(outputs, as_told, opened, session, frames, terminal)
        about: export.Export = {
            "database": opened.location,
            "session": name,
            "written": [str(path) for path in written_files(outputs)],
        }
    if as_told.of != "everything":
        terminal.note(f"--map-of {as_told.of}: {export.SHOWN[as_told.of]}")
    for path in written_files(outputs):
        terminal.note(f"wrote {path}")
    if json:
        console.print_result(plain(export.Export, about))


def view_command(
    context: typer.Context,
    database: options.Database,
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="[ws://ROBOT:8765|RECORDING]",
            help="a robot to be followed on the page, or a recording that is replayed there; see watch",
        ),
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any that is free")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="only print the address")] = False,
    most_gb: Annotated[float, typer.Option("--most-gb", min=0.0, help="largest recording, GB")] = 4.0,
    building: options.Building = None,
    floor: options.Floor = None,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    imu: options.ImuTopic = None,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    assume_identity: options.AssumeIdentity = False,
) -> None:
    """Look into a database in the browser, and drop recordings there to see them located, or see a running
    robot drive. Ctrl-C ends it.

    The address is printed. Only this machine is served, and nothing leaves it.

    Example: pc2grid view building.submaps
    """
    from pc2grid_cli import view
    from pc2grid_cli.known_pose import searched
    from pc2grid_cli.view import ViewServer

    extras.require(extras.of_addresses(source, database))
    settings = options.make_config(
        config, set_, topic=topic, odometry=odometry, imu=imu, assume_identity=assume_identity
    )
    terminal = console.of(context)
    with (
        searched(database, building, floor) as (opened, _),
        tempfile.TemporaryDirectory(prefix="pc2grid-view-") as folder,
    ):
        locator = view.Locator(opened, settings)
        try:
            server = ViewServer(
                port, locator.events, Path(folder), locator.work, most_bytes=round(most_gb * 1e9)
            )
        except OSError as error:
            raise OutputError(
                f"port {port}: {error.strerror}", hint="--port 0 takes any port that is free"
            ) from error
        locator.pages = server.pages
        server.pages[""] = view.live_page(opened)
        try:
            view.serve(server, locator, source, terminal, browser=not no_browser)
        finally:
            server.stop()


_Sessions = Annotated[list[str], typer.Argument(metavar="SESSION...", help="which of its sessions")]


def db_info_command(database: options.Database, json: options.AsJson = False) -> None:
    """Show the sessions of a database.

    Example: pc2grid db info building.submaps
    """
    from pc2grid_cli import db

    db.tell_sessions(database, json=json)


def db_check_command(database: options.Database, json: options.AsJson = False) -> None:
    """Read everything in a database and list all damage; exit code 1 if there is any.

    Example: pc2grid db check building.submaps
    """
    from pc2grid_cli import db

    db.tell_damage(database, json=json)


def db_merge_command(
    databases: Annotated[list[str], typer.Argument(metavar=f"{DATABASE} ...", help="what to merge")],
    output: options.WrittenDatabase,
    force: options.Force = False,
    json: options.AsJson = False,
) -> None:
    """Put the sessions of several databases into a new one.

    Example: pc2grid db merge monday.submaps tuesday.submaps -o week.submaps
    """
    from pc2grid.display import counted
    from pc2grid_cli import db
    from signature.database import maintenance

    count = maintenance.merge(databases, output, overwrite=force)
    db.tell(output, f"{maintenance.shown(output)}: {counted(count, 'session')}", json)


def db_copy_command(
    database: options.Database,
    output: options.WrittenDatabase,
    recover: Annotated[bool, typer.Option("--recover", help="leave damaged parts out; exit code 3")] = False,
    force: options.Force = False,
    json: options.AsJson = False,
) -> None:
    """Write a compact copy of a database.

    Example: pc2grid db copy --recover damaged.submaps -o good.submaps
    """
    from pc2grid_cli import db
    from signature.database import maintenance

    problems = maintenance.copy(database, output, recover=recover, overwrite=force)
    for problem in problems:
        console.warn(f"left out: {problem.where}: {problem.what}")
    db.tell(output, f"{maintenance.shown(output)}: {db.size(output)}", json, problems)
    if problems:
        raise typer.Exit(console.LOSSY)


def db_split_command(
    database: options.Database,
    sessions: _Sessions,
    output: options.WrittenDatabase,
    force: options.Force = False,
    json: options.AsJson = False,
) -> None:
    """Copy sessions of a database into a new one; the first stays as it is.

    Example: pc2grid db split building.submaps monday -o monday.submaps
    """
    from pc2grid.display import counted
    from pc2grid_cli import db
    from signature.database import maintenance

    count = maintenance.split(database, sessions, output, overwrite=force)
    db.tell(output, f"{maintenance.shown(output)}: {counted(count, 'session')}", json)


def db_rename_command(
    database: options.Database,
    old: Annotated[str, typer.Argument(metavar="OLD", help="the session")],
    new: Annotated[str, typer.Argument(metavar="NEW", help="its new name")],
    json: options.AsJson = False,
) -> None:
    """Give a session another name, for example before databases with equal names are merged.

    Example: pc2grid db rename building.submaps monday first-floor
    """
    from pc2grid_cli import db
    from signature.database import maintenance

    maintenance.rename(database, old, new)
    db.tell(database, one_line(f"{maintenance.shown(database)}: {old} is now {new}"), json)


def db_remove_command(
    database: options.Database,
    sessions: _Sessions,
    force: Annotated[bool, typer.Option("--force", help="also if no session is left")] = False,
    json: options.AsJson = False,
) -> None:
    """Remove sessions from a database, all or none; they cannot be brought back.

    Example: pc2grid db remove building.submaps monday
    """
    from pc2grid_cli import db
    from signature.database import maintenance

    if not force:
        db.refuse_all(database, sessions)
    maintenance.remove(database, sessions)
    db.tell(database, f"{maintenance.shown(database)}: {db.sessions_in(database)} left", json)


def db_join_command(
    context: typer.Context,
    database: options.Database,
    frame: Annotated[
        str | None,
        typer.Option(
            "--frame",
            metavar="SESSION",
            help="whose frame is the building's; default: as it was, or the oldest",
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only say it; nothing is stored")] = False,
    plot: options.Plot = None,
    force: options.Force = False,
    json: options.AsJson = False,
) -> None:
    """Find out which sessions show one building, and how they lie to each other.

    Every two sessions are compared, but for those with labels of different buildings or floors: some
    seconds a pair. What is found is stored: from then on, answers in a joined session are in the frame of its
    building; `--frame session` gives them as before.

    Example: pc2grid db join building.submaps
    """
    from pc2grid.display import counted
    from pc2grid_cli import db as join
    from pc2grid_cli.output import check_file
    from signature.database import maintenance, open_database
    from signature.localization.answer_json import plain
    from signature.localization.joining.building import join_sessions

    check_file("plot", plot, force)
    with open_database(database) as opened:
        names = [info.name for info in opened.sessions()]
        if len(names) < 2:
            raise ConfigError(
                f"{opened.location}: holds {counted(len(names), 'session')}, and two can be joined",
                hint="`pc2grid convert LOG --add` adds one, `pc2grid db merge` puts databases together",
            )
        found = join_sessions(opened, frame=frame, observer=console.of(context).observer())
        if plot is not None:
            join.draw(plot, opened, found)
    if not dry_run:
        join.store(database, found, names)
    if json:
        console.print_result(
            plain(join.DbJoin, join.document(maintenance.shown(database), found, names, dry_run))
        )
    else:
        join.report(found, names, dry_run=dry_run)


def config_dump_command(
    config: options.ConfigFile = None, set_: options.Assignments = None, preset: options.Preset = "default"
) -> None:
    """Print every setting with its value and meaning as TOML, ready for --config.

    Example: pc2grid config dump > mine.toml
    """
    from pc2grid.settings import dump_settings

    print(dump_settings(options.make_config(config, set_, preset=preset)), end="")


def config_schema_command(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="a command, or settings; without it: all names")
    ] = None,
) -> None:
    """Print the JSON Schema of a command's --json document, or of the settings.

    Example: pc2grid config schema relocalize
    """
    from pc2grid_cli.documents import DOCUMENTS, schema

    names = ["settings", *DOCUMENTS]
    if name is None:
        print("\n".join(names))
    elif name in names:
        console.print_result(schema(name))
    else:
        raise ConfigError(f"no schema {name!r}", hint=f"there are {', '.join(names)}")
