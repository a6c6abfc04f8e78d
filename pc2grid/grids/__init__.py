"""Occupancy grids: drawn from scans, or read from maps that somebody else made."""
