"""Measurements of time and memory: `python -m pc2grid_lab.bench.run`."""
