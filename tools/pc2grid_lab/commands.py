"""The commands of `pc2grid compare` as they are typed; see `pc2grid_cli.options`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pc2grid import libraries
from pc2grid_cli import console
from pc2grid_cli.options import OUTPUT_FOLDER

_OutputFolder = Annotated[Path, typer.Option(*OUTPUT_FOLDER, help="folder for results; run again to go on")]
_Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="processes [one a core]")]


def compare_recordings_command(
    context: typer.Context,
    data: Annotated[
        Path, typer.Argument(metavar="DATA", help="the folder of real recordings, or one of your own")
    ],
    out: Annotated[
        Path, typer.Option(*OUTPUT_FOLDER, metavar="FOLDER", help="for maps and answers; run again to go on")
    ] = Path("real-recordings"),
    table: Annotated[
        Path | None,
        typer.Option(
            "--table",
            metavar="FILE.json",
            help="what is compared with, and replaced by a whole run, with the page beside it; default: "
            "real.json in the folder",
        ),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(
            "--only", metavar="PATTERN", help="of recordings, buildings, sensors or kinds, such as 'wean*'"
        ),
    ] = None,
    of_base: Annotated[
        bool,
        typer.Option(
            "--of-base", help="poses in NAME.tum beside NAME.mcap are of the base, not of the sensor"
        ),
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="a small part of all, always the same")] = False,
    page: Annotated[
        bool, typer.Option("--page", help="print the page, in Markdown, in place of a table")
    ] = False,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="processes at a time")] = 2,
) -> None:
    """Map every real recording, locate parts of it in other maps, and tell what changed since the last time.

    Recordings of your own are located in the map of their beginning, and in those of the others of their
    folder. Answers are judged by NAME.tum beside them; without, by whether they fit together.

    Example: pc2grid compare recordings data --output real-recordings --quick
    """
    from pc2grid_lab.recordings.compare import compare_recordings

    compare_recordings(
        data,
        out,
        table or out / "real.json",
        console.of(context),
        only=only,
        of_base=of_base,
        quick=quick,
        as_page=page,
        jobs=jobs,
    )


def compare_sensors_command(
    context: typer.Context,
    plans: Annotated[
        list[Path],
        typer.Argument(help="Floor plans: MAP.yaml files; of several, each query is also sought in another."),
    ],
    out: _OutputFolder = Path("sensor-matrix"),
    queries: Annotated[int, typer.Option("--queries", min=1, help="query sessions a plan and sensor")] = 10,
    map_length: Annotated[float, typer.Option("--map-length", help="metres driven to make a map")] = 200.0,
    clutter: Annotated[
        int, typer.Option("--clutter", help="things in the way, different in each session")
    ] = 30,
    rate: Annotated[float, typer.Option("--rate", help="scans a second, of every sensor")] = 10.0,
    travel: Annotated[
        float, typer.Option("--travel", min=1.0, help="Metres that a query drives at most.")
    ] = 15.0,
    seed: Annotated[int, typer.Option("--seed", help="of the first query session")] = 1,
    jobs: _Jobs = None,
) -> None:
    """Map plans with lidar, laser and depth camera, locate sessions of each in each: nine cells.

    Example: pc2grid compare sensors maps/fr079.yaml maps/intel.yaml --queries 40 --out matrix
    """
    from pc2grid_lab.sensors import compare_sensors

    compare_sensors(
        plans,
        out,
        console.of(context),
        queries=queries,
        map_length=map_length,
        clutter=clutter,
        rate=rate,
        travel=travel,
        seed=seed,
        jobs=jobs,
    )


def compare_peers_command(
    context: typer.Context,
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG|SCAN.ply...",
            help="recordings of a laser or lidar, true poses beside them (NAME.tum or NAME_corrected.tum);"
            " and 3D scans, in which a lidar is simulated",
        ),
    ],
    out: _OutputFolder = Path("peers"),
    queries: Annotated[int, typer.Option("--queries", min=1, help="queries of each building")] = 24,
    travel: Annotated[float, typer.Option("--travel", min=0.0, help="metres that each drives")] = 10.0,
    mapped: Annotated[
        list[str] | None,
        typer.Option("--mapped", metavar="NAME=S", help="seconds of a recording that become the map [55 %]"),
    ] = None,
    of_base: Annotated[
        bool, typer.Option("--of-base", help="the true poses are of the base, not of the sensor")
    ] = False,
) -> None:
    """Locate later parts of real recordings in maps of earlier parts, by pc2grid and by other programs.

    MRPT's particle filter gets recordings of a laser; KISS-Matcher, MapClosures and Open3D's FPFH + RANSAC
    those of a lidar. Each query is also located in another building, where every answer is wrong.

    Example: pc2grid compare peers intel.mcap fr079.mcap hall.mcap --mapped intel=900 --mapped fr079=600
    """
    from pc2grid_lab.peers.programs import compare_peers

    compare_peers(
        recordings,
        out,
        console.of(context),
        queries=queries,
        travel=travel,
        mapped=mapped or [],
        of_base=of_base,
    )


def compare_paper_command(
    context: typer.Context,
    maps: Annotated[
        Path,
        typer.Option(
            "--maps",
            help="Folder with fr079.yaml, intel.yaml, ... of the paper; or a map, or a folder of maps.",
        ),
    ],
    out: _OutputFolder = Path("paper-tables"),
    queries: Annotated[
        int, typer.Option("--queries", min=1, help="Queries a map. 2000 take hours; 200 for a quick look.")
    ] = 2000,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--methods",
            help="Only these; repeatable. The error for a wrong name lists all of them.",
        ),
    ] = None,
    offset: Annotated[
        list[float] | None,
        typer.Option(
            "--offset", help="Farthest a query lies from a submap centre, m; repeatable. [1.0 and 0.5]"
        ),
    ] = None,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Also the method without some of its signatures.")
    ] = False,
    jobs: _Jobs = None,
    seed: Annotated[int, typer.Option("--seed", help="Of the queries and their noise.")] = 1,
) -> None:
    """Reproduce the paper's tables and figure 9, each number beside the published one.

    Example: pc2grid compare paper --maps maps/ --queries 200 --ablation
    """
    libraries.require({"paper": "compare paper"})
    from pc2grid_lab.paper import tables as command

    command.run(
        maps,
        out,
        console.of(context),
        queries=queries,
        methods=methods,
        offset=offset,
        ablation=ablation,
        jobs=jobs,
        seed=seed,
    )


def compare_scale_command(
    context: typer.Context,
    maps: Annotated[Path, typer.Option("--maps", help="Folder with maps, those of the paper among them.")],
    out: _OutputFolder = Path("paper-scale"),
    queries: Annotated[int, typer.Option("--queries", min=1, help="Queries a map.")] = 500,
    jobs: _Jobs = None,
    seed: Annotated[int, typer.Option("--seed", help="Of the queries and their noise.")] = 1,
) -> None:
    """Measure how recall falls with the number of places: Eq. 6 and the learned metric, on the paper's maps.

    Example: pc2grid compare scale --maps maps/
    """
    libraries.require({"paper": "compare scale"})
    from pc2grid_lab.paper import scale

    scale.run(maps, out, console.of(context), queries=queries, jobs=jobs, seed=seed)
