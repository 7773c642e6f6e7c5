"""Witnesses of motion: clouds, odometry and map held against each other, and which of them lies."""
