"""Frames arrive over zenoh, poses in the map frame leave. Only this package has threads, clocks and processes."""
