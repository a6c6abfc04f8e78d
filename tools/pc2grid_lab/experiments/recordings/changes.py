"""What changed between two runs, row by row, and what became worse by more than chance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median

from pc2grid_lab.experiments.recordings.chance import ALPHA, by_chance
from pc2grid_lab.experiments.recordings.rows import MapRow, PairRow, QueryRow, Table


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeParameters:
    """From when on a difference is told. All chosen by hand.

    share : of an error or of a time, which vary by less from one machine or version to the next. error_m : an
        error that changed by less is not told. seconds : the same of a processor time.
    """

    share: float = 0.25
    error_m: float = 0.01
    seconds: float = 1.0


CHANGE = ChangeParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """A line of what changed. row : of the page. worse : by more than chance."""

    row: str
    text: str
    worse: bool = False


def changes(before: Table, after: Table) -> list[Change]:
    """What changed in the rows that both runs have; times relative to the change that half of them exceed."""
    maps = [(old, new) for new in after.maps for old in before.maps if old.name == new.name]
    pairs = [(old, new) for new in after.pairs for old in before.pairs if _key(old) == _key(new)]
    pace = _pace(maps)
    same_form = before.quick == after.quick
    found = [change for old, new in maps for change in _map_changes(old, new, pace)]
    for old, new in pairs:
        windows = _same_windows([(old, new)], same_form=same_form)
        found += _pair_changes(new.name, old.problem, new.problem, windows)
    for building in dict.fromkeys(new.building for _, new in pairs):
        rows = [(old, new) for old, new in pairs if new.building == building]
        found += _worse(f"building {building}", _same_windows(rows, same_form=same_form))
    found += _worse("all queries", _same_windows(pairs, same_form=same_form))
    return found


def _key(row: PairRow) -> tuple[str, str, str]:
    return row.kind, row.query, row.map


def _pace(maps: Sequence[tuple[MapRow, MapRow]]) -> float:
    """Processor time of this run over that of the other one, in the median: machines differ."""
    ratios = [new.cpu_s / old.cpu_s for old, new in maps if old.cpu_s and new.cpu_s]
    return median(ratios) if ratios else 1.0


def _map_changes(old: MapRow, new: MapRow, pace: float) -> Iterator[Change]:
    if old.problem != new.problem:
        text = f"{old.problem or 'mapped'} -> {new.problem or 'mapped'}"
        yield Change(row=new.name, text=text, worse=bool(new.problem) and not old.problem)
        return
    if old.error_m is not None and new.error_m is not None:
        grown, ratio = new.error_m - old.error_m, new.error_m / max(old.error_m, 1e-6)
        if abs(grown) >= CHANGE.error_m and not 1 / (1 + CHANGE.share) < ratio < 1 + CHANGE.share:
            text = f"error {old.error_m:.3f} -> {new.error_m:.3f} m"
            yield Change(row=new.name, text=text, worse=grown > 0)
    if old.cpu_s and new.cpu_s:
        ratio = new.cpu_s / old.cpu_s / pace
        moved = abs(new.cpu_s / pace - old.cpu_s) >= CHANGE.seconds
        if moved and not 1 / (1 + CHANGE.share) < ratio < 1 + CHANGE.share:
            text = f"processor time {old.cpu_s:.1f} -> {new.cpu_s:.1f} s ({ratio:.2f} of what all changed by)"
            yield Change(row=new.name, text=text, worse=ratio > 1)
    if old.parts != new.parts:
        worse = (new.parts or 0) > (old.parts or 0)
        yield Change(row=new.name, text=f"parts {old.parts} -> {new.parts}", worse=worse)
    if round(100 * (old.lost or 0)) != round(100 * (new.lost or 0)):
        text = f"scans lost {100 * (old.lost or 0):.0f} -> {100 * (new.lost or 0):.0f} %"
        yield Change(row=new.name, text=text, worse=(new.lost or 0) > (old.lost or 0))
    verdicts = {warning.about: warning.verdict for row in (old, new) for warning in row.warnings}
    gone, come = ({w.about for w in row.warnings} for row in (old, new))
    for about in sorted(come - gone):
        text = f"new warning: {about} ({verdicts[about]})"
        yield Change(row=new.name, text=text, worse=verdicts[about] == "false")
    for about in sorted(gone - come):
        text = f"no longer warned of: {about} ({verdicts[about]})"
        yield Change(row=new.name, text=text, worse=verdicts[about] == "right")


def _same_windows(
    rows: Sequence[tuple[PairRow, PairRow]], *, same_form: bool
) -> list[tuple[QueryRow, QueryRow]]:
    """The answers of both runs to the same windows.

    same_form : whether both runs are quick, or none. If not, fewer answers judge each other in one of them,
        and what is judged in one only is left out.
    """
    return [
        (a, b)
        for old, new in rows
        for b in new.queries
        for a in old.queries
        if (a.window, a.start_s) == (b.window, b.start_s)
        and (same_form or (a.right is None) == (b.right is None))
    ]


def _pair_changes(
    name: str, old_problem: str, new_problem: str, windows: Sequence[tuple[QueryRow, QueryRow]]
) -> Iterator[Change]:
    if old_problem != new_problem:
        text = f"{old_problem or 'asked'} -> {new_problem or 'asked'}"
        yield Change(row=name, text=text, worse=bool(new_problem) and not old_problem)
    outcomes = [(_outcome(a), _outcome(b)) for a, b in windows]
    for what in ("right", "wrong", "refused", "not judged", "failed"):
        then, now = (sum(outcome[k] == what for outcome in outcomes) for k in (0, 1))
        if then != now:
            yield Change(
                row=name,
                text=f"{what} {then} -> {now} of {len(outcomes)}",
                worse=what == "failed" and now > then,
            )
    for (old, new), (was, is_) in zip(windows, outcomes, strict=True):
        if is_ == "wrong" and was != "wrong":
            sure = f" at {new.confidence:.3f}" if new.confidence is not None else ""
            off = f", {new.error_m:.2f} m off" if new.error_m is not None else ""
            text = f"newly wrong: the window from {old.start_s:.1f} s{off}{sure} ({was} before)"
            yield Change(row=name, text=text, worse=True)


def _worse(name: str, windows: Sequence[tuple[QueryRow, QueryRow]]) -> Iterator[Change]:
    """Whether fewer are located and right, by a sign test over the windows that changed."""
    was = [_outcome(a) == "right" for a, _ in windows]
    is_ = [_outcome(b) == "right" for _, b in windows]
    lost = sum(a and not b for a, b in zip(was, is_, strict=True))
    won = sum(b and not a for a, b in zip(was, is_, strict=True))
    if lost == won:
        return
    chance = by_chance(max(lost, won), min(lost, won))
    text = f"{won} windows more are located and right, {lost} are no longer (p {chance:.3f})"
    if chance < ALPHA or name == "all queries":
        yield Change(row=name, text=text, worse=lost > won and chance < ALPHA)


def _outcome(query: QueryRow) -> str:
    if query.problem:
        return "failed"
    if not query.located:
        return "refused"
    return "not judged" if query.right is None else "right" if query.right else "wrong"
