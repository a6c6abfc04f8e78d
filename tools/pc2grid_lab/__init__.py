"""The laboratory: recordings, sensors, the paper, and the programs and descriptors pc2grid is compared with.

Nothing of the product imports it, and the wheel does not have it. `pc2grid compare` loads it in a clone.
"""
