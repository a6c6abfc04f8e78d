"""The page contains everything, loads nothing, and agrees with the database and the answer."""

import base64
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import cv2
import networkx as nx
import numpy as np
import pytest

from pc2grid.io.maps import save_map
from pc2grid.model import Consistency, Contradiction, OccupancyGrid, Precision, Trajectory
from pc2grid_cli.relocalize import map_sigma_m
from signature.boundary import boundary_histogram
from signature.config import Config
from signature.database import SubmapDatabase, open_database
from signature.freespace import freespace_histogram, shortest_paths
from signature.localization.answer import PoseInSpace
from signature.paper import Signature, distances
from signature.sessions import find
from signature.shown.page import Found, contents, write_report
from tests.helpers.browser import DESK, PHONE, Browser
from tests.helpers.databases import stored
from tests.helpers.nav2_map import as_mapped
from tests.helpers.session_maps import LOOPS, session, way
from tests.helpers.simulated_drives import changed_part, cut, office, plan

NASTY = "</script><b>&"
RADIUS_M = Config().partition.radius_m

ROUNDED_M = 0.006
"""The page shows centimetres: half of one, and a little for the float32 of the table."""


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> SubmapDatabase:
    path = tmp_path_factory.mktemp("report") / "two.submaps"
    two = session("office", office(), way(), LOOPS), session(NASTY, plan(8, 5, []), way(25))
    return open_database(stored(path, *two))


@pytest.fixture(scope="module")
def found(database: SubmapDatabase, tmp_path_factory: pytest.TempPathFactory) -> Found:
    stem = tmp_path_factory.mktemp("query") / "part"
    save_map(cut(office(), 4.0, 3.0, 15.0, 12.0), stem)
    return find(stem.with_suffix(".yaml"), database, Config())


@pytest.fixture(scope="module")
def page(database: SubmapDatabase, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the database alone."""
    path = tmp_path_factory.mktemp("page") / "page.html"
    write_report(path, database)
    return path


@pytest.fixture(scope="module")
def answered(database: SubmapDatabase, found: Found, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the answer."""
    path = tmp_path_factory.mktemp("answered") / "page.html"
    write_report(path, database, found=found)
    return path


def embedded(page: str) -> dict:
    return json.loads(re.search(r"const D = (\{.*?\}), A = D\.answer", page, re.S)[1])


def test_the_page_is_whole_and_fetches_nothing(
    database: SubmapDatabase, found: Found, answered: Path
) -> None:
    page = answered.read_text(encoding="utf-8")
    outside = re.findall(r"(?:https?:)?//[a-z][^\s\"'`)]*", page.replace("http://www.w3.org/2000/svg", ""))
    assert [u for u in outside if u.startswith(("http", "//www"))] == []
    assert "default-src 'none'" in page
    assert not re.search(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=(?!.data:)", page)
    # A session's name cannot end the script: only the template's own end tag is there.
    assert page.count("</script>") == 1
    assert embedded(page) == contents(database, found=found)
    assert embedded(page)["sessions"][1]["name"] == NASTY


def test_submaps_graph_and_path_are_those_of_the_database(database: SubmapDatabase) -> None:
    first = contents(database)["sessions"][0]
    table = database.signatures()
    rows = np.flatnonzero(table.session_index == 0)
    assert [s["id"] for s in first["submaps"]] == table.submap_id[rows].tolist()
    assert np.allclose([s["xy"] for s in first["submaps"]], table.center_m[rows], atol=ROUNDED_M)
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


def test_furniture_is_in_the_picture_and_in_the_legend(tmp_path: Path, browser: Browser) -> None:
    """Also where there are so many cells that several of them are drawn as one."""
    few = as_mapped(office())
    many = replace(few, cells=np.kron(few.cells, np.ones((8, 8), np.int8)), resolution_m=few.resolution_m / 8)
    for name, grid, there in (("bare", office(), False), ("few", few, True), ("many", many, True)):
        made = replace(session("s", office(), way()), grid=grid)
        with open_database(stored(tmp_path / f"{name}.submaps", made)) as opened:
            write_report(tmp_path / "page.html", opened)
            image = contents(opened)["sessions"][0]["image"]
        raw = np.frombuffer(base64.b64decode(image["png"].split(",")[1]), np.uint8)
        pixels = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED)
        assert max(pixels.shape) <= 3000 and (image["furniture"] is not None) == there
        shown = looked_at(browser, tmp_path / "page.html")
        assert (">map's furniture: an obstacle, no wall<" in shown) == there
        if there:
            light_blue = (pixels[..., 2::-1] == image["furniture"]).all(axis=-1)
            assert light_blue.mean() == pytest.approx(few.things.mean(), rel=0.1)


def test_loops_join_the_places_that_they_are_between(database: SubmapDatabase) -> None:
    first, second = contents(database)["sessions"]
    places = way().planar()[:, :2]
    wanted = [[*places[loop.older], *places[loop.newer], loop.accepted] for loop in LOOPS]
    assert np.allclose(first["loops"], wanted, atol=ROUNDED_M)
    assert second["loops"] == []


def test_where_scans_disagree_and_how_exactly_places_are_known_is_drawn_along_the_path(
    tmp_path: Path,
) -> None:
    stamps = [int(stamp_ns) for stamp_ns in way().stamps_ns]
    stretch = Contradiction(from_ns=stamps[5], to_ns=stamps[9], x_m=2.4, y_m=7.0, length_m=0.8, share=0.4)
    made = replace(
        session("office", office(), way()),
        consistency=Consistency(hits_on_free=0.1, contradicted=0.3, bent=True, stretches=(stretch,)),
        precision=Precision(stamps_ns=(stamps[0], stamps[4], stamps[9]), sigma_m=(0.01, 0.05, 0.75)),
    )
    with open_database(stored(tmp_path / "x.submaps", made)) as database:
        shown = contents(database)["sessions"][0]
    assert (shown["agreement"], shown["bent"], shown["worst_m"]) == (0.7, True, 0.75)
    assert np.allclose(shown["contradicted"], [way().planar()[5:10, :2].ravel()], atol=ROUNDED_M)
    ((sigma_m, *xy),) = shown["loose"]  # the first piece is known better than a path is wide
    assert sigma_m == 0.4
    assert np.allclose((xy[:2], xy[-2:]), way().planar()[[4, 9], :2], atol=ROUNDED_M)


def test_an_answer_comes_with_how_exactly_the_map_is_known_there(tmp_path: Path, found: Found) -> None:
    stamps, pose = way().stamps_ns, found.T_map_base
    assert pose is not None
    nearest = int(np.argmin(np.hypot(*(way().planar()[:, :2] - (pose.x, pose.y)).T)))
    known = Precision(stamps_ns=(int(stamps[0]), int(stamps[nearest]) + 1), sigma_m=(0.1, 0.75))
    for precision, sigma_m in ((known, pytest.approx(0.75, abs=1e-6)), (None, None)):
        made = replace(session("office", office(), way()), precision=precision)
        with open_database(stored(tmp_path / f"{sigma_m}.submaps", made)) as database:
            assert map_sigma_m(found, database) == sigma_m


def test_the_answer_on_the_page_is_the_answer(database: SubmapDatabase, found: Found) -> None:
    shown = contents(database, found=replace(found, accept=0.8))["answer"]
    assert shown["status"] == "located" == found.status
    assert shown["session"] == "office" and shown["accept"] == 0.8
    assert (shown["pose"]["x"], shown["pose"]["y"]) == pytest.approx((4.0, 3.0), abs=0.05)
    assert shown["query"]["is_map"] and shown["query"]["source"] == "part.yaml"
    assert shown["hypotheses"][0]["T"] == pytest.approx([4.0, 3.0, 0.0], abs=0.05)
    assert len(shown["hypotheses"]) == len(found.hypotheses)


def test_the_walls_of_the_query_are_weighed_at_each_hypothesis(
    database: SubmapDatabase, found: Found
) -> None:
    shown = contents(database, found=found)["answer"]
    walls_m = np.array(shown["walls"]).reshape(-1, 2)
    assert len(walls_m) > 100
    assert found.drawn is not None
    at = found.drawn.to_cell(walls_m)
    near = [found.drawn.occupied[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].any() for r, c in at]
    assert all(near)
    for h in shown["hypotheses"]:
        assert len(h["support"]) == len(walls_m) and set(h["support"]) <= set("012")
        unknown, fits, contradicted = h["shares"]
        assert fits + contradicted == pytest.approx(h["overlap"], abs=1e-3)
        assert unknown + fits + contradicted == pytest.approx(1.0, abs=1e-3)
    # A part of the very map fits it, and is contradicted nowhere.
    assert shown["hypotheses"][0]["shares"][1] > 0.99 and shown["hypotheses"][0]["missed"] == []


def test_the_signatures_of_the_query_lie_on_those_of_the_map_where_it_is_and_not_at_the_rival(
    database: SubmapDatabase, found: Found
) -> None:
    """The query is a part of the map: a view in its middle sees the same in both."""
    shown = contents(database, found=found)["answer"]
    why = shown["why"]
    assert [tuple(at) for at in why["views"]] == [pytest.approx(at, abs=ROUNDED_M) for at in found.views_m]
    here, *rivals = why["places"]
    assert here["hypothesis"] == 0 and len(here["views"]) == len(why["views"])
    apart = []
    for view in here["views"]:
        query, there = np.array(view["boundary"])
        apart.append(np.abs(query - there).sum())
        assert np.array(view["symmetry"]).shape == (2, 48) and np.array(view["freespace"]).shape[0] == 2
    # Shares of all pairs differ by at most 2. The query's frame is not that of the cells, so that rays end a
    # cell earlier or later; a pair then falls into the next bin of 0.25 m. At a wrong place they differ by 1.
    assert min(apart) < 0.3
    assert sum(view["log_ratio"] or 0.0 for view in here["views"]) > 0.0
    for rival in rivals:
        assert found.hypotheses[rival["hypothesis"]] not in found.places[0].fits
        told = why["told_apart"]
        assert here["views"][told]["log_ratio"] > rival["views"][told]["log_ratio"]


def test_what_a_changed_query_contradicts_is_where_it_was_changed(
    database: SubmapDatabase, tmp_path: Path
) -> None:
    """The query lost a wall that the map has, from (7, 1) to (7, 3), and has a box that the map has not."""
    save_map(changed_part(), tmp_path / "changed")
    shown = contents(database, found=find(tmp_path / "changed.yaml", database, Config()))["answer"]
    best = shown["hypotheses"][0]
    missed_m = np.array(best["missed"]).reshape(-1, 2)
    assert len(missed_m) > 10
    assert np.abs(missed_m - (7.0, 2.0)).max(axis=0) == pytest.approx((0.0, 1.0), abs=0.2)
    against = np.array(shown["walls"]).reshape(-1, 2)[[s == "2" for s in best["support"]]]
    assert len(against) > 5
    assert np.abs(against - (5.7, 7.2)).max() < 0.3


def test_signatures_are_explained_by_what_they_are_computed_from(database: SubmapDatabase) -> None:
    """The histograms made again from what the page draws are those that the database has."""
    signature = Config().signature
    submaps = contents(database)["sessions"][0]["submaps"]
    for shown in submaps[::5]:
        drawn = shown["sources"]
        points = np.array(drawn["boundary"], np.int64).reshape(-1, 2)[:, ::-1]
        histogram = boundary_histogram(points, RADIUS_M, drawn["cell_m"], signature)
        assert np.allclose(histogram, shown["boundary"], atol=1e-4)
        nodes_m = (np.array(drawn["nodes"]).reshape(-1, 2) + 0.5) * drawn["cell_m"] + drawn["corner"]
        assert office().free[tuple(office().to_cell(nodes_m).T)].all()
        first, second = np.triu_indices(len(nodes_m), 1)
        bits = np.unpackbits(np.frombuffer(base64.b64decode(drawn["edges"]), np.uint8), bitorder="little")
        graph = nx.empty_graph(len(nodes_m))
        for a, b in zip(first[bits[: len(first)] == 1], second[bits[: len(first)] == 1], strict=True):
            graph.add_edge(int(a), int(b), length_m=math.dist(nodes_m[a], nodes_m[b]))
        paths = freespace_histogram(shortest_paths(graph), RADIUS_M, signature)
        assert np.allclose(paths, shown["freespace"], atol=1e-4)
    # The office's walls run along both axes of its map.
    angles = np.array([shown["sources"]["axes"] for shown in submaps if shown["sources"]["axes"]])
    along = np.abs((np.degrees(angles) + 45) % 90 - 45)
    assert np.median(along) < 2.0


def test_similar_places_are_the_nearest_in_the_database_but_not_those_around(
    database: SubmapDatabase,
) -> None:
    shown, table = contents(database)["sessions"][0]["submaps"], database.signatures()
    names = [info.name for info in database.sessions()]
    for row in np.flatnonzero(table.session_index == 0)[::7]:
        far_m = np.hypot(*(table.center_m - table.center_m[row]).T)
        near = {("office", int(k)) for k in table.submap_id[(table.session_index == 0) & (far_m < RADIUS_M)]}
        query = Signature(
            boundary=table.boundary[row], freespace=table.freespace[row], symmetry=table.symmetry[row]
        )
        order = np.argsort(distances(query, table), kind="stable")
        ranked = [(names[table.session_index[k]], int(table.submap_id[k])) for k in order]
        assert near <= set(ranked)
        wanted = [place for place in ranked if place not in near][:5]
        assert [(names[k], i) for k, i, _ in shown[row]["similar"]] == wanted


def test_a_page_about_an_answer_explains_the_maps_of_its_hypotheses(
    database: SubmapDatabase, found: Found
) -> None:
    there = {found.sessions[h.session_index] for h in found.hypotheses}
    for session_ in contents(database, found=found)["sessions"]:
        explained = [submap["sources"] is not None for submap in session_["submaps"]]
        assert set(explained) == {session_["name"] in there}


def test_a_map_of_nothing_still_has_a_page(tmp_path: Path) -> None:
    nothing = OccupancyGrid(cells=np.full((9, 9), -1, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    still = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    with open_database(stored(tmp_path / "x.submaps", session("x", nothing, still))) as opened:
        (only,) = contents(opened)["sessions"]
    assert only["submaps"] == [] and only["path"] == [] and only["graph"] == {"nodes": [], "edges": []}


def looked_at(
    browser: Browser, page: Path, size: tuple[int, int] = DESK, *, dark: bool = False, act: str = ""
) -> str:
    """The document after the script ran and a reader acted; fails on any message of the console."""
    browser.show(page.as_uri(), size, dark=dark)
    browser.evaluate(act)
    assert browser.complaints == []
    shown = re.sub(
        r"<script>.*?</script>", "", browser.evaluate("document.documentElement.outerHTML"), flags=re.S
    )
    assert "NaN" not in shown and "Infinity" not in shown and "undefined" not in shown
    return shown


LOOKS = pytest.mark.parametrize(
    ("size", "dark"), [(DESK, False), (DESK, True), (PHONE, False), (PHONE, True)]
)


def in_space(found: Found) -> Found:
    """The answer with a pose of six degrees of freedom."""
    T = np.eye(4)
    T[:3, 3] = 4.01, 3.02, 0.03
    variances = np.array([0.01, 0.01, 0.02, 0.003, 0.003, 0.003]) ** 2
    pose = PoseInSpace(
        status="agrees", T_map_base=T, covariance=np.diag(variances), rmse_m=0.02,
        rays=512, on=0.73, through=0.2, before=0.07,
    )  # fmt: skip
    return replace(found, in_space=pose)


@LOOKS
def test_a_browser_has_nothing_to_complain_about(
    database: SubmapDatabase,
    found: Found,
    tmp_path: Path,
    browser: Browser,
    size: tuple[int, int],
    dark: bool,
) -> None:
    write_report(tmp_path / "page.html", database, found=in_space(found))
    shown = looked_at(
        browser, tmp_path / "page.html", size, dark=dark, act="$('words').open = true; step(1);"
    )
    assert browser.evaluate("innerWidth") == size[0]
    for words in ("part.yaml in two.submaps", "submap centres", "query's wall: fits the map", ">overlap<"):
        assert words in shown
    assert "of the query's walls 100" in shown and "Of 512 rays of the query 73" in shown
    assert shown.count("<figcaption>") >= 6 and browser.evaluate("$('sessions').rows.length") == 3
    # Of the three loops that the first session came back by, off until they are wanted.
    for label in ("2 loops closed", "1 loop doubted"):
        assert re.search(rf'<label><input type="checkbox">(?:(?!<label>).)*?>{label}</span></label>', shown)
    behind = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    assert behind == ("rgb(20, 23, 26)" if dark else "rgb(255, 255, 255)")
    assert browser.faults() == []


def test_every_label_is_explained_under_the_pointer_and_in_the_list(answered: Path, browser: Browser) -> None:
    """No submap is shown until the reader chooses one."""
    assert '<g id="mark"></g>' in looked_at(browser, answered)
    shown = looked_at(browser, answered, act="$('next').click();")
    assert '<g id="mark"><circle' in shown and ">Submap 0<" in shown
    titles = browser.evaluate("[...document.querySelectorAll('#legend label span')].map(e => e.title)")
    told = browser.evaluate("[...document.querySelectorAll('#words dd')].map(e => e.textContent)")
    assert len(titles) > 5 and all(titles) and set(titles) <= set(told)
    heads = browser.evaluate(
        "[...document.querySelectorAll('#hypotheses th, #similar th')].map(e => e.title)"
    )
    assert {text for text in heads if text} <= set(told) and sum(map(bool, heads)) == 3
    # The words of layers that this page has not got are explained, too.
    layers = "[...Object.values(HEALTH).map(h => h[3]), ...SUPPORT.map(s => s[2])]"
    assert browser.evaluate(f"{layers}.length == 7 && {layers}.every(label => WORDS[label])")


def test_what_is_cut_small_or_faint_is_found(tmp_path: Path, browser: Browser) -> None:
    (tmp_path / "page.html").write_text(
        '<meta name="viewport" content="width=device-width"><p style="color: #aaa">faint</p>'
        '<div style="width: 400px">cut</div><svg class="chart" width="50" viewBox="0 0 100 9">'
        '<text y="9" style="font-size: 12px">small</text></svg>'
    )
    looked_at(browser, tmp_path / "page.html", PHONE)
    faults = browser.faults()
    assert {fault.split()[-1] for fault in faults} >= {"small", "faint"}
    assert any(fault.startswith("cut: <div") for fault in faults)


def test_the_pose_in_space_is_shown_with_all_that_the_terminal_says(
    database: SubmapDatabase, found: Found, answered: Path, tmp_path: Path, browser: Browser
) -> None:
    write_report(tmp_path / "page.html", database, found=in_space(found))
    looked_at(browser, tmp_path / "page.html")
    rows = browser.evaluate("[...$('six').rows].slice(1).map(r => [...r.cells].map(c => c.textContent))")
    assert [row[0] for row in rows] == ["x", "y", "z", "roll", "pitch", "yaw"]
    assert rows[2] == ["z", "0.030 m", "0.020 m"] and rows[3] == ["roll", "0.00°", "0.17°"]
    looked_at(browser, answered)
    assert browser.evaluate("$('space').hidden")


def test_the_place_under_the_pointer_is_named(database: SubmapDatabase, page: Path, browser: Browser) -> None:
    place = contents(database)["sessions"][0]["submaps"][3]["xy"]
    act = (
        f"const there = new DOMPoint({place[0]}, -({place[1]})).matrixTransform($('map').getScreenCTM());"
        " $('map').dispatchEvent(new PointerEvent('pointermove',"
        " { clientX: there.x, clientY: there.y, pointerId: 1 }));"
    )
    shown = looked_at(browser, page, act=act)
    x, y = (float(v) for v in re.findall(r'id="pointed"[^>]*>x (-?[\d.]+) m, y (-?[\d.]+) m<', shown)[0])
    assert math.hypot(x - place[0], y - place[1]) < 0.05


def test_each_warning_is_a_line_of_its_own(tmp_path: Path, browser: Browser) -> None:
    made = session("office", office(), way())
    warned = replace(made, report=replace(made.report, warnings=("first <warning>", "second")))
    with open_database(stored(tmp_path / "warned.submaps", warned)) as database:
        write_report(tmp_path / "page.html", database)
    shown = looked_at(browser, tmp_path / "page.html")
    assert "<li>office: first &lt;warning&gt;</li><li>office: second</li>" in shown


def points_drawn(shown: str) -> int:
    return sum(int(n) for n in re.findall(r'class="evidence" data-points="(\d+)"', shown))


def test_the_place_that_a_reader_chooses_is_the_one_weighed(
    database: SubmapDatabase, tmp_path: Path, browser: Browser
) -> None:
    """A query of a symmetric room fits it in both headings."""
    save_map(cut(plan(8, 5, []), 0.0, 0.0, 8.0, 5.0), tmp_path / "room")
    found = find(tmp_path / "room.yaml", database, Config())
    assert found.status == "ambiguous"
    write_report(tmp_path / "page.html", database, found=found)
    data = contents(database, found=found)["answer"]
    act = 'document.querySelectorAll("#hypotheses tr")[2].click();'
    shown = looked_at(browser, tmp_path / "page.html", act=act)
    assert "Place 2: of the query's walls" in shown
    second = data["hypotheses"][1]
    assert points_drawn(shown) == len(second["support"]) + len(second["missed"]) // 2


def test_the_submap_that_a_reader_chooses_is_explained_with_its_loops(
    database: SubmapDatabase, page: Path, browser: Browser
) -> None:
    first = contents(database)["sessions"][0]
    places_m = np.array([submap["xy"] for submap in first["submaps"]])
    ends_m = np.array([loop[:4] for loop in first["loops"]]).reshape(-1, 2, 2)
    nearest = np.linalg.norm(ends_m[:, :, None] - places_m, axis=-1).argmin(axis=-1)
    chosen = int(nearest[0, 0])
    own = int((nearest == chosen).any(axis=1).sum())
    act = f"pick(S.submaps.at({chosen} - 1)); $('next').click();"
    shown = looked_at(browser, page, act=act)
    submap = first["submaps"][chosen]
    assert f">Submap {submap['id']}<" in shown
    assert f"{own} loop{'s' if own > 1 else ''} from here" in shown and own < len(ends_m)
    bits = np.unpackbits(np.frombuffer(base64.b64decode(submap["sources"]["edges"]), np.uint8))
    assert f'id="graph" data-edges="{bits.sum()}"' in shown
    mark = shown[shown.index('<g id="mark">') :]
    assert mark.count("h.001") >= len(submap["sources"]["boundary"]) // 2
    assert "var(--yellow)" in mark[: mark.index("</svg>")]
    assert "Most similar places elsewhere" in shown
