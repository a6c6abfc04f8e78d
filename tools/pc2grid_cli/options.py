"""What can be typed: a frozen type for each command, whose fields are its options.

Its docstring is the help of the command. An option that several commands take stands in a type that they
extend. The function that does the work of a command (`main.py` names it) gets the options as they were typed.
A field without a declaration of typer is no option. Only what help needs is imported here.
"""

# Without `from __future__ import annotations`: typer reads the types of inherited fields as they are.
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pc2grid.observer import TimeSpan

if TYPE_CHECKING:
    from signature.config import Config

DATABASE = "BUILDING.submaps|postgresql://..."
OUTPUT_FOLDER = ("--output", "-o", "--out")
"""Names of the option for the folder of results; --out is the one it had first."""
Three = tuple[float, float, float]
Publish = Literal["none", "initialpose", "tf"]
"""What the robot is told."""

Database = Annotated[str, typer.Argument(metavar=DATABASE, help="the database")]
WrittenDatabase = Annotated[str, typer.Option("--output", "-o", metavar=DATABASE, help="what to write")]
Sessions = Annotated[list[str], typer.Argument(metavar="SESSION...", help="which of its sessions")]
Recover = Annotated[bool, typer.Option("--recover", help="use what is whole of a damaged recording")]
Force = Annotated[bool, typer.Option("--force", help="replace existing files")]
Topic = Annotated[
    str | None,
    typer.Option("--topic", "-t", help="topic of the scans, if several fit; /a,/b: of two sensors together"),
]
Assignments = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="one setting; repeatable")
]
PresetName = Literal["default", "paper"]
Preset = Annotated[
    PresetName,
    typer.Option("--preset", help="settings to start from; paper: submaps are discs of 8 m at junctions"),
]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="a picture of it")]
Report = Annotated[Path | None, typer.Option("--report", metavar="OUT.html", help="a page to look into it")]


@dataclass(frozen=True, kw_only=True)
class AsJson:
    """The form of the result."""

    json: Annotated[bool, typer.Option("--json", help="one JSON document on stdout")] = False


@dataclass(frozen=True, kw_only=True)
class Written(AsJson):
    """What becomes of files that exist."""

    force: Force = False


@dataclass(frozen=True, kw_only=True)
class Part:
    """The part of a recording that is read, and what is lost of it."""

    start: Annotated[float, typer.Option(min=0.0, metavar="S", help="seconds from the log's start")] = 0.0
    duration: Annotated[float | None, typer.Option(metavar="S", help="seconds to read; default: all")] = None
    recover: Recover = False
    strict: Annotated[
        bool, typer.Option("--strict", help="exit code 3 for any lost scan, not only from 1 % on")
    ] = False

    @property
    def span(self) -> TimeSpan:
        """Return the part between `start` and `duration` later."""
        return TimeSpan(self.start, self.duration)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings, in a file and one by one."""

    config: Annotated[
        Path | None, typer.Option(help="settings, TOML; default: the file PC2GRID_CONFIG names")
    ] = None
    assignments: Assignments = None

    def settings(self, *, preset: PresetName = "default", points: bool = True) -> "Config":
        """Return the settings: options override --set, which overrides the file, which overrides the preset.

        preset : what to start from. points : whether the points in space are kept. Raises ConfigError.
        """
        from pc2grid.settings import load_settings
        from signature.config import Config

        base = Config.paper() if preset == "paper" else None
        config = load_settings(Config, self.config, self.assignments or (), preset=base)
        given = {name: getattr(self, name, None) for name in ("topic", "odometry", "imu")}
        read = {name: value for name, value in given.items() if value is not None}
        sections = {
            "read": config.read.model_copy(update=read),
            "projection": config.projection.model_copy(update={} if points else {"points_voxel_m": None}),
        }
        return config.model_copy(update=sections)


@dataclass(frozen=True, kw_only=True)
class Reading(Settings):
    """How a recording is read."""

    topic: Topic = None
    odometry: Annotated[str | None, typer.Option(help='odometry topic; "none": do not use any')] = None
    imu: Annotated[
        str | None,
        typer.Option(help='IMU of a sensor in the hand without odometry; "none": do not use any'),
    ] = None


@dataclass(frozen=True, kw_only=True)
class SearchedSessions:
    """The sessions of a database that are searched."""

    database: str
    building: Annotated[
        str | None, typer.Option(metavar="NAME", help="look only in sessions labelled so")
    ] = None
    floor: Annotated[str | None, typer.Option(metavar="NAME", help="the same, of a floor")] = None


@dataclass(frozen=True, kw_only=True)
class SearchedInFrames(SearchedSessions):
    """The same, and the frame of the poses."""

    frame: Annotated[
        Literal["building", "session"],
        typer.Option(help="of poses: of the building, if sessions are joined (db join); or of the map"),
    ] = "building"


@dataclass(frozen=True, kw_only=True)
class Searched(SearchedInFrames):
    """The same of a database that may also be a map."""

    database: Annotated[
        str,
        typer.Option("--database", "-d", metavar=f"{DATABASE}|MAP", help="where to look; a map is converted"),
    ]


@dataclass(frozen=True, kw_only=True)
class KnownPose:
    """What is known of the robot's pose beforehand, or is to be checked.

    near : x, y, radius in metres. near_pose : a file, or a topic of the recording. check : x, y in metres and
    yaw in degrees. check_topic : a topic of the recording. session : whose map frame they are in.
    """

    near: Annotated[
        Three | None,
        typer.Option(metavar="X Y RADIUS", help="it is, or starts, within RADIUS metres of X, Y of the map"),
    ] = None
    near_pose: str | None = None
    check: Three | None = None
    check_topic: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="judge the pose that the robot believes in, on /amcl_pose or /tf: fine, lost or unsure",
        ),
    ] = None
    session: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="whose map frame these poses are in, of several"),
    ] = None


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Map a simulated office with a lidar, then find a robot with a depth camera in it.

    Example: pc2grid demo
    """

    out: Annotated[Path, typer.Option(*OUTPUT_FOLDER, metavar="DIR", help="where to leave the files")] = Path(
        "demo_out"
    )
    force: Force = False


@dataclass(frozen=True, kw_only=True)
class Simulate(Written):
    """Drive a robot through a building and record it: OUT.mcap, and OUT.tum with the true poses.

    A cloud or a mesh of a real building is driven through as it is: its floor is found and levelled, and
    rays hit its surfaces.

    Example: pc2grid simulate map.yaml drive.mcap --sensor depth --length 20
    """

    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="[BUILDING] OUT.mcap",
            help="MAP.yaml, or a real building as .pcd, .ply, .obj or .stl (default: an office);"
            " and what to write",
        ),
    ]
    sensor: Annotated[Literal["lidar", "laser", "depth"], typer.Option(help="what the robot carries")]
    length_m: Annotated[float, typer.Option("--length", min=0.1, metavar="M", help="metres to drive")] = 40.0
    seed: Annotated[int, typer.Option(min=0, help="route, clutter, noise and odometry")] = 0
    clutter: Annotated[int, typer.Option(min=0, help="movable objects in the way")] = 30
    start_m: Annotated[
        tuple[float, float] | None,
        typer.Option("--start", metavar="X Y", help="where to start in the map; default: anywhere"),
    ] = None
    building_seed: Annotated[int, typer.Option(min=0, help="which office, when no building is given")] = 0
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="leave odometry out of the log")] = False


@dataclass(frozen=True, kw_only=True)
class ShowInfo(AsJson):
    """Say what is in a recording, and which topic convert would use and why; or in a map, or a database.

    Example: pc2grid info monday.mcap
    """

    log: Annotated[
        str,
        typer.Argument(
            metavar="LOG|MAP|DATABASE", help="recording, map (.yaml, .pcd, .ply, mesh) or database"
        ),
    ]
    topic: Topic = None
    recover: Recover = False
    assignments: Assignments = None


@dataclass(frozen=True, kw_only=True)
class Convert(Reading, Part, Written):
    """Make a submap database from recordings or maps; several become a session each.

    Of several, each is stored when it is done: after an interruption the same command continues from there.

    Example: pc2grid convert monday.mcap -o building.submaps
    """

    inputs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG|MAP...", help="recordings, or maps: .yaml of nav2, .pcd, .ply, a mesh"),
    ]
    output: WrittenDatabase
    name: Annotated[str | None, typer.Option(help="of the session; default: the file's name")] = None
    building: Annotated[
        str | None, typer.Option(metavar="NAME", help="where it was recorded; answers name it")
    ] = None
    floor: Annotated[str | None, typer.Option(metavar="NAME", help="the same, within it")] = None
    no_points: Annotated[
        bool,
        typer.Option("--no-points", help="leave out the 3D points of lidars and depth cameras"),
    ] = False
    add: Annotated[bool, typer.Option("--add", help="add to an existing database")] = False
    join: Annotated[
        bool | None, typer.Option(help="join what is new (db join); default: if others are joined")
    ] = None
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="convert on the workers of this scheduler")
    ] = None
    jobs: Annotated[int | None, typer.Option(min=1, help="convert in so many processes of this machine")] = (
        None
    )
    preset: Preset = "default"


@dataclass(frozen=True, kw_only=True)
class Relocalize(Searched, KnownPose, Reading, Part, Written):
    """Find where a recording was made. Exit code 4: there is no confident single answer.

    Of several recordings, and with --every, each query has a line: of a table, of --csv, or with --json a
    document.

    With --near or --near-pose, places elsewhere are no answers. With --check or --check-topic, no place is
    found, but a pose is judged: fine, lost, or unsure; exit code 4 unless it is fine.

    Example: pc2grid relocalize tuesday.mcap --database building.submaps
    """

    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG|MAP...", help="recordings or maps to locate: .yaml, .pcd, .ply, a mesh"),
    ]
    near_pose: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|TOPIC",
            help="the robot is where this pose with covariance says: /initialpose in the log, or in a file",
        ),
    ] = None
    check: Annotated[
        Three | None, typer.Option(metavar="X Y YAW_DEG", help="is this pose at the last scan right?")
    ] = None
    every: Annotated[
        float | None,
        typer.Option(
            metavar="S", min=0.1, help="locate a window every S seconds, as long as --duration, else S"
        ),
    ] = None
    trajectory: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.tum",
            help="poses of the base, for evo; of several queries, where each was located",
        ),
    ] = None
    csv: Annotated[
        Path | None, typer.Option(metavar="OUT.csv", help="a line for each query, with its pose")
    ] = None
    initialpose: Annotated[
        Path | None, typer.Option(metavar="OUT.json", help="the pose as nav2 takes it")
    ] = None
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT.mcap", help="map, pose, path for Foxglove, rerun"),
    ] = None
    plot: Plot = None
    report: Report = None


@dataclass(frozen=True, kw_only=True)
class Watch(Searched, KnownPose, Reading, AsJson):
    """Find where a running robot is, while it drives, or was while it was recorded: each metre, until it is
    stopped or to the end of the recording. Exit code 4: at last it was not located.

    With --check-topic, say after each metre whether it is where it believes to be. Exit code 4: at last it
    was not.

    Example: pc2grid watch ws://robot:8765 --database building.submaps --publish initialpose
    """

    source: Annotated[
        str,
        typer.Argument(
            metavar="ws://ROBOT:8765|RECORDING",
            help="a robot with foxglove_bridge, or a finished recording, of which every scan is used",
        ),
    ]
    first: Annotated[bool, typer.Option("--first", help="stop when it is located for the first time")] = False
    publish: Annotated[
        Publish,
        typer.Option(
            help="tell the robot: /initialpose when it is located, first and again;"
            " or the transform map -> odom",
        ),
    ] = "none"
    publish_map: Annotated[
        bool, typer.Option("--publish-map", help="also /map, the map in which it is located")
    ] = False
    map_frame: Annotated[str, typer.Option(metavar="FRAME", help="the frame of what is published")] = "map"
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time", help="replay the recording at its own pace; scans may be dropped, as of a robot"
        ),
    ] = False
    timeout: Annotated[
        float | None, typer.Option(min=0.0, metavar="S", help="stop after so many seconds")
    ] = None
    json: Annotated[bool, typer.Option("--json", help="a JSON document on each line, one a search")] = False


@dataclass(frozen=True, kw_only=True)
class Export(SearchedInFrames, Written):
    """Write a session's map, trajectory or picture, or a page that shows all sessions.

    Of sessions that are joined (`db join`), --map, --cloud and --plot show all that are on a floor as one,
    unless --session names one. Maps, clouds and trajectories are in the frame of the building; pages,
    graphs, the picture of a session and the files of other viewers are in the session's own map frame.

    Example: pc2grid export building.submaps --map building --trajectory building.tum
    """

    database: Database
    map: Annotated[Path | None, typer.Option(metavar="STEM", help="STEM.yaml and STEM.pgm for nav2")] = None
    map_of: Annotated[
        Literal["everything", "walls", "raw"] | None,
        typer.Option(
            help="of --map and --mcap; default: everything that stands there is an obstacle; walls: furniture"
            " is unknown; raw: percent, which nav2 takes for free below 100",
        ),
    ] = None
    trajectory: Annotated[
        Path | None, typer.Option(metavar="OUT.tum|.kitti", help="poses of the base, for evo")
    ] = None
    cloud: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.ply|.pcd",
            help="the 3D points of the session, if it has any, else the walls at z = 0",
        ),
    ] = None
    graph: Annotated[
        Path | None, typer.Option(metavar="OUT.graphml", help="junctions, ends, and the ways between")
    ] = None
    g2o: Annotated[Path | None, typer.Option(metavar="OUT.g2o", help="the pose graph: steps and loops")] = (
        None
    )
    mcap: Annotated[
        Path | None, typer.Option(metavar="OUT.mcap", help="map, path, submaps for Foxglove, rerun")
    ] = None
    plot: Plot = None
    report: Report = None
    session: Annotated[str | None, typer.Option(help="which, if there are several")] = None


@dataclass(frozen=True, kw_only=True)
class ViewDatabase(SearchedSessions, Reading):
    """Look into a database in the browser, and drop recordings there to see them located, or see a running
    robot drive. Ctrl-C ends it.

    The address is printed. Only this machine is served, and nothing leaves it.

    Example: pc2grid view building.submaps
    """

    database: Database
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="[ws://ROBOT:8765|RECORDING]",
            help="a robot to be followed on the page, or a recording that is replayed there; see watch",
        ),
    ] = None
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free")] = 0
    no_browser: Annotated[bool, typer.Option("--no-browser", help="only print the address")] = False
    most_gb: Annotated[float, typer.Option(min=0.0, help="largest recording, GB")] = 4.0


@dataclass(frozen=True, kw_only=True)
class DbInfo(AsJson):
    """Show the sessions of a database.

    Example: pc2grid db info building.submaps
    """

    database: Database


@dataclass(frozen=True, kw_only=True)
class DbCheck(AsJson):
    """Read everything in a database and list all damage; exit code 1 if there is any.

    Example: pc2grid db check building.submaps
    """

    database: Database


@dataclass(frozen=True, kw_only=True)
class DbMerge(Written):
    """Put the sessions of several databases into a new one.

    Example: pc2grid db merge monday.submaps tuesday.submaps -o week.submaps
    """

    databases: Annotated[list[str], typer.Argument(metavar=f"{DATABASE} ...", help="what to merge")]
    output: WrittenDatabase


@dataclass(frozen=True, kw_only=True)
class DbCopy(Written):
    """Write a compact copy of a database.

    Example: pc2grid db copy --recover damaged.submaps -o good.submaps
    """

    database: Database
    output: WrittenDatabase
    recover: Annotated[bool, typer.Option("--recover", help="leave damaged parts out; exit code 3")] = False


@dataclass(frozen=True, kw_only=True)
class DbSplit(Written):
    """Copy sessions of a database into a new one; the first stays as it is.

    Example: pc2grid db split building.submaps monday -o monday.submaps
    """

    database: Database
    sessions: Sessions
    output: WrittenDatabase


@dataclass(frozen=True, kw_only=True)
class DbRename(AsJson):
    """Give a session another name, for example before databases with equal names are merged.

    Example: pc2grid db rename building.submaps monday first-floor
    """

    database: Database
    old: Annotated[str, typer.Argument(metavar="OLD", help="the session")]
    new: Annotated[str, typer.Argument(metavar="NEW", help="its new name")]


@dataclass(frozen=True, kw_only=True)
class DbRemove(AsJson):
    """Remove sessions from a database, all or none; they cannot be brought back.

    Example: pc2grid db remove building.submaps monday
    """

    database: Database
    sessions: Sessions
    force: Annotated[bool, typer.Option("--force", help="also if no session is left")] = False


@dataclass(frozen=True, kw_only=True)
class DbJoin(Written):
    """Find out which sessions show one building, and how they lie to each other.

    Every two sessions are compared, but for those with labels of different buildings or floors: some
    seconds a pair. What is found is stored: from then on, answers in a joined session are in the frame of its
    building; `--frame session` gives them as before.

    Example: pc2grid db join building.submaps
    """

    database: Database
    frame: Annotated[
        str | None,
        typer.Option(
            metavar="SESSION", help="whose frame is the building's; default: as it was, or the oldest"
        ),
    ] = None
    dry_run: Annotated[bool, typer.Option("--dry-run", help="only say it; nothing is stored")] = False
    plot: Plot = None


@dataclass(frozen=True, kw_only=True)
class ConfigDump(Settings):
    """Print every setting with its value and meaning as TOML, ready for --config.

    Example: pc2grid config dump > mine.toml
    """

    preset: Preset = "default"


@dataclass(frozen=True, kw_only=True)
class ConfigSchema:
    """Print the JSON Schema of a command's --json document, or of the settings.

    Example: pc2grid config schema relocalize
    """

    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="a command, or settings; without it: all names")
    ] = None
