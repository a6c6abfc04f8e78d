"""What docstrings and README show works as shown."""

from __future__ import annotations

import doctest
import importlib
import inspect
import math
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import pc2grid
import signature
from tests import workplace

ROOT = Path(__file__).resolve().parent.parent
FLAGS = doctest.NORMALIZE_WHITESPACE


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("furnished")
    workplace.furnish(folder)
    return folder


@pytest.fixture
def folder(furnished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder, and the working directory."""
    monkeypatch.chdir(workplace.copy(furnished, tmp_path))
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


@pytest.mark.parametrize("package", ["pc2grid", "signature"])
def test_importing_a_package_loads_no_library(package: str) -> None:
    code = (
        "import sys\n"
        f"import {package}\n"
        "print([m for m in ('numpy', 'scipy', 'pydantic', 'cv2', 'numba', 'networkx', 'open3d', 'mcap')"
        " if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# --- examples/ --------------------------------------------------------------------------------------------


@pytest.fixture
def run(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., list[str]]:
    """Run an example in the user's folder; what it prints, line by line."""

    def run_example(name: str, *arguments: str) -> list[str]:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    return run_example


Run = Callable[..., list[str]]


def test_example_convert_a_log(run: Run) -> None:
    said = run("convert_a_log.py", "tuesday.mcap", "new.submaps")
    assert said[0].startswith("/scan: ") and "4.0 m driven" in said[1]
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
    with pc2grid.open_log("tuesday.mcap") as log, Path("scans.txt").open("w") as out:
        for scan in log.scans(0.0, 4.0):
            x, y = (scan.points_m[:, :2] - [0.2, 0.0]).T
            ranges = np.full(541, np.nan)
            steps = np.rint((np.degrees(np.arctan2(y, x)) + 135.0) * 2).astype(int)
            inside = (steps >= 0) & (steps <= 540)
            ranges[steps[inside]] = np.hypot(x, y)[inside]
            words = " ".join(f"{value:.4f}" for value in ranges)
            out.write(f"{scan.stamp_ns * 1e-9:.4f} {words}\n")
    (said,) = run("own_sensor.py", "scans.txt", "own.submaps")
    with pc2grid.open_log("tuesday.mcap") as log:
        wanted = pc2grid.build_map(log, signature.Config(), session="tuesday", duration_s=4.0)
    with signature.open_database("own.submaps") as database:
        way = database.trajectory("scans").planar()
    assert said.startswith(f"{len(wanted.trajectory)} scans, ")
    assert np.allclose(way, wanted.trajectory.planar(), atol=0.05)


def test_example_own_descriptor(run: Run) -> None:
    said = run("own_descriptor.py", "map.yaml", "12")
    values = {(int(line[6]), line[9:25].strip()): float(line[26:31]) for line in said[1:]}
    assert len(values) == 9
    for level in range(3):
        assert 0.2 < values[level, "wall distances"] <= 1.0
        assert 0.5 < values[level, "proposed"] <= 1.0


def test_example_own_floor_plan(run: Run) -> None:
    said = run("own_floor_plan.py", "map.yaml", "1", "20", "3")
    (off_m,) = re.findall(r"visitor 0: located, ([\d.]+) m off", "\n".join(said))
    assert float(off_m) < 0.25


def test_example_signature_of_a_submap(run: Run) -> None:
    run("signature_of_a_submap.py", "map.yaml", "--out", "submap.png")
    assert Path("submap.png").read_bytes().startswith(b"\x89PNG")
