"""Global search: votes of keyframes, hypotheses, and the acceptance of a place."""
