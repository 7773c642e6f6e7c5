"""Tracking: registrations to the map and odometry between them, in one graph of poses."""
