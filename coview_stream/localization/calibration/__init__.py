"""Calibration: errors of a robot's sensor and odometry, estimated as it drives, and corrected."""
