"""The wheel holds what README names, and README reads where the repository is not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

import pc2grid

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = "share/pc2grid/examples"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    pytest.importorskip("hatchling", reason="needs hatchling, which builds the wheel")
    pytest.importorskip("hatch_fancy_pypi_readme", reason="needs hatch-fancy-pypi-readme")
    folder = tmp_path_factory.mktemp("dist")
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


def test_the_wheel_holds_the_examples_that_readme_names(wheel: zipfile.ZipFile) -> None:
    named = re.findall(r"examples/([\w./-]+\w)", (ROOT / "README.md").read_text("utf-8"))
    assert {"real.md", "nav2.md", "locate_a_robot.py"} <= set(named)
    held = {name.partition(f"{EXAMPLES}/")[2] for name in wheel.namelist() if EXAMPLES in name}
    assert set(named) <= held, set(named) - held
    assert "nav2.sh" in held


def test_the_wheel_holds_the_packages_without_tests_and_laboratory(wheel: zipfile.ZipFile) -> None:
    tops = {name.partition("/")[0] for name in wheel.namelist()}
    version = pc2grid.__version__
    wanted = {"pc2grid", "signature", "pc2grid_cli"}
    assert tops == {*wanted, f"pc2grid-{version}.dist-info", f"pc2grid-{version}.data"}
    for package in wanted:
        assert f"{package}/py.typed" in wheel.namelist()
    assert "signature/localization/shown/report.html" in wheel.namelist()


def test_the_wheel_alone_simulates_and_says_what_compare_needs(
    wheel: zipfile.ZipFile, tmp_path: Path
) -> None:
    wheel.extractall(tmp_path / "wheel")
    code = (
        "import sys, pathlib\n"
        "sys.path = [sys.argv.pop(1), *(p for p in sys.path if not pathlib.Path(p, 'pc2grid_lab').exists()"
        " and not pathlib.Path(p, 'pc2grid').exists())]\n"
        "from pc2grid_cli.main import main; main()"
    )

    def pc2grid(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, tmp_path / "wheel", *words]
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
        )

    made = pc2grid("simulate", "drive.mcap", "--sensor", "laser", "--length", "0.5")
    assert made.returncode == 0 and (tmp_path / "drive.tum").exists(), made.stderr
    assert pc2grid("demo", "--help").returncode == 0
    refused = pc2grid("compare", "recordings", ".")
    assert refused.returncode == 2 and "Traceback" not in refused.stderr
    assert "pip install -e ." in refused.stderr
    assert "recordings: not installed; only a clone of the repository has it" in refused.stderr
    assert "compare-paper" not in pc2grid("config", "schema").stdout


def test_readme_has_no_link_that_an_index_cannot_follow(wheel: zipfile.ZipFile) -> None:
    (name,) = (name for name in wheel.namelist() if name.endswith("METADATA"))
    metadata = message_from_bytes(wheel.read(name))
    readme = metadata.get_payload()
    assert isinstance(readme, str) and metadata["Description-Content-Type"] == "text/markdown"
    assert readme.startswith("# pc2grid") and "pip install" in readme and "relocalize" in readme
    assert re.findall(r"\]\((?!https?:|#)[^)]*\)", readme) == []
    assert "`nav2.md`" in readme, "what was a link is named"
    assert "is located in the map of a lidar" not in readme, "the line below a picture that is not there"
