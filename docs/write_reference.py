"""Write docs/options.md and docs/api.md: options and configuration as the code has them, and the public names.

    python docs/write_reference.py

A test holds both pages to the code.
"""

from __future__ import annotations

import argparse
import dataclasses
import enum
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import coview_stream
from coview_stream import config
from coview_stream.cli import PROGRAM, build_parser

HERE = Path(__file__).resolve().parent
_FIELD = re.compile(r"^    (\w+): (.*?)(?=^    \w+: |\Z)", re.MULTILINE | re.DOTALL)


def cell(text: str) -> str:
    """Return a text that stays in its cell of a table; ``<`` would begin HTML."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def code(text: str) -> str:
    """Return a text as code in a cell of a table."""
    return f"`{text}`".replace("|", "\\|") if text else ""


def options_of(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield a row for each argument of a command: how it is written, and its help."""
    formatter = argparse.HelpFormatter(parser.prog, width=1000)
    for action in parser._actions:
        if action.help == argparse.SUPPRESS or isinstance(action, argparse._HelpAction):
            continue
        name = ", ".join(action.option_strings)
        value = ""
        if not action.option_strings or action.nargs != 0:
            value = action.metavar or "|".join(map(str, action.choices or ())) or action.dest.upper()
            value = " ".join(value) if isinstance(value, tuple) else str(value)
        more = " ..." if action.nargs in ("+", "*") else ""
        text = formatter._expand_help(action) if action.help else ""
        yield f"| {code(f'{name} {value}{more}'.strip())} | {cell(text)} |"


def commands() -> Iterator[str]:
    """Yield a section for each command."""
    found = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    for name, parser in found.choices.items():
        yield f"## {PROGRAM} {name}\n\n{cell(parser.description or '')}\n\n| | |\n|---|---|\n" + "\n".join(
            options_of(parser)
        )


def documented_fields(kind: type) -> dict[str, str]:
    """Return what the docstring of a configuration says about each of its fields."""
    _, _, attributes = inspect.getdoc(kind).partition("\nAttributes:\n")
    attributes = re.split(r"^\S", attributes, maxsplit=1, flags=re.MULTILINE)[0]
    return {name: " ".join(text.split()) for name, text in _FIELD.findall(attributes)}


def default_of(field: dataclasses.Field[object]) -> str:
    """Return the default of a field as text, empty where there is none."""
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    if value is dataclasses.MISSING:
        return ""
    if dataclasses.is_dataclass(value):
        return f"{type(value).__name__}()"
    if isinstance(value, enum.Enum):
        return repr(value.value)
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def settings() -> Iterator[str]:
    """Yield a section for each configuration class."""
    for name in config.__all__:
        kind = getattr(config, name)
        if not dataclasses.is_dataclass(kind):
            continue
        texts = documented_fields(kind)
        rows = [
            f"| `{f.name}` | {code(default_of(f))} | {role_free(cell(texts.get(f.name, '')))} |"
            for f in dataclasses.fields(kind)
        ]
        first = role_free(" ".join(inspect.getdoc(kind).split("\n\n")[0].split()))
        yield f"### {name}\n\n{first}\n\n| field | default | |\n|---|---|---|\n" + "\n".join(rows)


def role_free(text: str) -> str:
    """Return a docstring's text with roles and double backticks as plain code."""
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`")


def options_page() -> str:
    """Return docs/options.md."""
    return "\n\n".join([
        "# Options",
        "Every option of every command and every field of the configuration, as the code has them.\n"
        "Written by `python docs/write_reference.py`; do not edit.",
        *commands(),
        "## Configuration in Python",
        "Frozen dataclasses of `coview_stream.config`; a value out of its range raises `ConfigError`,\n"
                "which names the field. "
        "Lengths in metres, angles in radians.",
        *settings(),
    ]) + "\n"  # fmt: skip


def api_page() -> str:
    """Return docs/api.md: a directive of mkdocstrings for each public name."""
    parts = [
        "# Python",
        "The names of `coview_stream` and what their docstrings say, on the site ([CONTRIBUTING](../CONTRIBUTING.md)\n"
        "says how it is made); `help(coview_stream.Localizer)` says the same.\n"
        "Written by `python docs/write_reference.py`; do not edit.",
        "Poses are 4x4 float64 named `T_target_source`; clouds (N, 3), metres.",
    ]
    names = [name for name in coview_stream.__all__ if not name.startswith("_")]
    parts += [f"::: coview_stream.{name}" for name in names]
    parts += ["## Runs and clouds", "::: coview_stream.recordings.open_run", "::: coview_stream.clouds.read_cloud"]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Write both pages."""
    (HERE / "options.md").write_text(options_page(), encoding="utf-8")
    (HERE / "api.md").write_text(api_page(), encoding="utf-8")


if __name__ == "__main__":
    main()
