"""The options that several commands share, and the configuration they make."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from signature.config import Config

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="settings, TOML; default: the file PC2GRID_CONFIG names")
]
Assignments = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="one setting; repeatable")
]


PresetName = Literal["default", "paper"]
TrajectoryFormat = Literal["tum", "kitti"]
Publish = Literal["none", "initialpose", "tf"]
"""What the robot is told."""
Frame = Annotated[
    Literal["building", "session"],
    typer.Option(
        "--frame", help="of poses: of the building, if sessions are joined (db join); or of the map"
    ),
]
Preset = Annotated[
    PresetName,
    typer.Option("--preset", help="settings to start from; paper: submaps are discs of 8 m at junctions"),
]
Topic = Annotated[
    str | None,
    typer.Option("--topic", "-t", help="topic of the scans, if several fit; /a,/b: of two sensors together"),
]
OdometryTopic = Annotated[
    str | None, typer.Option("--odometry", help='odometry topic; "none": do not use any')
]
ImuTopic = Annotated[
    str | None,
    typer.Option("--imu", help='IMU of a sensor in the hand without odometry; "none": do not use any'),
]
Start = Annotated[float, typer.Option("--start", min=0.0, metavar="S", help="seconds from the log's start")]
Duration = Annotated[
    float | None, typer.Option("--duration", metavar="S", help="seconds to read; default: all")
]
Recover = Annotated[bool, typer.Option("--recover", help="use what is whole of a damaged recording")]
Strict = Annotated[bool, typer.Option("--strict", help="exit code 3 for any lost scan, not only from 1 % on")]
AssumeIdentity = Annotated[
    bool, typer.Option("--assume-identity", help="a sensor frame that tf does not connect is the base")
]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON document on stdout")]
Force = Annotated[bool, typer.Option("--force", help="replace existing files")]
Dask = Annotated[
    str | None, typer.Option("--dask", metavar="ADDRESS", help="convert on the workers of this scheduler")
]
JobCount = Annotated[
    int | None, typer.Option("--jobs", min=1, help="convert in so many processes of this machine")
]
DATABASE = "BUILDING.submaps|postgresql://..."
Database = Annotated[str, typer.Argument(metavar=DATABASE, help="the database")]
SearchedDatabase = Annotated[
    str, typer.Option("--database", "-d", metavar=f"{DATABASE}|MAP", help="where to look; a map is converted")
]
Near = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        "--near",
        metavar="X Y RADIUS",
        help="it is, or starts, within RADIUS metres of X, Y of the map",
    ),
]
CheckTopic = Annotated[
    str | None,
    typer.Option(
        "--check-topic",
        metavar="TOPIC",
        help="judge the pose that the robot believes in, on /amcl_pose or /tf: fine, lost or unsure",
    ),
]
KnownSession = Annotated[
    str | None,
    typer.Option("--session", metavar="NAME", help="whose map frame these poses are in, of several"),
]
TrajectoryFile = Annotated[
    Path | None, typer.Option("--trajectory", metavar="OUT.tum", help="poses of the base, for evo")
]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="a picture of it")]
Report = Annotated[Path | None, typer.Option("--report", metavar="OUT.html", help="a page to look into it")]
Building = Annotated[
    str | None, typer.Option("--building", metavar="NAME", help="look only in sessions labelled so")
]
Floor = Annotated[str | None, typer.Option("--floor", metavar="NAME", help="the same, of a floor")]
WrittenDatabase = Annotated[str, typer.Option("--output", "-o", metavar=DATABASE, help="what to write")]
OUTPUT_FOLDER = ("--output", "-o", "--out")
"""Names of the option for the folder of results; --out is the one it had first."""


def make_config(
    file: Path | None,
    assignments: list[str] | None,
    *,
    topic: str | None = None,
    odometry: str | None = None,
    imu: str | None = None,
    assume_identity: bool = False,
    no_points: bool = False,
    preset: PresetName = "default",
) -> Config:
    """Flags override --set, which overrides the file, which overrides the preset. Raises ConfigError."""
    from pc2grid.settings import load_settings
    from signature.config import Config

    base = Config.paper() if preset == "paper" else None
    config = load_settings(Config, file, assignments or (), preset=base)
    given = {"topic": topic, "odometry": odometry, "imu": imu, "assume_identity": assume_identity or None}
    read = {name: value for name, value in given.items() if value is not None}
    kept = {"points_voxel_m": None} if no_points else {}
    sections = {
        "read": config.read.model_copy(update=read),
        "projection": config.projection.model_copy(update=kept),
    }
    return config.model_copy(update=sections)
