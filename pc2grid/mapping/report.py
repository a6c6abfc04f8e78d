"""The report of a session map: scans that are not in it, and warnings with what to do."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from pc2grid.arrays import F64
from pc2grid.errors import TrackingLost
from pc2grid.mapping.odometry_warnings import odometry_warnings
from pc2grid.mapping.parts import PARTS
from pc2grid.mapping.track import Track
from pc2grid.model import Health, ReadReport, SessionMap, Trajectory, part_name

_MOST_LOST = 0.2
"""Share of lost scans above which a laser gives no map without odometry: its parts do not hang together.
Chosen by hand."""
_STOREY_M = 2.0
"""A hand lifts a sensor by less than this, and storeys are at least 2.4 m high; chosen by hand."""


def check_followed(trajectory: Trajectory, name: str) -> None:
    """Raise TrackingLost if more than a fifth of the scans of the log `name` are lost."""
    lost = [health is Health.LOST for health in trajectory.health]
    if sum(lost) <= _MOST_LOST * len(lost):
        return
    first_s = (trajectory.stamps_ns[lost.index(True)] - trajectory.stamps_ns[0]) * 1e-9
    raise TrackingLost(
        f"{name}: {sum(lost)} of {len(lost)} scans could not be followed, first {first_s:.1f} s after the "
        "first scan, and the log has no odometry",
        hint="--odometry TOPIC names a topic with odometry, --start and --duration a part that can be "
        "followed; else record odometry, or scans that are closer together",
    )


def lost_warnings(health: Sequence[Health]) -> list[str]:
    """At most one sentence: that a query, with scans of this health, begins anew where tracking was lost."""
    lost = [number for number, of_scan in enumerate(health, start=1) if of_scan is Health.LOST]
    if not lost:
        return []
    return [
        f"{len(lost)} of {len(health)} scans could not be followed, so only the last "
        f"{len(health) - lost[-1]} count; record odometry, or more scans a second, or corners and furniture "
        "in place of bare walls"
    ]


def part_reports(
    report: ReadReport,
    session: str,
    parts: Sequence[SessionMap],
    kept: Sequence[SessionMap],
    walls_changed_ns: Collection[int] = (),
) -> list[ReadReport]:
    """The report of each part that is kept.

    report : of the reader. It becomes part of that of the first part; the scans of the others are counted in
        theirs.
    walls_changed_ns : as of a `Track`.
    """
    first, *others = (part.report for part in kept)
    elsewhere = sum(other.scans_read for other in others)
    left_out = sum(len(part.trajectory) for part in parts) - elsewhere - first.scans_read
    skipped = {"in a part too short to be of use": left_out} if left_out else {}
    division = [division_warning(session, parts, kept, walls_changed_ns)] if len(parts) > 1 else []
    first = dataclasses.replace(
        report,
        scans_read=report.scans_read - elsewhere,
        scans_skipped={**report.scans_skipped, **skipped, **first.scans_skipped},
        warnings=(*report.warnings, *division, *first.warnings),
    )
    return [first, *others]


def division_warning(
    session: str,
    parts: Sequence[SessionMap],
    kept: Sequence[SessionMap],
    walls_changed_ns: Collection[int] = (),
) -> str:
    """One sentence that says into what a recording was divided, where, and what to do."""
    start_ns = min(int(part.trajectory.stamps_ns[0]) for part in parts if len(part.trajectory))

    def begin_s(part: SessionMap) -> float:
        return (int(part.trajectory.stamps_ns[0]) - start_ns) * 1e-9

    short = len(parts) - len(kept)
    dropped = f"; {short} shorter than {PARTS.least_travel_m:.0f} m left out" if short else ""
    named = ", ".join(
        f"{part_name(session, k)} from {begin_s(part):.0f} s ({part.trajectory.length_m:.0f} m)"
        for k, part in enumerate(kept)
    )
    changed_s = [begin_s(part) for part in parts if part.trajectory.stamps_ns[0] in walls_changed_ns]
    if changed_s:
        times = " and ".join(f"{seconds:.0f}" for seconds in changed_s)
        return (
            f"the recording falls into {len(parts)} parts whose places relative to each other are not known: "
            f"{named}{dropped}; before {times} s after the first scan all walls changed while odometry stood "
            "still, as in a lift: cut the recording there, with --start and --duration, and name each floor "
            "with --floor"
        )
    advice = "come back to known places more often, to keep them together"
    if not any(part.odometry and part.odometry.compared for part in parts):
        advice = f"record with odometry, or {advice}"
    return (
        f"the recording falls into {len(parts)} parts whose places relative to each other are not known, "
        f"because tracking was lost: {named}{dropped}; {advice}"
    )


def with_track_warnings(report: ReadReport, track: Track) -> ReadReport:
    """The report of a recording, with what was assumed, and what is said of odometry and of heights."""
    warnings, skipped = [*report.warnings], dict(report.scans_skipped)
    if track.warning is not None:
        warnings.append(track.warning)
    if track.left_out:
        skipped["before one that shows the floor"] = track.left_out
    warnings += height_warnings(track.heights_m, track.trajectory)
    warnings += odometry_warnings(track.trajectory, track.readings)
    return dataclasses.replace(report, scans_skipped=skipped, warnings=tuple(warnings))


def height_warnings(heights_m: F64, trajectory: Trajectory) -> list[str]:
    """At most one sentence: that scans are as high (N,) above others as another floor is, and what to do."""
    known = np.flatnonzero(np.isfinite(heights_m))
    rise_m = heights_m[known] - heights_m[known[:1]]
    away = known[np.abs(rise_m) > _STOREY_M]
    if not len(away):
        return []
    begin_s = (trajectory.stamps_ns[away[0]] - trajectory.stamps_ns[0]) * 1e-9
    return [
        f"the height changes by {np.ptp(rise_m):.1f} m, and from {begin_s:.0f} s after the first scan on by "
        f"more than {_STOREY_M:.1f} m: a map is one floor, and this one shows several as one; cut the "
        "recording there, with --start and --duration, and name each floor with --floor"
    ]
