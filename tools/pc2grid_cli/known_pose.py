"""What is known of the robot's pose beforehand (--near, --near-pose), and the check of a pose (--check,
--check-topic).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.display import probability
from pc2grid.errors import ConfigError, one_line
from pc2grid.geometry import SE2
from pc2grid.io.map_pose import read_pose
from pc2grid.io.recording import Log, open_log
from pc2grid.model import Health, RegisteredScan
from pc2grid.observer import Observer, TimeSpan
from pc2grid_cli import console, options
from pc2grid_cli.options import KnownPose
from pc2grid_cli.output import Document
from signature.config import Config
from signature.database import SubmapDatabase
from signature.localization.answer import pose_text
from signature.localization.pose_check import PoseCheck, check_pose
from signature.places.map_index import MapIndex, Prior
from signature.sessions import about_query, open_database_or_map, query_config, tracked


def validate(known: KnownPose, *, is_map: bool = False) -> None:
    """Raise ConfigError for options that do not go together. is_map : the query is a map."""
    given = {
        "--near": known.near,
        "--near-pose": known.near_pose,
        "--check": known.check,
        "--check-topic": known.check_topic,
    }
    names = [name for name, value in given.items() if value is not None]
    if len(names) > 1:
        raise ConfigError(f"{' and '.join(names)} do not go together", hint="give one of them")
    if names and is_map:
        raise ConfigError(f"{names[0]}: there is no robot in a map", hint="give a recording")
    if known.session is not None and not names:
        raise ConfigError(
            "--session: says whose map frame a known pose is in, but none is given",
            hint="add --near X Y RADIUS or --check X Y YAW_DEG",
        )
    if known.check is not None and not all(map(math.isfinite, known.check)):
        raise ConfigError("--check: expected x and y in metres and the heading in degrees")


def region(known: KnownPose) -> Prior | None:
    """Return the region of `--near`; None if none is given. Raises ConfigError."""
    validate(known)
    return None if known.near is None else Prior.around(*known.near, session=known.session)


def prior(known: KnownPose, log: Log, span: TimeSpan) -> Prior | None:
    """Return the region that the pose is in at a part of a recording; None if none is given.

    Raises ConfigError, or what `Log.map_pose` raises.
    """
    if known.near_pose is None:
        return region(known)
    is_topic = known.near_pose.startswith("/") and not Path(known.near_pose).exists()
    pose = log.map_pose(known.near_pose, _end_s(span)) if is_topic else read_pose(Path(known.near_pose))
    if pose.covariance is None:
        raise ConfigError(
            f"--near-pose: poses of {known.near_pose} have no covariance",
            hint="--near X Y RADIUS names a region",
        )
    # A stamp of 0 is the newest scan, as AMCL takes it.
    stamp_ns = pose.stamp_ns or None
    return Prior.of_pose(pose.T_map_base, pose.covariance, stamp_ns=stamp_ns, session=known.session)


def _end_s(span: TimeSpan) -> float | None:
    """Return the end of a part of a recording, seconds after the recording's start; None: its own end."""
    return None if span.duration_s is None else span.start_s + span.duration_s


@contextlib.contextmanager
def searched(given: options.SearchedSessions) -> Iterator[tuple[SubmapDatabase, list[str]]]:
    """Open the database, or the map as one; only the sessions of a building and floor if they are given.

    Yields it, and what is damaged in it and left out, of which the user is warned.
    """
    with open_database_or_map(given.database, warn=console.warn) as opened:
        if given.building is not None or given.floor is not None:
            opened.keep_only(building=given.building, floor=given.floor)
        left_out = [f"{problem.where}: {problem.what}" for problem in opened.leave_out_damaged()]
        for damage in left_out:
            console.warn(f"{opened.location}: damaged and left out: {damage}")
        yield opened, left_out


def check_log(
    given: options.Relocalize, database: SubmapDatabase, config: Config, observer: Observer
) -> tuple[PoseCheck, Document]:
    """Check the pose at the end of a recording, or of the part of it that is named."""
    (path,), span = given.logs, given.span
    config = query_config(database, config)
    with open_log(path, config.read, recover=given.recover) as log:
        T_map_base, stamp_ns = _believed(log, given)
        health: list[Health] = []

        def counted() -> Iterator[tuple[RegisteredScan, PlanarScan]]:
            for registered, planar_scan in tracked(log, config, span, observer):
                health.append(registered.health)
                yield registered, planar_scan

        with observer.step("check", span.length_ns(log.info.start_ns, log.info.end_ns) * 1e-9):
            index = MapIndex.of(database, config)
            checked = check_pose(counted(), index, T_map_base, stamp_ns=stamp_ns, session=given.session)
        about = about_query(path, checked, log.report(), span, health, log.choose().sensor)
        return checked, {**judgement(checked, database.location), "query": about}


def _believed(log: Log, given: options.Relocalize) -> tuple[SE2, int | None]:
    """Return the pose to be checked, and its time; None: the last scan."""
    if given.check_topic is not None:
        pose = log.map_pose(given.check_topic, _end_s(given.span))
        return pose.T_map_base, pose.stamp_ns
    assert given.check is not None
    x_m, y_m, yaw_deg = given.check
    return SE2(x_m, y_m, math.radians(yaw_deg)), None


def judgement(checked: PoseCheck, where: str) -> Document:
    """Return what is said of a pose. where : the database."""
    pose, better = checked.T_map_base, checked.better
    return {
        "status": checked.status,
        "probability": checked.probability,
        "session": checked.session,
        "pose": {"x": pose.x, "y": pose.y, "yaw": pose.yaw, "stamp_ns": checked.stamp_ns},
        "off_m": checked.off_m,
        "off_rad": checked.off_rad,
        "comparable": not checked.lapsed,
        "better": None
        if better is None
        else {
            "session": better.session,
            "building": better.label.building,
            "floor": better.label.floor,
            "pose": better.stamped_pose,
            "confidence": better.confidence,
        },
        "database": {"path": where},
    }


def as_text(checked: PoseCheck) -> str:
    """Return the judgement in one or two lines."""
    told = f"{checked.status}: {pose_text(checked.T_map_base)} in {one_line(checked.session)}"
    if checked.lapsed:
        return f"{told}: registration was lost after that pose, so it cannot be compared"
    told += f", right with probability {_bound(checked)}"
    if checked.off_m is not None and checked.off_rad is not None and checked.status == "fine":
        told += f", {checked.off_m:.2f} m and {math.degrees(checked.off_rad):.1f} deg from the best fit"
    told += f", after {checked.path_m:.1f} m of travel"
    better = checked.better
    if better is not None and better.T_map_base is not None:
        told += (
            f"\n  better, in {one_line(better.session or '')}: {pose_text(better.T_map_base)},"
            f" confidence {probability(better.confidence)}"
        )
    return told


def _bound(checked: PoseCheck) -> str:
    """Return the probability in words: an upper bound unless the pose is fine."""
    told = probability(checked.probability)
    return told if checked.status == "fine" or told.startswith("<") else f"at most {told}"
