"""Occupancy grid -> submaps (paper III-A): skeleton, junction graph, partition, isovists."""
