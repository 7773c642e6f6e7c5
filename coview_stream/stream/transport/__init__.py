"""Transports (zenoh, ROS 2, and in memory for tests), their keys and queries, and the HTTP server."""
