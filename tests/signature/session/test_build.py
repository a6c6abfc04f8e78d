"""From a recording to a session map."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import NoScans, TrackingLost
from pc2grid.estimation.tracker import follow
from pc2grid.geometry import SE2, invert_pose
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import Health, OccupancyGrid, RegisteredScan, Scan, Trajectory
from pc2grid.observer import Observer, TimeSpan
from pc2grid.simulate import SimulationConfig, prepare_session, simulate_session
from pc2grid.simulate.config import LaserConfig
from pc2grid.simulate.session import Session
from pc2grid_lab.truth import read_relations, relation_errors
from signature.config import Config
from signature.session.build import build_map, build_maps, map_scans
from signature.session.part_maps import check_followed, lost_warnings
from tests.helpers.field import DATA
from tests.helpers.rooms import RESOLUTION_M

Mapped = tuple[Session, list[tuple[Scan, SE2]], OccupancyGrid, Trajectory]
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="PC2GRID_DATA is not there")


class News(Observer):
    """Keeps all scans and shares of progress."""

    def __init__(self) -> None:
        self.scans: list[RegisteredScan] = []
        self.shares: list[float] = []

    def on_scan(self, registered: RegisteredScan) -> None:
        self.scans.append(registered)

    def on_progress(self, share: float) -> None:
        self.shares.append(share)


def ate_m(positions: np.ndarray, truth: np.ndarray) -> float:
    """RMS distance (N, D) after the best rigid alignment."""
    a, b = positions - positions.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    fix = np.ones(a.shape[1])
    fix[-1] = np.sign(np.linalg.det(U @ Vt))
    return float(np.sqrt((((a @ (U @ np.diag(fix) @ Vt).T) - b) ** 2).sum(axis=1).mean()))


def test_a_laser_that_is_lost_too_often_gives_no_map() -> None:
    def trajectory(lost: int) -> Trajectory:
        health = [Health.FINE] * (10 - lost) + [Health.LOST] * lost
        return Trajectory(
            stamps_ns=np.arange(10) * 10**9,
            T_session_base=np.tile(np.eye(4), (10, 1, 1)),
            health=tuple(health),
        )

    check_followed(trajectory(2), "log")
    with pytest.raises(TrackingLost, match=r"log: 3 of 10 scans .* first 7\.0 s after .* no odometry"):
        check_followed(trajectory(3), "log")


@pytest.fixture(scope="module")
def session() -> Session:
    return prepare_session(sensor="laser", config=SimulationConfig(length_m=20.0, seed=6, clutter=10))


@pytest.fixture(scope="module")
def mapped(session: Session) -> Mapped:
    pairs = list(session.scans())
    news = News()
    grid, trajectory, _ = map_scans((scan for scan, _ in pairs), Config(), news)
    assert [registered.scan.stamp_ns for registered in news.scans] == trajectory.stamps_ns.tolist()
    return session, pairs, grid, trajectory


def test_trajectory_and_grid_agree_with_the_true_plan(mapped: Mapped) -> None:
    session, pairs, grid, trajectory = mapped
    truth = np.array([(p.x, p.y) for _, p in pairs])
    assert ate_m(trajectory.planar()[:, :2], truth) < RESOLUTION_M
    first = pairs[0][1]
    rows, columns = np.nonzero(grid.free)
    inside = session.grid.to_cell(first.apply(grid.to_point(np.column_stack((rows, columns)))))
    walls_called_free = session.grid.occupied[inside[:, 0], inside[:, 1]].mean()
    assert walls_called_free < 0.02
    assert grid.free.sum() * grid.resolution_m**2 > 20.0
    assert (grid.cells == -1).any()


def test_the_robot_drove_through_free_cells(mapped: Mapped) -> None:
    _, _, grid, trajectory = mapped
    cells = grid.to_cell(trajectory.planar()[:, :2])
    assert grid.free[cells[:, 0], cells[:, 1]].mean() >= 0.99


def test_follow_streams_one_planar_scan_a_scan(session: Session) -> None:
    pairs = [pair for pair, _ in zip(session.scans(), range(5), strict=False)]
    followed = list(follow((scan for scan, _ in pairs), Config()))
    assert [planar_scan.stamp_ns for _, planar_scan in followed] == [scan.stamp_ns for scan, _ in pairs]
    assert all(registered.health is Health.FINE for registered, _ in followed)


@pytest.fixture(scope="module")
def floors(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Drives of 10 m on two floors."""
    laser = LaserConfig(rate_hz=5.0, step_deg=1.0)
    return [
        simulate_session(
            tmp_path_factory.mktemp("floor") / "drive.mcap",
            sensor="laser",
            config=SimulationConfig(length_m=10.0, seed=floor, building_seed=floor, laser=laser),
        ).path
        for floor in (1, 2)
    ]


def test_the_map_of_a_robot_that_was_carried_elsewhere_is_warned_of(
    floors: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its driver started again there, on another floor, five minutes later, and tracking was never lost."""
    with open_log(floors[0]) as first, open_log(floors[1]) as second:
        alone = build_map(second, session="alone")
        upstairs = list(second.scans())
        begin_ns = first.info.end_ns + 300 * 10**9
        later = [replace(scan, stamp_ns=scan.stamp_ns - upstairs[0].stamp_ns + begin_ns) for scan in upstairs]
        scans = [*first.scans(), *later]
        monkeypatch.setattr(first, "scans", lambda *_: iter(scans))
        (made,) = build_maps(first, session="robot")
    assert len(made.trajectory) == len(scans)
    assert any("contradicts itself" in warning for warning in made.report.warnings)
    assert not any("contradicts itself" in warning for warning in alone.report.warnings)


def test_a_ride_in_a_lift_gives_a_map_for_each_floor(
    floors: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its odometry stands still, and for four seconds it looks at another floor before it drives on."""
    with open_log(floors[0]) as log, open_log(floors[1]) as second:
        scans, up = list(log.scans()), list(second.scans())
        below, begin_ns = scans[-1], scans[-1].stamp_ns + 2 * 10**8
        assert below.T_odom_base is not None and up[0].T_odom_base is not None
        T = below.T_odom_base @ invert_pose(up[0].T_odom_base)
        waits = [replace(up[0], stamp_ns=up[0].stamp_ns + (k - 20) * 2 * 10**8) for k in range(20)]
        for scan in (*waits, *up):
            assert scan.T_odom_base is not None
            stamp_ns = begin_ns + 4 * 10**9 + scan.stamp_ns - up[0].stamp_ns
            scans.append(replace(scan, stamp_ns=stamp_ns, T_odom_base=T @ scan.T_odom_base))
        monkeypatch.setattr(log, "scans", lambda *_: iter(scans))
        first, above = build_maps(log, session="robot")
    (said,) = [text for text in first.report.warnings if "falls into" in text]
    words = r"before (\d+) s after the first scan all walls changed .* cut the recording there"
    found = re.search(words, said)
    assert found is not None
    rode_s = (begin_ns - scans[0].stamp_ns) * 1e-9
    assert rode_s + 3.0 < int(found[1]) < rode_s + 6.0
    assert not any("contradicts itself" in text for part in (first, above) for text in part.report.warnings)


@pytest.mark.parametrize(("rise_m", "warned"), [(3.0, True), (-3.0, True), (0.5, False)])
def test_a_recording_that_leaves_its_floor_is_to_be_cut(
    floors: list[Path], monkeypatch: pytest.MonkeyPatch, rise_m: float, warned: bool
) -> None:
    """Its odometry rises in the middle; before the first reading there is no height."""
    with open_log(floors[0]) as log:
        scans = list(log.scans(0.0, 8.0))
        for k in range(1, len(scans)):
            T_odom_base = np.array(scans[k].T_odom_base)
            T_odom_base[2, 3] = 7.0 + rise_m * (k > len(scans) // 2)
            scans[k] = replace(scans[k], T_odom_base=T_odom_base)
        scans[0] = replace(scans[0], T_odom_base=None)
        monkeypatch.setattr(log, "scans", lambda *_: iter(scans))
        (mapped,) = build_maps(log, session="drive")
    said = [text for text in mapped.report.warnings if "the height changes by 3.0 m" in text]
    assert len(said) == warned and all("--start" in text and "--floor" in text for text in said)


def test_no_scans_no_trajectory() -> None:
    grid, trajectory, loops = map_scans(iter(()), Config())
    assert grid.cells.size == 0 and len(trajectory) == 0 and loops == ()


@pytest.mark.nightly
@needs_data
def test_the_hall_with_its_turns_of_forty_degrees() -> None:
    with open_log(DATA / "lidar" / "hall.mcap") as log:
        built = build_map(log, Config(), session="hall")
    truth = read_tum(DATA / "lidar" / "hall.tum")
    index = [int(np.argmin(np.abs(built.trajectory.stamps_ns - stamp))) for stamp in truth.stamps_ns]
    assert ate_m(built.trajectory.T_session_base[index, :3, 3], truth.T_session_base[:, :3, 3]) < 0.03
    assert built.submaps and not built.report.scans_skipped
    assert built.consistency is not None and not built.consistency.bent


@needs_data
def test_a_minute_of_fr079_meets_the_benchmark() -> None:
    with open_log(DATA / "laser" / "fr079.mcap") as log:
        news = News()
        built = build_map(log, Config(), session="fr079", span=TimeSpan(0.0, 60.0), observer=news)
    relations = read_relations(DATA / "laser" / "fr079.relations")
    errors = relation_errors(built.trajectory, relations, SE2(0.04, 0.0, 0.0))
    off_m, turned_rad = errors.mean(axis=0)
    assert len(errors) > 20 and off_m < 0.056 and math.degrees(turned_rad) < 1.0
    assert news.shares == sorted(news.shares) and news.shares[-1] == 1.0
    assert built.trajectory.T_session_base[0] == pytest.approx(np.eye(4), abs=1e-9)


@needs_data
def test_a_part_without_scans_is_an_error() -> None:
    with open_log(DATA / "laser" / "fr079.mcap") as log, pytest.raises(NoScans):
        build_map(log, Config(), session="nothing", span=TimeSpan(10_000.0, 5.0))


def test_a_query_is_told_how_much_of_it_counts() -> None:
    fine, lost = Health.FINE, Health.LOST
    assert lost_warnings([fine] * 3) == []
    (warning,) = lost_warnings([fine, lost, fine, lost, fine, fine, fine])
    assert warning.startswith("2 of 7 scans could not be followed, so only the last 3 count")
