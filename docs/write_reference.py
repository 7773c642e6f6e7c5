"""Write the pages that come from the code: docs/options.md, and the table of public names in docs/python.md.

    python docs/write_reference.py

A test compares both with the code.
"""

from __future__ import annotations

import argparse
import dataclasses
import enum
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import coview_stream
from coview_stream import config
from coview_stream.cli import PROGRAM, build_parser
from coview_stream.cli.options import documented_fields, role_free

HERE = Path(__file__).resolve().parent
_NAMES = re.compile(r"(?<=<!-- names -->\n).*?(?=<!-- end -->)", re.DOTALL)


def cell(text: str) -> str:
    """Return a text for a cell of a Markdown table, where ``<`` would begin HTML."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def code(text: str) -> str:
    """Return a text as code in a cell of a table."""
    return f"`{text}`".replace("|", "\\|") if text else ""


def options_of(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str, str]]:
    """Yield for each argument of a command: its name, how it is written, its help."""
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
        yield name.rpartition(" ")[2] or value, code(f"{name} {value}{more}".strip()), cell(text)


def commands() -> Iterator[str]:
    """Yield a section for each command, and one for the options that several commands share."""
    found = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    users: dict[tuple[str, str, str], list[str]] = {}
    for name, parser in found.choices.items():
        for option in options_of(parser):
            users.setdefault(option, []).append(name)
    common = {option for option, by in users.items() if len(by) > 1 and option[2] != "likewise"}
    for name, parser in found.choices.items():
        rows = [option for option, by in users.items() if name in by]
        own = [f"| {written} | {text} |" for option, written, text in rows if (option, written, text) not in common]
        shared = [code(option[0]) for option in rows if option in common]
        table = "\n\n| | |\n|---|---|\n" + "\n".join(own) if own else ""
        also = "\n\n" + textwrap.fill(f"[Shared](#shared-options): {', '.join(shared)}", 118) if shared else ""
        yield f"## {PROGRAM} {name}\n\n{cell(parser.description or '')}{table}{also}"
    table = [f"| {option[1]} | {option[2]} | {', '.join(by)} |" for option, by in users.items() if option in common]
    yield "## Shared options\n\n| | | commands |\n|---|---|---|\n" + "\n".join(table)


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


def options_page() -> str:
    """Return docs/options.md."""
    return "\n\n".join([
        "# Options",
        "Every option of every command and every field of the configuration.\n"
        "Written by `python docs/write_reference.py`; do not edit.",
        *commands(),
        "## Configuration in Python",
        "Frozen dataclasses of `coview_stream.config`. A value out of its range raises `ConfigError`,\n"
        "which names the field. Lengths in metres, angles in radians.",
        *settings(),
    ]) + "\n"  # fmt: skip


def names_table() -> str:
    """Return the public names of ``coview_stream`` with the first sentence of each docstring."""
    names = sorted((name for name in coview_stream.__all__ if not name.startswith("_")), key=str.casefold)
    sentences = [inspect.getdoc(getattr(coview_stream, name)).split("\n\n")[0] for name in names]
    rows = [f"| `{name}` | {role_free(cell(text))} |" for name, text in zip(names, sentences, strict=True)]
    return "| | |\n|---|---|\n" + "\n".join(rows) + "\n"


def python_page(text: str) -> str:
    """Return docs/python.md with its table of names as the code has them."""
    return _NAMES.sub(lambda _: names_table(), text)


def main() -> None:
    """Write both pages."""
    (HERE / "options.md").write_text(options_page(), encoding="utf-8")
    page = HERE / "python.md"
    page.write_text(python_page(page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
