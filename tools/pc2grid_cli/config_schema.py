"""`pc2grid config schema`: the JSON Schemas of the documents of the commands, and of the settings."""

from __future__ import annotations

from typing import Annotated

import typer

from pc2grid.errors import ConfigError
from pc2grid_cli import console
from pc2grid_cli.json_schemas import documents, schema


def config_schema_command(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="a command, or settings; without it: all names")
    ] = None,
) -> None:
    """Print the JSON Schema of a command's --json document, or of the settings.

    Example: pc2grid config schema relocalize
    """
    names = ["settings", *documents()]
    if name is None:
        print("\n".join(names))
    elif name in names:
        console.print_json(schema(name))
    else:
        raise ConfigError(f"no schema {name!r}", hint=f"there are {', '.join(names)}")
