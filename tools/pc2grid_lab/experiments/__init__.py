"""Experiments that measure how good the program is.

The paper's experiment: `paper_experiment`, with `noise`, `paper_tables`, `paper_task`. Relocalization across
sensors and in recordings: `sensor_matrix` and `replay`, with `registered_session`, `sensor_map`, `judgement`,
`trial`, `metrics`, `ablation`. Maps compared with the truth: `map_quality`, with `slam_relations`,
`trajectory_error`, `true_floor`.
"""
