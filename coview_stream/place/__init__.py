"""Where am I, roughly: descriptors, keyframes, retrieval, consensus."""
