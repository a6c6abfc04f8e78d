"""Statements of the repository are true: README commands exist, versions are pinned, scripts are POSIX."""

import json
import os
import re
import subprocess
import sys
import zipfile
from email import message_from_bytes
from importlib.metadata import distributions
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet
from typer.testing import CliRunner

import pc2grid
from pc2grid.errors import ConfigError
from pc2grid.settings import PartitionConfig, dump_settings, load_settings
from pc2grid_cli.main import app
from signature.config import Config

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("target", re.findall(r"`make (\w+)", (ROOT / "README.md").read_text()))
def test_readme_targets_are_real(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def test_constraints_are_plain_versions() -> None:
    line = re.compile(r"^[a-z0-9-]+==[0-9][0-9a-z.]*( ?; python_version [<>]=? '3\.1\d')?$")
    lines = [text for text in (ROOT / "constraints.txt").read_text().splitlines() if not text.startswith("#")]
    assert len(lines) > 20
    assert [text for text in lines if not line.match(text)] == []


def test_constraints_do_not_ask_for_a_later_patch_of_python() -> None:
    """The Python 3.11 of Debian 12 is 3.11.2: with a version that needs 3.11.5 nothing could be installed."""
    first = f"{sys.version_info.major}.{sys.version_info.minor}.0"
    pinned = re.findall(r"^([a-z0-9-]+)==([^;\s]+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    here = {(dist.metadata["Name"].lower().replace("_", "-"), dist.version): dist for dist in distributions()}
    asked = {pin: here[pin].metadata.get("Requires-Python") for pin in pinned if pin in here}
    assert len(asked) > 20
    assert [pin for pin, needs in asked.items() if needs and first not in SpecifierSet(needs)] == []


def test_scripts_are_posix_shell() -> None:
    for script in ("tools/setup.sh", ".ci/run"):
        assert (ROOT / script).read_text().startswith("#!/bin/sh\n")
        assert subprocess.run(["sh", "-n", ROOT / script], check=False).returncode == 0


def test_library_neither_prints_nor_exits_nor_imports_upward() -> None:
    code = (
        "import sys, pc2grid, pc2grid.model, pc2grid.errors, pc2grid.settings, signature.config\n"
        "print([m for m in ('pc2grid_cli', 'open3d', 'cv2', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_presets_are_named_and_what_a_file_says_overrides_them(tmp_path: Path) -> None:
    usual, paper = PartitionConfig(), Config.paper().partition
    assert usual == Config().partition == pc2grid.Config().partition
    assert (usual.view, usual.radius_m, usual.spacing_m) == ("isovist", 5.0, 1.0)
    assert (paper.view, paper.radius_m, paper.spacing_m) == ("disc", 8.0, None)
    file = tmp_path / "mine.toml"
    file.write_text("[partition]\nradius_m = 6.0\n")
    found = load_settings(Config, file, ["partition.cluster_m=2"], {}, preset=Config.paper())
    assert found.partition == PartitionConfig(view="disc", radius_m=6.0, spacing_m=None, cluster_m=2.0)
    printed = CliRunner().invoke(app, ["config", "dump", "--preset", "paper"]).stdout
    for dumped in (dump_settings(Config.paper()), printed):
        file.write_text(dumped, encoding="utf-8")
        assert load_settings(Config, file, (), {}) == Config.paper()
    with pytest.raises(ConfigError, match=r"did you mean partition\.radius_m"):
        load_settings(Config, None, ["partition.radius=3"], {}, preset=Config.paper())


def test_every_setting_is_explained() -> None:
    for name, field in Config.model_fields.items():
        section = field.annotation
        assert section is not None
        unexplained = [key for key, info in section.model_fields.items() if not info.description]
        assert unexplained == [], f"in section {name}"


def test_one_setting_leaves_the_others_of_its_section_alone() -> None:
    for name, section in Config():
        for key, value in section:
            text = "null" if value is None else json.dumps(value)
            assert load_settings(Config, None, [f"{name}.{key}={text}"], {}) == Config()


def test_order_of_precedence(tmp_path: Path) -> None:
    low, high = tmp_path / "low.toml", tmp_path / "high.toml"
    low.write_text("[partition]\nradius_m = 3.0\n[relocalize]\nviews = 3\n")
    high.write_text("[partition]\nradius_m = 4.0\n")
    environment = {"PC2GRID_CONFIG": str(low)}
    assert load_settings(Config, None, (), environment).partition.radius_m == 3.0
    assert load_settings(Config, high, (), environment).partition.radius_m == 4.0
    assert load_settings(Config, high, (), environment).relocalize.views == Config().relocalize.views
    assert load_settings(Config, high, ["partition.radius_m=5"], environment).partition.radius_m == 5.0
    assert load_settings(Config, None, ["read.topic=null"], {}).read.topic is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[partitoin]\nradius_m = 1.0\n", "did you mean partition"),
        ("[partition]\nradius = 1.0\n", r"did you mean partition\.radius_m"),
        ("[read]\nradius_m = 1.0\n", r"did you mean partition\.radius_m"),
        ("[partition]\nradius_m = nan\n", r"partition\.radius_m"),
        ("[partition]\nradius_m = 'big'\n", r"partition\.radius_m"),
        ("partition = 3\n", "partition"),
        ("[partition\n", "not TOML"),
    ],
)
def test_wrong_settings_name_the_key(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=words) as caught:
        load_settings(Config, file, (), {})
    assert str(file) in caught.value.message


# --- The wheel holds what README names, and README reads where the repository is not ---


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
    assert "signature/shown/report.html" in wheel.namelist()


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
