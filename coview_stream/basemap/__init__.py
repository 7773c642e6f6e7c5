"""Base maps: ground, stations, virtual reference scans, the file."""
