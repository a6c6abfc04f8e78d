"""What more travel tells: a robot begins somewhere in a recording, and is asked again and again as it drives.

    python -m pc2grid_lab.fit.travel DATA WORK [--only PATTERN] [--starts 16]

DATA is the folder of recordings, WORK the one in which `compare recordings` has kept its maps. The scans go
into a `Localizer`, as those of `relocalize` and of `watch` do. Prints rows for each pair of `compare
recordings`, after five scans, 3, 10, 20 and 40 m: how often it was asked; how many answers are located, right
and wrong; the mass of the best place, the least and the median; the processor time of an answer (median, s).

Answers judge each other, as those of `compare recordings` do where there are no true poses; one that those
from other starts do not judge counts as wrong. In the map of another building each located one is wrong.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.model import RegisteredScan, Trajectory
from pc2grid.pipeline import follow
from pc2grid_lab.experiments.recordings.catalogue import Catalogue, Pair
from pc2grid_lab.experiments.recordings.run import Folder, RecordedDrive, config_of, drive_of
from pc2grid_lab.experiments.truth import Clue, Frame, agreed_frame, is_right
from pc2grid_lab.fit.queries import Only, index_of
from signature.localization.answer import Answer
from signature.localization.localizer import Localizer

TRAVEL_M = (0.0, 3.0, 10.0, 20.0, 40.0)
_STANDING = 5
"""So many scans are the query of a robot that has not driven yet."""


@dataclass(frozen=True, slots=True)
class Asked:
    """The answer from one start after some travel, and its processor time."""

    start: int
    travel_m: float
    answer: Answer
    cpu_s: float

    @property
    def best(self) -> tuple[str, SE2]:
        """Session of the map and pose of the best place; there must be one."""
        h = self.answer.hypotheses[0]
        return self.answer.sessions[h.session_index], h.fit.T_map_query @ self.answer.T_odom_base


def asked(
    start: int, localizer: Localizer, scans: Iterable[tuple[RegisteredScan, PlanarScan]]
) -> Iterator[Asked]:
    """The answers along the scans."""
    due, travel_m, last = list(TRAVEL_M), 0.0, None
    for number, (registered, planar_scan) in enumerate(scans, start=1):
        pose = SE2.from_matrix(registered.T_session_base)
        travel_m += 0.0 if last is None else math.hypot(pose.x - last.x, pose.y - last.y)
        last = pose
        begin = time.process_time()
        localizer.add(registered, planar_scan)
        if number >= _STANDING and travel_m >= due[0]:
            answer = localizer.answer()
            yield Asked(start, due.pop(0), answer, time.process_time() - begin)
            if not due:
                return


def starts_s(drive: Trajectory, first_s: float, count: int) -> list[float]:
    """Times from `first_s` on, evenly spread, after which the robot drives as far as it is asked for."""
    path_m = drive.path_m()
    last_ns = drive.stamps_ns[np.searchsorted(path_m, max(path_m[-1] - TRAVEL_M[-1], 0.0))]
    last_s = float(last_ns - drive.stamps_ns[0]) * 1e-9
    starts: list[float] = np.linspace(first_s, max(first_s, last_s), count).tolist()
    return starts


def along(catalogue: Catalogue, folder: Folder, pair: Pair, starts: int) -> Iterator[Asked]:
    """The answers to the query of a pair from all starts."""
    recording, index = catalogue.recordings[pair.query], index_of(folder.map(pair.map_name))
    drive, config = drive_of(recording, folder).parts[0], config_of(recording)
    with open_log(folder.source(recording), config.read) as log:
        for number, start_s in enumerate(starts_s(drive, pair.until_s or 0.0, starts)):
            yield from asked(number, Localizer(index), follow(log.scans(start_s), config))


def clues(drive: RecordedDrive, answers: Iterable[Asked]) -> dict[tuple[int, str], list[Clue]]:
    """What answers say of how the parts of the drive lie in the sessions of the map."""
    said: dict[tuple[int, str], list[Clue]] = {}
    for one in answers:
        at = drive.where(one.answer.stamp_ns)
        if at is not None and one.answer.hypotheses:
            session, pose = one.best
            clue = Clue(at[1], pose, ("", one.start), one.answer.confidence)
            said.setdefault((at[0], session), []).append(clue)
    return said


def right(drive: RecordedDrive, answers: Sequence[Asked]) -> list[bool]:
    """Whether the best place of each answer is where those from other starts say."""
    frames = {key: agreed_frame(found) for key, found in clues(drive, answers).items()}
    judged = []
    for one in answers:
        verdict = False
        for key, (clue,) in clues(drive, [one]).items():
            frame = frames[key]
            others = [] if frame is None else [c for c in frame.clues if c.query != clue.query]
            if len(others) > 1:
                verdict = is_right(clue.T_map_base, *Frame(tuple(others)).place(clue.T_drive_base))[0]
        judged.append(verdict)
    return judged


def main(data: Path, work: Path, only: Only = None, starts: int = 16) -> None:
    """Print the table. DATA and WORK are those of `compare recordings`."""
    catalogue, folder = Catalogue.of(only=only), Folder(data.resolve(), work.resolve())
    for pair in catalogue.pairs:
        answers = list(along(catalogue, folder, pair, starts))
        elsewhere = pair.kind == "elsewhere"
        drive = drive_of(catalogue.recordings[pair.query], folder)
        verdicts = [False] * len(answers) if elsewhere else right(drive, answers)
        for travel_m in TRAVEL_M:
            here = [(a, v) for a, v in zip(answers, verdicts, strict=True) if a.travel_m == travel_m]
            if not here:
                continue
            located = [verdict for one, verdict in here if one.answer.status == "located"]
            mass, cpu_s = np.array([(one.answer.confidence, one.cpu_s) for one, _ in here]).T
            print(
                f"| {pair.query} | {pair.map_name} | {travel_m:g} | {len(here)} | {len(located)} |"
                f" {sum(located)} | {located.count(False)} | {mass.min():.2f} | {np.median(mass):.2f} |"
                f" {np.median(cpu_s):.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    typer.run(main)
