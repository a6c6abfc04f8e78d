"""The program `pc2grid`: global options and the list of commands."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from typing import Annotated

import typer

import pc2grid
from pc2grid import threads
from pc2grid_cli import console
from pc2grid_cli.command_line import MARKUP, group

_NEW_OBJECTS = 100_000
"""After so many new objects the collector looks for cycles. `convert` leaves 2,000 objects in cycles in 150 s
of a laser."""
# Name, "package.module:function", and what lists of commands say of it.
COMMANDS = {
    "demo": ("pc2grid_cli.commands:demo_command", "Map a simulated office, and find another robot in it."),
    "simulate": ("pc2grid_cli.commands:simulate_command", "Drive a robot through a building and record it."),
    "info": ("pc2grid_cli.commands:info_command", "Say what is in a recording, a map or a database."),
    "convert": ("pc2grid_cli.commands:convert_command", "Make a submap database from recordings or maps."),
    "relocalize": ("pc2grid_cli.commands:relocalize_command", "Find where a recording was made."),
    "watch": ("pc2grid_cli.commands:watch_command", "Find where a running robot is, while it drives."),
    "export": ("pc2grid_cli.commands:export_command", "Write a session's map, trajectory, picture or page."),
    "view": ("pc2grid_cli.commands:view_command", "Look into a database in the browser, and locate there."),
}
DB = {
    "info": ("pc2grid_cli.commands:db_info_command", "Show the sessions of a database."),
    "check": ("pc2grid_cli.commands:db_check_command", "Read everything and list all damage."),
    "merge": ("pc2grid_cli.commands:db_merge_command", "Put the sessions of several databases into one."),
    "join": (
        "pc2grid_cli.commands:db_join_command",
        "Find out how sessions of a building lie to each other.",
    ),
    "copy": ("pc2grid_cli.commands:db_copy_command", "Write a compact copy of a database."),
    "split": ("pc2grid_cli.commands:db_split_command", "Copy sessions into a database of their own."),
    "rename": ("pc2grid_cli.commands:db_rename_command", "Give a session another name."),
    "remove": ("pc2grid_cli.commands:db_remove_command", "Remove sessions from a database."),
}
CONFIG = {
    "dump": ("pc2grid_cli.commands:config_dump_command", "Print every setting as TOML."),
    "schema": ("pc2grid_cli.commands:config_schema_command", "Print the JSON Schema of a document."),
}
# Commands of the laboratory. No module of the product imports it: it is loaded by name when it is asked for.
COMPARE = {
    "recordings": (
        "pc2grid_lab.commands:compare_recordings_command",
        "Real recordings as maps, located in each other; and what changed.",
    ),
    "sensors": ("pc2grid_lab.commands:compare_sensors_command", "Each sensor in the maps of each."),
    "peers": (
        "pc2grid_lab.commands:compare_peers_command",
        "Other programs, the same maps and queries.",
    ),
    "paper": ("pc2grid_lab.commands:compare_paper_command", "The paper's tables and figures 9 and 10."),
    "scale": ("pc2grid_lab.commands:compare_scale_command", "The paper's recall in larger databases."),
}

app = typer.Typer(
    cls=group(COMMANDS),
    help="Recordings to a submap database, and where in it a later recording was made.",
    no_args_is_help=True,
    rich_markup_mode=MARKUP,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _say_version(wanted: bool) -> None:
    if wanted:
        print(f"pc2grid {pc2grid.__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_say_version, is_eager=True, help="print the version and stop"),
    ] = False,
) -> None:
    """Recordings to a submap database, and where in it a later recording was made."""


app.add_typer(
    typer.Typer(
        cls=group(COMPARE),
        help="Measure: recordings, sensors, peers, the paper's tables, scale. Only in a clone.",
        no_args_is_help=True,
    ),
    name="compare",
)
app.add_typer(
    typer.Typer(
        cls=group(DB),
        help="Look into databases, check, join, change, merge, split and copy them.",
        no_args_is_help=True,
    ),
    name="db",
)
app.add_typer(
    typer.Typer(cls=group(CONFIG), help="Settings, and schemas of JSON documents.", no_args_is_help=True),
    name="config",
)


def main() -> None:
    """Entry point of the console script."""
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it would look for them in all packages
    threads.use_one()
    # Imports make more than 100,000 objects, which stay. Python's collector of cycles would walk through them
    # again and again, also at the end.
    gc.set_threshold(_NEW_OBJECTS)
    atexit.register(gc.freeze)
    terminal = console.Console()
    sys.exit(terminal.run(lambda: app(prog_name="pc2grid", standalone_mode=False, obj=terminal)))
