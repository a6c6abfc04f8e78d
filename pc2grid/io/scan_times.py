"""When a recording begins and ends: with its scans.

Other messages may lie far from them: an odometry that was started first, a transform with a wrong clock.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from pc2grid.io import topics
from pc2grid.io.message_source import LogInfo, MessageSource

_STEP_NS = 1_000_000_000
"""The last message is looked for in steps that begin with this; chosen by hand: a scanner is faster."""
_FAR_NS = 5_000_000_000
"""Messages that are farther from all scans are reported, as a gap between scans is."""


def with_scan_times(source: MessageSource, wanted: str | None) -> LogInfo:
    """The facts about a recording, with the times of its scans in place of those of all messages.

    wanted : the topics of the scans; None: of all that hold scans. Messages far from the scans are among the
    warnings. Without scans, the times are those of all messages.

    Raises LogError if damage is reached.
    """
    info = source.info
    names = {t.topic for t in topics.usable(info.topics, wanted) if t.message_count != 0}
    first_ns = _first_ns(source, names)
    if first_ns is None:
        return info
    last_ns = _last_ns(source, names, first_ns)
    of_scans = replace(info, start_ns=first_ns, end_ns=last_ns)
    if max(first_ns - info.start_ns, info.end_ns - last_ns) <= _FAR_NS:
        return of_scans
    others = [t.topic for t in info.topics if t.topic not in names and t.message_count != 0]
    return replace(of_scans, warnings=(*info.warnings, *_strays(source, of_scans, others)))


def _strays(source: MessageSource, scans: LogInfo, names: Collection[str]) -> list[str]:
    """A sentence for each topic with messages far from the scans."""
    told = []
    for name in names:
        first_ns = _first_ns(source, {name})
        if first_ns is None:
            continue
        before_ns, after_ns = scans.start_ns - first_ns, _last_ns(source, {name}, first_ns) - scans.end_ns
        where = [f"{before_ns * 1e-9:.1f} s before the first scan"] if before_ns > _FAR_NS else []
        where += [f"{after_ns * 1e-9:.1f} s after the last scan"] if after_ns > _FAR_NS else []
        if where:
            told.append(f"{name}: a message {' and one '.join(where)}; times are those of the scans")
    return told


def _first_ns(source: MessageSource, names: Collection[str]) -> int | None:
    return next((message.log_time_ns for message in source.messages(names)), None)


def _last_ns(source: MessageSource, names: Collection[str], first_ns: int) -> int:
    """The last log time of messages of these topics, found from the end without reading all of them."""
    low_ns, high_ns = first_ns, source.info.end_ns + 1  # the last one is not before low, and before high
    step_ns = _STEP_NS
    while high_ns - low_ns > _STEP_NS:
        middle_ns = max(high_ns - step_ns, low_ns)
        if next(iter(source.messages(names, middle_ns, high_ns)), None) is None:
            high_ns, step_ns = middle_ns, 2 * step_ns
        else:
            low_ns, step_ns = middle_ns, _STEP_NS
    times_ns = (message.log_time_ns for message in source.messages(names, low_ns, high_ns))
    return max(times_ns, default=first_ns)
