"""Does a query fit at a pose? Walls, coarse search, refinement and score: geometry of grids and points
only."""
