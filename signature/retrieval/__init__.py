"""Where may the robot stand? Views of a query in, places out: by the signatures, and by nothing else."""
