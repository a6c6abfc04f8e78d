"""`pc2grid compare log`: a real recording cut into a map and queries, against its ground truth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from pc2grid.display import probability
from pc2grid.errors import ConfigError
from pc2grid.io import Log, open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.time_span import TimeSpan
from pc2grid_cli import console
from pc2grid_cli import options as options
from pc2grid_cli.tables import show, table
from pc2grid_lab.experiments.metrics import QueryCounts
from pc2grid_lab.experiments.replay import MappedPart, Replay, evenly_spaced
from pc2grid_lab.experiments.stored import in_processes
from pc2grid_lab.experiments.trial import JUDGEMENT, Trial

_MAP_S, _QUERY_S = 600.0, 40.0
"""Longest map and query that are chosen by default; chosen on fr079 and intel."""


def compare_log_command(
    context: typer.Context,
    log: Annotated[Path, typer.Argument(metavar="LOG", help="the recording")],
    truth: Annotated[Path, typer.Option("--truth", metavar="TUM", help="its true poses, stamped alike")],
    of_base: Annotated[
        bool, typer.Option("--of-base", help="the poses are of the base, not of the sensor")
    ] = False,
    map_: Annotated[
        str | None,
        typer.Option(
            "--map",
            metavar="FROM..TO",
            help="seconds that become the map; default: the first half of the log, at most 0..600",
        ),
    ] = None,
    queries: Annotated[
        int, typer.Option("--queries", min=1, help="parts to locate, spread over what comes after the map")
    ] = 10,
    length: Annotated[
        float | None,
        typer.Option(
            "--length",
            min=1.0,
            help="seconds each of them lasts; default: half of what comes after the map, at most 40",
        ),
    ] = None,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    json: options.AsJson = False,
) -> None:
    """Locate later parts of a recording in a map made of an earlier part, and judge the answers.

    Example: pc2grid compare log fr079.mcap --truth fr079_corrected.tum --map 0..600 --queries 10
    """
    settings = options.make_config(config, set_, topic=topic, odometry=odometry)
    wanted = None if map_ is None else _seconds(map_)
    _refuse_relations(truth)
    terminal = console.of(context)
    with open_log(log, settings.read) as opened:
        mapped, length_s, end_s = _spans(opened, wanted, length)
        to_s = mapped.start_s + (mapped.duration_s or 0.0)
        terminal.note(f"map: {mapped.start_s:.1f}..{to_s:.1f} s; queries last {length_s:.1f} s")
        replay = Replay(opened, read_tum(truth), settings, of_base=of_base)
        if replay.up != "z":
            console.warn(f"{truth.name}: {replay.up} points up in it; its poses are turned so that z does")
        part = _mapped(replay, mapped, terminal)
        with terminal.progress("locate") as advance:
            spans = [(span, part) for span in evenly_spaced(to_s, end_s, queries, length_s)]
            trials = in_processes(replay.locate, spans, jobs=1, advance=advance)
    judged = [trial for trial in trials if trial is not None]
    about = {"log": log.name, "map_s": [mapped.start_s, to_s], "length_s": length_s}
    if json:
        console.print_json(_document(judged, len(trials) - len(judged), about))
    else:
        _print(judged, len(trials) - len(judged))


def _document(trials: list[Trial], unknown: int, about: dict[str, Any]) -> dict[str, Any]:
    """What `--json` prints. unknown : queries that could not be judged."""
    return {
        "schema_version": 1,
        **about,
        "without_truth": unknown,
        "tally": asdict(QueryCounts.of(trials)),
        "trials": [asdict(trial) for trial in trials],
    }


def _spans(
    log: Log, wanted: tuple[float, float] | None, length_s: float | None
) -> tuple[TimeSpan, float, float]:
    """What becomes the map, the length of a query, and the end of the log. Raises ConfigError."""
    end_s = (log.info.end_ns - log.info.start_ns) * 1e-9
    from_s, to_s = wanted or (0.0, min(_MAP_S, end_s / 2))
    if to_s >= end_s:
        raise ConfigError(
            f"--map {from_s:g}..{to_s:g}: nothing is left to locate, the log lasts {end_s:.1f} s",
            hint=f"for example --map 0..{end_s / 2:.0f}",
        )
    return TimeSpan(from_s, to_s - from_s), length_s or min(_QUERY_S, (end_s - to_s) / 2), end_s


def _mapped(replay: Replay, span: TimeSpan, terminal: console.Console) -> MappedPart:
    observer = terminal.observer()
    with observer.step("map"):
        part = replay.map(span, observer)
    for warning in part.warnings:
        console.warn(f"map: {warning}")
    return part


def _refuse_relations(truth: Path) -> None:
    """Raises ConfigError for a list of relations, which has no pose of a single scan."""
    if truth.suffix == ".relations":
        raise ConfigError(
            f"{truth}: relations between poses, but poses are needed (TUM)",
            hint="`pc2grid compare maps --log LOG --truth FILE.relations` takes relations",
        )


def _seconds(text: str) -> tuple[float, float]:
    """The two numbers of `FROM..TO`. Raises ConfigError."""
    first, _, last = text.partition("..")
    try:
        from_s, to_s = float(first), float(last)
    except ValueError:
        raise ConfigError(f"--map {text}: not a span of seconds", hint="for example --map 0..600") from None
    if not 0 <= from_s < to_s:
        raise ConfigError(f"--map {text}: ends before it begins", hint="for example --map 0..600")
    return from_s, to_s


def _print(trials: list[Trial], unknown: int) -> None:
    counts = QueryCounts.of(trials)
    title = "later parts of the recording in the map of the earlier one"
    numbers = ["driven", "covered", "confidence", "off by", "map bent by"]
    found = table(title, ["from", "answer", "judged"], numbers)
    for trial in trials:
        found.add_row(
            f"{trial.seed} s",
            trial.status.replace("_", " "),
            _verdict(trial),
            f"{trial.travel_m:.1f} m",
            f"{trial.mapped:.2f}",
            probability(trial.confidence),
            "" if trial.error_m is None or trial.status != "located" else f"{trial.error_m:.2f} m",
            "" if trial.map_bent_m is None else f"{trial.map_bent_m:.2f} m",
        )
    share = f", {counts.right / counts.inside:.2f}" if counts.inside else ""
    show(
        found,
        "off by: against the map around, which as a whole may be bent by what the last column says",
        f"inside, where the map covers {JUDGEMENT.mapped:.2f} or more of what the query saw:"
        f" {counts.right} of {counts.inside} located and right"
        f"{share}, {counts.wrong} wrong, {counts.unsure} without an answer",
    )
    if counts.outside:
        at_the_edge = counts.outside - counts.refused - counts.wrong_outside
        show(
            f"outside, where the map covers less than {JUDGEMENT.mapped:.2f} of it and no answer is the right"
            f" one: {counts.refused} of {counts.outside} without an answer, {counts.wrong_outside} located"
            f" and wrong, {at_the_edge} located and right all the same, at its edge"
        )
    if unknown:
        show(f"{unknown} queries could not be judged: the truth has no pose of them")


def _verdict(trial: Trial) -> str:
    """What an answer counts as, in a word or two."""
    verdict = "no answer" if trial.status != "located" else "right" if trial.right else "wrong"
    return verdict if trial.in_map else f"outside, {verdict}"
