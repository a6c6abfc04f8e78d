"""The options that several commands share, and the configuration they make."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

if TYPE_CHECKING:
    from signature.config import Config

ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="settings, TOML; default: the file PC2GRID_CONFIG names")
]
Assignments = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="one setting; repeatable")
]
Topic = Annotated[str | None, typer.Option("--topic", "-t", help="topic of the scans, if several fit")]
OdometryTopic = Annotated[
    str | None, typer.Option("--odometry", help='odometry topic; "none": do not use any')
]
Start = Annotated[float, typer.Option("--start", min=0.0, metavar="S", help="seconds from the log's start")]
Duration = Annotated[
    float | None, typer.Option("--duration", metavar="S", help="seconds to read; default: all")
]
Recover = Annotated[bool, typer.Option("--recover", help="use what is whole of a damaged recording")]
AssumeIdentity = Annotated[
    bool, typer.Option("--assume-identity", help="a sensor frame that tf does not connect is the base")
]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON document on stdout")]
Force = Annotated[bool, typer.Option("--force", help="replace existing files")]
DATABASE = "BUILDING.submaps|postgresql://..."
Database = Annotated[str, typer.Argument(metavar=DATABASE, help="the database")]
WrittenDatabase = Annotated[str, typer.Option("--output", "-o", metavar=DATABASE, help="what to write")]

Rerun = Annotated[
    str | None,
    typer.Option(
        "--rerun",
        metavar="[HOST:PORT|OUT.rrd]",
        help="watch in the rerun viewer, here or there, or in a file; needs [viz]",
    ),
]


class LooseCommand(TyperCommand):
    """`--dask` and `--rerun` may stand without a value, for which typer has no notation."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put in what stands for no value, unless one follows."""
        from pc2grid_cli.rerun_target import VIEWER, names_target

        following = [*args, ""][1:]
        alone: dict[str, tuple[str, Callable[[str], bool]]] = {
            "--dask": ("local", lambda word: "://" in word),
            "--rerun": (VIEWER, names_target),
        }
        named = [
            f"{arg}={alone[arg][0]}" if arg in alone and not alone[arg][1](after) else arg
            for arg, after in zip(args, following, strict=True)
        ]
        return super().parse_args(ctx, named)


def make_config(
    file: Path | None,
    assignments: list[str] | None,
    *,
    topic: str | None = None,
    odometry: str | None = None,
    assume_identity: bool = False,
) -> Config:
    """Flags over --set over the file over the defaults. Raises ConfigError."""
    from pc2grid.settings import load_settings
    from signature.config import Config

    config = load_settings(Config, file, assignments or ())
    flags: dict[str, object] = {}
    if topic is not None:
        flags["topic"] = topic
    if odometry is not None:
        flags["odometry"] = odometry
    if assume_identity:
        flags["assume_identity"] = True
    return config.model_copy(update={"read": config.read.model_copy(update=flags)}) if flags else config
