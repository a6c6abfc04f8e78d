"""The paper, in the order of its sections; the method itself is in the product.

III-A: a map becomes submaps, `pc2grid.submaps.submaps`.
III-B, C, D: the three signatures, `signature.boundary`, `signature.freespace`, `signature.symmetry`.
III-E: Eq. 6, `signature.paper`, and all of it as one method, `proposed`.
IV-A: its six rivals, in `rivals`; `protocol` says what every method does, `methods` makes them by name.
IV-B: queries and measures, `experiment`, and their noise, `noise`; the printed tables, `published`; their
cells as tasks, `cells`, and other settings, `choices`; tables and Figure 9 drawn, `report`; the `command`.
Not in the paper: `several_centres`, `learned`; `scale`, a command of its own.
"""
