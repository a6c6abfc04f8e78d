"""The laboratory: experiments, the programs and descriptors pc2grid is compared with, and benchmarks.

Nothing of the product imports it. `pc2grid compare` loads it when it is asked for.
"""
