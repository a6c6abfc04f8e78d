"""Recordings -> registered scans -> occupancy grids -> submaps.

The front of pc2grid: everything that knows what a sensor is. `signature` (the back) only sees grids
and submaps. Importing this package costs nothing: the modules load their libraries when used.
"""

__version__ = "0.1.0"
