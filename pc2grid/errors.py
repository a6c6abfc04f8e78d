"""Every error that pc2grid raises on purpose, as one tree.

The library raises; only the command line prints and exits. A message is one line with the fault and its
place; `hint` is what to type next: the command line prints it as it is, `str` in terms of Python.
"""

from __future__ import annotations

import re


def _setting(found: re.Match[str]) -> str:
    """Return a setting of the command line as an argument in Python."""
    section, key, value = found.groups()
    known = {"true": "True", "false": "False"}.get(value)
    plain = value if re.fullmatch(r"-?[\d.]+|N", value) else repr(value)
    return f"config=Config({section}={{'{key}': {known or plain}}})"


_IN_PYTHON = (
    (r"--set (\w+)\.(\w+)=([^\s,;()]+)", _setting),
    (r"--(topic|odometry|imu) ([^\s,;()]+(?:,/[^\s,;()]+)*)", r"config=Config(read={'\1': '\2'})"),
    (r"--(topic|odometry|imu)", r"config=Config(read={'\1': ...})"),
    (r"--start and --duration", "span=TimeSpan(start_s, duration_s)"),
    (r"--start\b", "start_m"),
    (r"--near X Y RADIUS", "prior=Prior.around(x_m, y_m, radius_m)"),
    (r"--force", "overwrite=True"),
    (r"--(recover|add)", r"\1=True"),
    (r"--(name|session|floor)\b( NAME)?", r"\1=..."),
    (r"`?pc2grid convert (\S+) -o ([^\s`]+)`?", r'pc2grid.convert("\1", "\2")'),
    (r"`pc2grid info ([^`]+)`", r'pc2grid.open_log("\1").info'),
)
"""What stands for options of the command line in Python, in this order."""


def in_python(hint: str) -> str:
    """Translate a hint for the command line into one for Python.

    >>> print(in_python("choose one, e.g. --topic /front"))
    choose one, e.g. config=Config(read={'topic': '/front'})
    >>> print(in_python("--set read.max_points=1000 raises it"))
    config=Config(read={'max_points': 1000}) raises it
    """
    parts = re.split(r"(`pc2grid db .*?`)", hint)  # these have no function that is as short
    for option, argument in _IN_PYTHON:
        parts[::2] = [re.sub(option, argument, part) for part in parts[::2]]
    return "".join(parts)


def one_line(text: str) -> str:
    """Escape line breaks and control characters: names in a file may contain them."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class Pc2GridError(Exception):
    """Base of all errors of pc2grid.

    Parameters
    ----------
    message : what is wrong and where (file, topic, key), in one line.
    hint : what the user can do or type next; printed behind the message.
    """

    exit_code = 1

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        self.message = one_line(message)
        self.hint = None if hint is None else one_line(hint)
        super().__init__(self.message)

    def __str__(self) -> str:
        return self.message if self.hint is None else f"{self.message} ({in_python(self.hint)})"

    @property
    def in_short(self) -> str:
        """Return message and hint in one line, as the command line prints them."""
        return self.message if self.hint is None else f"{self.message} ({self.hint})"


# --- logs ---------------------------------------------------------------------------------------------


class LogError(Pc2GridError):
    """A recording cannot be used."""


class LogNotFound(LogError):
    """The path is missing, a folder without a recording, or unreadable."""


class NotALog(LogError):
    """The file is of a kind that pc2grid does not read, or the folder holds several recordings."""


class LogTruncated(LogError):
    """The recording ends in the middle."""


class LogCorrupt(LogError):
    """The recording is damaged."""


class LimitExceeded(LogError):
    """The file asks for more memory or work than the configured limit allows."""


class UnsupportedSchema(LogError):
    """A topic's message type, encoding or compression is not one that pc2grid reads."""


class TopicError(LogError):
    """The topic asked for does not exist, or several would do and none was named."""


class NoScans(LogError):
    """The recording, or the part of it that is asked for, holds no scans to make a map from."""


class TrackingLost(LogError):
    """The scans of a laser cannot be followed, and no odometry bridges the gaps: there is no map."""


class PointCloudError(LogError):
    """A PointCloud2, LaserScan or depth image contradicts itself."""


class FrameError(LogError):
    """A coordinate frame is unknown, or not connected to the base frame."""


class LiveError(LogError):
    """A running robot cannot be reached, or does not take messages."""


# --- maps and trajectories ----------------------------------------------------------------------------


class MapFileError(Pc2GridError):
    """A map.yaml or its image is malformed."""


class TrajectoryFileError(Pc2GridError):
    """A TUM file, or a file of times, is malformed."""


# --- configuration, database, output ------------------------------------------------------------------


class ConfigError(Pc2GridError):
    """A configuration key or value is wrong."""

    exit_code = 2


class DatabaseError(Pc2GridError):
    """A submap database cannot be used."""


class NotADatabase(DatabaseError):
    """The file is not a pc2grid database."""


class DatabaseCorrupt(DatabaseError):
    """The database is damaged: its structure, or a row whose checksum is wrong."""


class DatabaseVersion(DatabaseError):
    """The database was written in a format this version does not read."""


class DatabaseBusy(DatabaseError):
    """Another process holds the database for writing."""


class DatabaseUnreachable(DatabaseError):
    """The server of a database does not answer, refuses the connection, or closed it."""


class ClusterError(Pc2GridError):
    """The cluster that should convert recordings cannot be used."""


class OutputError(Pc2GridError):
    """A result cannot be written: it exists already, the disk is full, or permission is missing."""
