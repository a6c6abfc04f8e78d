"""The confidence is a monotone function of the evidence."""

import itertools

import numpy as np
import pytest

from signature.relocalization.confidence import (
    CALIBRATION,
    LIMITS,
    NO_EVIDENCE,
    PRESENCE,
    SAME_PLACE,
    Evidence,
)

AGREEMENTS = np.linspace(0.0, 1.0, 21).tolist()
WALLS = [0.0, 5.0, 30.0, 100.0, 300.0, 2000.0]
LEADS = [0.0, 0.01, 0.05, 0.2, LIMITS.longest_lead, 1.0]


def p(agreement: float, walls: float, lead: float) -> float:
    return CALIBRATION.probability(Evidence(agreement=agreement, walls=walls, lead=lead))


def test_more_agreement_or_a_longer_lead_never_lowers_it() -> None:
    for walls, lead in itertools.product(WALLS, LEADS):
        along = [p(a, walls, lead) for a in AGREEMENTS]
        assert along == sorted(along)
    for agreement, walls in itertools.product(AGREEMENTS, WALLS):
        along = [p(agreement, walls, lead) for lead in LEADS]
        assert along == sorted(along)


def test_more_walls_make_surer_either_way() -> None:
    good = [p(0.97, walls, 0.1) for walls in WALLS]
    poor = [p(0.5, walls, 0.2) for walls in WALLS[2:]]
    assert good == sorted(good) and good[-1] > 0.99
    assert poor == sorted(poor, reverse=True) and poor[-1] < 0.01


def test_few_walls_locate_nothing_however_well_they_fit() -> None:
    assert p(1.0, 0.0, 1.0) == 0.0
    assert p(1.0, 5.0, 1.0) < 0.5
    assert CALIBRATION.probability(NO_EVIDENCE) == PRESENCE.probability(NO_EVIDENCE) == 0.0


def test_two_equal_places_lie_in_the_map_but_which_one_is_open() -> None:
    tie = Evidence(agreement=0.97, walls=200.0, lead=0.0)
    assert CALIBRATION.probability(tie) < 0.9 and PRESENCE.probability(tie) > 0.5
    perfect = Evidence(agreement=1.0, walls=1e6, lead=0.0)
    assert CALIBRATION.probability(perfect) <= 0.5
    poor = Evidence(agreement=0.7, walls=200.0, lead=0.0)
    assert CALIBRATION.probability(poor) < 0.01 and PRESENCE.probability(poor) < 0.1


def test_surroundings_are_the_same_if_enough_walls_agree() -> None:
    assert SAME_PLACE.probability(0.627, 1000.0) == pytest.approx(0.5)
    assert SAME_PLACE.probability(0.9, 100.0) > 0.99 > SAME_PLACE.probability(0.9, 10.0) > 0.5
    assert SAME_PLACE.probability(0.3, 1000.0) < 0.01
