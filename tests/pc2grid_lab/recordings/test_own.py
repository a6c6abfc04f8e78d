"""Recordings of a folder that the catalogue does not name."""

from __future__ import annotations

from pathlib import Path

from pc2grid_lab.recordings.catalogue import RECORDINGS, own_recordings, state_of
from tests.helpers.recordings import STEP, T0, ros, write_mcap


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
