"""Fusion of localized runs with the base map: one cloud, tagged by source and by change."""
