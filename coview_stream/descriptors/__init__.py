"""Descriptors of places: co-view context (paper, section 3) and learned features."""
