"""pc2grid beside other programs that locate a robot: the same maps and queries, each in a process of its own.

`programs` prepares buildings, says which of the programs are installed, asks them, judges and counts;
`cloud_matchers` are those that match clouds.
"""
