"""`pc2grid relocalize`: where in the database was this recorded?

One query, of which everything is written, or several (recordings, maps, or windows along a recording), each
with a line of its own.
"""

from __future__ import annotations

import contextlib
import csv
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pc2grid import libraries
from pc2grid.display import plain, probability
from pc2grid.errors import ConfigError, LogError, NotALog, one_line
from pc2grid.geometry import F64
from pc2grid.grids.drawn import is_drawn_map
from pc2grid.io.atomic import replace_file
from pc2grid.io.map_pose import write_initialpose
from pc2grid.io.maps import is_map_file
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import stamp_text, write_trajectory
from pc2grid.matching.score import Fit
from pc2grid.model import SENSOR_MODELS, Trajectory
from pc2grid.observer import Observer, TimeSpan
from pc2grid_cli import console, known_pose, options, output
from pc2grid_cli.export import write_answer
from pc2grid_cli.output import Document
from signature.config import Config
from signature.database import SubmapDatabase
from signature.database.maintenance import is_database
from signature.database.protocol import BuildingFrame
from signature.localization.answer import Answer, answer_in_building, pose_text
from signature.places.map_index import MapIndex
from signature.session.quality import PROMISED_M
from signature.sessions import find, query_config
from signature.shown.page import Found, write_report
from signature.shown.picture import draw_answer, draw_answers

_FILES = ("trajectory", "csv", "initialpose", "output", "plot", "report")
"""Options that name what is written, in this order."""
_OF_ONE = {"initialpose", "output", "report"}
"""Those that take one query."""
_OF_ANSWER = {"trajectory", "initialpose", "output"}
"""Those whose files only an answer can fill."""


def run(given: options.Relocalize, terminal: console.Console) -> int:
    """Locate the queries, or check a pose, and print what is found. Return the exit code."""
    outputs = output.files_of(given, _FILES)
    is_check = given.check is not None or given.check_topic is not None
    several = given.every is not None or len(given.logs) > 1
    _check(given, outputs, is_check=is_check, several=several)
    settings = given.settings()
    windows = _windows(given, settings)
    with known_pose.searched(given) as (opened, left_out):
        if is_check:
            checked, document = known_pose.check_log(given, opened, settings, terminal)
            console.print_result(plain(document) if given.json else known_pose.as_text(checked))
            for warning in document["query"]["warnings"]:
                console.warn(warning)
            return console.OK if checked.status == "fine" else console.UNSURE
        frames = opened.frames() if given.frame == "building" else {}
        said = Said(given, outputs, opened, frames, left_out, terminal)
        if several:
            return said.all(_found(windows, given, opened, settings, terminal))
        return said.one(windows[0], _find(windows[0], given, opened, settings, terminal))


def _check(given: options.Relocalize, outputs: Mapping[str, Path], *, is_check: bool, several: bool) -> None:
    """Raise what is wrong with the options before any work is done. several : queries at once."""
    libraries.require(libraries.of_addresses(given.database))
    for option, path in outputs.items():
        output.check_file(option, path, given.force)
    if several:
        hint = "leave it out, or give one recording and no --every"
        _refuse(outputs.keys() & _OF_ONE, "is of one query", hint)
    for log in given.logs:
        if is_drawn_map(log):
            hint = "--json and --output have its pose"
            _refuse(outputs.keys() & {"trajectory", "initialpose"}, "there is no robot in a map", hint)
        known_pose.validate(given, is_map=is_map_file(log))
        if is_database(str(log)):
            raise NotALog(
                f"{log}: a submap database, where a recording or a map is expected",
                hint=f"are they swapped? pc2grid relocalize {given.database} -d {log}",
            )
    if is_check:
        hint = "leave it out, or ask without --check"
        _refuse(outputs.keys(), "--check judges a pose and finds none", hint)
        if several:
            raise ConfigError("--check: judges one pose", hint="give one recording, and no --every")


def _refuse(options: Collection[str], reason: str, hint: str) -> None:
    """Raise ConfigError if there is any of these options."""
    if options:
        raise ConfigError(f"--{min(options)}: {reason}", hint=hint)


@dataclass(frozen=True, slots=True)
class QueryInput:
    """A query: a part of a recording, or a map."""

    path: Path
    span: TimeSpan

    def __str__(self) -> str:
        return one_line(f"{self.path.name} from {self.span.start_s:g} s")


def _windows(given: options.Relocalize, config: Config) -> list[QueryInput]:
    """Return the queries: of each path one, or with --every one so often, from --start on.

    Such a window is as long as --duration, by default --every. It ends within its recording, unless it is the
    first.

    Raises ConfigError for a map with --every, and the errors of `open_log`.
    """
    every_s, start_s = given.every, given.start
    if every_s is None:
        return [QueryInput(path, given.span) for path in given.logs]
    length_s = given.duration or every_s
    windows = []
    for path in given.logs:
        if is_drawn_map(path):
            raise ConfigError(f"--every: {path} is a map, and no time passes in it", hint="leave it out")
        with open_log(path, config.read, recover=given.recover) as log:
            left_s = (log.info.end_ns - log.info.start_ns) * 1e-9 - start_s - length_s
        starts_s = start_s + every_s * np.arange(max(math.floor(left_s / every_s), 0) + 1)
        windows += [QueryInput(path, TimeSpan(float(at_s), length_s)) for at_s in starts_s]
    return windows


def _find(
    window: QueryInput,
    given: options.Relocalize,
    database: SubmapDatabase,
    config: Config,
    observer: Observer,
    index: MapIndex | None = None,
) -> Found:
    """Locate a query. index : of the database, if it is prepared."""
    return find(
        window.path,
        database,
        config,
        span=window.span,
        recover=given.recover,
        observer=observer,
        prior=lambda log, span: known_pose.prior(given, log, span),
        index=index,
    )


class _Share(Observer):
    """The news of one query of several: its progress is a part of that of all."""

    def __init__(self, all_: Observer, done: int, count: int) -> None:
        self._all, self._done, self._count = all_, done, count
        self.on_note, self.on_warning = all_.on_note, all_.on_warning  # type: ignore[method-assign]

    def on_progress(self, share: float) -> None:
        """Move the bar of all."""
        self._all.on_progress((self._done + share) / self._count)


def _found(
    windows: Sequence[QueryInput],
    given: options.Relocalize,
    database: SubmapDatabase,
    config: Config,
    observer: Observer,
) -> Generator[tuple[QueryInput, Found | None]]:
    """Locate each query, by one index of the database. One that cannot be read is warned of, and is None."""
    index = MapIndex.of(database, query_config(database, config), observer)
    with observer.step(f"locate {len(windows)} queries"):
        for number, window in enumerate(windows):
            found, part = None, _Share(observer, number, len(windows))
            try:
                found = _find(window, given, database, config, part, index)
            except LogError as error:
                console.warn(f"{window}: {error.message}")
            part.on_progress(1.0)
            yield window, found


@dataclass(frozen=True, slots=True)
class Said:
    """What is said of answers, and the files that show them.

    frames : of the buildings that poses are in, by session. left_out : damage of the database.
    """

    given: options.Relocalize
    outputs: Mapping[str, Path]
    database: SubmapDatabase
    frames: Mapping[str, BuildingFrame]
    left_out: list[str]
    terminal: console.Console

    def one(self, window: QueryInput, found: Found) -> int:
        """Print the answer to one query, and write what shows it. Return the exit code."""
        stated = answer_in_building(found, self.frames)
        located = in_map(found.poses, found)
        # Printed first: a file that cannot be written must not cost the answer.
        text, sigma_m = as_text(stated, is_map=found.drawn is not None), map_sigma_m(found, self.database)
        if sigma_m is not None and sigma_m > PROMISED_M:
            off = f"the map itself may be off by {sigma_m:.1f} m here (standard deviation)"
            text += f"\n  {off}, see `pc2grid db info`"
        console.print_result(self._document(found, stated) if self.given.json else text)
        outputs = self._fillable(located=located is not None)
        if "csv" in outputs:
            write_csv(outputs["csv"], [(window, stated)])
        _write(outputs, self.database, found, stated, located, self.given.force)
        for path in outputs.values():
            self.terminal.note(f"wrote {path}")
        _warn_of_missing_points(found, self.database)
        _warn_of_unjoined(found, self.database)
        for warning in found.about["warnings"]:
            console.warn(warning)
        _warn_of_prior(stated)
        return self._code([found])

    def all(self, found_in_turn: Generator[tuple[QueryInput, Found | None]]) -> int:
        """Print the answers to several queries, and write what shows them. Return the exit code.

        The documents are printed one by one, the table at the end, also if the work is interrupted."""
        rows: list[tuple[QueryInput, Found | None]] = []
        all_found: list[Found] = []
        with contextlib.ExitStack() as stack:
            if not self.given.json:
                stack.callback(show, rows)
            for window, found in stack.enter_context(contextlib.closing(found_in_turn)):
                stated = found and answer_in_building(found, self.frames)
                rows.append((window, stated))
                if found is not None and stated is not None:
                    all_found.append(found)
                    if self.given.json:
                        console.print_result(self._document(found, stated), indent=None)
        answers = [answer for _, answer in rows if answer is not None]
        outputs = self._fillable(located=any(answer.status == "located" for answer in answers))
        if "csv" in outputs:
            write_csv(outputs["csv"], rows)
        if "trajectory" in outputs:
            write_places(outputs["trajectory"], [(answer.poses, answer) for answer in answers])
        if "plot" in outputs:
            drawn = [(found, found.poses, found.about["source"]) for found in all_found]
            draw_answers(outputs["plot"], self.database, drawn)
        for path in outputs.values():
            self.terminal.note(f"wrote {path}")
        warnings = [f"{f.about['source']}: {w}" for f in all_found for w in f.about["warnings"]]
        for warning in dict.fromkeys(warnings):
            console.warn(warning)
        return self._code(all_found, failed=len(all_found) < len(rows))

    def _document(self, found: Found, stated: Found) -> Document:
        """Return what `--json` prints. stated : the answer as it is given."""
        sigma_m = map_sigma_m(found, self.database)
        about = {
            **stated.to_json(),
            "query": stated.about,
            "database": {
                "sessions": [*stated.sessions],
                "path": self.database.location,
                "left_out": self.left_out,
            },
            "map_sigma_m": None if sigma_m is None else round(sigma_m, 3),
        }
        return plain(about)

    def _fillable(self, *, located: bool) -> Mapping[str, Path]:
        """Return the files that can be written, by option. Warn of those that lack an answer."""
        missed = set() if located else self.outputs.keys() & _OF_ANSWER
        for option in sorted(missed):
            console.warn(f"{self.outputs[option]}: not written, there is no answer to put into it")
        return {option: path for option, path in self.outputs.items() if option not in missed}

    def _code(self, all_found: Sequence[Found], *, failed: bool = False) -> int:
        """Return the exit code. Data that was lost is warned of. failed : a query could not be read."""
        reports = [(found.about["source"], found.read) for found in all_found if found.read is not None]
        for source, report in reports:
            if report.lossy:
                console.warn(f"{source}: {output.sentence(report)}")
        if not all_found:
            return console.FAILED
        if all(found.status != "located" for found in all_found):
            return console.UNSURE
        severe = any(output.ends_with_3(report, self.given.strict) for _, report in reports)
        return console.LOSSY if severe or self.left_out or failed else console.OK


def _write(
    outputs: Mapping[str, Path],
    database: SubmapDatabase,
    found: Found,
    stated: Found,
    located: Trajectory | None,
    force: bool,
) -> None:
    """Write the files.

    stated : the answer as it is given. What shows the map of a session is in the frame of that map, whatever
    frame the answer is given in. located : the poses of the query in that map, None without an answer.
    """
    if "trajectory" in outputs and located is not None:
        write_trajectory(outputs["trajectory"], in_map(found.poses, stated) or located)
    if "initialpose" in outputs and stated.T_map_base is not None and stated.covariance is not None:
        write_initialpose(outputs["initialpose"], stated.stamp_ns, stated.T_map_base, stated.covariance)
    if "output" in outputs and located is not None:
        write_answer(outputs["output"], database, found, located, force)
    if "plot" in outputs:
        draw_answer(outputs["plot"], database, found, found.poses)
    if "report" in outputs:
        write_report(outputs["report"], database, found=found)


def in_map(poses: Trajectory, answer: Answer) -> Trajectory | None:
    """Return the query's poses in the map frame; None without an answer."""
    if answer.T_map_odom is None:
        return None
    return replace(poses, T_session_base=answer.T_map_odom.lift() @ poses.T_session_base)


def map_sigma_m(answer: Answer, database: SubmapDatabase) -> float | None:
    """Return the standard deviation (m) of the map itself where the query is; None if it is not known.

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


def _warn_of_prior(answer: Answer) -> None:
    """Warn of what the known pose had to do with the answer, if that is not what the user expects."""
    if answer.prior == "lapsed":
        console.warn("registration was lost after the time of --near-pose, so that pose was not used")
    if answer.prior == "ahead":
        console.warn("the time of --near-pose lies after the last scan, so that pose was not used")
    excluded = answer.excluded
    if excluded is None or excluded.pose is None:
        return
    pose = excluded.pose
    where = f"{one_line(excluded.best_session or '')}: x {pose.x:.2f} m, y {pose.y:.2f} m"
    how = "is certain" if excluded.status == "located" else "fits better"
    console.warn(
        f"a place that --near excludes {how}: {where}, confidence {probability(excluded.confidence)}"
    )


def _warn_of_missing_points(found: Found, database: SubmapDatabase) -> None:
    """Warn that points in space were not kept, where an answer is not certain."""
    in_space = {kind for kind, model in SENSOR_MODELS.items() if not model.planar}
    if found.status == "located" or found.about["sensor"] not in in_space:
        return
    infos = [info for info in database.sessions() if info.sensor in in_space]
    if infos and not any(info.points for info in infos):
        console.warn(
            "the map was made with --no-points; with points, what the sensor sees above and below the plane"
            " of the map tells places apart, too"
        )


def _warn_of_unjoined(answer: Answer, database: SubmapDatabase) -> None:
    """Warn that the two best places are in sessions that are not joined: they may be one place."""
    if answer.status != "ambiguous" or len(answer.places) < 2:
        return
    a, b = sorted(place.fits[0].session_index for place in answer.places[:2])
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
    """Return the answer in a few lines; of a map as the query, the pose is that of its frame."""
    after = "" if is_map else f" after {answer.path_m:.1f} m"
    near = " near the given one" if answer.prior == "used" else ""
    if answer.located is not None and answer.T_map_base is not None:
        of_what = "for the map's own frame" if is_map else "at the last scan"
        travel = "" if is_map else f", after {answer.path_m:.1f} m of travel"
        return (
            f"located in {_named(answer, answer.located)}:{_frame(answer)}"
            f" {pose_text(answer.T_map_base)} {of_what},"
            f" confidence {probability(answer.confidence)}{travel}" + _in_space(answer)
        )
    lines = [
        {
            "ambiguous": f"ambiguous: {len(answer.places)} places fit{after}",
            "not_found": f"not found: no place{near} fits well enough{after}",
        }[answer.status]
    ]
    for h in answer.hypotheses[:5]:
        pose = h.T_map_query @ answer.T_odom_base
        lines.append(f"  {_named(answer, h)}: x {pose.x:.2f} m, y {pose.y:.2f} m, score {h.score:.2f}")
    line = answer.line
    if line is not None:
        lines.append(
            f"  on one line of {line.length_m:.1f} m with probability {probability(line.probability)}:"
            f" from x {line.begin.x:.1f} m, y {line.begin.y:.1f} m to x {line.end.x:.1f} m,"
            f" y {line.end.y:.1f} m, yaw {math.degrees(line.yaw_rad):.0f} deg"
        )
    return "\n".join(lines) + _in_space(answer)


def _in_space(answer: Answer) -> str:
    """Return a line about the pose in space, if both sides have points; else nothing."""
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
    """Return the frame of the building that the pose is in; nothing if it is in that of the session."""
    inside = answer.frame is None or answer.frame == answer.session
    return "" if inside else one_line(f" in the frame of {answer.frame},")


def _named(answer: Answer, hypothesis: Fit) -> str:
    """Return the session whose map a hypothesis is in, with its building and floor if they are known."""
    session = answer.sessions[hypothesis.session_index]
    label = answer.labels[hypothesis.session_index]
    return one_line(f"{session} ({label})" if label.building or label.floor else session)


_COLUMNS = (
    "recording", "start_s", "time_s", "status", "session", "frame", "x_m", "y_m", "yaw_rad", "confidence",
    "sigma_x_m", "sigma_y_m", "sigma_yaw_rad",
)  # fmt: skip
"""Of --csv. start_s: of the query, after the start of its recording. time_s: of its last scan, as in TUM."""
_DIGITS = 6
"""Of numbers in --csv: micrometres."""


def show(answers: Sequence[tuple[QueryInput, Answer | None]]) -> None:
    """Print a table with a line for each query."""
    counts = Counter("failed" if answer is None else answer.status for _, answer in answers)
    title = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.most_common())
    texts = ("recording", "answer", "in")
    numbers = ("from, s", "x, m", "y, m", "yaw, deg", "confidence", "travel, m")
    table = output.table(f"{len(answers)} queries: {title}", texts, numbers)
    for window, answer in answers:
        name, start_s = one_line(window.path.name), f"{window.span.start_s:g}"
        if answer is None:
            table.add_row(name, "failed", "", start_s)
            continue
        pose = answer.T_map_base
        at = (f"{pose.x:.2f}", f"{pose.y:.2f}", f"{math.degrees(pose.yaw):.1f}") if pose else ("", "", "")
        sure = probability(answer.confidence), f"{answer.path_m:.1f}"
        where = one_line(answer.frame or answer.session or "")
        table.add_row(name, answer.status.replace("_", " "), where, start_s, *at, *sure)
    output.show(table)


def write_csv(path: Path, answers: Sequence[tuple[QueryInput, Answer | None]]) -> None:
    """Write a line for each query; what is not known of it is empty. Raises OutputError."""
    with replace_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(_COLUMNS)
        for window, answer in answers:
            row: list[object] = [window.path.name, window.span.start_s]
            if answer is None:
                rows.writerow([*row, "", "failed", *[""] * 9])
                continue
            pose, covariance = answer.T_map_base, answer.covariance
            at = ("", "", "") if pose is None else (pose.x, pose.y, pose.yaw)
            sigmas = ("", "", "") if covariance is None else np.sqrt(np.diag(covariance)).tolist()
            where = (answer.session or "", answer.frame or answer.session or "")
            time_s = stamp_text(answer.stamp_ns) if answer.stamp_ns else ""  # no time passes in a map
            row += [time_s, answer.status, *where, *at, answer.confidence, *sigmas]
            rows.writerow([round(cell, _DIGITS) if isinstance(cell, float) else cell for cell in row])


def write_places(path: Path, found: Sequence[tuple[Trajectory, Answer]]) -> None:
    """Write where queries were located, in the order of time, as a trajectory. Raises OutputError.

    found : the poses of each query, and its answer. A trajectory is in one frame: answers in another one than
    most are left out, and warned of.
    """
    located: dict[str, dict[int, F64]] = defaultdict(dict)
    for poses, answer in found:
        placed = in_map(poses, answer)
        if placed is not None:
            located[answer.frame or answer.session or ""][answer.stamp_ns] = placed.T_session_base[-1]
    frame = max(located, key=lambda name: len(located[name]))
    for other in located.keys() - {frame}:
        console.warn(f"{path}: is in the frame of {frame}; {len(located[other])} poses in {other} left out")
    stamps_ns = sorted(located[frame])
    T = np.array([located[frame][stamp_ns] for stamp_ns in stamps_ns])
    write_trajectory(path, Trajectory(stamps_ns=np.array(stamps_ns), T_session_base=T))
