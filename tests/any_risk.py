"""Acceptance rules with risks that no user may ask for: so that no place, however certain, is accepted."""

import sys

from coview_stream.config import AcceptanceConfig


def with_risk(risk: float) -> AcceptanceConfig:
    rule = AcceptanceConfig()
    object.__setattr__(rule, "risk", risk)
    return rule


NEVER = with_risk(sys.float_info.min)
"""Nothing is that certain."""
