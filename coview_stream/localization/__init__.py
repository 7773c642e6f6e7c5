"""The engine: frames and odometry in, fixes out. No clock, no network, no threads."""
