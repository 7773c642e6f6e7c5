"""Viewers: what there is to see of a session, robots on their map, handed to all that show or record it."""
