"""Recordings that have what users report: the folder `field` beside the real data (PC2GRID_DATA), and others
that are altered to have it."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from pc2grid.errors import Pc2GridError
from pc2grid.geometry import F64
from pc2grid_cli.main import app
from signature.database import open_database
from tests.helpers.recordings import Message, ros, write_mcap

DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).resolve().parents[2] / ".." / "shared" / "data"))
Change = Callable[[str, Any, int], Any]
"""Of a topic, a message and its log time: the message as it is in the altered recording; None: left out."""


def field_log(name: str) -> Path:
    """The recording of this name; the test that asks for it is skipped where it is not there."""
    return field_file(f"{name}.mcap")


def field_file(name: str) -> Path:
    """The file of this name; the test that asks for it is skipped where it is not there."""
    path = DATA.resolve().parent / "field" / name
    if not path.is_file():
        pytest.skip(f"{path}: no such file here; PC2GRID_DATA names the folder beside it")
    return path


def altered(source: Path, target: Path, change: Change) -> Path:
    """A recording (of ROS 2) whose messages are changed, written to `target`."""
    store, messages = ros().store, []
    with source.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            content = store.deserialize_cdr(message.data, schema.name)
            changed = change(channel.topic, content, message.log_time)
            if changed is not None:
                data = bytes(store.serialize_cdr(changed, changed.__msgtype__))
                kind = changed.__msgtype__.replace("/msg/", "/")
                messages.append(Message(channel.topic, kind, message.log_time, data))
    return write_mcap(target, messages)


class Outcome(NamedTuple):
    """What `pc2grid convert` made of an input: exit code, all that was printed, warnings, the document of the
    session and its poses (N, 4, 4); None if there is none."""

    code: int
    said: str
    warnings: list[str]
    session: dict[str, Any] | None = None
    poses: F64 | None = None

    @property
    def steps_m(self) -> F64:
        """(N - 1,) distances from scan to scan."""
        assert self.poses is not None, self.said
        distances: F64 = np.linalg.norm(np.diff(self.poses[:, :2, 3], axis=0), axis=1)
        return distances

    def warned_of(self, words: str) -> bool:
        """Whether a warning has these words."""
        return any(words in warning for warning in self.warnings)


def convert(path: Path, folder: Path, *options: str) -> Outcome:
    """Run the command on an input, into a folder."""
    database = folder / f"{path.stem}.submaps"
    arguments = ["convert", str(path), "-o", str(database), "--json", "--force", *options]
    result = CliRunner().invoke(app, arguments)
    if not database.exists():
        failure = result.exception
        error = failure.in_short if isinstance(failure, Pc2GridError) else str(failure or "")
        return Outcome(result.exit_code, f"{error}\n{result.output}", [])
    session = json.loads(result.stdout)["sessions"][0]
    with open_database(database) as opened:
        poses = opened.trajectory(session["session"]).T_session_base
    return Outcome(result.exit_code, result.output, session["report"]["warnings"], session, poses)


def info(path: Path, *options: str) -> dict[str, Any]:
    """The document of `pc2grid info`."""
    result = CliRunner().invoke(app, ["info", str(path), "--json", *options])
    assert result.exit_code == 0, result.output
    document: dict[str, Any] = json.loads(result.stdout)
    return document
