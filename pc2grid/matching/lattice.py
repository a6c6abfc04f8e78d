"""How the poses of a search lie: squares of cells, in tiles that are summed at once."""

SQUARE = 4
"""Side of a square of the lattice, in cells."""
TILE = 16, 64
"""Rows and columns of squares that are summed at once. A row of sums of 16 bits fills two of the widest
vector registers; shorter rows of a fixed length are not compiled to vector instructions (measured)."""
BLOCK = 4
"""Of a block of so many by so many squares, the best pose at a heading is reported."""
