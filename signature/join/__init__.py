"""How the sessions of a building lie to each other: graph to graph, verified by walls, one frame for all."""
