"""Submaps -> signatures -> database -> retrieval -> verified pose.

The back of pc2grid: one file per section of the paper (`boundary`, `freespace`, `symmetry`,
`similarity`), the database behind one protocol, and the decision where a query is.
"""
