"""The paper, in the order of its sections; the method itself is in the product.

III-A: a map becomes submaps, `pc2grid.submaps.partition`.
III-B, C, D: the three signatures, `signature.boundary`, `signature.freespace`, `signature.symmetry`.
III-E: Eq. 6, `signature.similarity`, and all of it as one method, `proposed`.
IV-A: its six rivals in `rivals`; what all methods do is `protocol`, and `methods` makes them by name.
IV-B: queries and measures in `experiment`, noise in `noise`; the printed Tables I, III and IV in `published`;
their cells as tasks in `cells`, other settings in `choices`; tables and Figure 9 in `report`, run by `command`.
Not in the paper: `several_centres`.
"""
