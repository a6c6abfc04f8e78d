"""`pc2grid compare`: one file for each command and, beside it, what draws its report."""

import typer

from pc2grid_cli.command_line import MARKUP, Command
from pc2grid_lab.compare.floors import compare_floors_command
from pc2grid_lab.compare.log import compare_log_command
from pc2grid_lab.compare.maps import compare_maps_command
from pc2grid_lab.compare.paper import compare_paper_command
from pc2grid_lab.compare.peers import compare_peers_command
from pc2grid_lab.compare.real import compare_real_command
from pc2grid_lab.compare.sensors import compare_sensors_command
from pc2grid_lab.compare.signatures import compare_signatures_command

app = typer.Typer(rich_markup_mode=MARKUP)
app.command("paper", cls=Command)(compare_paper_command)
app.command("sensors", cls=Command)(compare_sensors_command)
app.command("signatures", cls=Command)(compare_signatures_command)
app.command("log", cls=Command)(compare_log_command)
app.command("maps", cls=Command)(compare_maps_command)
app.command("floors", cls=Command)(compare_floors_command)
app.command("real", cls=Command)(compare_real_command)
app.command("peers", cls=Command)(compare_peers_command)
