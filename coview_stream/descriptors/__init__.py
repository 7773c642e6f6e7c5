"""Descriptors of places: co-view context (paper, eqs 1-4) and learned features."""
