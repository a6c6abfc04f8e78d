"""`pc2grid_lab.fit.posterior` on made queries whose model is known, and as its users run it."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.geometry import F64
from pc2grid.matching.evidence import Evidence, masses
from pc2grid_lab.fit import posterior
from pc2grid_lab.fit.posterior import (
    IN_PLANE,
    IN_SPACE,
    Known,
    compared_of,
    fit,
    known_of,
    left_out,
    shuffled,
)

PLANE, SPACE = np.array([-4.0, 2.0, 4.0]), np.array([6.0, -15.0, -60.0, -2.0])
"""The models that make the answers below."""


def queries(
    count: int, truth: F64, terms: Callable[[np.random.Generator], F64], *, in_space: bool
) -> list[Known]:
    """Two places each; which of them is the true one, if any, is drawn by the masses that `truth` gives."""
    rng, made = np.random.default_rng(0), []
    for number in range(count):
        in_plane = rng.uniform(0.05, 0.4, 2) if in_space else None
        one = Known(
            kind="in its own building",
            buildings=frozenset("abc"[number % 3]),
            session=str(number // 4),
            terms=terms(rng),
            right=frozenset(),
            in_plane=in_plane,
        )
        drawn = rng.random() - np.cumsum(one.masses(truth))
        right = next((k for k in (0, 1) if drawn[k] < 0.0), None)
        made.append(one if right is None else replace(one, right=frozenset((right,))))
    return made


def place(rng: np.random.Generator, lead: float) -> Evidence:
    return Evidence(
        known_agreement=float(rng.uniform(0.3, 0.98)),
        compared=float(rng.uniform(30, 300)),
        backward=float(rng.uniform(0.3, 0.98)),
        looked_at=float(rng.uniform(30, 300)),
        lead=lead,
        likeness=float(rng.uniform(0.0, 1.0)),
    )


def of_places(rng: np.random.Generator) -> F64:
    lead = float(rng.uniform(0.0, 0.15))
    return np.array([place(rng, lead).terms, place(rng, -lead).terms])


def of_rays(rng: np.random.Generator) -> F64:
    shares = rng.dirichlet((12.0, 1.5, 0.7), 2)
    terms = np.column_stack((rng.uniform(0.3, 0.8, (2, 1)) * shares, np.zeros(2)))
    terms[rng.random(2) < 0.2] = 0.0, 0.0, 0.0, 1.0
    return terms


def test_masses_are_those_of_the_product() -> None:
    rng = np.random.default_rng(0)
    places = [place(rng, 0.1), replace(place(rng, 0.0), compared=0.0), place(rng, -0.1)]
    row = {"log": "a", "map": "a", "place": "in the map", "start": "0"}
    row |= {"evidence": [asdict(one) for one in places], "errors": [[0.1, 0.0]] * 3}
    (known,) = known_of([row])
    assert known.masses(IN_PLANE) == pytest.approx(masses(places), rel=1e-9)


def test_the_fit_recovers_the_model_that_made_the_answers() -> None:
    """To what the number of answers allows; that some truths are taken for none makes the fit a little
    steeper. The bias is that of a world in which half of the places are found."""
    some = queries(3000, PLANE, of_places, in_space=False)
    (bias, of_fit, lead), share = fit(some, IN_PLANE), np.mean([bool(q.right) for q in some])
    assert bias == pytest.approx(PLANE[0] - np.log(share / (1.0 - share)), abs=0.5)
    assert (of_fit, lead) == pytest.approx(PLANE[1:], rel=0.25)
    with pytest.raises(ValueError, match="found and others"):
        fit([q for q in some if q.right], IN_PLANE)


def test_the_fit_recovers_what_each_kind_of_ray_tells() -> None:
    on, through, before, left = fit(queries(1600, SPACE, of_rays, in_space=True), IN_SPACE, IN_SPACE)
    assert (on, before) == pytest.approx((SPACE[0], SPACE[2]), rel=0.4)
    assert before < 2.0 * through and through < 0.0 and left < 0.0


def test_no_query_of_a_building_takes_part_in_the_fit_that_judges_it() -> None:
    """In building c the rays tell the opposite, which the others do not show; one query of it is in a."""
    some = [
        replace(q, terms=-q.terms) if "c" in q.buildings else q
        for q in queries(30, SPACE, of_rays, in_space=True)
    ]
    some.append(replace(some[2], buildings=frozenset("ac")))

    def fitted(some: Sequence[Known]) -> F64:
        """Fit in no time; what is left out shows as well as with a minimizer."""
        return np.asarray(np.concatenate([q.terms for q in some]).mean(axis=0))

    for q, x in zip(some, left_out(some, fitted), strict=True):
        assert x == pytest.approx(fitted([other for other in some if not other.buildings & q.buildings]))
    assert np.abs(fitted(some) - left_out(some, fitted)[2]).max() > 0.1


def test_shuffled_rays_do_not_tell_places_apart() -> None:
    some = queries(300, SPACE, of_rays, in_space=True)
    right = [sum(int(q.masses(SPACE).argmax()) in q.right for q in given) for given in (some, shuffled(some))]
    assert right[0] > 1.3 * right[1]


def row(log: str, evidence: Evidence, error: list[float], **changes: Any) -> dict[str, Any]:
    """As `queries evidence` writes it."""
    one = {"log": log, "map": log, "place": "in the map", "start": "0", "travel_m": 3.0}
    return one | {"evidence": [asdict(evidence)], "errors": [error]} | changes


GOOD, POOR = (
    replace(place(np.random.default_rng(0), lead), known_agreement=share, backward=share)
    for lead, share in ((0.2, 0.98), (0.01, 0.3))
)


def printed(
    rows: list[dict[str, Any]], folder: Path, capsys: pytest.CaptureFixture[str], **options: bool
) -> str:
    (folder / "rows.json").write_text(json.dumps(rows))
    posterior.main([folder / "rows.json"], **options)
    return capsys.readouterr().out


def test_one_command_fits_and_judges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = []
    for log in ("a", "fr079"):
        rows += [row(log, GOOD, [0.1, 0.01]), row(log, POOR, [7.0, 0.0])]
    rows += [
        row("a", POOR, [float("inf"), 3.0], map="fr079", place="elsewhere"),
        row("a", POOR, [9.0, 0.0], place="blanked"),
        row("a", POOR, [0.2, 0.0], place="blanked"),  # beside its place: neither right nor wrong
        row("a", POOR, [float("inf"), 3.0]),  # no true pose
    ]
    kinds = [k.kind for k in known_of(rows)]
    assert kinds.count("in its own building") == 4 and len(kinds) == 6
    # Without both buildings of "a in the map of fr079" nothing is left to fit to.
    with pytest.raises(SystemExit, match="without a and fr079 not both kinds"):
        printed(rows, tmp_path, capsys)
    said = printed([*rows, row("b", GOOD, [0.1, 0.01]), row("b", POOR, [7.0, 0.0])], tmp_path, capsys)
    assert "in use, in its own building: of 6 located 3 of 3 right ones, 0 wrong ones" in said
    assert "fitted without the building: log loss" in said and "bias, fit, lead: -" in said
    (right, wrong) = (-np.log(mass) for mass in (0.8, 0.9))
    one = replace(next(known_of(rows)), right=frozenset((0,)))
    masses = [np.array([0.8]), np.array([0.1])]
    posterior.print_judged([one, replace(one, right=frozenset())], "by hand", masses)
    assert f"by hand: log loss {(right + wrong) / 2:.4f}" in capsys.readouterr().out


def compared(error_m: float, **changes: Any) -> dict[str, Any]:
    """The second of two places was compared in space."""
    told = {"1": {"terms": [0.5, 0.0, 0.0, 0.0], "error": [error_m, 0.0]}}
    fits = Evidence(known_agreement=0.9, compared=80.0, backward=0.8, looked_at=80.0, lead=0.1, likeness=0.3)
    one = row("a", fits, [3.0, 1.0], in_space=told)
    return one | {"evidence": one["evidence"] * 2, "errors": [[3.0, 1.0]] * 2} | changes


def test_the_place_that_counts_is_where_icp_ends() -> None:
    rows = [compared(0.1), compared(0.6, start="two 0.0")]
    near, far = compared_of(rows + rows[:1])  # a window that is asked twice counts once
    assert near.right == {1} and far.right == frozenset()
    assert np.isnan(near.terms[0]).all() and near.terms[1, 0] == 0.5
    assert near.in_plane is not None and near.masses(SPACE)[1] > near.in_plane[1]


def test_the_factor_in_space_is_judged_as_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        compared(
            0.1 if at == of else 9.0,
            log=of,
            map=at,
            start=of,
            place="in the map" if at == of else "elsewhere",
        )
        for of in "abcd"
        for at in "abcd"
    ]
    said = printed(rows, tmp_path, capsys, in_space=True)
    assert "in the plane, in its own building: of 4 located" in said and "in use, shuffled: log loss" in said
    assert "fitted without the building, in another building: of 12" in said and "left: " in said
