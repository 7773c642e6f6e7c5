"""Calibration: what is imperfect about a robot's sensor and odometry, estimated as it drives, and corrected."""
