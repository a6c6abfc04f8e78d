"""The confidence is a monotone function of the evidence."""

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from signature.localization.confidence import (
    CALIBRATION,
    LIMITS,
    NO_EVIDENCE,
    PRESENCE,
    SAME_PLACE,
    Calibration,
    Evidence,
    Presence,
)
from signature.localization.hypotheses import Hypothesis
from signature.localization.query import QueryMap

AGREEMENTS = np.linspace(0.0, 1.0, 11).tolist()
WALLS = [5.0, 30.0, 100.0, 300.0, 2000.0]
LEADS = [0.0, 0.01, 0.05, 0.1, LIMITS.longest_lead, 1.0]
USUAL = Evidence(forward=0.8, walls=200.0, backward=0.9, looked_at=150.0, lead=0.1, likeness=0.4)


@pytest.mark.parametrize("model", [CALIBRATION, PRESENCE])
@pytest.mark.parametrize(
    ("field", "values"),
    [("forward", AGREEMENTS), ("backward", AGREEMENTS), ("lead", LEADS)],
)
def test_more_agreement_or_a_longer_lead_never_lowers_it(
    model: Calibration | Presence, field: str, values: list[float]
) -> None:
    for agreement, walls, lead in itertools.product(AGREEMENTS[::2], WALLS, LEADS[::2]):
        other = replace(USUAL, forward=agreement, backward=agreement, walls=walls, looked_at=walls, lead=lead)
        along = [model.probability(replace(other, **{field: value})) for value in values]
        assert along == sorted(along) and along[-1] > along[0]


def test_more_walls_make_surer_either_way() -> None:
    good = [CALIBRATION.probability(replace(USUAL, walls=n, looked_at=n)) for n in WALLS]
    poor = replace(USUAL, forward=0.4, backward=0.4, lead=0.0)
    poorer = [PRESENCE.log_odds(replace(poor, walls=n, looked_at=n)) for n in WALLS]
    assert good == sorted(good) and good[0] < 0.1 and good[-1] > 0.95
    assert poorer == sorted(poorer, reverse=True) and poorer[-1] < poorer[0]


def test_an_agreement_counts_by_the_points_that_it_rests_on() -> None:
    """A single scan contradicts hardly any wall of a map, wherever it is placed."""
    alone = replace(USUAL, forward=0.5, backward=1.0, lead=0.05)
    on_few, on_many = (CALIBRATION.probability(replace(alone, looked_at=n)) for n in (20.0, 300.0))
    assert on_few < on_many
    assert CALIBRATION.probability(replace(USUAL, backward=1.0, looked_at=0.0)) == pytest.approx(
        CALIBRATION.probability(replace(USUAL, backward=0.0, looked_at=0.0))
    )


def found(score: float, **known: float) -> Hypothesis:
    """As much of a hypothesis as the evidence is made of."""
    return cast(Hypothesis, SimpleNamespace(fit=SimpleNamespace(score=score, **known)))


def test_the_only_place_that_was_found_is_not_sure_by_being_the_only_one() -> None:
    """Two scans of a real hall, in the map of an office: a wall fits, the walls of the office do not."""
    query = cast(QueryMap, SimpleNamespace(walls=SimpleNamespace(weight=709.0), likeness=0.0))
    hall = {"known_agreement": 0.966, "overlap": 0.447, "backward": 0.115, "looked_at": 2199.0}
    alone = Evidence.of([found(0.269, **hall)], query)
    assert alone.lead == pytest.approx(0.0538) and CALIBRATION.probability(alone) < 0.6
    assert CALIBRATION.probability(replace(alone, lead=LIMITS.longest_lead)) > 0.9
    office = {"known_agreement": 0.95, "overlap": 0.9, "backward": 0.9, "looked_at": 300.0}
    assert Evidence.of([found(0.9, **office)], query).clearance == pytest.approx(
        Evidence.of([found(0.9, **office), found(0.9 - LIMITS.longest_lead)], query).clearance
    )
    assert Evidence.of([found(0.9, **office), found(0.85)], query).lead == pytest.approx(0.05)


def test_a_changed_hall_is_located_by_its_lead() -> None:
    """Figures of a real scanner in a real hall that has been changed: no other place fits nearly as well."""
    changed = replace(
        USUAL, forward=0.75, walls=450.0, backward=0.71, looked_at=436.0, lead=LIMITS.longest_lead
    )
    assert CALIBRATION.probability(changed) > 0.9
    assert CALIBRATION.probability(replace(changed, lead=0.02)) < 0.3


def test_a_lead_on_few_walls_is_chance() -> None:
    """Figures of a standing scanner asked in another building: a long lead, on 32 wall points."""
    elsewhere = replace(USUAL, forward=0.89, walls=32.0, backward=0.62, looked_at=45.0, lead=0.17)
    assert CALIBRATION.probability(elsewhere) < 0.7
    assert CALIBRATION.probability(replace(elsewhere, walls=300.0, looked_at=300.0)) > 0.9


@pytest.mark.parametrize("model", [CALIBRATION, PRESENCE])
def test_a_lead_says_the_less_the_more_the_query_is_like_itself(model: Calibration | Presence) -> None:
    along = [model.probability(replace(USUAL, likeness=like)) for like in (0.0, 0.3, 0.6, 0.9, 1.0)]
    assert along == sorted(along, reverse=True) and along[-1] < along[0]


def test_a_corridor_that_the_map_lacks_is_not_located_in_another() -> None:
    """Figures of a real laser, 73 m from where it was: 406 wall points fit, most of them slid along, too."""
    corridor = Evidence(
        forward=0.913, walls=406.0, backward=0.826, looked_at=582.0, lead=0.033, likeness=0.835
    )
    assert CALIBRATION.probability(corridor) < 0.88
    longer = replace(corridor, lead=LIMITS.longest_lead)
    assert CALIBRATION.probability(longer) > 0.9  # a corridor that no other resembles


def test_without_walls_there_is_no_answer() -> None:
    assert CALIBRATION.probability(replace(USUAL, walls=0.0)) == 0.0
    assert CALIBRATION.probability(NO_EVIDENCE) == PRESENCE.probability(NO_EVIDENCE) == 0.0


def test_two_equal_places_lie_in_the_map_but_which_one_is_open() -> None:
    tie = replace(USUAL, forward=0.97, backward=0.97, lead=0.0)
    assert CALIBRATION.probability(tie) <= 0.5 and PRESENCE.probability(tie) > 0.5
    perfect = replace(tie, forward=1.0, backward=1.0, walls=1e6, looked_at=1e6)
    assert CALIBRATION.probability(perfect) <= 0.5
    poor = replace(tie, forward=0.6, backward=0.6)
    assert CALIBRATION.probability(poor) < 0.01 and PRESENCE.probability(poor) < 0.1


def test_surroundings_are_the_same_if_enough_walls_agree() -> None:
    assert SAME_PLACE.probability(0.627, 1000.0) == pytest.approx(0.5)
    assert SAME_PLACE.probability(0.9, 100.0) > 0.99 > SAME_PLACE.probability(0.9, 10.0) > 0.5
    assert SAME_PLACE.probability(0.3, 1000.0) < 0.01
