"""What docstrings and README show works as shown."""

from __future__ import annotations

import ast
import doctest
import functools
import html
import importlib
import inspect
import json
import math
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import matplotlib
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore
from typer.main import get_command
from typer.testing import CliRunner

import pc2grid
import signature
from pc2grid_cli import demo
from pc2grid_cli.main import app
from signature.shown.picture import MISSED_LABEL, SUPPORT_LABELS
from tests.helpers import doc_files
from tests.helpers.browser import DESK, PHONE, Browser
from tests.helpers.nav2_map import nav2_map
from tests.helpers.shared_folders import shared_folder

ROOT = Path(__file__).resolve().parent.parent
FLAGS = doctest.NORMALIZE_WHITESPACE


furnished = shared_folder()(doc_files.furnish)


@pytest.fixture
def folder(furnish: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder, and the working directory."""
    monkeypatch.chdir(doc_files.copy(furnish, tmp_path))
    return tmp_path


def with_examples() -> list[str]:
    """Names of the modules whose docstrings have examples; found without importing them."""
    files = [file for package in ("pc2grid", "signature") for file in (ROOT / package).rglob("*.py")]
    found = [file.relative_to(ROOT).with_suffix("").parts for file in files if ">>> " in file.read_text()]
    return sorted(".".join(parts).removesuffix(".__init__") for parts in found)


@pytest.mark.parametrize("module", with_examples())
def test_examples_in_docstrings(module: str, folder: Path) -> None:
    said: list[str] = []
    for example in doctest.DocTestFinder().find(importlib.import_module(module)):
        doctest.DocTestRunner(optionflags=FLAGS).run(example, out=said.append)
    assert not said, "".join(said)


@pytest.mark.parametrize(
    ("package", "name"),
    [(package, name) for package in (pc2grid, signature) for name in package.__all__ if name[0] != "_"],
)
def test_every_public_name_is_there_and_explained(package: ModuleType, name: str) -> None:
    thing = getattr(package, name)
    text = inspect.getdoc(thing)
    assert text
    if inspect.isfunction(thing):
        assert ">>>" in text
        parameters = inspect.signature(thing).parameters.values()
        assert all(p.annotation is not p.empty for p in parameters)


@pytest.mark.parametrize("package", [pc2grid, signature])
def test_help_begins_with_every_public_name(package: ModuleType) -> None:
    """What `help` prints behind it, dozens of modules and the methods of dataclasses, is no way in."""
    assert package.__doc__
    listed = set(re.findall(r"\w+", re.sub(r"^>>> .*$", "", package.__doc__, flags=re.MULTILINE)))
    missing = {name for name in package.__all__ if name[0] != "_"} - listed
    assert not missing, f"not in the docstring of {package.__name__}/__init__.py: {missing}"


@pytest.mark.parametrize("package", [pc2grid, signature])
def test_type_checkers_see_the_public_names_where_they_are_loaded_from(package: ModuleType) -> None:
    assert package.__file__ is not None
    body = ast.parse(Path(package.__file__).read_text("utf-8")).body
    block = next(node for node in body if isinstance(node, ast.If))
    seen = {
        alias.asname: f"{node.module}:{alias.name}"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    homes = {name: home if ":" in home else f"{home}:{name}" for name, home in package._HOMES.items()}
    assert homes == seen


def test_importing_the_packages_loads_no_library() -> None:
    code = (
        "import sys, pc2grid, signature\n"
        "print([m for m in ('numpy', 'scipy', 'pydantic', 'cv2', 'numba', 'networkx', 'open3d', 'mcap')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# --- README and what stands beside it ---------------------------------------------------------------------

EXAMPLES = sorted(f"examples/{path.name}" for path in ROOT.glob("examples/*.md"))
GUIDES = ("docs/method.md", "docs/outputs.md", "docs/robustness.md")
DOCUMENTS = ("README.md", "CONTRIBUTING.md", *GUIDES, *EXAMPLES)
ON_OWN_FILES = ("examples/nav2.md", "examples/recordings.md", "examples/buildings.md", "docs/outputs.md")
"""Their commands are run in a folder with the files that they name; those of README make their own."""
NOT_RUN = {
    "make": "test_repository.py looks at the Makefile; `make demo` is `pc2grid demo` after an installation",
    "pip": "the network is not asked in tests",
    "ros2": "needs ROS; test_example_nav2 has one that listens",
    "createdb": "needs a PostgreSQL server; test_postgres.py brings one",
    "pc2grid view": "serves until Ctrl-C; see test_view.py",
    "pc2grid watch ws://": "needs a robot; test_watch.py has one",
    "pc2grid convert logs": "several processes; test_conversion_jobs.py does it",
}
SHORTER = {"--length 20": "--length 1"}
"""What a command says, and what is run in its place so that it takes a second."""


def blocks(name: str, *languages: str) -> list[tuple[str, str]]:
    """Language and text of each block of code in a document, in order."""
    kinds = "|".join(languages)
    return re.findall(rf"^```({kinds})\n(.*?)^```", (ROOT / name).read_text(), re.MULTILINE | re.DOTALL)


def commands_of(block: str) -> list[str]:
    lines = [line.partition(" #")[0].strip() for line in block.splitlines()]
    return [line for line in lines if line]


def run_or_parse(command: str) -> str | None:
    """Run a command of a document here. What cannot be run must at least parse; returns why it is not run."""
    reason = next((why for start, why in NOT_RUN.items() if command.startswith(start)), None)
    if "postgresql://" in command:
        reason = NOT_RUN["createdb"]
    words = functools.reduce(lambda text, pair: text.replace(*pair), SHORTER.items(), command).split()
    if reason is not None:
        if words[0] == "pc2grid":
            parse(words[1:])
        return reason
    assert words[0] == "pc2grid", command
    done = CliRunner().invoke(app, words[1:], catch_exceptions=False)
    assert done.exit_code == 0, f"{command}: {done.stderr}"
    return None


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which `pc2grid demo` was called, with shorter drives."""
    folder = tmp_path_factory.mktemp("demonstrated")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "MAP_LENGTH_M", 20.0)
        patch.setattr(demo, "QUERY_LENGTH_M", 6.0)
        patch.chdir(folder)
        done = CliRunner().invoke(app, ["demo"], catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    return folder


@pytest.mark.nightly
@pytest.mark.timeout(900)  # half a minute of work; on a busy machine many times as long
def test_the_readme_can_be_pasted_from_top_to_bottom(
    demonstrated: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one folder, with only what its own commands have made."""
    monkeypatch.chdir(demonstrated)
    ran = ["pc2grid demo"]
    for language, block in blocks("README.md", "sh", "python"):
        if language == "python":
            exec(compile(block, "README.md", "exec"), {})
            assert capsys.readouterr().out.splitlines()[-1].startswith("located SE2(")
            continue
        for command in commands_of(block):
            if command.startswith("cd "):
                monkeypatch.chdir(command.removeprefix("cd "))
            elif command not in ran and run_or_parse(command) is None:
                ran.append(command)
    assert len(ran) >= 7
    for file in re.findall(r"`(\w+\.(?:mcap|tum|submaps|png))`", (ROOT / "README.md").read_text()):
        assert Path(file).exists(), f"README names {file}, which its commands do not make"


@pytest.mark.nightly
def test_the_cells_of_the_notebook_run(
    demonstrated: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As plain Python, one after the other; what Jupyter would show of a last line is made as well."""
    monkeypatch.chdir(demonstrated)
    monkeypatch.setenv("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # the notebook sets it, for good
    notebook = json.loads((ROOT / "examples" / "from_log_to_answer.ipynb").read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    shown: list[str] = []
    with matplotlib.rc_context({"backend": "agg"}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="FigureCanvasAgg is non-interactive")
        for cell in cells:
            lines = ast.parse("".join(cell["source"])).body
            last = lines.pop() if isinstance(lines[-1], ast.Expr) else None
            exec(compile(ast.Module(lines, []), "notebook", "exec"), names)
            if last is not None:
                value = eval(compile(ast.Expression(last.value), "notebook", "eval"), names)
                for form in ("__repr__", "_repr_html_", "_repr_png_"):
                    if hasattr(value, form):
                        getattr(value, form)()
                shown.append(repr(value))
        matplotlib.pyplot.close("all")
    assert any(text.startswith("Answer(located in 'lidar'") for text in shown)
    (off_m,) = re.findall(r"off by ([\d.]+) m", capsys.readouterr().out)
    assert float(off_m) < 0.25
    # It was saved as it ran: in order, without an error.
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(output["output_type"] != "error" for cell in cells for output in cell["outputs"])


@pytest.mark.parametrize(
    "commands",
    [
        pytest.param(commands_of(block), id=f"{name}-{number}")
        for name in ON_OWN_FILES
        for number, (_, block) in enumerate(blocks(name, "sh"), start=1)
    ],
)
def test_shown_commands_work(commands: list[str], folder: Path) -> None:
    """Each block in a user's folder of its own."""
    reasons = [run_or_parse(command) for command in commands]
    if all(reasons):
        pytest.skip("; ".join(sorted({reason for reason in reasons if reason})))


@pytest.mark.parametrize("name", [name for name in DOCUMENTS if name not in ("README.md", *ON_OWN_FILES)])
def test_commands_that_take_hours_or_other_data_parse(name: str) -> None:
    for _, block in blocks(name, "sh", ""):
        for command in commands_of(block.replace("\\\n", " ")):
            if command.startswith("pc2grid "):
                parse(shlex.split(command)[1:])


def parse(arguments: list[str]) -> None:
    """Look at the command and its options only; the files need not be there."""
    group = get_command(app)
    context = group.make_context("pc2grid", [], resilient_parsing=True)
    while hasattr(group, "get_command"):
        name = arguments.pop(0)
        group = group.get_command(context, name)
        assert group is not None, f"no command {name}"
    group.make_context("pc2grid", arguments, parent=context)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_links_lead_somewhere(name: str) -> None:
    text = (ROOT / name).read_text()
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert ((ROOT / name).parent / target).exists(), target
    for target in re.findall(r"`((?:examples|tests|tools|signature|pc2grid)/[\w./]+)`", text):
        assert (ROOT / target).exists(), target


def test_every_picture_is_drawn_by_make_pictures() -> None:
    """And none is in the repository that no page shows."""
    shown = {
        ((ROOT / name).parent / target).resolve().relative_to(ROOT).as_posix()
        for name in DOCUMENTS
        for target in re.findall(r"\]\(([^)#:]+\.png)\)", (ROOT / name).read_text())
    }
    kept = (path for folder in ("docs", "examples") for path in (ROOT / folder).rglob("*.png"))
    assert shown == {path.relative_to(ROOT).as_posix() for path in kept}
    recipe = (ROOT / "Makefile").read_text().partition("\npictures:")[2].partition("\n\n")[0]
    assert {word for word in recipe.split() if re.fullmatch(r"(?:docs|examples)/\w+\.png", word)} == shown


def test_the_first_screen_says_what_this_is() -> None:
    """A command in the first lines, a picture, the paper and its three signatures; all of README is short."""
    text = (ROOT / "README.md").read_text()
    lines = text.splitlines()
    assert any(line.startswith("pc2grid ") for line in lines[:15])
    # What sets everything up on a fresh machine: the main job, and the tests. CI runs both.
    setting_up = {"make demo", "make test"}
    assert setting_up <= set(commands_of(blocks("README.md", "sh")[0][1]))
    assert setting_up <= set((ROOT / ".ci" / "run").read_text().splitlines())
    assert len(lines) <= 120 and len(text.split()) <= 1300
    first = " ".join(text.partition("\n## ")[0].split())
    abstract = " ".join(yaml.safe_load((ROOT / "CITATION.cff").read_text())["abstract"].split())
    (title,) = re.findall(r'"(.+)"', abstract)
    assert f'the paper "{title}"' in first and "![" in first
    for name in ("Boundary distances", "Free-space path lengths", "Reflection symmetry"):
        assert f"- **{name}**: " in first


def test_the_caption_of_the_picture_has_the_words_of_its_legend() -> None:
    first = " ".join((ROOT / "README.md").read_text().partition("\n## ")[0].split())
    (caption,) = re.findall(r"\*`demo_out/answer\.png`: (.+?)\*", first)
    assert f"Green, {SUPPORT_LABELS['FITS']};" in caption
    for colour, kind in (("red", "CONTRADICTED"), ("blue", "UNKNOWN")):
        of_what, _, said = SUPPORT_LABELS[kind].partition(": ")
        assert of_what == "query's wall" and f"{colour}: {said}" in caption
    assert f"Orange crosses, {MISSED_LABEL}." in caption


# --- examples/ --------------------------------------------------------------------------------------------


@pytest.fixture
def run(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., list[str]]:
    """Run an example in the user's folder; what it prints, line by line."""

    def run_example(name: str, *arguments: str) -> list[str]:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        try:
            runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        except SystemExit as ended:  # typer always ends like this
            assert not ended.code, capsys.readouterr().err
        return capsys.readouterr().out.splitlines()

    return run_example


Run = Callable[..., list[str]]


@pytest.mark.parametrize("name", sorted(path.name for path in ROOT.glob("examples/*.py")))
def test_examples_without_arguments_say_how_to_call_them(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [name])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert "usage:" in said.lower() and name in said and "Traceback" not in said


def test_example_convert_a_log(run: Run) -> None:
    said = run("convert_a_log.py", "tuesday.mcap", "new.submaps")
    assert said[0].startswith("tuesday.mcap: /scan (laser): ") and "laser, 4.0 m in " in said[1]
    with signature.open_database("new.submaps") as database:
        assert [session.name for session in database.sessions()] == ["tuesday"]


def test_example_locate_a_robot(run: Run) -> None:
    said = run("locate_a_robot.py", "tuesday.mcap", "building.submaps")
    truth_plan = next(pc2grid.read_tum("monday.tum").poses()).inverse()
    last = said[-1]
    assert last.startswith("in monday at x ")
    x, y = (float(word) for word in re.findall(r"(-?[\d.]+) m", last))
    way = [truth_plan @ pose for pose in pc2grid.read_tum("tuesday.tum").poses()]
    assert min(math.hypot(pose.x - x, pose.y - y) for pose in way) < 0.1


def test_example_own_sensor(run: Run) -> None:
    def write(path: str, span: pc2grid.TimeSpan) -> None:
        with pc2grid.open_log("tuesday.mcap") as log, Path(path).open("w") as out:
            for scan in log.scans(span.start_s, span.duration_s):
                x, y = (scan.points_m[:, :2] - [0.2, 0.0]).T
                ranges = np.full(541, np.nan)
                steps = np.rint((np.degrees(np.arctan2(y, x)) + 135.0) * 2).astype(int)
                inside = (steps >= 0) & (steps <= 540)
                ranges[steps[inside]] = np.hypot(x, y)[inside]
                words = " ".join(f"{value:.4f}" for value in ranges)
                out.write(f"{scan.stamp_ns * 1e-9:.4f} {words}\n")

    whole = pc2grid.TimeSpan()
    write("scans.txt", whole)
    write("later.txt", pc2grid.TimeSpan(2.0))
    mapped, located = run("own_sensor.py", "scans.txt", "later.txt", "own.submaps")
    with pc2grid.open_log("tuesday.mcap") as log:
        wanted = pc2grid.build_map(log, signature.Config(), session="tuesday", span=whole)
    with signature.open_database("own.submaps") as database:
        way = database.trajectory("scans").planar()
    assert mapped.startswith(f"{len(wanted.trajectory)} scans, ")
    assert np.allclose(way, wanted.trajectory.planar(), atol=0.05)
    (x, y) = (float(word) for word in re.findall(r"[xy] (-?[\d.]+) m", located))
    assert located.startswith("Answer(located in 'scans'") and math.dist((x, y), way[-1, :2]) < 0.1


def test_example_own_descriptor(run: Run) -> None:
    said = run("own_descriptor.py", "map.yaml", "--queries", "12")
    values = {(int(line[6]), line[9:25].strip()): float(line[26:31]) for line in said[1:]}
    assert len(values) == 9
    for level in range(3):
        assert 0.2 < values[level, "wall distances"] <= 1.0
        assert 0.5 < values[level, "proposed"] <= 1.0


def test_example_own_floor_plan(run: Run) -> None:
    said = run("own_floor_plan.py", "map.yaml", "--visitors=1", "--map-length-m=20", "--query-length-m=3")
    (off_m,) = re.findall(r"visitor 0: located, ([\d.]+) m off", "\n".join(said))
    assert float(off_m) < 0.25


def test_example_signature_of_a_submap(run: Run) -> None:
    run("signature_of_a_submap.py", "map.yaml", "--out", "submap.png")
    assert Path("submap.png").read_bytes().startswith(b"\x89PNG")


def test_example_how_it_works(run: Run) -> None:
    assert run("how_it_works.py", "monday.mcap", "tuesday.mcap", "--out", "how.png") == ["wrote how.png"]
    image = cv2.cvtColor(cv2.imread("how.png"), cv2.COLOR_BGR2RGB).astype(int)
    height, width = image.shape[:2]

    def drawn(rows: slice, column: int, colour: str) -> int:
        """Pixels of a colour in a panel."""
        wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        panel = image[rows, column * width // 4 : (column + 1) * width // 4]
        return int((np.abs(panel - wanted).max(axis=-1) < 30).sum())

    upper, middle, lower = (
        slice(int(a * height), int(b * height)) for a, b in ((0, 0.35), (0.4, 0.75), (0.77, 1))
    )
    blue, orange, green, vermillion = "#0072B2", "#E69F00", "#009E73", "#D55E00"
    # Path, junctions, boundary points, edges, axes; the signatures of the query; where it was located.
    for rows, column, colour in (
        (upper, 1, vermillion), (upper, 3, blue),
        (middle, 0, blue), (middle, 1, green), (middle, 2, vermillion), (middle, 3, orange),
        (lower, 0, orange), (lower, 1, orange), (lower, 2, orange),
    ):  # fmt: skip
        assert drawn(rows, column, colour) > 50, (rows, column, colour)
    assert not drawn(upper, 2, blue)


def test_the_table_of_folders_names_the_files_that_are_there() -> None:
    rows = re.findall(r"^\| `(\S+/)` \|(.*?)\|", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    for folder, files in rows:
        if folder.startswith(("pc2grid", "signature", "tools/pc2grid_cli")):
            there = {path.stem for path in (ROOT / folder).glob("*.py")} - {"__init__"}
            assert set(re.findall(r"`(\w+)`", files)) == there, folder
    listed = {folder for folder, _ in rows}
    for package in ("pc2grid", "signature"):
        files = ROOT.glob(f"{package}/**/*.py")
        assert {f"{path.parent.relative_to(ROOT)}/" for path in files} <= listed


# --- nav2 and Foxglove ------------------------------------------------------------------------------------


def test_example_nav2(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Programs that say how they were called; both commands of pc2grid end with the file to write.
    tools = folder / "bin"
    tools.mkdir()
    called = '#!/bin/sh\necho "$@" >> called\nfor last; do :; done\n'
    for name, does in (("pc2grid", 'echo "{}" > "$last"\n'), ("ros2", 'echo "$last" > heard\n')):
        (tools / name).write_text(called + does)
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    before = sorted(folder.iterdir())
    monkeypatch.chdir(tools)
    subprocess.run(["sh", ROOT / "examples" / "nav2.sh", "../map.yaml", "../tuesday.mcap"], check=True)
    assert sorted(folder.iterdir()) == before, "the folder of the map may be shared"
    convert, locate, publish = Path("called").read_text().splitlines()
    assert publish.startswith("topic pub --once /initialpose geometry_msgs/msg/PoseWithCovarianceStamped {}")
    assert Path("heard").read_text() == "{}\n"
    for command in (convert, locate):
        Path(command.split()[-1]).unlink()
        assert CliRunner().invoke(app, command.split(), catch_exceptions=False).exit_code == 0

    pose = json.loads(Path("tuesday.initialpose.json").read_text())["pose"]["pose"]
    truth = list(pc2grid.read_tum(folder / "tuesday.tum").poses())[-1]
    x, y = pose["position"]["x"], pose["position"]["y"]
    yaw = 2 * math.atan2(pose["orientation"]["z"], pose["orientation"]["w"])
    assert math.hypot(x - truth.x, y - truth.y) < 0.1
    assert abs(math.remainder(yaw - truth.yaw, 2 * math.pi)) < math.radians(2)
    # In the map as nav2 reads it, the last scan ends at walls.
    cells, resolution_m, origin_m = nav2_map(folder / "map.yaml")
    with pc2grid.open_log(folder / "tuesday.mcap") as log:
        *_, scan = log.scans()
    ends = pc2grid.SE2(x, y, yaw).apply(scan.points_m[:, :2])
    column, row = ((ends - origin_m) / resolution_m).astype(int).T
    near_wall = cv2.dilate((cells == 100).astype(np.uint8), np.ones((7, 7), np.uint8))
    assert near_wall[row, column].mean() > 0.9


def test_an_exported_map_is_read_by_nav2_as_it_was(folder: Path) -> None:
    assert CliRunner().invoke(app, ["export", "building.submaps", "--map", "out"]).exit_code == 0
    cells, resolution_m, origin_m = nav2_map(folder / "out.yaml")
    with signature.open_database("building.submaps") as database:
        grid = database.grid("monday")
    assert np.array_equal(cells == 100, grid.occupied) and np.array_equal(cells == 0, grid.free)
    exact = pytest.approx((grid.resolution_m, *grid.origin_m), rel=5e-16, abs=0.0)
    assert (resolution_m, *origin_m) == exact


EXPORT_MCAP = ["export", "building.submaps", "--mcap", "map.mcap"]
LOCATE_TO_MCAP = ["relocalize", "tuesday.mcap", "-d", "building.submaps", "--output", "answer.mcap"]


@pytest.mark.skipif(shutil.which("rerun") is None, reason="rerun is not installed; it is only called")
def test_rerun_shows_the_map_and_where_the_robot_was(folder: Path) -> None:
    assert CliRunner().invoke(app, LOCATE_TO_MCAP).exit_code == 0
    subprocess.run(["rerun", "mcap", "convert", "answer.mcap", "-o", "answer.rrd"], check=True)
    shown = subprocess.run(
        ["rerun", "rrd", "print", "answer.rrd"], check=True, capture_output=True, text=True
    ).stdout
    assert re.search(r"/map - data columns: .*GridMap:data", shown)
    assert re.search(r"/tf - data columns: .*Transform3D:translation", shown)


def test_foxglove_shows_what_the_layout_names(folder: Path) -> None:
    for arguments in (EXPORT_MCAP, LOCATE_TO_MCAP):
        assert CliRunner().invoke(app, arguments).exit_code == 0
    layout = json.loads((ROOT / "examples" / "foxglove.json").read_text())
    panel = layout["configById"]["3D!pc2grid"]
    path = layout["configById"]["RawMessages!pose"]["topicPath"]
    assert {layout["layout"]["first"], layout["layout"]["second"]} == set(layout["configById"])

    def read(name: str) -> list[tuple[str, int, Any]]:
        with (folder / name).open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            return [(c.topic, m.log_time, d) for _, c, m, d in reader.iter_decoded_messages()]

    # Another implementation, with definitions of its own, reads every message to its last byte.
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name in ("map.mcap", "answer.mcap"):
        with (folder / name).open("rb") as stream:
            reader = make_reader(stream)
            assert reader.get_header().profile == "ros2"
            for kind, channel, message in reader.iter_messages():
                # By these Foxglove and rerun choose how a topic is read and drawn.
                assert (kind.encoding, channel.message_encoding) == ("ros2msg", "cdr")
                assert re.fullmatch(r"(nav|geometry|visualization|tf2)_msgs/msg/\w+", kind.name)
                again = store.serialize_cdr(store.deserialize_cdr(message.data, kind.name), kind.name)
                assert bytes(again) == message.data, kind.name

    answer = read("answer.mcap")
    topics = {topic for topic, _, _ in answer}
    assert set(panel["topics"]) <= topics and path.partition(".")[0] in topics
    assert {topic for topic, _, _ in read("map.mcap")} == {"/map", "/submaps", "/path", "/tf"}
    # A transform must be there at or before all that is drawn in its frame.
    edges = [(at, edge) for topic, at, told in answer if topic == "/tf" for edge in told.transforms]
    joined = {(edge.header.frame_id, edge.child_frame_id) for _, edge in edges}
    assert joined == {("map", "odom"), ("odom", "base_link")}
    first = min(at for _, at, _ in answer)
    assert {edge.child_frame_id for at, edge in edges if at == first} == {"odom", "base_link"}
    with signature.open_database("building.submaps") as database:
        spheres = next(told for topic, _, told in answer if topic == "/submaps").markers[0].points
        assert len(spheres) == len(database.signatures())


def test_every_row_of_what_was_tried_names_a_test_that_exists() -> None:
    text = (ROOT / "docs" / "robustness.md").read_text("utf-8")
    rows = [
        line
        for line in text.splitlines()
        if line.startswith("|") and not re.match(r"\|(-|\s*what was)", line)
    ]
    assert len(rows) > 40
    for row in rows:
        named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", row)
        assert len(named) == 1, row
        (file, name), *_ = named
        assert re.search(rf"^def {name}\(", (ROOT / file).read_text("utf-8"), re.MULTILINE), row


# --- The documentation site is built without a warning, and says what the program says ---


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("material", reason="needs the extra docs (mkdocs-material)")
    pytest.importorskip("mkdocstrings", reason="needs the extra docs (mkdocstrings)")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT, capture_output=True, text=True, check=False, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr, done.stderr
    return folder


def text_of(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text("utf-8")))


@pytest.mark.nightly
@pytest.mark.parametrize("command", ["", "convert", "relocalize", "db merge", "compare sensors"])
def test_commands_are_described_as_by_help(site: Path, command: str) -> None:
    said = CliRunner().invoke(app, [*command.split(), "--help"], prog_name="pc2grid").stdout
    page = f"commands/{command.replace(' ', '_')}" if command else "commands"
    assert said.strip() in text_of(site / "reference" / f"{page}.html")


@pytest.mark.nightly
def test_every_setting_and_every_public_name_has_its_place(site: Path) -> None:
    settings = text_of(site / "reference" / "settings.html")
    assert "radius_m = 5.0" in settings and "[relocalize]" in settings
    for package in (pc2grid, signature):
        page = site / "reference" / f"{package.__name__}.html"
        linked = dict(re.findall(r'<a href="([^"]*/(\w+)\.html)"><code>\2<', page.read_text("utf-8")))
        places = {name: path for path, name in linked.items()}
        for name in package.__all__:
            thing = getattr(package, name)
            if name[0] != "_":
                own = (page.parent / places[name]).read_text("utf-8")
                assert f'id="{thing.__module__}.{thing.__qualname__}"' in own, name


@pytest.mark.nightly
def test_docstrings_are_set_as_text_lists_and_code(site: Path) -> None:
    scan, convert = (site / "reference" / "pc2grid" / f"{name}.html" for name in ("Scan", "convert"))
    assert "stamp_ns: when the scan was taken" in text_of(scan) and "stamp_ns : when" not in text_of(scan)
    assert ">>> monday = pc2grid.convert(" in text_of(convert)
    raw = convert.read_text("utf-8")
    assert "&gt;&gt;&gt; " not in re.sub(r"<pre.*?</pre>", "", raw, flags=re.DOTALL)


def test_what_people_need_has_a_short_example() -> None:
    """That it runs, test_docs.py shows."""
    pytest.importorskip("mkdocs", reason="needs the extra docs (mkdocs-material)")
    needed = runpy.run_path(str(ROOT / "tools" / "docs_site.py"))["NEEDED"]
    assert len(needed) == 12
    for name in needed:
        text = inspect.getdoc(getattr(pc2grid, name)) or ""
        assert 1 <= len(re.findall(r"^(?:>>>|\.\.\.)", text, re.MULTILINE)) <= 10, name


@pytest.mark.nightly
def test_what_people_need_is_on_the_first_page_of_the_reference(site: Path) -> None:
    first = (site / "reference" / "pc2grid.html").read_text("utf-8").partition('id="all-others"')[0]
    shown = {
        "convert": "overwrite: ",
        "relocalize": "pc2grid.relocalize(",
        "Answer": "answer.plot()",
        "Localizer": "Localizer(",
    }
    for name, words in shown.items():
        assert f'href="pc2grid/{name}.html"' in first
        assert words in text_of(site / "reference" / "pc2grid" / f"{name}.html")


@pytest.mark.nightly
def test_the_notebook_and_the_pictures_are_there(site: Path) -> None:
    notebook = (site / "examples" / "from_log_to_answer.html").read_text("utf-8")
    assert notebook.count("data:image/png;base64,") > 4 and "session lidar" in notebook
    assert (site / "docs" / "signatures.png").is_file() and (site / "examples" / "demo.png").is_file()


@pytest.mark.nightly
def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        tags = re.findall(r"<(?:script|link|img)\b[^>]*>", page.read_text("utf-8"))
        assert [tag for tag in tags if re.search(r"(?:src|href)=\"?https?:", tag)] == [], page.name


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_the_site_can_be_searched_without_a_server(site: Path, tmp_path: Path) -> None:
    page = (site / "docs" / "method.html").read_text("utf-8")
    typed = (
        'addEventListener("load", () => setTimeout(() => {'
        'const box = document.querySelector("[data-md-component=search-query]");'
        'box.focus(); box.value = "MapClosures"; box.dispatchEvent(new Event("keyup")); }, 500));'
    )
    (site / "docs" / "searched.html").write_text(page.replace("</body>", f"<script>{typed}</script></body>"))
    done = subprocess.run(
        ["chromium", "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}",
         "--virtual-time-budget=20000", "--dump-dom", f"file://{site / 'docs' / 'searched.html'}"],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    found = re.findall(r'<a href="([^"]*)" class="md-search-result__link"', done.stdout)
    assert any("examples/comparisons.html" in link for link in found), found


@pytest.mark.nightly
@pytest.mark.parametrize(
    "page", ["index", "examples/recordings", "reference/pc2grid", "reference/pc2grid/convert"]
)
def test_pages_can_be_read_in_light_in_dark_and_on_a_phone(site: Path, browser: Browser, page: str) -> None:
    behind = []
    for size, dark in ((DESK, False), (DESK, True), (PHONE, False)):
        browser.show((site / f"{page}.html").as_uri(), size, dark=dark)
        behind.append(browser.evaluate("getComputedStyle(document.body).backgroundColor"))
        assert browser.evaluate("document.documentElement.scrollWidth") == size[0]
        assert browser.complaints == []
    assert behind[0] == behind[2] != behind[1]


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text("utf-8")
    missing = [path.name for path in ROOT.glob("examples/*.md") if f"examples/{path.name}" not in navigation]
    assert not missing, f"not in the nav of mkdocs.yml: {missing}"


def test_how_to_cite() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= citation.keys()  # what the format demands


# --- The figures of README are those of the pages that they come from ---


README = (ROOT / "README.md").read_text("utf-8")
FLAT = " ".join(README.split())

Row = dict[str, str]


def tables(page: str) -> list[list[Row]]:
    """The tables of a page: of each row the cells by their heads. An empty first cell repeats that above."""
    found = []
    text = README if page == "README.md" else (ROOT / "examples" / page).read_text("utf-8")
    for block in re.findall(r"^\|.*(?:\n\|.*)+", text, re.MULTILINE):
        lines = [line.strip()[1:-1].split("|") for line in block.splitlines()]
        head, _, *body = [[cell.strip(" *") for cell in line] for line in lines]
        rows: list[Row] = []
        for cells in body:
            first = cells[0] or (rows[-1][head[0]] if rows else "")
            rows.append(dict(zip(head, [first, *cells[1:]], strict=False)))
        found.append(rows)
    return found


def table(page: str, *head: str) -> list[Row]:
    """The only table of a page that has these heads."""
    (found,) = [rows for rows in tables(page) if rows and set(head) <= rows[0].keys()]
    return found


def test_the_table_of_real_sensors_is_that_of_the_page() -> None:
    head = ("query by", "in a map by lidar")
    assert table("README.md", *head) == table("real.md", *head)


def test_elsewhere_is_what_the_page_counts() -> None:
    (total,) = [
        one
        for one in table("real.md", "building", "elsewhere: wrong of asked")
        if one["building"] == "all queries"
    ]
    wrong, _, asked, *_ = total["elsewhere: wrong of asked"].split()
    verb = "was" if wrong == "1" else "were"
    assert f"In the map of another building, {wrong} of {asked} queries {verb} located." in FLAT


def test_robots_that_are_followed_are_those_of_the_page() -> None:
    page = " ".join((ROOT / "examples" / "real.md").read_text("utf-8").split())
    alone, carried = page.split("## Along drives")[1].split("## Carried away")
    wrong = (
        r"Of (\d+) places that can be judged, (\d+) are wrong, in \d+ of \d+ rows.*? what it sees: (\d+)\."
    )
    ((located, drives, s, m, *told),) = re.findall(
        r"(\d+) of (\d+) robots are located, (\S+) s and (\S+) m after they began, .*? " + wrong, alone
    )
    assert (
        f"Along {drives} drives {located} robots without a first pose are located, after {s} s and {m} m "
        f"(median); {told[1]} of {told[0]} poses were wrong."
    ) in FLAT
    ((kidnaps, noticed, s, m, shown, again, again_s, again_m, *told),) = re.findall(
        r"Of (\d+) kidnaps of a robot that knew where it was, (\d+) are noticed, (\S+) s and (\S+) m after "
        r"it was put down, in the median. In (\d+) of them the map shows what it sees there; it is located "
        r"again (\d+) times, (\S+) s and (\S+) m after, in the median. " + wrong,
        carried,
    )
    assert (
        f"Of {kidnaps} robots carried away while they were off, {noticed} noticed it, after {s} s and {m} m. "
        f"At {shown} of the new places the map shows what the robot sees: {again} robots were located again, "
        f"after {again_s} s and {again_m} m; {told[1]} of {told[0]} poses were wrong."
    ) in FLAT


MEASURED = ("comparisons", "paper", "real")


@pytest.mark.parametrize("page", MEASURED)
def test_a_page_of_figures_names_the_program_that_made_them(page: str) -> None:
    head = "\n".join((ROOT / "examples" / f"{page}.md").read_text("utf-8").splitlines()[:8])
    assert re.search(r"of commit [0-9a-f]{7,12}|\([0-9a-f]{7,12}\)", head)
