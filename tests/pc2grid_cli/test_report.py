"""The page contains everything, loads nothing, and agrees with the database and the answer."""

from __future__ import annotations

import base64
import itertools
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.io.nav2_map import save_map
from pc2grid.model import Consistency, Contradiction, OccupancyGrid, Trajectory
from pc2grid_cli.locate import Found, find_map
from pc2grid_cli.nav2_pose import initialpose
from pc2grid_cli.report import contents, runs, write_report
from signature.config import Config
from signature.database import SubmapDatabase, open_database
from signature.sessions import add_sessions, provenance
from tests.helpers.session_maps import LOOPS, session, way
from tests.helpers.simulated_drives import cut, office, plan

NASTY = "</script><b>&"


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> SubmapDatabase:
    folder = tmp_path_factory.mktemp("report")
    config = Config()
    sessions = [
        (session("office", office(), way(), LOOPS), provenance(Path("office.mcap"), "a" * 64, config)),
        (session(NASTY, plan(8, 5, []), way(25)), provenance(Path("room.mcap"), "b" * 64, config)),
    ]
    add_sessions(folder / "two.submaps", sessions, config, keep=False)
    return open_database(folder / "two.submaps")


@pytest.fixture(scope="module")
def found(database: SubmapDatabase, tmp_path_factory: pytest.TempPathFactory) -> Found:
    stem = tmp_path_factory.mktemp("query") / "part"
    save_map(cut(office(), 4.0, 3.0, 15.0, 12.0), stem)
    return find_map(stem.with_suffix(".yaml"), database, Config())


def embedded(page: str) -> dict:
    return json.loads(re.search(r"const D = (\{.*?\}), A = D\.answer", page, re.S)[1])


def test_the_page_is_whole_and_fetches_nothing(
    database: SubmapDatabase, found: Found, tmp_path: Path
) -> None:
    write_report(tmp_path / "page.html", database, found=found)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    outside = re.findall(r"(?:https?:)?//[a-z][^\s\"'`)]*", page.replace("http://www.w3.org/2000/svg", ""))
    assert [u for u in outside if u.startswith(("http", "//www"))] == []
    assert "default-src 'none'" in page
    assert not re.search(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=", page)
    # A session's name cannot end the script: only the template's own end tag is there.
    assert page.count("</script>") == 1
    assert embedded(page) == contents(database, found=found)
    assert embedded(page)["sessions"][1]["name"] == NASTY


def test_the_same_database_gives_the_same_page(database: SubmapDatabase, tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        write_report(tmp_path / name, database)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_submaps_graph_and_path_are_those_of_the_database(database: SubmapDatabase) -> None:
    first = contents(database)["sessions"][0]
    table = database.signatures()
    rows = np.flatnonzero(table.session_index == 0)
    assert [s["id"] for s in first["submaps"]] == table.submap_id[rows].tolist()
    assert np.allclose([s["xy"] for s in first["submaps"]], table.center_m[rows], atol=0.006)
    assert np.allclose([s["boundary"] for s in first["submaps"]], table.boundary[rows], atol=1e-4)
    nodes, edges = first["graph"]["nodes"], first["graph"]["edges"]
    assert len(nodes) > 5 and len(edges) > 5
    assert all(0 <= i < len(nodes) for edge in edges for i in edge)
    assert all(office().free[tuple(c)] for c in office().to_cell(np.array(nodes)[:, :2]))


def test_the_picture_lies_where_the_grid_lies(database: SubmapDatabase) -> None:
    image = contents(database)["sessions"][0]["image"]
    raw = np.frombuffer(base64.b64decode(image["png"].split(",")[1]), np.uint8)
    pixels = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED)
    grid = office()
    assert pixels.shape[:2] == grid.cells.shape
    assert (image["x"], image["y"], image["w"], image["h"]) == (0.0, 0.0, 20.0, 14.0)
    # The highest row of the picture is the one with the largest y.
    assert np.array_equal(pixels[::-1, :, 0] < 60, grid.occupied)


def test_a_path_is_cut_where_its_health_changes_and_stays_connected() -> None:
    pieces = runs(way())
    assert [p["health"] for p in pieces] == ["fine", "degenerate", "lost", "fine"]
    for before, after in itertools.pairwise(pieces):
        assert before["xy"][-2:] == after["xy"][:2]
    assert pieces[-1]["xy"][-2:] == [8.8, 7.0]


def test_standing_still_costs_no_points() -> None:
    still = Trajectory(stamps_ns=np.arange(500), T_session_base=np.tile(np.eye(4), (500, 1, 1)))
    (piece,) = runs(still)
    assert piece["health"] == "fine" and len(piece["xy"]) == 4


def test_loops_join_the_places_that_they_are_between(database: SubmapDatabase) -> None:
    first, second = contents(database)["sessions"]
    places = way().planar()[:, :2]
    wanted = [[*places[loop.older], *places[loop.newer], loop.accepted] for loop in LOOPS]
    assert np.allclose(first["loops"], wanted, atol=0.006)
    assert second["loops"] == []


def test_where_map_and_scans_disagree_is_marked_on_the_path(tmp_path: Path) -> None:
    stamps = way().stamps_ns
    stretch = Contradiction(
        from_ns=int(stamps[5]), to_ns=int(stamps[9]), x_m=2.4, y_m=7.0, length_m=0.8, share=0.4
    )
    bent = replace(
        session("office", office(), way()),
        consistency=Consistency(hits_on_free=0.1, contradicted=0.3, bent=True, stretches=(stretch,)),
    )
    add_sessions(
        tmp_path / "bent.submaps", [(bent, provenance(Path("office.mcap"), "a" * 64, Config()))], Config()
    )
    with open_database(tmp_path / "bent.submaps") as database:
        shown = contents(database)["sessions"][0]
    assert (shown["agreement"], shown["bent"]) == (0.7, True)
    assert np.allclose(shown["contradicted"], [way().planar()[5:10, :2].ravel()], atol=0.006)


def test_the_answer_on_the_page_is_the_answer(database: SubmapDatabase, found: Found) -> None:
    shown = contents(database, found=found, accept=0.8)["answer"]
    assert shown["status"] == "located" == found.answer.status
    assert shown["session"] == "office" and shown["accept"] == 0.8
    assert (shown["pose"]["x"], shown["pose"]["y"]) == pytest.approx((4.0, 3.0), abs=0.05)
    assert shown["query"]["is_map"] and shown["query"]["source"] == "part.yaml"
    assert shown["hypotheses"][0]["T"] == pytest.approx([4.0, 3.0, 0.0], abs=0.05)
    assert len(shown["hypotheses"]) == len(found.answer.hypotheses)
    assert shown["image"]["w"] == 11.0 and shown["image"]["h"] == 9.0


def test_an_initial_pose_is_what_nav2_takes() -> None:
    covariance = np.array([[0.1, 0.01, 0.02], [0.01, 0.2, 0.03], [0.02, 0.03, 0.3]])
    message = initialpose(1_700_000_000_123_456_789, SE2(1.0, -2.0, np.pi / 2), covariance)
    assert message["header"] == {"stamp": {"sec": 1_700_000_000, "nanosec": 123_456_789}, "frame_id": "map"}
    pose = message["pose"]["pose"]
    assert pose["position"] == {"x": 1.0, "y": -2.0, "z": 0.0}
    assert pose["orientation"] == pytest.approx({"x": 0, "y": 0, "z": 0.5**0.5, "w": 0.5**0.5})
    full = np.array(message["pose"]["covariance"]).reshape(6, 6)
    assert np.array_equal(full[np.ix_((0, 1, 5), (0, 1, 5))], covariance)
    assert np.count_nonzero(full) == 9
    assert json.loads(json.dumps(message)) == message


def test_a_map_of_nothing_still_has_a_page(tmp_path: Path) -> None:
    nothing = OccupancyGrid(cells=np.full((9, 9), -1, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    still = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    origin = provenance(Path("nothing.mcap"), "c" * 64, Config())
    add_sessions(tmp_path / "x.submaps", [(session("x", nothing, still), origin)], Config(), keep=False)
    with open_database(tmp_path / "x.submaps") as opened:
        (only,) = contents(opened)["sessions"]
    assert only["submaps"] == [] and only["path"] == [] and only["graph"] == {"nodes": [], "edges": []}


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium to look at the page with")
@pytest.mark.parametrize("size", ["1280,900", "390,844"])
def test_a_browser_has_nothing_to_complain_about(
    database: SubmapDatabase, found: Found, tmp_path: Path, size: str
) -> None:
    write_report(tmp_path / "page.html", database, found=found)
    assert CHROMIUM is not None
    done = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}",
         "--enable-logging=stderr", "--virtual-time-budget=3000", f"--window-size={size}", "--dump-dom",
         f"file://{tmp_path / 'page.html'}"],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line] == []
    shown = re.sub(r"<script>.*?</script>", "", done.stdout, flags=re.S)
    for words in ("part.yaml in two.submaps", "submap centres", "query: walls as located", "Submap "):
        assert words in shown
    # Of the three loops that the first session came back by.
    assert re.search(r"<label><input type=\"checkbox\">.*?2 loops closed</label>", shown)
    assert "1 loop doubted</label>" in shown
    assert "NaN" not in shown and "Infinity" not in shown
