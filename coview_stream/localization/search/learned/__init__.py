"""Place recognition by learned features, on NumPy and SciPy."""
