"""Results -> files of other programs: MCAP, g2o, GraphML, point clouds."""
