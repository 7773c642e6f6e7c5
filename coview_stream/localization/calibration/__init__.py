"""Calibration: errors of a robot's sensor and odometry, estimated during the drive and corrected."""
