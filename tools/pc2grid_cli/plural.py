"""Numbers of things in words."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """A number with its noun.

    >>> counted(1, "submap"), counted(0, "submap"), counted(12, "lidar scan")
    ('1 submap', '0 submaps', '12 lidar scans')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"
