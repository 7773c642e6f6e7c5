"""Witnesses of motion: clouds, odometry and map compared with each other, to find the one that is wrong."""
