"""Training of the learned re-localizer: simulated worlds, their bird views, and the networks' training."""
