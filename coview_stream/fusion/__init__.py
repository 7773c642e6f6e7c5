"""Fusion of localized runs with the base map: one cloud, with tags for source and change."""
