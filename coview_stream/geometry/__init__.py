"""Transforms, rotations, SE(3) and rasters: plain NumPy, nothing about lidar."""
