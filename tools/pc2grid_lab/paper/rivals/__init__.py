"""The rivals of the paper (IV-A): Shape Context, bags of SIFT or SURF words, distance features (SDF)."""
