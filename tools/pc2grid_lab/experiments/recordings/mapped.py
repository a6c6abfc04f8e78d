"""The rows of the page about maps."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import Trajectory
from pc2grid_lab.experiments.recordings.catalogue import Recording
from pc2grid_lab.experiments.recordings.children import Finished, kept
from pc2grid_lab.experiments.recordings.drive import config_of, mount, sessions
from pc2grid_lab.experiments.recordings.rows import NOT_RUN, MapRow, Verdict, Warned
from pc2grid_lab.experiments.recordings.run import Folder
from pc2grid_lab.experiments.slam_relations import Relations, read_relations, relation_error
from pc2grid_lab.experiments.trajectory_error import trajectory_error

MISSING = "not in the data folder"
_ABOUT = {
    "bent": r"contradicts itself",
    "loose": r"^no loop ties",
    "height": r"^the height changes by",
    "parts": r"^the recording falls into \d+ parts",
    "lost": r"^registration was lost",
    "weak": r"did not fix the pose in every direction",
    "no tf": r"^the log has no tf",
    "gaps": r"gaps of more than",
    "empty scans": r"hold no returns",
}
_SHAPE = ("bent", "loose")
EXACT_M, WRONG_M = 0.1, 0.25
"""A map with a smaller error is not bent, one with a larger is. Chosen by hand: what a doubled wall needs."""


def map_row(recording: Recording, folder: Folder) -> MapRow:
    """The row of a recording as a map; what cannot be judged is a row that says why."""
    row: dict[str, Any] = {
        "name": recording.name,
        "building": recording.building,
        "sensor": recording.sensor_shown,
    }
    if folder.missing(recording):
        return MapRow(**row, problem=MISSING)
    done = kept(folder.result(recording.name))
    if done is None:
        return MapRow(**row, problem=NOT_RUN)
    if done.failed:
        return MapRow(**row, problem=done.error, cpu_s=done.cpu_s)
    try:
        return MapRow(**row, cpu_s=done.cpu_s, **_figures(recording, folder, done))
    except Exception as error:
        return MapRow(**row, problem=said(error))


def said(error: Exception) -> str:
    """What became of a row that cannot be judged."""
    return f"{type(error).__name__}: {error}"


def _figures(recording: Recording, folder: Folder, done: Finished) -> dict[str, Any]:
    stored = done.document["sessions"]
    reports = [session["report"] for session in stored]
    read = sum(report["scans_read"] for report in reports)
    skipped = sum(sum(report["scans_skipped"].values()) for report in reports)
    bare = kept(folder.bare(recording.name))
    bare_of: dict[str, Any] = {} if bare is None or bare.failed else bare.document
    error = _error(recording, folder)
    texts = itertools.chain.from_iterable(report["warnings"] for report in reports)
    sums = {name: sum(session[name] for session in stored) for name in ("duration_s", "path_m", "area_m2")}
    return {
        "minutes": sums["duration_s"] / 60.0,
        "metres": sums["path_m"],
        "area_m2": sums["area_m2"],
        "over_bare": done.cpu_s / bare_of["cpu_s"] if bare_of else None,
        "parts": len(stored),
        "lost": skipped / read if read else None,
        "warnings": warned(texts, error_m=error.get("error_m")),
        "bare_m": bare_of.get("ate_m"),
        **error,
    }


def _error(recording: Recording, folder: Folder) -> dict[str, Any]:
    """The error of a trajectory against its truth; of a recording in parts, that of each part by itself."""
    parts, truth = list(sessions(folder, recording.name).values()), folder.truth(recording)
    if recording.same_place:
        return {"truth": "loops", **_relation_error(parts, _loops(recording, folder), SE2())}
    if truth is None:
        return {}
    if truth.suffix == ".relations":
        T_base_sensor = SE2.from_matrix(mount(folder, recording))
        return {"truth": "relations", **_relation_error(parts, read_relations(truth), T_base_sensor)}
    return {"truth": "poses", **_pose_error(parts, truth)}


def _loops(recording: Recording, folder: Folder) -> Relations:
    """From each scan of `Recording.same_place` to the next one the sensor has not moved."""
    with open_log(folder.source(recording), config_of(recording).read) as log:
        stamps = {number: scan.stamp_ns for number, scan in enumerate(log.scans())}
    there = np.array([stamps[number] for number in recording.same_place])
    return Relations(first_ns=there[:-1], second_ns=there[1:], T_first_second=np.zeros((len(there) - 1, 3)))


def _relation_error(
    parts: Sequence[Trajectory], relations: Relations, T_base_sensor: SE2
) -> dict[str, float]:
    """Mean errors over the relations that lie in one part."""
    offset_m = (T_base_sensor.x, T_base_sensor.y)
    found = [relation_error(part, relations, base_to_reference_m=offset_m) for part in parts]
    found = [error for error in found if error.used]
    if not found:
        return {"compared": 0.0}
    used = [error.used for error in found]
    return {
        "error_m": float(np.average([error.translation_m for error in found], weights=used)),
        "error_deg": float(np.average([error.rotation_deg for error in found], weights=used)),
        "compared": sum(used) / found[0].total,
    }


def _pose_error(parts: Sequence[Trajectory], truth: Path) -> dict[str, float]:
    """RMS distance from the true poses, each part aligned by itself."""
    true = read_tum(truth)
    found = [error for part in parts if (error := trajectory_error(part, true)) is not None]
    if not found:
        return {"compared": 0.0}
    poses = [error.poses for error in found]
    return {
        "error_m": float(np.sqrt(np.average([error.ate_m**2 for error in found], weights=poses))),
        "compared": sum(poses) / max(sum(len(part) for part in parts), 1),
    }


def warned(texts: Iterable[str], *, error_m: float | None) -> tuple[Warned, ...]:
    """The warnings of `convert`, each with what it is about and whether it is right, where that is known.

    error_m : of the trajectory, None if it is not known.
    """
    return tuple(
        Warned(about=about, verdict=_verdict(about, error_m), text=text)
        for text in texts
        for about in [_about(text)]
    )


def _about(text: str) -> str:
    """What a warning is about; of one that is not known here, its first words."""
    for about, pattern in _ABOUT.items():
        if re.search(pattern, text):
            return about
    return " ".join(text.split()[:5])


def _verdict(about: str, error_m: float | None) -> Verdict:
    if about == "height":  # each of the recordings is of one floor
        return "false"
    if about in _SHAPE and error_m is not None:
        if error_m < EXACT_M:
            return "false"
        if error_m > WRONG_M:
            return "right"
    return "unknown"
