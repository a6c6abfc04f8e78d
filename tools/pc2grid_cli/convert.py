"""`pc2grid convert`: recordings and maps become a database."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from pc2grid import extras
from pc2grid.errors import ConfigError
from pc2grid.time_span import TimeSpan
from pc2grid_cli import console, conversion
from pc2grid_cli import options as options
from pc2grid_cli.output_files import check_database
from pc2grid_cli.stored_sessions import stored_sessions
from signature.database import Label

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
    _check(output, dask=dask, jobs=jobs)
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


def _check(output: str, *, dask: str | None, jobs: int | None) -> None:
    """Raises ConfigError if `dask` is no address, or if what the options need is not installed."""
    if dask is not None and (jobs is not None or "://" not in dask):
        raise ConfigError(
            "--dask ADDRESS names the scheduler of a cluster", hint="--jobs N: processes of this machine"
        )
    extras.require(({} if dask is None else {"cluster": "--dask"}) | extras.of_addresses(output))
