"""Base maps: ground, stations, virtual reference scans, and the map file."""
