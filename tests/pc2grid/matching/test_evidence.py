"""The evidence of places, and their masses by it: agreement, number of points, lead, prior."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from pc2grid.matching.evidence import EVIDENCE, Evidence, evidence_of, masses, tempered
from pc2grid.matching.score import Fit

AGREEMENTS = np.linspace(0.0, 1.0, 11).tolist()
WALLS = [5.0, 30.0, 100.0, 300.0, 2000.0]
LEADS = [-0.1, 0.0, 0.01, 0.05, 0.1, 0.15]
NO_EVIDENCE = Evidence(known_agreement=0.0, compared=0.0, backward=0.0, looked_at=0.0, lead=0.0, likeness=0.0)
USUAL = Evidence(known_agreement=0.9, compared=200.0, backward=0.9, looked_at=150.0, lead=0.15, likeness=0.4)


def mass(evidence: Evidence) -> float:
    return float(masses([evidence])[0])


@pytest.mark.parametrize(
    ("field", "values"), [("known_agreement", AGREEMENTS), ("backward", AGREEMENTS), ("lead", LEADS)]
)
def test_more_agreement_or_a_longer_lead_never_lowers_the_mass(field: str, values: list[float]) -> None:
    for agreement, walls, lead in itertools.product(AGREEMENTS[::2], WALLS, LEADS[::2]):
        other = replace(
            USUAL, known_agreement=agreement, backward=agreement, compared=walls, looked_at=walls, lead=lead
        )
        along = [mass(replace(other, **{field: value})) for value in values]
        assert along == sorted(along) and along[-1] > along[0]


def test_masses_and_what_they_leave_add_up_to_one() -> None:
    """ "Nowhere" has the weight 1 beside exp(z) of each place."""
    places = [replace(USUAL, lead=0.01), replace(USUAL, lead=-0.01, known_agreement=0.85)]
    odds = np.exp([p.log_odds() for p in places])
    assert masses(places) == pytest.approx(odds / (1.0 + odds.sum()))


def test_of_two_equal_places_each_has_at_most_half() -> None:
    twins = [replace(USUAL, known_agreement=1.0, backward=1.0, compared=1e6, looked_at=1e6, lead=0.0)] * 2
    assert masses(twins).max() <= 0.5
    assert masses([replace(USUAL)] * 2).sum() > 0.9  # which of them is open, not whether it is one


def test_the_prior_decides_between_equal_places_and_not_what_is_certain() -> None:
    twins = [replace(USUAL, lead=0.0)] * 2
    first, second = masses(twins, [1.0, 0.01])
    assert first == pytest.approx(100.0 * second)
    assert masses([USUAL], [0.5])[0] == pytest.approx(mass(USUAL) / (2.0 - mass(USUAL)))


def test_what_neither_side_knows_says_nothing() -> None:
    assert tempered(0.9, 0.0) == 0.0
    assert mass(replace(USUAL, backward=1.0, looked_at=0.0)) == pytest.approx(
        mass(replace(USUAL, backward=0.0, looked_at=0.0))
    )
    assert masses([replace(USUAL, compared=0.0)])[0] == 0.0 and masses([NO_EVIDENCE])[0] == 0.0
    assert len(masses([])) == 0


def test_a_place_where_fewer_points_agree_than_at_wrong_ones_speaks_against_itself() -> None:
    poor = replace(USUAL, known_agreement=0.4, backward=0.4)
    assert poor.log_likelihood < 0.0 < USUAL.log_likelihood
    assert mass(poor) < 0.9 < mass(USUAL)


def test_a_lead_says_the_less_the_more_the_query_is_like_itself() -> None:
    along = [mass(replace(USUAL, likeness=like)) for like in (0.0, 0.3, 0.6, 0.9, 1.0)]
    assert along == sorted(along, reverse=True) and along[-1] < 0.9 < along[0]


def test_a_corridor_that_the_map_lacks_is_not_located_in_another() -> None:
    """Figures of a real laser, 73 m from where it was: 406 wall points fit, most of them slid along, too."""
    corridor = replace(
        USUAL,
        known_agreement=0.913,
        compared=406.0,
        backward=0.826,
        looked_at=582.0,
        lead=0.033,
        likeness=0.835,
    )
    assert mass(corridor) < 0.88
    assert mass(replace(corridor, lead=0.17)) > 0.9  # a corridor that no other resembles


def found(score: float, agreement: float = 0.9) -> Fit:
    """As much of a fit as the evidence is made of."""
    known = {"known_agreement": agreement, "compared": 270.0, "backward": 0.9, "looked_at": 300.0}
    return cast(Fit, SimpleNamespace(score=score, **known))


def test_the_lead_is_over_the_best_other_place_and_not_longer_than_what_is_searched_for() -> None:
    assert [e.lead for e in evidence_of([found(0.9), found(0.85), found(0.6)])] == pytest.approx(
        [0.05, -0.05, -0.3]
    )
    (alone,) = evidence_of([found(0.9)])
    assert alone.lead == pytest.approx(EVIDENCE.longest_lead * 0.9)
    (rivalled,) = evidence_of([found(0.9)], rivals=[found(0.87)])
    assert rivalled.lead == pytest.approx(0.03)


def test_equal_places_are_no_example_of_what_wrong_places_score() -> None:
    twins = evidence_of([found(0.9), found(0.895), found(0.8)])
    assert [e.lead for e in twins] == pytest.approx([0.1, 0.1, -0.1])
    first, second, _ = masses(twins)
    assert first == second and first + second > 0.9


def test_what_differs_between_equal_places_is_chance() -> None:
    """Their scores are equal, as the one that agrees less lies on more known ground."""
    twins = evidence_of([found(0.9, 0.85), found(0.9, 0.95)])
    assert twins[0] == twins[1] and twins[0].known_agreement == 0.95
