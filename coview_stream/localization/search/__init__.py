"""Global search: votes of keyframes, hypotheses, and when to believe one."""
