"""`relocalize --near`, `--near-pose`, `--check` and `--check-topic`, as a user types them."""

import json
import math
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml
from click.testing import Result
from mcap.reader import make_reader
from mcap.writer import Writer
from typer.testing import CliRunner

from pc2grid.geometry import SE2
from pc2grid.io.map_pose import initialpose, read_pose
from pc2grid.io.maps import save_map
from pc2grid_cli.console import Console
from pc2grid_cli.known_pose import as_text
from pc2grid_cli.main import app
from pc2grid_cli.output import schema
from signature.localization.pose_check import CheckStatus, PoseCheck
from tests.helpers.field import field_log
from tests.helpers.json_schema import closed
from tests.helpers.recordings import ros
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import BENT, TWINS, plan

LEFT_ROOM = plan(6, 6, BENT)


def pc2grid(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], obj=Console())


def quaternion(yaw_rad: float) -> tuple[float, float]:
    return math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)


@shared_folder()
def twins(folder: Path) -> None:
    """twins.submaps: two rooms that are alike; drive.mcap, a laser in the left one, with what its
    localization believed on /initialpose (right, at the start) and /amcl_pose (wrong, at the end)."""
    save_map(TWINS, folder / "twins")
    save_map(LEFT_ROOM, folder / "left")
    assert pc2grid("convert", folder / "twins.yaml", "-o", folder / "twins.submaps").exit_code == 0
    laser = ("--sensor", "laser", "--length", 4, "--seed", 3, "--clutter", 0)
    assert pc2grid("simulate", folder / "left.yaml", folder / "plain.mcap", *laser).exit_code == 0
    (start_ns, first), *_, (end_ns, last) = true_poses(folder)
    covariance = np.diag([0.25, 0.25, 0, 0, 0, 0.07])
    believed = [("/initialpose", start_ns, first), ("/amcl_pose", end_ns, last @ SE2(0.8, 0.0, 0.0))]
    with (folder / "plain.mcap").open("rb") as source, (folder / "drive.mcap").open("wb") as target:
        writer = Writer(target)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        kind = "geometry_msgs/PoseWithCovarianceStamped"
        number = writer.register_schema(
            "geometry_msgs/msg/PoseWithCovarianceStamped", "ros2msg", ros().schema(kind)
        )
        for topic, stamp_ns, pose in believed:
            z, w = quaternion(pose.yaw)
            make = ros().make
            content = make(
                "geometry_msgs/Pose",
                make("geometry_msgs/Point", pose.x, pose.y, 0.0),
                make("geometry_msgs/Quaternion", 0.0, 0.0, z, w),
            )
            full = make("geometry_msgs/PoseWithCovariance", content, covariance.reshape(-1))
            data = ros().message(topic, stamp_ns, make(kind, ros().header(stamp_ns, "map"), full)).data
            writer.add_message(writer.register_channel(topic, "cdr", number), stamp_ns, data, stamp_ns)
        writer.finish()


def true_poses(folder: Path) -> list[tuple[int, SE2]]:
    """Stamp and pose of each scan of drive.mcap."""
    rows = np.loadtxt(folder / "plain.tum")
    return [(round(p[0] * 1e9), SE2(p[1], p[2], 2.0 * math.atan2(p[6], p[7]))) for p in rows]


@pytest.fixture
def rooms(twins: Path) -> tuple[Path, SE2]:
    """The folder, and the true pose at the end of drive.mcap."""
    return twins, true_poses(twins)[-1][1]


def relocalize(folder: Path, *words: object) -> Result:
    return pc2grid("relocalize", folder / "drive.mcap", "-d", folder / "twins.submaps", *words)


def apart_m(pose: dict[str, float], truth: SE2) -> float:
    return math.dist((pose["x"], pose["y"]), (truth.x, truth.y))


def test_near_names_the_room(rooms: tuple[Path, SE2]) -> None:
    """The robot is in the left one; without a word it may be in either."""
    folder, truth = rooms
    done = relocalize(folder, "--json")
    assert done.exit_code == 4
    document = json.loads(done.stdout)
    assert document["status"] == "ambiguous" and document["prior"] is None
    done = relocalize(folder, "--near", 3 + 6.0, 3, 3.5, "--json")
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["prior"] == {"status": "used", "excluded": None}
    assert apart_m(document["pose"], SE2(truth.x + 6.0, truth.y, truth.yaw)) < 3 * RESOLUTION_M


def test_a_wrong_word_finds_nothing_and_says_what_it_excludes(rooms: tuple[Path, SE2]) -> None:
    done = relocalize(rooms[0], "--near", -50, -50, 2)
    assert done.exit_code == 4
    assert done.stdout.startswith("not found: no place near the given one")
    assert "--near excludes" in done.stderr and "twins: x" in done.stderr


def test_a_pose_in_the_log_or_in_a_file_is_carried_along(rooms: tuple[Path, SE2], tmp_path: Path) -> None:
    folder, truth = rooms
    done = relocalize(folder, "--near-pose", "/initialpose", "--initialpose", tmp_path / "pose.json")
    assert done.exit_code == 0 and done.stdout.startswith("located in twins"), done.output
    written = read_pose(tmp_path / "pose.json")
    assert math.dist((written.T_map_base.x, written.T_map_base.y), (truth.x, truth.y)) < 3 * RESOLUTION_M
    done = relocalize(folder, "--near-pose", tmp_path / "pose.json", "--json")
    assert done.exit_code == 0 and json.loads(done.stdout)["status"] == "located"


def test_a_pose_without_a_time_is_one_of_the_newest_scan(rooms: tuple[Path, SE2], tmp_path: Path) -> None:
    """A later one than that says nothing of the recording, which is told."""
    folder, truth = rooms
    end_ns = round(np.loadtxt(folder / "plain.tum")[-1, 0] * 1e9)
    for name, stamp_ns in (("now", 0), ("later", end_ns + 2_000_000_000)):
        message = initialpose(stamp_ns, truth, np.diag([0.04, 0.04, 0.01]))
        (tmp_path / f"{name}.json").write_text(json.dumps(message))
    done = relocalize(folder, "--near-pose", tmp_path / "now.json")
    assert done.exit_code == 0 and done.stdout.startswith("located in twins"), done.output
    done = relocalize(folder, "--near-pose", tmp_path / "later.json")
    assert done.exit_code == 4 and done.stdout.startswith("ambiguous"), done.output
    assert "lies after the last scan" in done.stderr


def test_a_pose_acts_at_its_time(tmp_path: Path) -> None:
    """Of a floor that looks the same when turned by 180 degrees, the pose of 18 of 24 s tells which way."""
    drive = field_log("near_pose_before_its_time")
    map_ = drive.with_name("near_pose_map.yaml")
    assert pc2grid("convert", map_, "-o", tmp_path / "map.submaps").exit_code == 0
    told = ("--near-pose", drive.with_suffix(".json"), "--json")
    done = pc2grid("relocalize", drive, "-d", tmp_path / "map.submaps", *told)
    document = json.loads(done.stdout)
    assert done.exit_code == 0 and "registration was lost" not in done.stderr, done.output
    assert math.dist((document["pose"]["x"], document["pose"]["y"]), (4.27, 0.46)) < 0.1
    assert math.degrees(document["pose"]["yaw"]) == pytest.approx(-165.0, abs=1.0)


def test_a_right_pose_is_fine_and_a_wrong_one_lost(rooms: tuple[Path, SE2]) -> None:
    folder, truth = rooms
    yaw_deg = math.degrees(truth.yaw)
    done = relocalize(folder, "--check", truth.x, truth.y, yaw_deg)
    assert done.exit_code == 0 and done.stdout.startswith("fine: x "), done.output
    done = relocalize(folder, "--check", truth.x, truth.y, yaw_deg + 20.0, "--json")
    document = json.loads(done.stdout)
    assert done.exit_code == 4 and document["status"] == "lost" and document["probability"] <= 0.1
    assert apart_m(document["better"]["pose"], truth) < 3 * RESOLUTION_M
    # 0.8 m ahead of the truth.
    done = relocalize(folder, "--check-topic", "/amcl_pose")
    assert done.exit_code == 4 and done.stdout.startswith("lost: x "), done.output
    assert "better, in twins: x" in done.stdout
    # Right, at the first scan.
    done = relocalize(folder, "--check-topic", "/initialpose", "--json")
    document = json.loads(done.stdout)
    assert done.exit_code == 0 and document["comparable"] and document["better"] is None
    assert apart_m(document["pose"], truth) < 3 * RESOLUTION_M


def test_a_pose_file_is_read_as_it_is_written_and_as_ros2_prints_it(tmp_path: Path) -> None:
    covariance = np.array([[0.2, 0.1, 0.0], [0.1, 0.3, 0.01], [0.0, 0.01, 0.05]])
    message = initialpose(12_000_000_345, SE2(1.0, -2.0, 2.5), covariance)
    (tmp_path / "pose.json").write_text(json.dumps(message))
    (tmp_path / "pose.yaml").write_text(yaml.safe_dump(message) + "---\n" + yaml.safe_dump(message) + "---\n")
    for name in ("pose.json", "pose.yaml"):
        pose = read_pose(tmp_path / name)
        assert pose.stamp_ns == 12_000_000_345
        assert (pose.T_map_base.x, pose.T_map_base.y) == (1.0, -2.0)
        assert pose.T_map_base.yaw == pytest.approx(2.5)
        assert np.allclose(pose.covariance, np.diag([0.2, 0.3, 0.05]))


def test_a_robot_is_told_after_each_metre_whether_its_pose_is_right(rooms: tuple[Path, SE2]) -> None:
    """The pose of /amcl_pose is 0.8 m off, that of /initialpose right; both at one time of the drive."""
    folder, _ = rooms
    words = ("watch", folder / "drive.mcap", "-d", folder / "twins.submaps", "--json")
    done = pc2grid(*words, "--check-topic", "/initialpose")
    looks = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.exit_code == 0, done.output
    for look in looks:
        jsonschema.validate(look, closed(schema("watch-check")))
    last = looks[-1]
    assert len(looks) > 1 and last["status"] == "fine" and last["comparable"]
    assert last["off_m"] < 2 * RESOLUTION_M
    done = pc2grid(*words, "--check-topic", "/amcl_pose")
    looks = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.exit_code == 4 and looks[-1]["status"] == "lost", done.output
    better, believed = looks[-1]["better"]["pose"], looks[-1]["pose"]
    assert 0.6 < math.dist((better["x"], better["y"]), (believed["x"], believed["y"])) < 1.0


def test_a_missing_pose_of_a_robot_is_named(rooms: tuple[Path, SE2]) -> None:
    folder, _ = rooms
    watch = ("watch", folder / "drive.mcap", "-d", folder / "twins.submaps", "--check-topic")
    done = pc2grid(*watch, "/amcl_pos")
    assert done.exit_code == 1 and "did you mean /amcl_pose" in str(done.exception)
    done = relocalize(folder, "--check-topic", "/none")
    assert done.exit_code == 1 and "/amcl_pose" in str(done.exception)
    assert "do not go together" in str(pc2grid(*watch, "/amcl_pose", "--publish", "tf").exception)


def test_a_map_is_a_database_for_one_query(rooms: tuple[Path, SE2], tmp_path: Path) -> None:
    folder, truth = rooms
    page = tmp_path / "page.html"
    words = (folder / "drive.mcap", "-d", folder / "left.yaml", "--json", "--report", page)
    done = pc2grid("relocalize", *words)
    assert done.exit_code == 0, done.stderr
    assert apart_m(json.loads(done.stdout)["pose"], truth) < 2 * RESOLUTION_M
    assert f"wrote {page}" in done.stderr and page.exists()


@pytest.mark.parametrize(
    ("status", "probability", "said"),
    [
        ("fine", 0.97, "probability 0.97"),
        ("lost", 0.2, "at most 0.20"),
        ("lost", 0.001, "probability < 0.01"),
    ],
)
def test_a_probability_is_said_once(status: CheckStatus, probability: float, said: str) -> None:
    about = {"T_map_base": SE2(0.0, 0.0, 0.0), "session": "monday", "stamp_ns": 0, "path_m": 1.0}
    assert said in as_text(PoseCheck(status=status, probability=probability, **about))
