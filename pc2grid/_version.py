"""The version of pc2grid, in a module that imports nothing."""

__version__ = "0.1.0"
