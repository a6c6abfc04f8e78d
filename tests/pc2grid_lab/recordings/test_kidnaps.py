"""What is said of a robot that is carried away, from the looks of `watch`."""

from pathlib import Path

from pc2grid.io.recording import open_log
from pc2grid_lab.recordings.judging import Look, followed_row
from pc2grid_lab.recordings.run import write_part
from pc2grid_lab.recordings.table import FollowedRow
from tests.helpers.recordings import laser_drive, write_mcap

ROW = FollowedRow(before="a", after="b", map="c", building="x", shown=True)
KNOWS = [Look("searching", None), Look("located", True), Look("doubtful", None), Look("located", True)]
"""Before it is carried away."""


def look(since_s: float, state: str, right: bool | None = None) -> Look:
    return Look(state, right, since_s, 0.3 * since_s, carried=True)


def test_a_kidnap_is_noticed_by_the_first_look_that_gives_the_old_place_up() -> None:
    after = [look(1, "located", False), look(2, "doubtful"), look(3, "lost"), look(5, "recovered", True)]
    row = followed_row(ROW, [*KNOWS, *after, look(6, "located", True)])
    assert (row.noticed_s, row.noticed_m, row.located_s, row.located_m) == (3, 0.3 * 3, 5, 1.5)
    assert (row.located, row.judged, row.wrong, row.alarms) == (4, 4, 0, 0)


def test_a_kidnap_that_nothing_notices_is_neither_noticed_nor_located_again() -> None:
    row = followed_row(ROW, [*KNOWS, *(look(s, "located", False) for s in (1, 2, 3))])
    assert row.knew and row.noticed_s is None and row.located_s is None


def test_a_wrong_place_after_it_is_wrong_and_the_right_one_counts_later() -> None:
    row = followed_row(ROW, [*KNOWS, look(2, "recovered", False), look(4, "located", True)])
    assert (row.noticed_s, row.located_s, row.wrong) == (2, 4, 1)


def test_who_is_given_up_though_nobody_carried_it_away_raises_an_alarm() -> None:
    given_up = [Look("lost", None, alarm=True), Look("lost", None), Look("recovered", True)]
    assert followed_row(ROW, [*KNOWS, *given_up]).alarms == 1
    assert followed_row(ROW, [*KNOWS, Look("lost", None)]).alarms == 0  # it has left the map


def test_a_robot_that_did_not_know_where_it_was_can_notice_nothing() -> None:
    row = followed_row(ROW, [Look("searching", None), look(1, "searching"), look(2, "located", True)])
    assert not row.knew and row.noticed_s is None and row.located == 1


def test_a_drive_is_located_by_the_first_look_that_is_not_wrong() -> None:
    looks = [
        Look("searching", None, 2.0, 0.0),
        Look("located", False, 5.0, 1.0),
        Look("located", True, 8.0, 2.0),
        Look("doubtful", None, 11.0, 3.0),
    ]
    row = followed_row(FollowedRow(before="a", after=None, map="c", building="x"), looks)
    assert (row.located_s, row.located_m, row.noticed_s) == (8.0, 2.0, None)
    assert (row.looks, row.located, row.wrong) == (4, 2, 1)


def test_the_later_part_of_a_recording_has_its_odometry(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "whole.mcap", laser_drive(count=40))
    write_part(whole, 3.0, tmp_path / "part.mcap")
    with open_log(whole) as log, open_log(tmp_path / "part.mcap") as part:
        scans, later = list(log.scans()), list(part.scans())
    assert len(later) == 10 and later[0].stamp_ns == scans[30].stamp_ns
    assert all(scan.T_odom_base is not None for scan in later)
