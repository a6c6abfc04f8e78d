"""`pc2grid config`: all settings with their values and meanings, and the JSON Schemas of the documents."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid.errors import ConfigError
from pc2grid.settings import dump_settings
from pc2grid_cli import console
from pc2grid_cli.json_schemas import DOCUMENTS, schema
from pc2grid_cli.options import Assignments, ConfigFile, Preset, make_config


def config_dump_command(
    config: ConfigFile = None, set_: Assignments = None, preset: Preset = "default"
) -> None:
    """Print every setting with its value and meaning as TOML, ready for --config.

    Example: pc2grid config dump > mine.toml
    """
    print(dump_settings(make_config(config, set_, preset=preset)), end="")


def config_schema_command(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="a command, or settings; without it: all names")
    ] = None,
) -> None:
    """Print the JSON Schema of a command's --json document, or of the settings.

    Example: pc2grid config schema relocalize
    """
    names = ["settings", *DOCUMENTS]
    if name is None:
        print("\n".join(names))
    elif name in names:
        console.print_result(schema(name))
    else:
        raise ConfigError(f"no schema {name!r}", hint=f"there are {', '.join(names)}")
