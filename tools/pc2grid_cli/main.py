"""The program `pc2grid`: global options and the list of commands."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

import pc2grid
from pc2grid_cli import console
from pc2grid_cli.compare_log import compare_log_command
from pc2grid_cli.compare_maps import compare_maps_command
from pc2grid_cli.compare_paper import compare_paper_command
from pc2grid_cli.compare_sensors import compare_sensors_command
from pc2grid_cli.config import dump_command, schema_command
from pc2grid_cli.convert import convert_command
from pc2grid_cli.db import check_command, copy_command, merge_command
from pc2grid_cli.db import info_command as db_info_command
from pc2grid_cli.demo import demo_command
from pc2grid_cli.export import export_command
from pc2grid_cli.info import info_command
from pc2grid_cli.relocalize import relocalize_command
from pc2grid_cli.settings import LooseCommand
from pc2grid_cli.simulate import simulate_command

# Colours and boxes cost a tenth of a second at every --help; they are for terminals that want them.
_FANCY = sys.stderr.isatty() and sys.stdout.isatty() and not os.environ.get("NO_COLOR")

app = typer.Typer(
    help="Recordings to a submap database, and where in it a later recording was made.",
    no_args_is_help=True,
    rich_markup_mode="rich" if _FANCY else None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _say_version(wanted: bool) -> None:
    if wanted:
        print(f"pc2grid {pc2grid.__version__}")
        raise typer.Exit


@app.callback()
def options(
    verbose: Annotated[
        int, typer.Option("--verbose", "-v", count=True, help="say more; twice: still more")
    ] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="only warnings and errors")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="tracebacks for errors")] = False,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_say_version, is_eager=True, help="print the version and stop"),
    ] = False,
) -> None:
    """Recordings to a submap database, and where in it a later recording was made."""
    console.State.verbosity = -1 if quiet else verbose
    console.State.debug = console.State.debug or debug


app.command("demo")(demo_command)
app.command("simulate")(simulate_command)
app.command("info")(info_command)
app.command("convert", cls=LooseCommand)(convert_command)
app.command("relocalize", cls=LooseCommand)(relocalize_command)
app.command("export", cls=LooseCommand)(export_command)

compare = typer.Typer(help="The paper's tables, sensors against sensors.", no_args_is_help=True)
compare.command("paper")(compare_paper_command)
compare.command("sensors")(compare_sensors_command)
compare.command("log")(compare_log_command)
compare.command("maps")(compare_maps_command)
app.add_typer(compare, name="compare")

db = typer.Typer(help="Look into databases, check, merge and copy them.", no_args_is_help=True)
db.command("info")(db_info_command)
db.command("check")(check_command)
db.command("merge")(merge_command)
db.command("copy")(copy_command)
app.add_typer(db, name="db")

config = typer.Typer(help="Settings, and schemas of JSON documents.", no_args_is_help=True)
config.command("dump")(dump_command)
config.command("schema")(schema_command)
app.add_typer(config, name="config")


_GLOBAL = ("-v", "-vv", "--verbose", "-q", "--quiet", "--debug")


def main() -> None:
    """Entry point of the console script."""
    # Global options are understood behind the command as well, where people put them.
    first = [word for word in sys.argv[1:] if word in _GLOBAL]
    rest = [word for word in sys.argv[1:] if word not in _GLOBAL]
    sys.exit(console.run(lambda: app([*first, *rest], prog_name="pc2grid", standalone_mode=False)))
