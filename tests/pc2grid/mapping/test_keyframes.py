"""Keyframes that wait in a file."""

from __future__ import annotations

import errno
import io

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import OutputError
from pc2grid.geometry import SE2
from pc2grid.mapping.keyframes import Keyframe, Keyframes


def test_keyframes_come_back_from_a_file_as_they_were() -> None:
    small, spilled = Keyframes(), Keyframes(in_memory_bytes=1)
    rng = np.random.default_rng(0)
    kept = []
    for k in range(20):
        planar_scan = PlanarScan.of_hits(
            stamp_ns=2**60 + k,
            hits_m=rng.normal(size=(k, 2)).astype(np.float32),
            origin_m=rng.normal(size=2),
            free_m=rng.random(8).astype(np.float32),
        )
        kept.append(Keyframe(3 * k, planar_scan, SE2(*rng.normal(size=3)), k == 7))
        small.append(kept[-1])
        spilled.append(kept[-1])
        spilled[k // 2]  # reading moves the file; the next goes to its end all the same
    for keyframes in (small, spilled):
        assert len(keyframes) == 20
        for got, want in zip(keyframes, kept, strict=True):
            assert (got.index, got.restart, got.T_session_base) == (
                want.index,
                want.restart,
                want.T_session_base,
            )
            assert got.planar_scan.stamp_ns == want.planar_scan.stamp_ns
            for name in ("hits_m", "normal_rad", "origin_m", "free_m"):
                assert np.array_equal(getattr(got.planar_scan, name), getattr(want.planar_scan, name))
        keyframes.close()


def test_a_full_disk_under_the_keyframes_is_an_output_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.BytesIO):
        def write(self, data: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tempfile.SpooledTemporaryFile", lambda max_size: Full())
    planar_scan = PlanarScan.of_hits(
        stamp_ns=0,
        hits_m=np.ones((5, 2), np.float32),
        origin_m=np.zeros(2),
        free_m=np.ones(8, np.float32),
    )
    with pytest.raises(OutputError, match="no room for the scans of the map: No space left") as caught:
        Keyframes().append(Keyframe(0, planar_scan, SE2()))
    assert "TMPDIR" in str(caught.value.hint)
