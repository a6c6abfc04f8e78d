"""An office, made once for all tests of commands."""

from pathlib import Path

from typer.testing import CliRunner

from pc2grid.io.maps import save_map
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import cut, office


@shared_folder()
def office_folder(folder: Path) -> None:
    """office.yaml, part.yaml of it, its database b.submaps, and drive.mcap, a laser's 8 m in it."""
    save_map(office(), folder / "office")
    save_map(cut(office(), 4.0, 3.0, 15.0, 12.0), folder / "part")
    convert = ["convert", str(folder / "office.yaml"), "-o", str(folder / "b.submaps")]
    assert CliRunner().invoke(app, convert, catch_exceptions=False).exit_code == 0
    drive = SimulationConfig(length_m=8.0, seed=4, clutter=0)
    simulate_session(folder / "drive.mcap", sensor="laser", grid=office(), config=drive)


@shared_folder("office_folder")
def metre_folder(folder: Path) -> None:
    """The office, with drive.mcap of a laser's metre in it, and two.submaps of the whole and of a part."""
    laser = ("--sensor", "laser", "--length", "1.5", "--seed", "4", "--clutter", "0", "--force")
    for arguments in (
        ("simulate", folder / "office.yaml", folder / "drive.mcap", *laser),
        ("convert", folder / "office.yaml", folder / "part.yaml", "-o", folder / "two.submaps"),
    ):
        assert CliRunner().invoke(app, [*map(str, arguments)], catch_exceptions=False).exit_code == 0
