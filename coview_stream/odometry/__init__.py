"""Odometry: a buffer of poses, deskewing, and lidar odometry for robots that have no other."""
