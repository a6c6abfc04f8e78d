"""`pc2grid compare log`: a real recording cut into a map and queries, against its ground truth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pc2grid_cli import console
from pc2grid_cli import settings as options

if TYPE_CHECKING:
    from signature.evaluation.replay import Part, Tally
    from signature.evaluation.trial import Trial


def compare_log_command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="the recording")],
    truth: Annotated[Path, typer.Option("--truth", metavar="TUM", help="its true poses, stamped alike")],
    of_base: Annotated[
        bool, typer.Option("--of-base", help="the poses are of the base, not of the sensor")
    ] = False,
    map_: Annotated[
        str, typer.Option("--map", metavar="FROM..TO", help="seconds that become the map")
    ] = "0..600",
    queries: Annotated[
        int, typer.Option("--queries", min=1, help="parts to locate, spread over what comes after the map")
    ] = 10,
    length: Annotated[float, typer.Option("--length", min=1.0, help="seconds each of them lasts")] = 40.0,
    topic: options.Topic = None,
    odometry: options.OdometryTopic = None,
    config: options.ConfigFile = None,
    set_: options.Assignments = None,
    json: options.AsJson = False,
) -> None:
    """Locate later parts of a recording in a map made of an earlier part, and judge the answers.

    Example: pc2grid compare log fr079.mcap --truth fr079_corrected.tum --map 0..600 --queries 10
    """
    from pc2grid.io import open_log
    from pc2grid.io.trajectory import read_tum
    from signature.evaluation.replay import Replay, Tally, spread

    settings = options.make_config(config, set_, topic=topic, odometry=odometry)
    part = _part(map_)
    with open_log(log, settings.read) as opened:
        replay = Replay(opened, read_tum(truth), settings, of_base=of_base)
        end_s = (opened.info.end_ns - opened.info.start_ns) * 1e-9
        with console.progress("map") as advance:
            mapped = replay.map(part, advance)
        trials = []
        with console.progress("locate") as advance:
            asked = spread(part.start_s + part.length_s, end_s, queries, length)
            for done, query in enumerate(asked, start=1):
                trials.append(replay.locate(query, mapped))
                advance(done / len(asked))
    judged = [trial for trial in trials if trial is not None]
    tally = Tally.of(judged)
    if json:
        document = {
            "schema_version": 1,
            "log": log.name,
            "map_s": [part.start_s, part.start_s + part.length_s],
            "length_s": length,
            "without_truth": len(trials) - len(judged),
            "tally": asdict(tally),
            "trials": [trial.to_json() for trial in judged],
        }
        console.print_json(document)
    else:
        _print(judged, tally, len(trials) - len(judged))


def _part(text: str) -> Part:
    from pc2grid.errors import ConfigError
    from signature.evaluation.replay import Part

    first, _, last = text.partition("..")
    try:
        part = Part(start_s=float(first), length_s=float(last) - float(first))
    except ValueError:
        raise ConfigError(f"--map {text}: not a span of seconds", hint="for example --map 0..600") from None
    if part.start_s < 0 or part.length_s <= 0:
        raise ConfigError(f"--map {text}: ends before it begins", hint="for example --map 0..600")
    return part


def _print(trials: list[Trial], tally: Tally, unknown: int) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="later parts of the recording in the map of the earlier one")
    for heading in ("from", "driven", "covered", "answer", "confidence", "off by"):
        table.add_column(heading, justify="left" if heading == "answer" else "right")
    for trial in trials:
        table.add_row(
            f"{trial.seed} s",
            f"{trial.travel_m:.1f} m",
            f"{trial.mapped:.2f}",
            trial.status,
            f"{trial.confidence:.2f}",
            f"{trial.error_m:.2f} m" if trial.status == "located" else "",
        )
    out = Console()
    out.print(table)
    share = f", {tally.right / tally.inside:.2f}" if tally.inside else ""
    out.print(
        f"where the map covers what the query saw: {tally.right} of {tally.inside} located and right{share},"
        f" {tally.wrong} wrong, {tally.unsure} without an answer"
    )
    if tally.outside:
        out.print(
            f"elsewhere: {tally.refused} of {tally.outside} without an answer, as it should be,"
            f" {tally.wrong_outside} wrong"
        )
    if unknown:
        out.print(f"{unknown} queries could not be judged: the truth says nothing of them")
