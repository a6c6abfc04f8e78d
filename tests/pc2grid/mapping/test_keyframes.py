"""Keyframes that wait in a file."""

from __future__ import annotations

import errno
import io

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import OutputError
from pc2grid.geometry import SE2
from pc2grid.mapping import keyframes as spool
from pc2grid.mapping.keyframes import Keyframe, Keyframes


def planar_scan(hits: int) -> PlanarScan:
    rng = np.random.default_rng(hits)
    return PlanarScan.of_hits(
        stamp_ns=2**60 + hits,
        hits_m=rng.normal(size=(hits, 2)).astype(np.float32),
        origin_m=rng.normal(size=2),
        free_m=rng.random(8).astype(np.float32),
    )


@pytest.mark.parametrize("in_memory_bytes", [spool.IN_MEMORY_BYTES, 1])
def test_keyframes_come_back_as_they_were(monkeypatch: pytest.MonkeyPatch, in_memory_bytes: int) -> None:
    monkeypatch.setattr(spool, "IN_MEMORY_BYTES", in_memory_bytes)
    keyframes = Keyframes()
    kept = [Keyframe(3 * k, planar_scan(k), SE2(0.1 * k, 1.0, -0.2), k == 7) for k in range(20)]
    for k, keyframe in enumerate(kept):
        keyframes.append(keyframe)
        keyframes[k // 2]  # reading moves the file; the next goes to its end all the same
    for got, want in zip(keyframes, kept, strict=True):
        assert (got.index, got.T_session_base, got.restart) == (
            want.index,
            want.T_session_base,
            want.restart,
        )
        for name in ("stamp_ns", "hits_m", "normal_rad", "origin_m", "free_m", "height_m"):
            assert np.array_equal(getattr(got.planar_scan, name), getattr(want.planar_scan, name))
    keyframes.close()


def test_a_full_disk_under_the_keyframes_is_an_output_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.BytesIO):
        def write(self, data: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tempfile.SpooledTemporaryFile", lambda max_size: Full())
    with pytest.raises(OutputError, match="no room for the scans of the map: No space left") as caught:
        Keyframes().append(Keyframe(0, planar_scan(5), SE2()))
    assert "TMPDIR" in str(caught.value.hint)
