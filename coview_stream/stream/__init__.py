"""Zenoh frames in, map-frame poses out. Threads, clocks and processes live here and nowhere else."""
