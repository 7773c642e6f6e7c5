"""Tracking: registrations to the map and odometry between them, in one pose graph."""
