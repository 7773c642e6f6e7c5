"""Poses, planar motions, rasters, distributions, protection levels, and checks of input arrays, in plain NumPy."""
