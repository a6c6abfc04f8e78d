"""The catalogue of real recordings names what there is."""

import os
import re
from itertools import combinations
from pathlib import Path

import pytest

from pc2grid_lab.recordings.catalogue import (
    FOREIGN_MAPS,
    NOT_ALIKE,
    PAIR_KINDS,
    PAIRS,
    RECORDINGS,
    Catalogue,
    evenly_spaced,
    own_recordings,
    state_of,
)
from tests.helpers.recordings import STEP, T0, ros, write_mcap

DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).resolve().parents[4] / ".." / "shared" / "data"))
needs_data = pytest.mark.skipif(not (DATA / "README.md").is_file(), reason="PC2GRID_DATA is not there")
_MAPPED = (".mcap", ".bag", ".ply", ".yaml")


@needs_data
def test_every_recording_and_map_of_the_data_is_in_the_catalogue() -> None:
    there = {str(file.relative_to(DATA)) for file in DATA.rglob("*") if file.suffix in _MAPPED}
    assert there == {recording.file for recording in RECORDINGS}


@needs_data
def test_the_catalogue_names_only_files_that_the_data_describes() -> None:
    named = {r.file for r in RECORDINGS} | {f for r in RECORDINGS for f in (r.truth, r.poses) if f}
    assert all((DATA / file).is_file() for file in named)
    text = (DATA / "README.md").read_text()
    for file in sorted(named):
        folder, stem = Path(file).parent.name, re.sub(r"(_corrected)?\.[a-z_0-9]+$", "", Path(file).name)
        words = (stem, stem.rstrip("123ab"), f"`_{stem.rpartition('_')[2]}.")  # of several, only how they end
        assert folder in text and any(word in text for word in words), file


def test_names_are_unique_and_pairs_name_recordings() -> None:
    names = [recording.name for recording in RECORDINGS]
    assert len(set(names)) == len(names)
    keys = [(pair.kind, pair.query, pair.map_name) for pair in PAIRS]
    assert len(set(keys)) == len(keys)
    known = {recording.name: recording for recording in RECORDINGS}
    for pair in PAIRS:
        buildings = {known[name].building for name in (pair.query, pair.map)}
        assert (len(buildings) == 2) == (pair.kind == "elsewhere"), pair
        assert pair.kind == "disturbed" or (pair.until_s is not None) == (pair.kind == "later part"), pair
        files = {known[name].file for name in (pair.query, pair.map)}
        if pair.kind in ("later part", "same recording"):
            assert len(files) == 1, pair
        else:
            assert pair.query != pair.map, pair
    assert {pair.kind for pair in PAIRS} == set(PAIR_KINDS)


def test_all_maps_of_one_building_are_compared_and_each_with_some_of_others() -> None:
    joins = Catalogue.of().joins
    building = {recording.name: recording.building for recording in RECORDINGS}
    names = {name for pair in joins for name in pair}
    same = {pair for pair in joins if building[pair[0]] == building[pair[1]]}
    others = [name for pair in {*joins} - same for name in pair]
    assert len({frozenset(pair) for pair in joins}) == len(joins) and {*NOT_ALIKE} <= {*joins}
    assert not any("disturbed" in name for name in names)
    assert len(same) == sum(building[a] == building[b] for a, b in combinations(names, 2))
    assert "wean.yaml" in names and not any("without" in name or "every" in name for name in names)
    assert min(others.count(name) for name in names) >= FOREIGN_MAPS


def test_the_quick_form_is_a_part_of_all() -> None:
    whole, quick = Catalogue.of(), Catalogue.of(quick=True)
    assert set(quick.pairs) < set(whole.pairs) and set(quick.mapped) < set(whole.mapped)
    for pair in quick.pairs:
        few, all_ = quick.windows(pair, 300.0), whole.windows(pair, 300.0)
        assert set(few) < set(all_)
    assert {pair.kind for pair in quick.pairs} == set(PAIR_KINDS)


def test_only_names_recordings_buildings_sensors_and_kinds() -> None:
    assert [r.name for r in Catalogue.of(only="wean ?").mapped] == ["wean 1", "wean 2", "wean 3"]
    assert {r.sensor for r in Catalogue.of(only="depth").mapped} == {"depth"}
    assert {p.kind for p in Catalogue.of(only="elsewhere").pairs} == {"elsewhere"}
    assert not Catalogue.of(only="nothing").mapped


def test_windows_begin_where_commands_are_told_to() -> None:
    catalogue = Catalogue.of()
    starts = [w.start_s for pair in catalogue.pairs for _, w in catalogue.windows(pair, 1000.0 / 3.0)]
    assert all(start == float(f"{start:.3f}") for start in starts)


def test_windows_are_spread_over_the_time_left() -> None:
    spans = evenly_spaced(600.0, 1060.0, 10, 40.0)
    assert [span.start_s for span in spans[:2]] == pytest.approx([600.0, 600.0 + 420.0 / 9])
    assert {span.duration_s for span in spans} == {40.0} and spans[-1].start_s == pytest.approx(1020.0)
    assert len({span.start_s for span in evenly_spaced(100.0, 110.0, 3, 40.0)}) == 1


def test_windows_of_a_later_part_come_after_the_map() -> None:
    catalogue = Catalogue.of(only="later part")
    for pair in catalogue.pairs:
        assert pair.until_s is not None
        assert catalogue.windows(pair, pair.until_s + 60.0)[0][1].start_s == pair.until_s


# --- Recordings of a folder that the catalogue does not name ---


def record(path: Path) -> None:
    """A laser that stands still for 17.5 s."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_mcap(path, [ros().laser("/scan", T0 + i * STEP, [1.0] * 10) for i in range(176)])


def test_recordings_are_found_with_the_truth_beside_them(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap")
    record(tmp_path / "house" / "b.mcap")
    record(tmp_path / "out" / "made.mcap")
    record(tmp_path / next(r.file for r in RECORDINGS if r.file.endswith(".mcap")))
    (tmp_path / "torn.bag").write_bytes(b"no recording")
    for truth in ("a.tum", "a.relations", "house/b.tum"):
        (tmp_path / truth).write_text("")
    recordings, pairs = own_recordings(tmp_path, without=tmp_path / "out", of_base=True)
    found = {r.name: (r.building, r.sensor, r.truth, r.poses) for r in recordings}
    assert found == {
        "a.mcap": (tmp_path.name, "laser", "a.relations", "a.tum"),
        "house/b.mcap": ("house", "laser", "house/b.tum", "house/b.tum"),
        "torn.bag": (tmp_path.name, "unknown", None, None),
    }
    assert all(recording.of_base and recording.quick for recording in recordings)
    first, second = pairs
    assert (first.query, first.map_name, second.query) == ("a.mcap", "a.mcap 0..8.8 s", "house/b.mcap")
    assert (first.window_s, first.windows) == (4.3, 4)


def test_recordings_of_one_folder_are_asked_in_each_others_maps(tmp_path: Path) -> None:
    for name in ("home/monday.mcap", "home/tuesday.mcap", "office/monday.mcap"):
        record(tmp_path / name)
    _, pairs = own_recordings(tmp_path, without=tmp_path / "out", of_base=False)
    asked = [(pair.kind, pair.query, pair.map, pair.until_s) for pair in pairs]
    assert asked == [
        ("later part", "home/monday.mcap", "home/monday.mcap", 8.8),
        ("other day", "home/monday.mcap", "home/tuesday.mcap", None),
        ("later part", "home/tuesday.mcap", "home/tuesday.mcap", 8.8),
        ("other day", "home/tuesday.mcap", "home/monday.mcap", None),
        ("later part", "office/monday.mcap", "office/monday.mcap", 8.8),
    ]
    assert {(pair.window_s, pair.windows) for pair in pairs if pair.until_s is None} == {(8.8, 4)}


def test_a_recording_that_changed_is_another_one(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap")
    recordings, _ = own_recordings(tmp_path, without=tmp_path / "out", of_base=False)
    before = state_of(tmp_path, recordings)
    assert before and before == state_of(tmp_path, recordings) and not state_of(tmp_path, [])
    (tmp_path / "a.mcap").write_bytes(b"")
    assert state_of(tmp_path, recordings) != before
