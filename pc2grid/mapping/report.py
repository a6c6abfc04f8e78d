"""The report of a session map: scans that are not in it, and warnings with what to do."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from pc2grid.errors import TrackingLost
from pc2grid.estimation.overruled import stalls
from pc2grid.estimation.rides import RIDES
from pc2grid.mapping.consistency import consistency_warning
from pc2grid.mapping.odometry_warnings import odometry_warnings
from pc2grid.mapping.part_maps import PartMap
from pc2grid.mapping.parts import PARTS
from pc2grid.mapping.precision import precision_warning
from pc2grid.mapping.track import Track
from pc2grid.model import Health, ReadReport, Trajectory, part_name

_MOST_LOST = 0.2
"""Share of lost scans above which a laser, or a sensor in the hand, gives no map without odometry: its parts
do not hang together. Chosen by hand."""
_LEAST_HELD = 1.0 / 3.0
"""Share of scans in which the points fix the pose, below which a sensor in the hand gives no map without
odometry. In recordings of two rooms, an office, a kitchen and a hall it is 0.9 to 1, of a simulated phone
that drifts by 2 percent 0.5, and in simulated flats that are seen three times a second, whose tracks are off
by metres, 0.1."""
HELD_SCANS = 100
"""While a recording is followed, so many of the last scans are judged by that share; chosen by hand."""
_WARN_DEGENERATE = 0.1
"""Share of degenerate scans above which the report says so; chosen by hand."""


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


def not_held(health: Collection[Health], name: str) -> TrackingLost | None:
    """The error of a log, if most scans of a sensor in the hand, without odometry, do not fix their poses.

    Such a map does not contradict itself: each scan fits what the last ones showed, wherever these lie.
    """
    total, fine = len(health), sum(h is Health.FINE for h in health)
    if fine >= _LEAST_HELD * total:
        return None
    return TrackingLost(
        f"{name}: only {fine} of {total} scans of a sensor in the hand fix the pose in every direction, and "
        "there is no odometry, so that the poses would be wrong by metres",
        hint="--odometry TOPIC names a topic with odometry, such as the visual-inertial one of the device; "
        "else record it, or more scans a second, or corners and furniture in place of bare walls",
    )


def part_reports(
    report: ReadReport,
    session: str,
    parts: Sequence[PartMap],
    kept: Sequence[PartMap],
    floors: Sequence[str | None],
    *,
    slopes_unseen: bool,
) -> list[ReadReport]:
    """The report of each part that is kept, with the warnings of registration and of its map.

    report : of the reader. It becomes that of the first part; the scans of the others are counted in theirs.
    """
    elsewhere = sum(len(part.trajectory) for part in kept[1:])
    warnings, skipped = list(report.warnings), dict(report.scans_skipped)
    if len(parts) > 1:
        warnings.append(division_warning(session, parts, kept, floors))
    left_out = sum(len(part.trajectory) for part in parts) - elsewhere - len(kept[0].trajectory)
    if left_out:
        skipped["in a part too short to be of use"] = left_out
    first = dataclasses.replace(
        report,
        scans_read=report.scans_read - elsewhere,
        scans_skipped=skipped,
        warnings=tuple(warnings),
    )
    others = [ReadReport(scans_read=len(part.trajectory)) for part in kept[1:]]
    return [
        _with_warnings(r, part, slopes_unseen=slopes_unseen)
        for r, part in zip([first, *others], kept, strict=True)
    ]


def division_warning(
    session: str, parts: Sequence[PartMap], kept: Sequence[PartMap], floors: Sequence[str | None]
) -> str:
    """One sentence that says into what a recording was divided, where, and what to do."""
    start_ns = min(int(part.trajectory.stamps_ns[0]) for part in parts if len(part.trajectory))

    def begin_s(part: PartMap) -> float:
        return (int(part.trajectory.stamps_ns[0]) - start_ns) * 1e-9

    named = ", ".join(
        f"{part_name(session, k)} "
        + (f"(floor {floors[k]}) " if floors[k] is not None else "")
        + f"from {begin_s(part):.0f} s ({part.trajectory.length_m:.0f} m)"
        for k, part in enumerate(kept)
    )
    advice = "come back to known places more often, to keep them together"
    if not any(part.odometry.compared for part in parts):
        advice = f"record with odometry, or {advice}"
    short = len(parts) - len(kept)
    dropped = f"; {short} shorter than {PARTS.least_travel_m:.0f} m left out" if short else ""
    if len({part.storey for part in parts}) == len(parts):
        return f"the recording goes over {len(parts)} floors: {named}{dropped}"
    return (
        f"the recording falls into {len(parts)} parts whose places relative to each other are not known, "
        "because tracking was lost, stairs or a lift lay between, or the map would contradict itself: "
        f"{named}{dropped}; {advice}"
    )


def with_track_warnings(report: ReadReport, track: Track) -> ReadReport:
    """The report of a recording, with what was assumed, and what is said of rides and of odometry."""
    of_odometry = odometry_warnings(track.trajectory, track.readings)
    warnings = (*report.warnings, *track.assumptions, *ride_warnings(track), *of_odometry)
    return dataclasses.replace(report, warnings=warnings)


def without_points(report: ReadReport) -> ReadReport:
    """The report of a recording of which points in space were asked for, and that has none."""
    no_points = "a 2D laser shows no points in space, so none are kept"
    return dataclasses.replace(report, warnings=(*report.warnings, no_points))


def ride_warnings(track: Track) -> list[str]:
    """What may have been a ride to another floor that did not divide the recording, or a slope that was not
    noticed: where, and what to do."""
    if not len(track.trajectory):
        return []
    stamps_ns, heights_m = track.trajectory.stamps_ns, track.trajectory.T_session_base[:, 2, 3]
    advice = "the map shows two floors as one: convert each by itself, with --start, --duration and --floor"
    warnings = []
    if len(track.riding) and track.riding[-1]:
        last = int(np.flatnonzero(~track.riding)[-1]) if not track.riding.all() else -1
        begin_s = (stamps_ns[last + 1] - stamps_ns[0]) * 1e-9
        lost = len(track.riding) - 1 - last
        warnings.append(
            f"from {begin_s:.0f} s after the first scan on, the robot is on a slope that leads to another "
            f"floor, or less than {RIDES.settled_m:.0f} m behind it: these {lost} scans are in no map; "
            "record more of that floor"
        )
    for stall in stalls(stamps_ns.tolist(), track.disagreements):
        from_s, to_s = ((stamp_ns - stamps_ns[0]) * 1e-9 for stamp_ns in (stall.from_ns, stall.to_ns))
        warnings.append(
            f"from {from_s:.0f} to {to_s:.0f} s after the first scan odometry reports "
            f"{stall.reported_m:.1f} m of travel, and the scans show {stall.moved_m:.1f} m: unless the "
            "wheels spun, the robot was on a slope that was not noticed, and the map is wrong there; leave "
            "that part out with --start and --duration"
        )
    away = np.flatnonzero(np.abs(heights_m - heights_m[0]) > RIDES.storey_m)
    if track.carried and len(away):
        begin_s = (stamps_ns[away[0]] - stamps_ns[0]) * 1e-9
        farthest_m = float(max(heights_m - heights_m[0], key=abs))
        where = f"{abs(farthest_m):.1f} m {'above' if farthest_m > 0 else 'below'}"
        warnings.append(
            f"the sensor in the hand is up to {where} its first height, and more than {RIDES.storey_m:.1f} m "
            f"from {begin_s:.0f} s after the first scan on; if that was by stairs, {advice}"
        )
    return warnings


def _with_warnings(report: ReadReport, part: PartMap, *, slopes_unseen: bool) -> ReadReport:
    """The report of a part with the warnings of registration and of the map added."""
    trajectory = part.trajectory
    lost = sum(h is Health.LOST for h in trajectory.health)
    weak = sum(h is Health.DEGENERATE for h in trajectory.health)
    total, skipped, warnings = len(trajectory), dict(report.scans_skipped), list(report.warnings)
    if lost:
        skipped["registration lost"] = lost
        first = next(k for k, h in enumerate(trajectory.health) if h is Health.LOST)
        seconds = (trajectory.stamps_ns[first] - trajectory.stamps_ns[0]) * 1e-9
        warnings.append(
            f"registration was lost for {lost} of {total} scans, first {seconds:.1f} s after the first scan; "
            "they are not in the map"
        )
    if weak > _WARN_DEGENERATE * total:
        warnings.append(
            f"{weak} of {total} scans did not fix the pose in every direction: there it rests on odometry "
            "or on the motion before"
        )
    bent = consistency_warning(
        part.consistency,
        trajectory,
        slopes_unseen=slopes_unseen,
        with_odometry=part.odometry.compared > 0,
    )
    if bent is not None:
        warnings.append(bent)
    uncertain = precision_warning(part.precision, trajectory)
    if uncertain is not None:
        warnings.append(uncertain)
    return dataclasses.replace(report, scans_skipped=skipped, warnings=tuple(warnings))
