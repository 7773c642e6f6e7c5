"""Viewers: robots on their map, decoded once and handed to the web page, Foxglove, rerun and recordings."""
