"""The fit finds the model that made the answers, and is judged on what was left out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from pc2grid_lab.experiments.calibration import (
    Known,
    accept_of,
    accepted,
    clopper_pearson,
    fit,
    left_out,
    log_loss,
    roc_area,
    share_by_building,
    share_by_session,
)
from signature.localization.posterior import POSTERIOR, Evidence, masses

TRUTH = replace(POSTERIOR, bias=-4.0, fit=2.0, lead=4.0)


def place(rng: np.random.Generator, lead: float, tail: tuple[float, ...] = ()) -> Evidence:
    return Evidence(
        forward=float(rng.uniform(0.3, 0.98)),
        walls=float(rng.uniform(30, 300)),
        backward=float(rng.uniform(0.3, 0.98)),
        looked_at=float(rng.uniform(30, 300)),
        lead=lead,
        likeness=float(rng.uniform(0.0, 1.0)),
        tail=tail,
    )


def answers(count: int) -> list[Known]:
    """Two places each; which of them is the true one, if any, is drawn by the masses that `TRUTH` gives."""
    rng = np.random.default_rng(0)
    made = []
    for i in range(count):
        lead = float(rng.uniform(0.0, 0.15))
        tail = tuple(rng.uniform(-1.0, 1.5, 5).tolist())
        places = (place(rng, lead, tail), place(rng, -lead))
        drawn = rng.random() - np.cumsum(masses(places, p=TRUTH))
        first = next((k for k in (0, 1) if drawn[k] < 0.0), None)
        buildings = frozenset("abc"[i % 3])
        made.append(Known(buildings=buildings, session=str(i // 4), places=places, first=first))
    return made


def test_the_fit_recovers_the_model_that_made_the_answers() -> None:
    """To what the number of answers allows; that some truths are taken for none makes the fit a little
    steeper."""
    found = fit(answers(6000))
    assert found.bias == pytest.approx(TRUTH.bias, rel=0.25)
    assert found.fit == pytest.approx(TRUTH.fit, rel=0.25)
    assert found.lead == pytest.approx(TRUTH.lead, rel=0.25)


def test_found_places_weigh_what_they_are_told_to() -> None:
    """Half of the others left out: with a given weight of the found ones, the fit is the same."""
    some = answers(6000)
    kept = [a for i, a in enumerate(some) if a.first is not None or i % 2]
    by_number, by_weight = ([fit(of, share).bias for of in (some, kept)] for share in (None, 0.5))
    assert by_number[1] - by_number[0] == pytest.approx(np.log(2.0), abs=0.3)
    assert by_weight[1] == pytest.approx(by_weight[0], abs=0.3)


def test_answers_are_judged_by_a_fit_without_their_group() -> None:
    some = answers(1500)
    held_out = left_out(some)
    own = np.array([a.probability(TRUTH) for a in some])
    assert log_loss(some, held_out) == pytest.approx(log_loss(some, own), abs=0.03)
    assert roc_area(some, held_out) == pytest.approx(roc_area(some, own), abs=0.02)
    assert roc_area(some, np.zeros(len(some))) == 0.5


def test_no_answer_of_a_building_takes_part_in_the_fit_that_judges_it() -> None:
    """Here the queries of a in the map of b would teach a fit that nothing is ever right."""
    some = [replace(a, buildings=frozenset("ab"), first=None) for a in answers(450)]
    known = [a for a in answers(900) if a.buildings != frozenset("b")] + some
    held_out = left_out(known)
    for name in "ac":
        here = np.array([a.buildings == frozenset(name) for a in known])
        without = fit([a for a in known if name not in a.buildings])
        wanted = [a.probability(without) for a in known if a.buildings == frozenset(name)]
        assert held_out[here] == pytest.approx(wanted)
    only_c = fit([a for a in known if a.buildings == frozenset("c")])
    assert held_out[-1] == pytest.approx(some[-1].probability(only_c))


def test_a_fit_needs_both_kinds() -> None:
    with pytest.raises(ValueError, match="found and others"):
        fit([a for a in answers(50) if a.first is not None])


def test_the_interval_counts_sessions_not_answers() -> None:
    yes = np.repeat([True, False], 50)
    share, low, high = share_by_session([f"{i}" for i in range(100)], yes)
    _, wide_low, wide_high = share_by_session(["a"] * 50 + ["b"] * 50, yes)
    assert share == 0.5 and 0.4 < low < 0.5 < high < 0.6
    assert (wide_low, wide_high) == (0.0, 1.0)


def test_the_interval_is_wider_where_all_of_one_building_are_wrong() -> None:
    """Five wrong of a hundred: one in each drive, or all in one of ten buildings."""
    buildings = [frozenset(str(i // 10)) for i in range(100)]
    drives = [f"{i // 5}" for i in range(100)]
    spread, together = np.arange(100) % 20 == 0, np.arange(100) < 5
    for yes in (spread, together):
        assert share_by_building(buildings, drives, yes)[0] == 0.05
    low, high = share_by_building(buildings, drives, spread)[1:]
    lowest, highest = share_by_building(buildings, drives, together)[1:]
    assert lowest < low < 0.05 < high < highest


def test_clopper_pearson_is_the_interval_of_the_binomial_distribution() -> None:
    """Of 100 trials without a hit the upper end is where that happens once in twenty: .95 ** (1 / 100)."""
    assert clopper_pearson(0, 100) == pytest.approx((0.0, 1.0 - 0.05**0.01))
    assert clopper_pearson(100, 100) == pytest.approx((0.05**0.01, 1.0))
    low, high = clopper_pearson(5, 100)
    assert binom.sf(4, 100, low) == pytest.approx(0.05) and binom.cdf(5, 100, high) == pytest.approx(0.05)


def test_the_least_mass_leaves_out_what_is_wrong_too_often() -> None:
    right = np.array([True, True, False, True, True, True])
    mass = np.array([0.99, 0.98, 0.8, 0.9, 0.7, 0.6])
    assert accept_of(right, mass, most_wrong=0.0) == 0.9
    assert accept_of(right, mass, most_wrong=0.17) == 0.6  # one of six
    assert accept_of(right, mass, most_wrong=0.17, least=0.65) == 0.9  # one of five is too many
    assert accept_of(~right, mass, most_wrong=0.1) == 1.0
    assert accept_of(np.array([True, False]), np.array([0.9, 0.9]), most_wrong=0.0) == 1.0  # equal masses


def test_the_least_mass_is_chosen_without_the_building() -> None:
    """In building c nothing is where it seems to be: a least mass chosen with c lets nothing through."""
    known = [replace(a, first=None) if a.buildings == frozenset("c") else a for a in answers(900)]
    given = accepted(known, most_wrong=0.05)
    in_c = np.array([a.buildings == frozenset("c") for a in known])
    assert given[in_c].mean() > given[~in_c].mean()
