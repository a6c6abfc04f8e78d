"""Data that was lost while a recording was read: the warning, and whether the exit code is 3."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pc2grid.model import ReadReport


def sentence(report: ReadReport) -> str:
    """What was lost, by reason, for a warning."""
    parts = [f"{count} scans skipped ({reason})" for reason, count in report.scans_skipped.items()]
    if report.bytes_lost:
        parts.append(f"{report.bytes_lost} bytes unreadable")
    return f"data was lost: {', '.join(parts)}"


def ends_with_3(report: ReadReport, strict: bool) -> bool:
    """Whether the loss is severe; with `strict` any loss is."""
    return report.severe or (strict and report.lossy)
