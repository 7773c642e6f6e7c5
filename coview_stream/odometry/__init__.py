"""Odometry: a buffer of poses, deskewing, and lidar odometry for robots without any other."""
