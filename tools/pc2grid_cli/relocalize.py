"""`pc2grid relocalize`: where in the database was this recorded?"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid import libraries as extras
from pc2grid.display import probability
from pc2grid.errors import ConfigError, NotALog, one_line
from pc2grid.io.maps import is_map_file
from pc2grid.io.trajectory import write_trajectory
from pc2grid.mapping.drawn import is_drawn_map
from pc2grid.mapping.quality import PRECISION
from pc2grid.model import SENSOR_MODELS
from pc2grid_cli import console
from pc2grid_cli import options as options
from pc2grid_cli import output as data_loss
from pc2grid_cli.export import write_answer, write_located_map
from pc2grid_cli.known_pose import KnownPose, in_map, write_initialpose
from pc2grid_cli.output import check_file
from pc2grid_cli.windows import Window, show, write_csv, write_places
from signature.database.maintenance import is_database
from signature.localization.answer import answer_in_building
from signature.localization.answer_json import QueryRecording, Result, Sessions
from signature.localization.shown.page import Found, write_report
from signature.localization.shown.picture import draw_answer, draw_answers

if TYPE_CHECKING:
    from pc2grid.model import Trajectory
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.database.protocol import BuildingFrame
    from signature.localization.answer import AmbiguousLine, Answer
    from signature.localization.hypotheses import Hypothesis


class Searched(Sessions):
    """Where it was looked for. left_out: damage that was not used."""

    path: str
    left_out: list[str]


class Relocalize(Result):
    """`pc2grid relocalize --json`. T_map_odom puts the query's own frame into the map. confidence: the
    probability that the best hypothesis is right. hypotheses: best first. map_sigma_m: standard deviation of
    the map itself there, relative to the rest of it; the covariance of the pose is about the walls around."""

    query: QueryRecording
    database: Searched
    map_sigma_m: float | None


_OF_ONE = {"initialpose", "output", "report"}
"""The options that take one query."""
_OF_ANSWER = {"trajectory", "initialpose", "output"}
"""The options whose files only an answer can fill."""


def check_options(
    logs: Sequence[Path],
    database: str,
    outputs: Mapping[str, Path],
    force: bool,
    known: KnownPose,
    *,
    several: bool,
) -> None:
    """Raises what is wrong with the options before any work is done. several : queries at once."""
    extras.require(extras.of_addresses(database))
    for option, path in outputs.items():
        check_file(option, path, force)
    if several:
        hint = "leave it out, or give one recording and no --every"
        _refuse(outputs.keys() & _OF_ONE, "is of one query", hint)
    for log in logs:
        if is_drawn_map(log):
            hint = "--json and --output have its pose"
            _refuse(outputs.keys() & {"trajectory", "initialpose"}, "there is no robot in a map", hint)
        known.validate(is_map=is_map_file(log))
        _check_not_swapped(log, database)
    if known.is_check:
        hint = "leave it out, or ask without --check"
        _refuse(outputs.keys(), "--check judges a pose and finds none", hint)
        if several:
            raise ConfigError("--check: judges one pose", hint="give one recording, and no --every")


def _refuse(options: Collection[str], reason: str, hint: str) -> None:
    """Raises ConfigError if there is any of these options."""
    if options:
        raise ConfigError(f"--{min(options)}: {reason}", hint=hint)


@dataclass(frozen=True, slots=True)
class Told:
    """What of the options and of the database decides how answers are told.

    frames : of the buildings that poses are in, by session. left_out : damage of the database.
    """

    database: SubmapDatabase
    frames: Mapping[str, BuildingFrame]
    left_out: list[str]
    strict: bool
    as_json: bool

    def document(self, found: Found, stated: Answer) -> Relocalize:
        """What `--json` prints. stated : the answer as it is given."""
        sigma_m = map_sigma_m(found.answer, self.database)
        return {
            **stated.to_json(),
            "query": found.about,
            "database": {
                "sessions": [*stated.sessions],
                "path": self.database.location,
                "left_out": self.left_out,
            },
            "map_sigma_m": None if sigma_m is None else round(sigma_m, 3),
        }

    def code(self, all_found: Sequence[Found], *, failed: bool = False) -> int:
        """The exit code. Data that was lost is warned of. failed : a query could not be read."""
        losses = [_warn_of_losses(found, self.strict) for found in all_found]
        if not all_found:
            return console.FAILED
        if all(found.answer.status != "located" for found in all_found):
            return console.UNSURE
        return console.LOSSY if any(losses) or self.left_out or failed else console.OK


def tell_one(
    window: Window,
    found: Found,
    told: Told,
    outputs: Mapping[str, Path],
    force: bool,
    settings: Config,
    terminal: console.Console,
) -> int:
    """Print the answer to one query, and write what shows it; returns the exit code."""
    stated = answer_in_building(found.answer, told.frames)
    located = in_map(found.poses, found.answer)
    # Printed first: a file that cannot be written must not cost the answer.
    text = as_text(stated, is_map=found.drawn is not None)
    text += _about_map(map_sigma_m(found.answer, told.database))
    console.print_result(told.document(found, stated) if told.as_json else text)
    outputs = _fillable(outputs, located=located is not None)
    if "csv" in outputs:
        write_csv(outputs["csv"], [(window, stated)])
    _write(outputs, told.database, found, stated, located, force, settings)
    for path in outputs.values():
        terminal.note(f"wrote {path}")
    _warn_of_missing_points(found, told.database)
    _warn_of_unjoined(found.answer, told.database)
    for warning in found.about["warnings"]:
        console.warn(warning)
    _warn_of_prior(stated)
    return told.code([found])


def _fillable(outputs: Mapping[str, Path], *, located: bool) -> Mapping[str, Path]:
    """The files that can be written, by option. Of those that lack an answer the user is warned."""
    missed = set() if located else outputs.keys() & _OF_ANSWER
    for option in sorted(missed):
        console.warn(f"{outputs[option]}: not written, there is no answer to put into it")
    return {option: path for option, path in outputs.items() if option not in missed}


def tell_all(
    found_in_turn: Generator[tuple[Window, Found | None]],
    told: Told,
    outputs: Mapping[str, Path],
    terminal: console.Console,
) -> int:
    """Print the answers to several queries, and write what shows them; returns the exit code.

    The documents are printed one by one, the table at the end, also if the work is interrupted."""
    rows: list[tuple[Window, Answer | None]] = []
    all_found: list[Found] = []
    with contextlib.ExitStack() as stack:
        if not told.as_json:
            stack.callback(show, rows)
        for window, found in stack.enter_context(contextlib.closing(found_in_turn)):
            if found is None:
                rows.append((window, None))
                continue
            all_found.append(found)
            stated = answer_in_building(found.answer, told.frames)
            rows.append((window, stated))
            if told.as_json:
                console.print_result(told.document(found, stated), indent=None)
    answers = [answer for _, answer in rows if answer is not None]
    outputs = _fillable(outputs, located=any(answer.status == "located" for answer in answers))
    if "csv" in outputs:
        write_csv(outputs["csv"], rows)
    if "trajectory" in outputs:
        write_places(outputs["trajectory"], [(f.poses, a) for f, a in zip(all_found, answers, strict=True)])
    if "plot" in outputs:
        draw_answers(outputs["plot"], told.database, all_found)
    for path in outputs.values():
        terminal.note(f"wrote {path}")
    for warning in dict.fromkeys(f"{f.about['source']}: {w}" for f in all_found for w in f.about["warnings"]):
        console.warn(warning)
    return told.code(all_found, failed=len(all_found) < len(rows))


def _warn_of_losses(found: Found, strict: bool) -> bool:
    """Say what of the recording was lost; whether that is to end with exit code 3."""
    report = found.report
    if report is None:
        return False
    if report.lossy:
        console.warn(f"{found.about['source']}: {data_loss.sentence(report)}")
    return data_loss.ends_with_3(report, strict)


def _check_not_swapped(log: Path, database: str) -> None:
    """Raises NotALog if a database is given in place of the recording."""
    if is_database(str(log)):
        raise NotALog(
            f"{log}: a submap database, where a recording or a map is expected",
            hint=f"are they swapped? pc2grid relocalize {database} -d {log}",
        )


def _write(
    outputs: Mapping[str, Path],
    database: SubmapDatabase,
    found: Found,
    stated: Answer,
    located: Trajectory | None,
    force: bool,
    settings: Config,
) -> None:
    """Write the files.

    stated : the answer as it is given. What shows the map of a session is in the frame of that map, whatever
    frame the answer is given in. located : the poses of the query in that map, None without an answer.
    """
    answer = found.answer
    if "trajectory" in outputs and located is not None:
        write_trajectory(outputs["trajectory"], in_map(found.poses, stated) or located)
    if "initialpose" in outputs:
        write_initialpose(outputs["initialpose"], stated)
    if "output" in outputs and found.drawn is not None:
        write_located_map(outputs["output"], database, answer, found.drawn, force)
    elif "output" in outputs and located is not None:
        write_answer(outputs["output"], database, answer, located, force)
    if "plot" in outputs:
        draw_answer(outputs["plot"], database, answer, found.poses)
    if "report" in outputs:
        write_report(outputs["report"], database, found=found, accept=settings.relocalize.accept)


def map_sigma_m(answer: Answer, database: SubmapDatabase) -> float | None:
    """Standard deviation (m) of the map itself where the query is; None if it is not known or not located.

    The covariance of the answer is about the walls there. Where these lie in the map is another question.
    """
    if answer.T_map_base is None or answer.session is None:
        return None
    (info,) = database.sessions([answer.session])
    trajectory = database.trajectory(answer.session)
    if info.precision is None or not info.precision.stamps_ns or not len(trajectory):
        return None
    x, y, _ = trajectory.planar().T
    nearest = int(np.argmin(np.hypot(x - answer.T_map_base.x, y - answer.T_map_base.y)))
    return info.precision.at(int(trajectory.stamps_ns[nearest]))


def _about_map(sigma_m: float | None) -> str:
    """A line about the map where it is not known well enough to rely on; else nothing."""
    if sigma_m is None or sigma_m <= PRECISION.promised_m:
        return ""
    return (
        f"\n  the map itself may be off by {sigma_m:.1f} m here (standard deviation), see `pc2grid db info`"
    )


def _warn_of_prior(answer: Answer) -> None:
    """Say what the known pose had to do with the answer, if that is not what the user expects."""
    if answer.prior == "lapsed":
        console.warn("registration was lost after the time of --near-pose, so that pose was not used")
    if answer.prior == "ahead":
        console.warn("the time of --near-pose lies after the last scan, so that pose was not used")
    excluded = answer.excluded
    if excluded is None or excluded.pose is None:
        return
    pose = excluded.pose
    where = f"{one_line(excluded.session or '')}: x {pose.x:.2f} m, y {pose.y:.2f} m"
    how = "is certain" if excluded.status == "located" else "fits better"
    console.warn(
        f"a place that --near excludes {how}: {where}, confidence {probability(excluded.confidence)}"
    )


def _warn_of_missing_points(found: Found, database: SubmapDatabase) -> None:
    """Say what would tell more, where an answer is not certain and points in space were not kept."""
    in_space = {kind for kind, model in SENSOR_MODELS.items() if not model.planar}
    if found.answer.status == "located" or found.about["sensor"] not in in_space:
        return
    infos = [info for info in database.sessions() if info.sensor in in_space]
    if infos and not any(info.points for info in infos):
        console.warn(
            "the map was made with --no-points; with points, what the sensor sees above and below the plane"
            " of the map tells places apart, too"
        )


def _warn_of_unjoined(answer: Answer, database: SubmapDatabase) -> None:
    """Say what may make one place of two, where the best of them are in sessions that are not joined."""
    if answer.status != "ambiguous" or 1 not in answer.places:
        return
    a, b = sorted(answer.hypotheses[answer.places.index(place)].session_index for place in (0, 1))
    one, other = answer.sessions[a], answer.sessions[b]
    frames = database.frames()
    joined = one in frames and other in frames and frames[one].name == frames[other].name
    if one == other or joined or answer.labels[a].contradicts(answer.labels[b]):
        return
    console.warn(
        f"{one_line(one)} and {one_line(other)} are not joined: if they show one building, `pc2grid db join"
        f" {database.location}` makes one place of these two"
    )


def as_text(answer: Answer, *, is_map: bool = False) -> str:
    """The answer in a few lines; of a map as the query, the pose is that of its frame."""
    after = "" if is_map else f" after {answer.path_m:.1f} m"
    near = " near the given one" if answer.prior == "used" else ""
    if answer.T_map_base is not None:
        pose = answer.T_map_base
        of_what = "for the map's own frame" if is_map else "at the last scan"
        travel = "" if is_map else f", after {answer.path_m:.1f} m of travel"
        return (
            f"located in {_named(answer, answer.hypotheses[0])}:{_frame(answer)}"
            f" x {pose.x:.2f} m, y {pose.y:.2f} m,"
            f" yaw {math.degrees(pose.yaw):.1f} deg {of_what},"
            f" confidence {probability(answer.confidence)}{travel}" + _in_space(answer)
        )
    lines = [
        {
            "ambiguous": f"ambiguous: {len(set(answer.places))} places fit{after}",
            "not_found": f"not found: no place{near} fits well enough{after}",
        }[answer.status]
    ]
    for h in answer.hypotheses[:5]:
        pose = h.fit.T_map_query @ answer.T_odom_base
        lines.append(f"  {_named(answer, h)}: x {pose.x:.2f} m, y {pose.y:.2f} m, score {h.fit.score:.2f}")
    if answer.line is not None:
        lines.append(_on_line(answer.line))
    return "\n".join(lines) + _in_space(answer)


def _on_line(line: AmbiguousLine) -> str:
    """What is known of a base that is somewhere on a line."""
    (x, y), (to_x, to_y) = line.begin_m, line.end_m
    return (
        f"  on one line of {line.length_m:.1f} m with probability {probability(line.probability)}:"
        f" from x {x:.1f} m, y {y:.1f} m to x {to_x:.1f} m, y {to_y:.1f} m,"
        f" yaw {math.degrees(line.yaw_rad):.0f} deg"
    )


def _in_space(answer: Answer) -> str:
    """A line about the pose in space, if both sides have points; else nothing."""
    pose = answer.in_space
    if pose is None:
        return ""
    shares = f"{pose.on:.0%} of {pose.rays} rays end on surfaces of the map"
    if answer.T_map_base is None:
        return f"\n  a place that fits in the plane was turned down in space: {shares}"
    roll, pitch, _ = (math.degrees(angle) for angle in pose.rpy_rad)
    sigma_m = float(max(pose.covariance[k, k] for k in range(3))) ** 0.5
    return (
        f"\n  in space: z {pose.T_map_base[2, 3]:.2f} m, roll {roll:.1f} deg, pitch {pitch:.1f} deg,"
        f" standard deviation {100.0 * sigma_m:.1f} cm; {shares}"
    )


def _frame(answer: Answer) -> str:
    """The frame of the building that the pose is in; nothing if it is in that of the session."""
    inside = answer.frame is None or answer.frame == answer.session
    return "" if inside else one_line(f" in the frame of {answer.frame},")


def _named(answer: Answer, hypothesis: Hypothesis) -> str:
    """The session whose map a hypothesis is in, with its building and floor if they are known."""
    session = answer.sessions[hypothesis.session_index]
    label = answer.labels[hypothesis.session_index]
    return one_line(f"{session} ({label})" if label.building or label.floor else session)
