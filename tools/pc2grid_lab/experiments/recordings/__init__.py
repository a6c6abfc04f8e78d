"""`pc2grid compare recordings`: what is asked, how it is judged, what changed, and the page."""
