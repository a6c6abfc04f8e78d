"""pc2grid beside other programs that locate a robot: the same maps and queries, each in a process of its own.

`site` prepares a building: its map and the queries, in the form that each program takes. `programs` says
which of the programs are installed, and asks them: `own`, `particle_filter`, and `cloud_matchers` with three
of them, which `serving` lets answer alike. `outcome` judges and counts.
"""
