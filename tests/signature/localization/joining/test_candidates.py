"""Of many sessions, each is compared with those whose places look like its own."""

from __future__ import annotations

import numpy as np
import pytest

from signature.localization.joining.candidates import CandidateParameters, LookedAt, candidates
from signature.seen_places import SIGNATURE_COLUMNS, SeenPlaces

BUILDINGS, SESSIONS, PLACES = 6, 4, 30
FEW = CandidateParameters(sessions=3, neighbours=16)


def sessions() -> dict[str, LookedAt]:
    """Vectors of 30 places a building, far from each other; in each session half of a step off. The spread
    that comes with the program expects steps of about 1 at one place, and of 5 and more at two."""
    rng = np.random.default_rng(0)
    at = rng.normal(0.0, 3.0, (BUILDINGS, PLACES, 24))
    return {
        f"{b}-{s}": LookedAt(
            (at[b] + rng.normal(0.0, 0.5, (PLACES, 24))).astype(np.float32), np.ones(PLACES, np.float32)
        )
        for s in range(SESSIONS)
        for b in range(BUILDINGS)
    }


def test_sessions_of_the_same_building_come_first() -> None:
    all_of_them = sessions()
    found = candidates(all_of_them, all_of_them, parameters=FEW)
    assert found.keys() == all_of_them.keys()
    for name, others in found.items():
        assert sorted(others) == [f"{name[0]}-{s}" for s in range(SESSIONS) if f"{name[0]}-{s}" != name]


def test_a_large_session_is_not_likelier_because_it_has_more_places() -> None:
    """Beside its building's, each place has eight places of a large session that look a little like it."""
    all_of_them = sessions()
    rng = np.random.default_rng(1)
    here = np.concatenate([all_of_them[f"{b}-0"].vectors for b in range(BUILDINGS)])
    alike = np.repeat(here, 8, axis=0) + rng.normal(0.0, 0.8, (8 * len(here), 24))
    large = LookedAt(alike.astype(np.float32), np.ones(len(alike), np.float32))
    found = candidates({**all_of_them, "large": large}, ["0-0"], parameters=FEW)
    assert sorted(found["0-0"]) == ["0-1", "0-2", "0-3"]


def test_what_may_not_be_compared_takes_no_place_of_the_others() -> None:
    """All but one of the same building are on another floor: the next likeliest take their places."""
    all_of_them = sessions()
    found = candidates(all_of_them, ["0-0"], lambda a, b: b not in ("0-1", "0-2"), FEW)
    assert found.keys() == {"0-0"}
    assert found["0-0"][0] == "0-3" and not {"0-1", "0-2"} & {*found["0-0"]}


def test_a_session_without_places_is_compared_with_none() -> None:
    nothing = LookedAt(np.empty((0, 24), np.float32), np.empty(0, np.float32))
    found = candidates({"nothing": nothing, **sessions()}, ["nothing", "1-1"], parameters=FEW)
    assert "nothing" not in found and "nothing" not in found["1-1"]
    assert candidates({"a": nothing, "b": nothing}, ["a"]) == {}


def test_a_place_is_looked_at_from_one_viewpoint() -> None:
    signatures = np.zeros((4, SIGNATURE_COLUMNS), np.uint8)
    signatures[:, -1] = (255, 51, 102, 0)
    seen = SeenPlaces(at_m=np.zeros((4, 2), np.float32), place=np.array([0, 0, 1, 1]), signatures=signatures)
    looked_at = LookedAt.of(seen)
    assert looked_at.vectors.shape == (2, 24)
    assert looked_at.seen.tolist() == pytest.approx([1.0, 0.4])
