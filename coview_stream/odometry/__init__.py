"""Odometry from lidar frames alone, for robots that have no other."""
