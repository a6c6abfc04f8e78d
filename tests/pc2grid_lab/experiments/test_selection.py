"""The comparison of ways to select places."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.geometry import SE2
from pc2grid_cli.json_schemas import schema
from pc2grid_cli.main import app
from pc2grid_lab.compare import signatures as compare_signatures
from pc2grid_lab.experiments.ablation import seen_independence
from pc2grid_lab.experiments.selection import (
    ALL,
    LOCATED_BY,
    RANDOM,
    SELECTORS,
    SHUFFLED,
    SIGNATURES,
    Selection,
    SelectionTrial,
    tally,
)
from pc2grid_lab.experiments.sensor_map import SensorMap
from signature.localization.query import Query
from signature.seen_places import SIGNATURE_COLUMNS, SeenPlaces
from tests.helpers.json_schema import closed
from tests.helpers.simulated_drives import building, drive, office, plan

OFFICE = building({"office": office()})


def query() -> tuple[object, SE2]:
    """What a drive of 8 m in the office has seen, and its frame there."""
    window = Query(OFFICE.made_with, OFFICE.config)
    first: SE2 | None = None
    for registered, planar_scan, truth in drive(office(), [(1.5, 7.0), (9.5, 7.0)]):
        first = first or truth
        window.add(registered, planar_scan)
    assert first is not None
    return window.map(), first


def test_each_selector_looks_at_its_share_and_all_places_find_the_right_one() -> None:
    seen, T_map_query = query()
    selection = Selection(OFFICE, "building", 0.3)
    found = {row[0]: row[1:] for row in selection.measure(seen, T_map_query)}  # type: ignore[arg-type]
    assert tuple(found) == SELECTORS
    places = len(OFFICE.places.table)
    for selector, (looked_at, hit, located, right, processor_ms) in found.items():
        assert looked_at == places if selector == ALL else 0 < looked_at <= 0.3 * places + 1
        assert (located is None) == (selector not in LOCATED_BY)
        assert right is None or located or not right
        assert processor_ms > 0 and isinstance(hit, bool)
    assert found[ALL][1] and found[SIGNATURES][1]
    assert found[ALL][3]


def test_places_are_selected_without_locating_the_query() -> None:
    seen, T_map_query = query()
    selection = Selection(OFFICE, "building", 0.3)
    rows = list(selection.measure(seen, T_map_query, (ALL, SIGNATURES), locate=False))  # type: ignore[arg-type]
    assert [row[0] for row in rows] == [ALL, SIGNATURES]
    assert all(row[2] and row[3] is None and row[4] is None for row in rows)


def made_up_floor(seed: int, _: object) -> SeenPlaces:
    """500 places that look like nothing."""
    rng, columns = np.random.default_rng(seed), SIGNATURE_COLUMNS
    return SeenPlaces(
        at_m=rng.uniform(0, 20, (500, 2)).astype(np.float32),
        place=np.arange(500),
        signatures=rng.integers(200, 256, (500, columns)).astype(np.uint8),
    )


def test_a_query_from_elsewhere_is_not_counted() -> None:
    seen, T_map_query = query()
    far = SE2(500.0, 0.0, 0.0) @ T_map_query
    assert not list(Selection(OFFICE, "building", 0.3).measure(seen, far))  # type: ignore[arg-type]


def test_shares_have_intervals_by_session() -> None:
    one = SelectionTrial(
        plan="a", query_sensor="laser", seed=0, travel_m=1.0, scope="city", places=100, selector=ALL,
        looked_at=5, found=True, located=True, right=True, processor_ms=3.0,
    )  # fmt: skip
    trials = [replace(one, seed=k, found=k < 15, located=k < 12, right=k < 10) for k in range(20)]
    (row,) = tally(trials)
    share, low, high = row["found"]  # type: ignore[misc]
    assert share == 0.75 and low < 0.75 < high and high - low < 0.4
    assert row["right"][0] == 0.5 and row["wrong"] == pytest.approx(0.1)  # type: ignore[index]
    assert row["sessions"] == 20


def test_equal_maps_by_two_sensors_are_one_place_and_independent_maps_are_not() -> None:
    grid = plan(10, 8, [(4, 0, 4, 5), (6, 3, 10, 3), (6, 5, 6, 8)])
    maps = [
        SensorMap(name="a", sensor=sensor, T_plan_map=SE2(), index=building({"a": grid}))
        for sensor in ("lidar", "laser")
    ]
    shifted = [maps[0], replace(maps[1], T_plan_map=SE2(3.0, 0.0, 0.0))]
    right, wrong = seen_independence([maps], draws=20), seen_independence([shifted], draws=20)
    whole = "boundary+freespace+symmetry"
    auc, low, high, same, other = right[whole]
    assert auc > 0.95 and low <= auc <= high and same and other
    assert wrong[whole][0] < auc - 0.1


def test_the_command_uses_what_it_has_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = plan(12, 10, [(4, 0, 4, 6), (6, 4, 12, 4), (6, 6, 6, 10)])
    monkeypatch.setattr(compare_signatures, "_plan", lambda _: grid)
    monkeypatch.setattr(compare_signatures, "_city", lambda *_: tmp_path / "city")
    monkeypatch.setattr(compare_signatures, "with_floors", lambda own, *_: own.index)
    monkeypatch.setattr(compare_signatures, "described_floor", made_up_floor)
    monkeypatch.setattr(compare_signatures, "_FLOORS_AT_ONCE", 3)
    arguments = ["compare", "signatures", "a.yaml", "--queries", "1", "--map-length", "12", "--rate", "2"]
    arguments += ["--clutter", "0", "--change", "0", "--share", "0.3", "-o", str(tmp_path), "--json"]
    first = CliRunner().invoke(app, [*arguments, "--scale", "2000"])
    assert first.exit_code == 0, first.output
    document = json.loads(first.stdout)
    jsonschema.validate(document, closed(schema("compare-signatures")))
    assert document["plans"] == ["a"] and (tmp_path / "signatures.png").stat().st_size > 10_000
    assert {row["scope"] for row in document["rows"]} == {"building", "city"}
    nearly_all = [
        row
        for row in document["scale"]
        if row["share"] == 0.05 and row["travel_m"] == 8.0 and row["selector"] == SIGNATURES
    ]
    assert nearly_all and all(row["found"][0] == 1.0 for row in nearly_all)
    assert {row["places"] for row in document["scale"]} == {2000}
    assert {row["selector"] for row in document["scale"]} == {SIGNATURES, SHUFFLED, RANDOM}
    monkeypatch.setattr(compare_signatures, "_select", None)  # nothing is selected again
    assert json.loads(CliRunner().invoke(app, arguments).stdout)["rows"] == document["rows"]
    table = CliRunner().invoke(app, [a for a in arguments if a != "--json"])
    assert table.exit_code == 0 and "random" in table.stdout and "all places" in table.stdout


def test_a_plan_that_does_not_exist_is_named() -> None:
    for name, text in (("office:x", "the seed is not a number"), ("nowhere.yaml", "no such file")):
        error = CliRunner().invoke(app, ["compare", "signatures", name]).exception
        assert error is not None and text in str(error)
