"""pc2grid beside other programs that locate a robot: the same maps and queries, each in a process of its own.

`site` prepares a building: its map and the queries, in the form that each program takes. `environment` says
which of the programs are installed, and how they are. A peer (`peer_process`, `particle_filter`) is asked
query by query; `outcome` judges and counts. `cloud_matchers` and `own_process` are what the processes run.
"""
