"""relocalize as a user of nav2 and Foxglove calls it: what it writes for a recording and for a map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from pc2grid_cli import console
from pc2grid_cli.main import app
from tests.helpers.nav2_map import spread_by_amcl, valid_for_nav2
from tests.helpers.rooms import RESOLUTION_M


def pc2grid(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""

    def command() -> Any:
        return app([str(a) for a in arguments], prog_name="pc2grid", standalone_mode=False)

    try:
        code = console.Console().run(command)
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


def messages(path: Path) -> dict[str, list[Any]]:
    """Decoded messages by topic."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        for _, channel, _, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def test_a_recording_gives_nav2_and_foxglove_the_same_pose(
    office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose, mcap, page = tmp_path / "pose.json", tmp_path / "answer.mcap", tmp_path / "page.html"
    options = ("--initialpose", pose, "--output", mcap, "--report", page, "--json")
    code, out, err = pc2grid(
        capsys, "relocalize", office_folder / "drive.mcap", "-d", office_folder / "b.submaps", *options
    )
    assert code == 0, err
    answer, initial = json.loads(out)["pose"], json.loads(pose.read_text())
    assert initial["header"]["frame_id"] == "map"
    stamp = initial["header"]["stamp"]
    assert stamp["sec"] * 10**9 + stamp["nanosec"] == answer["stamp_ns"]
    assert initial["pose"]["pose"]["position"] == {"x": answer["x"], "y": answer["y"], "z": 0.0}
    (told,) = messages(mcap)["/initialpose"]
    assert told.header.frame_id == "map"
    assert told.pose.pose.position.x == answer["x"] and told.pose.pose.position.y == answer["y"]
    for axis, value in initial["pose"]["pose"]["orientation"].items():
        assert getattr(told.pose.pose.orientation, axis) == pytest.approx(value)
    assert list(told.pose.covariance) == initial["pose"]["covariance"]
    assert valid_for_nav2(told)
    assert np.array_equal(spread_by_amcl(told), np.diag(np.diagonal(answer["covariance"])))
    (whole,) = messages(mcap)["/pose"]
    full = np.reshape(whole.pose.covariance, (6, 6))
    assert np.array_equal(full[np.ix_((0, 1, 5), (0, 1, 5))], answer["covariance"])
    assert np.array_equal(full[2:5, 2:5], 1e6 * np.eye(3)) and np.count_nonzero(full) == 12
    assert '"status":"located"' in page.read_text(encoding="utf-8")


def test_a_map_is_located_and_laid_over_the_other(
    office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mcap = tmp_path / "answer.mcap"
    where = ("relocalize", office_folder / "part.yaml", "-d", office_folder / "b.submaps")
    code, out, err = pc2grid(capsys, *where, "--output", mcap, "--json")
    assert code == 0, err
    document = json.loads(out)
    assert document["status"] == "located" and document["query"]["sensor"] == "map"
    assert (document["T_map_odom"]["x"], document["T_map_odom"]["y"]) == pytest.approx(
        (4, 3), abs=RESOLUTION_M
    )
    told = messages(mcap)
    assert told["/query_map"][0].header.frame_id == "query_map"
    (edge,) = told["/tf_static"][0].transforms
    assert (edge.header.frame_id, edge.child_frame_id) == ("map", "query_map")
    assert (edge.transform.translation.x, edge.transform.translation.y) == pytest.approx(
        (4, 3), abs=RESOLUTION_M
    )
    assert "/initialpose" not in told
    code, out, err = pc2grid(capsys, *where)
    assert code == 0 and out.startswith("located in office: x 4.0") and "travel" not in out


@pytest.mark.parametrize("option", ["--initialpose", "--trajectory"])
def test_a_map_has_no_robot_to_write_about(
    option: str, office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "x"
    code, out, err = pc2grid(
        capsys, "relocalize", office_folder / "part.yaml", "-d", office_folder / "b.submaps", option, target
    )
    assert code == 2 and out == "" and option in err and not target.exists()


def test_no_answer_no_pose_but_a_page(
    office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose, page = tmp_path / "pose.json", tmp_path / "page.html"
    options = ("--duration", "1", "--set", "relocalize.accept=0.999999", "--initialpose", pose)
    code, _, err = pc2grid(
        capsys,
        "relocalize",
        office_folder / "drive.mcap",
        "-d",
        office_folder / "b.submaps",
        *options,
        "--report",
        page,
    )
    assert code == 4 and not pose.exists() and "not written" in err
    assert '"status":"located"' not in page.read_text(encoding="utf-8")


def test_export_writes_a_page_and_does_not_overwrite_it(
    office_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    assert pc2grid(capsys, "export", office_folder / "b.submaps", "--report", page)[0] == 0
    before = page.read_bytes()
    code, _, err = pc2grid(capsys, "export", office_folder / "b.submaps", "--report", page)
    assert code == 1 and "--force" in err and page.read_bytes() == before
