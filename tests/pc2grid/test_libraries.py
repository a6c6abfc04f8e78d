"""What is not installed is said before any work, all of it at once, with the command that installs it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pc2grid.errors import ClusterError, ConfigError, DatabaseError, LiveError, Pc2GridError
from pc2grid.io.live.live_log import open_live
from pc2grid.io.maps import save_map
from pc2grid.libraries import EXTRAS, of_addresses, require
from pc2grid_cli.main import app
from tests.helpers.rooms import cross, grid_of
from tests.helpers.simulated_drives import office

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]


def missing(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """As if the packages of these extras were not installed."""
    for name in names:
        for module in EXTRAS[name].modules:
            monkeypatch.setitem(sys.modules, module, None)


def test_the_table_is_that_of_the_project() -> None:
    """Every extra but the developers', and the packages that pip would install for it."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    declared = tomllib.loads(text)["project"]["optional-dependencies"]
    assert set(EXTRAS) == set(declared) - {"dev"}
    for name, extra in EXTRAS.items():
        packages = {re.split("[>;<=]", requirement)[0] for requirement in declared[name]}
        assert {package.strip("'") for package in extra.packages} == packages, name


@pytest.mark.parametrize("name", EXTRAS)
def test_each_extra_is_named_with_what_needs_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    missing(monkeypatch, name)
    with pytest.raises(EXTRAS[name].error) as caught:
        require({name: "this command"})
    assert caught.value.message.startswith(f"the extra `{name}`, for this command, is not installed (")
    assert caught.value.hint == f"pip install {' '.join(EXTRAS[name].packages)}"


def test_a_package_that_is_broken_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """psycopg without its library can be found, but not imported; the reason is told."""
    (tmp_path / "mahotas.py").write_text("raise ImportError('libfoo.so.5: cannot open')")
    monkeypatch.delitem(sys.modules, "mahotas", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=r"libfoo\.so\.5"):
        require({"paper": "surf_bow"})


@pytest.mark.parametrize(
    ("command", "blocked", "error", "hint"),
    [
        ("compare paper --maps {0} -o {0}/new", ("paper",), ConfigError, "pip install mahotas scikit-learn"),
        ("convert a.mcap -o postgresql://u:secret@h/d --dask tcp://h:1", ("cluster", "postgres"),
         ClusterError, "pip install dask distributed 'psycopg[binary]'"),
        ("export postgresql://h/d --map m", ("postgres",), DatabaseError, "pip install 'psycopg[binary]'"),
        ("watch ws://robot -d postgresql://h/d", ("live", "postgres"), LiveError,
         "pip install websockets 'psycopg[binary]'"),
        ("view {0}/no.submaps wss://robot", ("live",), LiveError, "pip install websockets"),
    ],
)  # fmt: skip
def test_commands_say_all_that_is_missing_before_any_work(
    command: str,
    blocked: tuple[str, ...],
    error: type[Pc2GridError],
    hint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Neither the recording nor the database exists: nothing was looked at before."""
    from pc2grid.io.maps import save_map

    save_map(grid_of(cross(6.0, 2.0)), tmp_path / "intel")
    before = sorted(tmp_path.iterdir())
    missing(monkeypatch, *blocked)
    done = CliRunner().invoke(app, command.format(tmp_path).split())
    assert type(done.exception) is error and done.exception.hint == hint
    assert all(f"`{name}`" in done.exception.message for name in blocked)
    assert "secret" not in str(done.exception)
    assert sorted(tmp_path.iterdir()) == before


def test_what_needs_no_extra_runs_without_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    missing(monkeypatch, *EXTRAS)
    require(of_addresses(tmp_path / "b.submaps", "monday.mcap", "-", None))


def test_a_robot_is_not_waited_for_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    missing(monkeypatch, "live")
    with pytest.raises(LiveError, match="`live`"):
        open_live("ws://127.0.0.1:1")


# --- Open3D is loaded without its plots for web pages, and still has them ---


_ROOT = Path(__file__).resolve().parents[2]


def _printed(code: str) -> str:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, check=True, capture_output=True, text=True, cwd=_ROOT).stdout


def test_plots_are_loaded_when_one_is_drawn_and_not_before() -> None:
    # In a process of its own: here Open3D is loaded already.
    code = """
import sys
from pc2grid.open3d_core import o3d
print("dash" in sys.modules, "plotly" in sys.modules)
mesh = o3d.geometry.TriangleMesh.create_box()
for _ in range(2):
    print(type(o3d.visualization.get_plotly_fig([mesh])).__name__)
drawn = o3d.visualization.draw_plotly
print(drawn.__module__, drawn.__name__, "dash" in sys.modules)
"""
    assert _printed(code).split("\n")[:4] == [
        "False False",
        "Figure",
        "Figure",
        "open3d.visualization.draw_plotly draw_plotly True",
    ]


def test_an_open3d_that_is_loaded_already_stays_as_it_is() -> None:
    code = """
import open3d
before = open3d.visualization.draw_plotly
from pc2grid.open3d_core import o3d
print(o3d is open3d, before is o3d.visualization.draw_plotly, before.__module__)
"""
    assert _printed(code).strip() == "True True open3d.visualization.draw_plotly"


# --- pc2grid makes maps without the package above it, whose names it only passes on ---


def test_pc2grid_needs_no_signature(tmp_path: Path) -> None:
    save_map(office(), tmp_path / "map")
    code = (
        "import sys\n"
        "sys.modules['signature'] = None\n"  # importing it raises ImportError
        "import pc2grid\n"
        "from pc2grid.settings import Config\n"
        f"grid = pc2grid.load_map({str(tmp_path / 'map.yaml')!r})\n"
        "print(len(pc2grid.submaps_of(grid, Config().partition)) > 10, callable(pc2grid.follow))\n"
        "try:\n"
        "    pc2grid.convert\n"
        "except ImportError:\n"
        "    print('only what is passed on is missing')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout == "True True\nonly what is passed on is missing\n", done.stderr


def test_what_is_passed_on_is_the_same_thing() -> None:
    import pc2grid
    import signature

    for name in ("Answer", "Config", "convert", "Localizer", "open_database", "relocalize"):
        assert getattr(pc2grid, name) is getattr(signature, name)
