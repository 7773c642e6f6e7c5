"""Several maps as one: storeys or sites side by side, searched together, and poses told by map."""
