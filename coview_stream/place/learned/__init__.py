"""Learned place recognition between a map seen from above and a robot's scan from below; NumPy and onnxruntime."""
