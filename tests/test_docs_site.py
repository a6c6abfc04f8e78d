"""The documentation site is built without a warning, and says what the program says."""

from __future__ import annotations

import html
import inspect
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

import pc2grid
import signature
from pc2grid_cli.main import app
from tests.helpers.browser import DESK, PHONE, Browser

ROOT = Path(__file__).resolve().parent.parent


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
