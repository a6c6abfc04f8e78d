"""How well two sets of walls, or two clouds, fit at a pose: field, coarse search, refinement, score."""
