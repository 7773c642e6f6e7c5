"""Training of the learned features: simulated worlds, their bird's-eye views, and the networks."""
