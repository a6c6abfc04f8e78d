"""Windows asked with the shortlist of the signatures, and with the controls."""

from __future__ import annotations

from pc2grid.simulate import office_floorplan
from pc2grid_lab.fit.shortlists import asked, together
from signature.localization.query import Query
from tests.helpers.simulated_drives import building, drive, office


def test_a_window_is_right_where_it_was_made() -> None:
    own, other = building({"map": office()}), building({"map": office_floorplan(1)})
    every = together({"office": own, "floor": other})
    assert every.sessions == ("office", "floor")
    assert len(every.places.table) == len(own.places.table) + len(other.places.table)
    query = Query(own.made_with, own.config)
    for registered, planar_scan, end in drive(office(), [(1.5, 7.0), (9.5, 7.0), (9.5, 4.0)]):
        query.add(registered, planar_scan)
        truth = end
    found = asked(every, query.map(), "signatures", {"office": truth})
    assert found.located and found.right
    elsewhere = asked(every, query.map(), "boundary", {"floor": truth})
    assert elsewhere.located and not elsewhere.right
