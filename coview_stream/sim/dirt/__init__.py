"""Dirt of the real world in simulated worlds; each kind is an option with its own random numbers."""

from __future__ import annotations

from coview_stream.sim.dirt.config import KINDS_OF_DIRT, REAL, Dirt, parse_dirt, real

__all__ = ["KINDS_OF_DIRT", "REAL", "Dirt", "parse_dirt", "real"]
