"""`pc2grid compare recordings`: what is run, how it is judged, what changed, and the page."""
