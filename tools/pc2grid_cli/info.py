"""`pc2grid info`: what is in a recording, and what `convert` would use of it and why."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any

import typer

from pc2grid.errors import one_line
from pc2grid_cli.console import print_json
from pc2grid_cli.settings import AsJson, Recover, Topic


def info_command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="the recording to look at")],
    topic: Topic = None,
    recover: Recover = False,
    json: AsJson = False,
) -> None:
    """Say what is in a recording, and which topic convert would use and why.

    Example: pc2grid info monday.mcap
    """
    document = describe(log, topic=topic, recover=recover)
    if json:
        print_json(document)
    else:
        _show(document)


def describe(path: Path, *, topic: str | None = None, recover: bool = False) -> dict[str, Any]:
    """The answer as one JSON-able document; `choice` is null and `problem` says why, if convert could not.

    Reads the log's summary and a few messages only, unless it has no summary.
    Raises LogError if the file cannot be opened.
    """
    from pc2grid.config import ReadConfig
    from pc2grid.errors import Pc2GridError
    from pc2grid.io import open_log

    with open_log(path, ReadConfig(topic=topic), recover=recover) as log:
        found = log.info
        choice: dict[str, Any] | None = None
        problem: str | None = None
        try:
            chosen = log.choose()
        except Pc2GridError as error:
            problem = str(error)
        else:
            choice = {
                "topic": chosen.topic,
                "sensor": chosen.sensor,
                "odometry_topic": chosen.odometry_topic,
                "base_frame": chosen.base_frame,
                "sensor_frame": chosen.sensor_frame,
                "reason": chosen.reason,
            }
        report = log.report()
        return {
            "schema_version": 1,
            "path": str(found.path),
            "format": found.format,
            "size_bytes": found.size_bytes,
            "start_ns": found.start_ns,
            "end_ns": found.end_ns,
            "duration_s": found.duration_s,
            "message_count": found.message_count,
            "topics": [
                {"topic": t.topic, "type": t.type, "encoding": t.encoding, "message_count": t.message_count}
                for t in found.topics
            ],
            "choice": choice,
            "problem": problem,
            "bytes_lost": report.bytes_lost,
            "warnings": list(dict.fromkeys((*found.warnings, *report.warnings))),
        }


def _show(document: dict[str, Any]) -> None:
    from rich import markup
    from rich.console import Console
    from rich.table import Table

    def escape(text: str) -> str:
        # Names come from the log, and may hold what a terminal would obey.
        return markup.escape(one_line(text))

    console = Console()
    choice = document["choice"] or {}
    count = document["message_count"]
    console.print(f"[bold]{escape(document['path'])}[/bold]", soft_wrap=True, highlight=False)
    console.print(
        f"{document['format']}, {document['size_bytes'] / 1e6:.1f} MB, {document['duration_s']:.1f} s from "
        f"{_when(document['start_ns'])}, {'?' if count is None else count} messages",
        soft_wrap=True,
        highlight=False,
    )
    table = Table(box=None, pad_edge=False)
    for name in ("topic", "type", "messages", "used as"):
        table.add_column(name, justify="right" if name == "messages" else "left", overflow="fold")
    uses = {choice.get("odometry_topic"): "odometry", choice.get("topic"): f"scans ({choice.get('sensor')})"}
    for topic in document["topics"]:
        number = "?" if topic["message_count"] is None else str(topic["message_count"])
        table.add_row(escape(topic["topic"]), escape(topic["type"]), number, uses.get(topic["topic"], ""))
    console.print(table)
    if choice:
        console.print(f"convert uses {escape(choice['topic'])}: {escape(choice['reason'])}", soft_wrap=True)
        frames = f"base frame {choice['base_frame']}, scans in frame {choice['sensor_frame'] or '(unnamed)'}"
        console.print(escape(frames), soft_wrap=True, highlight=False)
    else:
        console.print(f"convert cannot use this log: {escape(str(document['problem']))}", soft_wrap=True)
    for warning in document["warnings"]:
        console.print(f"note: {escape(warning)}", soft_wrap=True, highlight=False)


def _when(stamp_ns: int) -> str:
    """RFC 3339, UTC."""
    try:
        moment = datetime.fromtimestamp(stamp_ns // 1_000_000_000, tz=timezone.utc)
    except (OverflowError, ValueError, OSError):
        return f"{stamp_ns} ns"
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")
