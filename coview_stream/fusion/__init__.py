"""Fusion of localized runs with the base map: one cloud, tagged by source, and what has changed."""
