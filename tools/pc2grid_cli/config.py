"""`pc2grid config`: see all settings, and the schemas of what the commands print."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli.settings import Assignments, ConfigFile, make_config


def dump_command(config: ConfigFile = None, set_: Assignments = None) -> None:
    """Print every setting with its value and meaning as TOML, ready for --config.

    Example: pc2grid config dump > mine.toml
    """
    from pc2grid.settings import dump_settings

    print(dump_settings(make_config(config, set_)), end="")


def schema_command(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="a command, or settings; without it: all names")
    ] = None,
) -> None:
    """Print the JSON Schema of a command's --json document, or of the settings.

    Example: pc2grid config schema relocalize
    """
    from pc2grid.errors import ConfigError
    from pc2grid_cli.documents import DOCUMENTS, schema

    names = ["settings", *DOCUMENTS]
    if name is None:
        print("\n".join(names))
    elif name in names:
        console.print_json(schema(name))
    else:
        raise ConfigError(f"no schema {name!r}", hint=f"there are {', '.join(names)}")
