"""The version, outside the package's __init__ so that no module has to import upward."""

__version__ = "0.1.0"
