"""The version, apart from the package so that nothing below has to import upward."""

__version__ = "0.1.0"
