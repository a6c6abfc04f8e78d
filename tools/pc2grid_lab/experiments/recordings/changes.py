"""What changed between two runs, row by row, and what became worse by more than chance."""

from __future__ import annotations

from collections import Counter
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
class RowChange:
    """A line of what changed. row : of the page. worse : by more than chance."""

    row: str
    text: str
    worse: bool = False


def changes(before: Table, after: Table) -> list[RowChange]:
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


def _map_changes(old: MapRow, new: MapRow, pace: float) -> Iterator[RowChange]:
    if old.problem != new.problem:
        yield _problem(new.name, old.problem, new.problem, "mapped")
        return
    for text, was, is_, told in _figures(old, new, pace):
        if told:
            yield RowChange(row=new.name, text=text, worse=is_ > was)
    verdicts = [{warning.about: warning.verdict for warning in row.warnings} for row in (old, new)]
    for words, some, others, bad in (
        ("new warning", verdicts[1], verdicts[0], "false"),
        ("no longer warned of", verdicts[0], verdicts[1], "right"),
    ):
        for about in sorted(some.keys() - others.keys()):
            verdict = some[about]
            yield RowChange(row=new.name, text=f"{words}: {about} ({verdict})", worse=verdict == bad)


def _figures(old: MapRow, new: MapRow, pace: float) -> Iterator[tuple[str, float, float, bool]]:
    """What is said of each figure of a map, the two values (more is worse), and whether it is told."""
    if old.error_m is not None and new.error_m is not None:
        text = f"error {old.error_m:.3f} -> {new.error_m:.3f} m"
        yield text, old.error_m, new.error_m, _moved(old.error_m, new.error_m, CHANGE.error_m)
    if old.cpu_s and new.cpu_s:
        cpu_s = new.cpu_s / pace
        ratio = f"({cpu_s / old.cpu_s:.2f} of what all changed by)"
        text = f"processor time {old.cpu_s:.1f} -> {new.cpu_s:.1f} s {ratio}"
        yield text, old.cpu_s, cpu_s, _moved(old.cpu_s, cpu_s, CHANGE.seconds)
    yield f"parts {old.parts} -> {new.parts}", old.parts or 0, new.parts or 0, old.parts != new.parts
    was, is_ = (100 * (row.lost or 0.0) for row in (old, new))
    yield f"scans lost {was:.0f} -> {is_:.0f} %", was, is_, round(was) != round(is_)


def _moved(old: float, new: float, least: float) -> bool:
    """Whether a value differs by `least` and by more than `ChangeParameters.share`."""
    ratio, share = new / max(old, 1e-6), 1 + CHANGE.share
    return abs(new - old) >= least and not 1 / share < ratio < share


def _problem(row: str, old: str, new: str, without: str) -> RowChange:
    """Two problems that differ. without : the word for none."""
    return RowChange(row=row, text=f"{old or without} -> {new or without}", worse=bool(new) and not old)


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
) -> Iterator[RowChange]:
    if old_problem != new_problem:
        yield _problem(name, old_problem, new_problem, "asked")
    before, after = (Counter(_outcome(pair[k]) for pair in windows) for k in (0, 1))
    for what in ("right", "wrong", "refused", "not judged", "failed"):
        if before[what] != after[what]:
            text = f"{what} {before[what]} -> {after[what]} of {len(windows)}"
            yield RowChange(row=name, text=text, worse=what == "failed" and after[what] > before[what])
    for old, new in windows:
        if _outcome(new) == "wrong" != _outcome(old):
            sure = f" at {new.confidence:.3f}" if new.confidence is not None else ""
            off = f", {new.error_m:.2f} m off" if new.error_m is not None else ""
            text = f"newly wrong: the window from {old.start_s:.1f} s{off}{sure} ({_outcome(old)} before)"
            yield RowChange(row=name, text=text, worse=True)


def _worse(name: str, windows: Sequence[tuple[QueryRow, QueryRow]]) -> Iterator[RowChange]:
    """Whether fewer are located and right, by a sign test over the windows that changed."""
    counts = Counter((_outcome(a) == "right", _outcome(b) == "right") for a, b in windows)
    lost, won = counts[True, False], counts[False, True]
    if lost == won:
        return
    chance = by_chance(max(lost, won), min(lost, won))
    text = f"{won} windows more are located and right, {lost} are no longer (p {chance:.3f})"
    if chance < ALPHA or name == "all queries":
        yield RowChange(row=name, text=text, worse=lost > won and chance < ALPHA)


def _outcome(query: QueryRow) -> str:
    if query.problem:
        return "failed"
    if not query.located:
        return "refused"
    return "not judged" if query.right is None else "right" if query.right else "wrong"
