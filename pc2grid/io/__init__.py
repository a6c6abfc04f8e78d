"""Files in and out: recordings, maps, trajectories. Nothing here knows what a submap is."""
