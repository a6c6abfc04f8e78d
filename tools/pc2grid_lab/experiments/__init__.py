"""Experiments that measure how good the program is.

The paper's experiment: `paper_experiment`, with `noise`, `paper_tables`, `paper_task`. Real recordings:
`recordings`, with `slam_relations`, `trajectory_error`. Relocalization across sensors: `sensor_matrix`, with
`registered_session`, `answers`, `trial`.
"""
