"""Where am I, exactly, and how sure: registration and verification."""
