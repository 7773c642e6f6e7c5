"""Range checks of the simulator's settings."""

from __future__ import annotations

from coview_stream.config.checks import require


def within(config: object, **ranges: tuple[float, float]) -> None:
    """Refuse fields outside their ranges, both ends included; NaN is outside.

    Raises:
        ConfigError: naming the field, its value and the range.
    """
    for name, (low, high) in ranges.items():
        require(low <= getattr(config, name) <= high, config, name, f"within {low:g} and {high:g}")
