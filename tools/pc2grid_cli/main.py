"""The program `pc2grid`: global options and the list of commands."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

import pc2grid
from pc2grid_cli import console
from pc2grid_cli.command_line import MARKUP, Command, Group
from pc2grid_cli.config_dump import config_dump_command
from pc2grid_cli.config_schema import config_schema_command
from pc2grid_cli.convert import convert_command
from pc2grid_cli.db_check import db_check_command
from pc2grid_cli.db_copy import db_copy_command
from pc2grid_cli.db_info import db_info_command
from pc2grid_cli.db_merge import db_merge_command
from pc2grid_cli.db_remove import db_remove_command
from pc2grid_cli.db_rename import db_rename_command
from pc2grid_cli.db_split import db_split_command
from pc2grid_cli.demo import demo_command
from pc2grid_cli.export import export_command
from pc2grid_cli.info import info_command
from pc2grid_cli.laboratory import Compare, laboratory
from pc2grid_cli.relocalize import relocalize_command
from pc2grid_cli.view import view_command
from pc2grid_cli.watch import watch_command

app = typer.Typer(
    cls=Group,
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
    context: typer.Context,
    verbose: Annotated[
        int, typer.Option("--verbose", "-v", count=True, help="print more; twice: still more")
    ] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="only warnings and errors")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="tracebacks for errors")] = False,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_say_version, is_eager=True, help="print the version and stop"),
    ] = False,
) -> None:
    """Recordings to a submap database, and where in it a later recording was made."""
    # Most of them were applied when the words were read; what arrives here stood in a word such as -vvv.
    terminal = console.of(context)
    terminal.verbose += verbose
    terminal.quiet = terminal.quiet or quiet
    terminal.debug = terminal.debug or debug


app.command("demo", cls=Command)(demo_command)
app.command("simulate", cls=Command)(laboratory("simulate").simulate_command)
app.command("info", cls=Command)(info_command)
app.command("convert", cls=Command)(convert_command)
app.command("relocalize", cls=Command)(relocalize_command)
app.command("watch", cls=Command)(watch_command)
app.command("export", cls=Command)(export_command)
app.command("view", cls=Command)(view_command)

compare = typer.Typer(
    cls=Compare,
    help="Logs, maps, sensors, floors, signatures, peers, the paper: measured against the truth.",
    no_args_is_help=True,
)
app.add_typer(compare, name="compare")

db = typer.Typer(
    cls=Group, help="Look into databases, check, change, merge, split and copy them.", no_args_is_help=True
)
db.command("info", cls=Command)(db_info_command)
db.command("check", cls=Command)(db_check_command)
db.command("merge", cls=Command)(db_merge_command)
db.command("copy", cls=Command)(db_copy_command)
db.command("split", cls=Command)(db_split_command)
db.command("rename", cls=Command)(db_rename_command)
db.command("remove", cls=Command)(db_remove_command)
app.add_typer(db, name="db")

config = typer.Typer(cls=Group, help="Settings, and schemas of JSON documents.", no_args_is_help=True)
config.command("dump", cls=Command)(config_dump_command)
config.command("schema", cls=Command)(config_schema_command)
app.add_typer(config, name="config")


def main() -> None:
    """Entry point of the console script."""
    terminal = console.Console()
    sys.exit(terminal.run(lambda: app(prog_name="pc2grid", standalone_mode=False, obj=terminal)))
