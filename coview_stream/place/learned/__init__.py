"""Learned place recognition, of a scan from below on a map from above, by NumPy, SciPy and onnxruntime."""
