"""Experiments that measure how good the program is.

Real recordings: `recordings`, with `slam_relations`, `trajectory_error`. Relocalization across sensors:
`sensor_matrix`, with `registered_session`, `answers`, `trial`.
"""
