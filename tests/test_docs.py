"""What docstrings and README show works as shown."""

from __future__ import annotations

import doctest
import importlib
import inspect
import subprocess
import sys
from pathlib import Path
from types import ModuleType

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
