"""Laser scans whose numbers no laser has, through a whole log."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import NoScans, Pc2GridError, PointCloudError
from pc2grid.model import ReadReport, Scan
from tests.helpers.recordings import STEP, T0, Message, read, ros, write_mcap

RANGES = np.linspace(2.0, 5.0, 180)


def scans_of(folder: Path, *messages: Message) -> tuple[list[Scan], ReadReport]:
    return read(write_mcap(folder / "a.mcap", messages))


def laser(i: int = 0, ranges: np.ndarray = RANGES, **options: object) -> Message:
    return ros().laser("/scan", T0 + i * STEP, ranges, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("angle_max", [0.0, -math.pi / 2, -3.0, 30.0, math.nan])
def test_a_wrong_angle_max_is_ignored_and_told(tmp_path: Path, angle_max: float) -> None:
    (right, wrong), report = scans_of(tmp_path, laser(0), laser(1, angle_max=angle_max))
    np.testing.assert_array_equal(right.points_m, wrong.points_m)
    assert any("angle_max is ignored" in w for w in report.warnings)


def test_angles_in_degrees_are_refused(tmp_path: Path) -> None:
    with pytest.raises(PointCloudError, match="span 179 rad, more than a turn") as caught:
        scans_of(tmp_path, laser(angles=(-90.0, 1.0)))
    assert "in radians" in str(caught.value.hint)
    whole_turn = laser(0, np.linspace(2.0, 5.0, 361), angles=(-math.pi, math.radians(1.0)))
    assert len(scans_of(tmp_path, whole_turn)[0][0].points_m) == 361


@pytest.mark.parametrize(
    "limits_m", [(math.nan, math.nan), (math.inf, math.nan), (0.0, 0.0), (0.0, math.inf)]
)
def test_limits_that_are_not_set(tmp_path: Path, limits_m: tuple[float, float]) -> None:
    """The same largest range of several beams is what the driver writes for no return."""
    ranges = np.where(np.arange(180) % 10 == 0, 81.91, RANGES)
    (scan,), report = scans_of(tmp_path, laser(0, ranges, limits_m=limits_m))
    assert len(scan.points_m) == 162
    assert scan.points_m.max() < 5.0
    assert not [w for w in report.warnings if "tf" not in w]


@pytest.mark.parametrize(
    ("ranges", "limits_m", "error", "words"),
    [
        (1000 * RANGES, (0.1, 80.0), NoScans, "every range lies outside the limits, 0.1 to 80 m"),
        (RANGES, (80.0, 0.1), NoScans, "every range lies outside the limits, 80 to 0.1 m"),
        (np.full(180, np.inf), (0.1, 80.0), NoScans, "nothing came back"),
        (np.full(180, np.nan), (math.nan, math.nan), NoScans, "nothing came back"),
        (np.zeros(180), (0.0, 80.0), NoScans, "nothing came back"),
        (100 * RANGES, (10.0, 8000.0), PointCloudError, "farther than 100 m; metres are expected"),
        (1000 * RANGES, (100.0, 80_000.0), PointCloudError, "farther than 100 m; metres are expected"),
        (np.r_[0.05, 1000 * RANGES[1:]], (0.01, 80.0), PointCloudError, "metres are expected"),
        (100 * RANGES, (math.nan, math.nan), PointCloudError, "metres are expected"),
    ],
)
def test_ranges_without_a_return(
    tmp_path: Path, ranges: np.ndarray, limits_m: tuple[float, float], error: type[Pc2GridError], words: str
) -> None:
    with pytest.raises(error, match=words) as caught:
        scans_of(tmp_path, *(laser(i, ranges, limits_m=limits_m) for i in range(3)))
    assert "metres" in str(caught.value.hint)


def test_a_single_scan_without_returns_is_an_empty_one(tmp_path: Path) -> None:
    (first, _), report = scans_of(tmp_path, laser(0, np.full(180, np.inf)), laser(1))
    assert len(first.points_m) == 0
    assert any("some scans hold no returns at all: nothing came back" in w for w in report.warnings)


def test_the_plane_of_a_laser_is_x_y_of_its_frame(tmp_path: Path) -> None:
    """Also of a frame that is called optical; one that stands upright on the robot draws no floor plan."""
    (plain,), _ = scans_of(tmp_path, laser())
    (optical,), _ = scans_of(tmp_path, laser(frame="camera_depth_optical_frame"))
    np.testing.assert_array_equal(plain.points_m, optical.points_m)
    mount = ros().tf(
        T0, "base_link", "camera_optical", 0.2, quaternion=(-0.5, 0.5, -0.5, 0.5), topic="/tf_static"
    )
    with pytest.raises(
        PointCloudError, match="the plane of the laser stands upright: x-y of frame camera_optical"
    ):
        scans_of(tmp_path, mount, laser(frame="camera_optical"))
