"""A window asked in its map, in another building, with its place blanked, and standing."""

import math

from pc2grid.observer import TimeSpan
from pc2grid_lab.fit.posterior import known_of
from pc2grid_lab.fit.queries import KnownWindow, rows
from pc2grid_lab.recordings.catalogue import Catalogue
from signature.config import Config
from signature.places.query import Query
from tests.helpers.simulated_drives import OTHER, building, drive, office


def test_each_question_says_what_tells_for_its_places() -> None:
    whole, last = (Query(Config(), Config().relocalize) for _ in range(2))
    for registered, planar_scan, truth in drive(office(), [(1.5, 7.0), (9.5, 7.0), (9.5, 4.0)]):
        whole.add(registered, planar_scan)
        end = truth
    last.add(registered, planar_scan)
    catalogue = Catalogue.of()
    pair = next(pair for pair in catalogue.pairs if (pair.query, pair.map) == ("wean 1", "wean 2"))
    window = KnownWindow(pair, TimeSpan(0.0, 20.0), whole.map(), None, last.map(), {"office": end}, True)
    asked = list(
        rows(window, building({"office": office()}), {"fr079": building({"other": OTHER})}, catalogue)
    )
    assert [(row["place"], row["map"]) for row in asked] == [
        ("in the map", "wean"),
        ("elsewhere", "fr079"),
        ("in the map", "wean"),
        ("blanked", "wean"),
    ]
    inside, elsewhere, standing, blanked = asked
    assert inside["errors"][0][0] < 0.1 and inside["travel_m"] > 10.0
    assert (
        standing["travel_m"] == 0.0 < standing["evidence"][0]["compared"] < inside["evidence"][0]["compared"]
    )
    assert all(error_m == math.inf for error_m, _ in elsewhere["errors"])
    assert all(error_m > 0.5 for error_m, _ in blanked["errors"])
    known = {one.kind: one for one in known_of([inside, elsewhere])}
    assert known["in its own building"].right == {0}
    assert not known["in another building"].right
    assert known["in another building"].buildings == {"wean", "fr079"}
