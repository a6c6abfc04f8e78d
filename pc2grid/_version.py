"""The version of pc2grid, in a module without imports."""

__version__ = "0.1.0"
