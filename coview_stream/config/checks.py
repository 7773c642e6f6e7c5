"""Range checks of configuration fields at construction; the message names field, value and range."""

from __future__ import annotations

import functools
import math
import numbers
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np

from coview_stream.errors import ConfigError, did_you_mean

Config = TypeVar("Config")


def require(ok: bool, config: object, name: str, allowed: str) -> None:
    """Raise :class:`ConfigError`, with the field, its value and the ``allowed`` range, unless ``ok``."""
    if not ok:
        value = getattr(config, name)
        raise ConfigError(f"{name} is {value!r}; it must be {allowed} ({type(config).__name__}.{name})")


def names_parts(kind: type[Config]) -> type[Config]:
    """Make a configuration refuse an unknown field; the ConfigError names the part that has it, or a similar field."""
    made = kind.__init__

    @functools.wraps(made)
    def checked(self: Config, *given: Any, **named: Any) -> None:
        own = {item.name: item.default_factory for item in fields(kind)}  # type: ignore[arg-type]  # a dataclass
        for name in named.keys() - own.keys():
            for part, inner in own.items():
                if isinstance(inner, type) and name in inner.__dataclass_fields__:
                    raise ConfigError(
                        f"{kind.__name__} has no {name}; write {part}={inner.__name__}({name}={named[name]!r})"
                    )
            raise ConfigError(f"{kind.__name__} has no {name}; {did_you_mean(name, list(own))}")
        made(self, *given, **named)

    kind.__init__ = checked  # type: ignore[method-assign, assignment]  # of the same fields
    return kind


_NUMBERS = {"float": (numbers.Real, "a number"), "int": (numbers.Integral, "a whole number")}


def check_types(config: Any) -> None:
    """Refuse a configuration with a field of another type than its annotation: text for a number, a dict for a part."""
    for item in fields(config):
        value = getattr(config, item.name)
        truth = isinstance(value, bool | np.bool_)
        if item.type == "bool":
            require(truth, config, item.name, "True or False")
        elif item.type in _NUMBERS:
            kind, allowed = _NUMBERS[str(item.type)]
            require(isinstance(value, kind) and not truth, config, item.name, allowed)
        elif str(item.type).startswith("tuple["):
            require(isinstance(value, tuple | list), config, item.name, "a tuple")
            plain = str(item.type) != "tuple[float, ...]" or all(isinstance(v, numbers.Real) for v in value)
            require(plain, config, item.name, "a tuple of numbers")
        elif isinstance(item.default_factory, type):
            part = item.default_factory
            require(isinstance(value, part), config, item.name, f"a {part.__name__}")


def positive(config: object, *names: str) -> None:
    """Refuse fields that are not positive and finite."""
    for name in names:
        value = getattr(config, name)
        require(math.isfinite(value) and value > 0, config, name, "a positive, finite number")


def all_positive(config: Any, *but: str) -> None:
    """Refuse a configuration with a field, other than those in ``but``, that is not positive and finite."""
    positive(config, *(f.name for f in fields(config) if f.name not in but))


def counts(config: object, *names: str, minimum: int = 1, maximum: int | None = None) -> None:
    """Refuse fields that are not whole numbers of at least ``minimum``, and at most ``maximum``."""
    for name in names:
        value = getattr(config, name)
        fits = isinstance(value, int) and value >= minimum and (maximum is None or value <= maximum)
        most = "" if maximum is None else f" and <= {maximum}"
        require(fits, config, name, f"a whole number >= {minimum}{most}")


def fraction(config: object, *names: str) -> None:
    """Refuse fields outside (0, 1]."""
    for name in names:
        require(0 < getattr(config, name) <= 1, config, name, "in (0, 1]")


def within(config: object, **ranges: tuple[float, float]) -> None:
    """Refuse fields outside their ranges, both ends included; NaN is outside."""
    for name, (low, high) in ranges.items():
        require(low <= getattr(config, name) <= high, config, name, f"within {low:g} and {high:g}")
