"""Settings of a node from a TOML file: tables named like the configuration classes' fields."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from coview_stream.errors import ConfigError, did_you_mean

T = TypeVar("T")


def read_settings(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file; a ConfigError names the file and the line."""
    if path.suffix in (".json5", ".json", ".yaml", ".yml"):
        raise ConfigError(f"{path}: --config takes a TOML file; zenoh's configuration goes to --zenoh-config")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}; name a TOML file that can be read") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text; name a TOML file") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not valid TOML: {error}") from error


def with_table(config: T, table: Mapping[str, Any], where: str) -> T:
    """Return a configuration with the fields of a table; a field that is a configuration takes its own table.

    ``where`` names file and table in the ConfigError of an unknown key, or of a value of another type or out of range.
    """
    names = [field.name for field in fields(config)]  # type: ignore[arg-type]  # T is a dataclass
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in names:
            raise ConfigError(f"{where}: {unknown_key(key, names)}")
        current = getattr(config, key)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: {key} is {value!r}; write a table of its fields")
            values[key] = with_table(current, value, f"{where.removesuffix(']')}.{key}{']' * where.endswith(']')}")
        elif isinstance(value, list):
            values[key] = tuple(value)
        else:
            values[key] = float(value) if isinstance(current, float) and type(value) is int else value
    try:
        return replace(config, **values)  # type: ignore[type-var]  # likewise
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error


def unknown_key(key: str, known: list[str]) -> str:
    """Return the message about an unknown key of a table, with the nearest known one."""
    return f"unknown key {key!r}; {did_you_mean(key, known)}"
