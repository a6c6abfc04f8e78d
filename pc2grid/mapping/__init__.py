"""Registered scans -> a map: keyframes, local maps, loop closure, pose graph, occupancy grid."""
