"""Place recognition by learned features, on NumPy, SciPy and onnxruntime."""
