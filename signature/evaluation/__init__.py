"""How good is it?

The paper's experiment: `evaluate`, with `noise`, `published`, `reproduce`. Relocalization across sensors:
`sensor_matrix` and `replay`, with `driven`, `mapped`, `trial`, `contribution`, `summary`. Maps against
the truth: `map_quality`, with `relations`, `trajectory_error`, `true_floor`.
"""
