"""Lost scans: a warning up to a named share, exit code 3 from there on, or with --strict."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from pc2grid.model import MISSING_FILES, ReadReport
from pc2grid_cli import output as data_loss
from pc2grid_cli.main import app
from tests.helpers.recordings import STEP, T0, ros, write_mcap


@pytest.mark.parametrize(
    ("report", "lossy", "severe"),
    [
        (ReadReport(scans_read=500), False, False),
        (ReadReport(scans_read=500, scans_skipped={"registration lost": 4}), True, False),
        (ReadReport(scans_read=500, scans_skipped={"registration lost": 4, "no stamp": 1}), True, True),
        (ReadReport(scans_read=500, scans_skipped={MISSING_FILES: 1}), True, True),
        (ReadReport(scans_read=500, bytes_lost=1), True, True),
        (ReadReport(scans_read=0, scans_skipped={"no stamp": 1}), True, True),
        (ReadReport(scans_read=0), False, False),
    ],
)
def test_which_losses_are_severe(report: ReadReport, lossy: bool, severe: bool) -> None:
    assert (report.lossy, report.severe) == (lossy, severe)
    assert data_loss.ends_with_3(report, strict=False) == severe
    assert data_loss.ends_with_3(report, strict=True) == lossy


def test_one_lost_scan_of_150_is_a_warning(tmp_path: Path) -> None:
    ranges = [2.0 + 0.01 * (k % 7) for k in range(315)]
    scans = [ros().laser("/scan", T0 + i * STEP, ranges) for i in range(150)]
    log = write_mcap(tmp_path / "a.mcap", [*scans, ros().laser("/scan", T0, ranges)._replace(
        log_time_ns=T0 + 150 * STEP
    )])  # fmt: skip
    for options, code in (((), 0), (("--strict",), 3)):
        output = tmp_path / f"{code}.submaps"
        done = CliRunner().invoke(app, ["convert", str(log), "-o", str(output), *options])
        assert done.exit_code == code, done.stderr
        assert "warning: a: data was lost: 1 scans skipped" in done.stderr
        assert output.exists()
