"""What can be typed after `pc2grid compare`: a frozen type for each command; see `pc2grid_cli.options`."""

# Without `from __future__ import annotations`: typer reads the types of inherited fields as they are.
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from pc2grid_cli.options import OUTPUT_FOLDER, Simulate

OutputFolder = Annotated[
    Path, typer.Option(*OUTPUT_FOLDER, metavar="FOLDER", help="for results; run again to go on")
]
Queries = Annotated[int, typer.Option(min=1, help="queries of each map, or of each plan and sensor")]
OfBase = Annotated[bool, typer.Option("--of-base", help="true poses are of the base, not of the sensor")]


@dataclass(frozen=True, kw_only=True)
class RandomQueries:
    """How queries are drawn at random, and by how many processes."""

    jobs: Annotated[int | None, typer.Option(min=1, help="processes [one a core]")] = None
    seed: Annotated[int, typer.Option(help="of the queries and their noise")] = 1


@dataclass(frozen=True, kw_only=True)
class DrivenQueries:
    """How many queries are driven, and how far."""

    queries: Queries = 24
    travel: Annotated[float, typer.Option(min=1.0, help="metres that a query drives at most")] = 10.0


@dataclass(frozen=True, kw_only=True)
class CompareRecordings:
    """Map every real recording, locate parts of it in other maps, and tell what changed since the last time.

    Recordings of your own are located in the map of their beginning, and in those of the others of their
    folder. Answers are judged by NAME.tum beside them; without, by whether they fit together.

    Example: pc2grid compare recordings data --output real-recordings --quick
    """

    data: Annotated[
        Path, typer.Argument(metavar="DATA", help="the folder of real recordings, or one of your own")
    ]
    out: OutputFolder = Path("real-recordings")
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.json",
            help="what is compared with, and replaced by a whole run, with the page beside it; default: "
            "real.json in the folder",
        ),
    ] = None
    only: Annotated[
        str | None,
        typer.Option(metavar="PATTERN", help="of recordings, buildings, sensors or kinds, such as 'wean*'"),
    ] = None
    of_base: OfBase = False
    quick: Annotated[bool, typer.Option("--quick", help="a small part of all, always the same")] = False
    page: Annotated[bool, typer.Option("--page", help="print the page, in Markdown, in place of a table")] = (
        False
    )
    jobs: Annotated[int, typer.Option(min=1, help="processes at a time")] = 2


@dataclass(frozen=True, kw_only=True)
class CompareSensors(DrivenQueries, RandomQueries):
    """Map plans with lidar, laser and depth camera, locate sessions of each in each: nine cells.

    Example: pc2grid compare sensors maps/fr079.yaml maps/intel.yaml --queries 40 --out matrix
    """

    plans: Annotated[
        list[Path],
        typer.Argument(help="Floor plans: MAP.yaml files; of several, each query is also sought in another."),
    ]
    out: OutputFolder = Path("sensor-matrix")
    map_length: Annotated[float, typer.Option(help="metres driven to make a map")] = 200.0
    clutter: Annotated[int, typer.Option(help="things in the way, different in each session")] = (
        Simulate.clutter
    )
    rate: Annotated[float, typer.Option(help="scans a second, of every sensor")] = 10.0


@dataclass(frozen=True, kw_only=True)
class ComparePeers(DrivenQueries):
    """Locate later parts of real recordings in maps of earlier parts, by pc2grid and by other programs.

    MRPT's particle filter gets recordings of a laser; KISS-Matcher, MapClosures and Open3D's FPFH + RANSAC
    those of a lidar. Each query is also located in another building, where every answer is wrong.

    Example: pc2grid compare peers intel.mcap fr079.mcap hall.mcap --mapped intel=900 --mapped fr079=600
    """

    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG|SCAN.ply...",
            help="recordings of a laser or lidar, true poses beside them (NAME.tum or NAME_corrected.tum);"
            " and 3D scans, in which a lidar is simulated",
        ),
    ]
    out: OutputFolder = Path("peers")
    mapped: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=S", help="seconds of a recording that become the map [half, 600 at most]"),
    ] = None
    of_base: OfBase = False


@dataclass(frozen=True, kw_only=True)
class ComparePaper(RandomQueries):
    """Reproduce the paper's tables and figure 9, each number beside the published one.

    Example: pc2grid compare paper --maps maps/ --queries 200 --ablation
    """

    maps: Annotated[
        Path,
        typer.Option(
            help="folder with fr079.yaml, intel.yaml, ... of the paper; or a map, or a folder of maps"
        ),
    ]
    out: OutputFolder = Path("paper-tables")
    queries: Queries = 2000
    methods: Annotated[
        list[str] | None,
        typer.Option(help="only these; repeatable. The error for a wrong name lists all of them."),
    ] = None
    offset: Annotated[
        list[float] | None,
        typer.Option(help="farthest a query lies from a submap centre, m; repeatable [1.0 and 0.5]"),
    ] = None
    ablation: Annotated[
        bool, typer.Option("--ablation", help="also the method without some of its signatures")
    ] = False


@dataclass(frozen=True, kw_only=True)
class CompareScale(RandomQueries):
    """Measure how recall falls with the number of places: Eq. 6 and the learned metric, on the paper's maps.

    Example: pc2grid compare scale --maps maps/
    """

    maps: Annotated[Path, typer.Option(help="folder with maps, those of the paper among them")]
    out: OutputFolder = Path("paper-scale")
    queries: Queries = 500
