"""What places look like: co-view context (paper, sec. 3) and learned features."""
