"""The paper, in the order of its sections; the method itself is in the product.

III-A: a map becomes submaps, `pc2grid.submaps.submaps`.
III-B, C, D: the three signatures, `signature.boundary`, `signature.freespace`, `signature.symmetry`.
III-E: Eq. 6, `signature.paper`.
IV-A: all of it as one method, its six rivals, and what learns, by name, in `methods`.
IV-B: queries, noise, measures, and what every method does, `experiment`; the printed tables and Figure 9,
`tables`. Not in the paper: what learns, in `methods`; `scale`, a command of its own.
"""
