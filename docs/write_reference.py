"""Write what comes from code and results: docs/options.md, names in docs/python.md, figures in docs/limits.md.

    python docs/write_reference.py

A test compares them.
"""

from __future__ import annotations

import argparse
import dataclasses
import enum
import inspect
import re
import textwrap
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path

import coview_stream
from coview_stream import config
from coview_stream.cli import PROGRAM, build_parser
from coview_stream.cli.options import documented_fields, role_free
from coview_stream.cli.serve import NOT_IN_TABLES, TABLES
from coview_stream.config.node import NodeConfig
from coview_stream.config.odometry import LidarOdometryConfig

HERE = Path(__file__).resolve().parent
_FIGURE = re.compile(r"(<!-- ([\w ]+), ([^>]+?)(?: @ ([^>]+?))? -->).*?(?=<!-- end -->)")
_NAMES = re.compile(r"(?<=<!-- names -->\n).*?(?=<!-- end -->)", re.DOTALL)


def cell(text: str) -> str:
    """Return a text for a cell of a Markdown table, where ``<`` would begin HTML."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def code(text: str) -> str:
    """Return a text as code in a cell of a table."""
    return f"`{text}`".replace("|", "\\|") if text else ""


def table_of(titles: str, rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table; ``titles`` are parted by bars."""
    lines = [f"|{titles}|", "|---" * (titles.count("|") + 1) + "|", *(f"|{'|'.join(row)}|" for row in rows)]
    return "\n".join(lines)


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
    parsers = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction)).choices
    users: dict[tuple[str, str, str], list[str]] = {}
    for name, parser in parsers.items():
        for option in options_of(parser):
            users.setdefault(option, []).append(name)
    common = {option for option, by in users.items() if len(by) > 1}
    for name, parser in parsers.items():
        rows = list(options_of(parser))
        table = "\n\n" + table_of("|", (option[1:] for option in rows if option not in common))
        table = "" if common.issuperset(rows) else table
        shared = [code(option[0]) for option in rows if option in common]
        line = textwrap.fill(f"[Shared](#shared-options): {', '.join(shared)}", 118, break_on_hyphens=False)
        also = f"\n\n{line}" if shared else ""
        yield f"## {PROGRAM} {name}\n\n{cell(parser.description or '')}{table}{also}"
    table = table_of("||commands", ((*option[1:], ", ".join(by)) for option, by in users.items() if option in common))
    yield f"## Shared options\n\n{table}"


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


def tables_of(name: str, value: object) -> dict[type, str]:
    """Return the table of ``serve --config`` for a configuration, and those for its fields that are configurations."""
    tables = {type(value): name}
    for field in dataclasses.fields(value):
        if dataclasses.is_dataclass(inner := getattr(value, field.name)) and field.name not in NOT_IN_TABLES:
            tables |= tables_of(f"{name}.{field.name}", inner)
    return tables


def settings() -> Iterator[str]:
    """Yield a section for each configuration class."""
    values = {"node": NodeConfig(), "localizer": config.LocalizerConfig(), "lidar_odometry": LidarOdometryConfig()}
    tables = {kind: table for name in TABLES for kind, table in tables_of(name, values[name]).items()}
    public = {kind for name in config.__all__ if dataclasses.is_dataclass(kind := getattr(config, name))}
    for kind in sorted(public | set(tables), key=lambda kind: kind.__name__):
        texts = documented_fields(kind)
        rows = (
            (code(f.name), code(default_of(f)), role_free(cell(texts.get(f.name, ""))))
            for f in dataclasses.fields(kind)
        )
        first = role_free(" ".join(inspect.getdoc(kind).split("\n\n")[0].split()))
        table = f" Table `[{tables[kind]}]`." if kind in tables else ""
        yield f"### {kind.__name__}\n\n{first}{table}\n\n{table_of('field|default|', rows)}"


def options_page() -> str:
    """Return docs/options.md."""
    return "\n\n".join([
        "# Options",
        "Every option of every command and every field of the configuration.\n"
        "Written by `python docs/write_reference.py`; do not edit.",
        *commands(),
        "## Configuration in Python",
        "Frozen dataclasses of `coview_stream.config`, `.node` and `.odometry`. A value out of its range raises\n"
        "`ConfigError`, which names the field. Lengths in metres, angles in radians. `serve --config` takes the\n"
        f"tables named here, without {' and '.join(f'`{name}`' for name in NOT_IN_TABLES)}.",
        *settings(),
    ]) + "\n"  # fmt: skip


def names_table() -> str:
    """Return the public names of ``coview_stream`` with the first sentence of each docstring, and what each has."""
    names = sorted((name for name in coview_stream.__all__ if not name.startswith("_")), key=str.casefold)
    rows = []
    for name in names:
        thing = getattr(coview_stream, name)
        text = role_free(cell(inspect.getdoc(thing).split("\n\n")[0]))
        rows.append((code(name), " ".join([text, *members_of(thing)])))
    return table_of("|", rows) + "\n"


def members_of(thing: object) -> Iterator[str]:
    """Yield in one sentence the parameters of a function, or the parameters and members of a class with methods."""
    if inspect.isfunction(thing):
        yield f"{code(called(thing))}."
    if not inspect.isclass(thing) or issubclass(thing, Exception | enum.Enum) or thing.__name__.endswith("Config"):
        return
    members = [field.name for field in dataclasses.fields(thing)] if dataclasses.is_dataclass(thing) else []
    if not members:
        yield f"{code(called(thing))}:"
    ours = [base for base in thing.__mro__ if base.__module__.startswith("coview_stream")]
    for name, value in ((name, getattr(thing, name)) for base in ours for name in vars(base)):
        if isinstance(value, property | cached_property):
            members.append(name)
        elif callable(value):
            members.append(called(value))
    yield ", ".join(code(member) for member in dict.fromkeys(members) if not member.startswith("_")) + "."


def called(thing: object) -> str:
    """Return a function or class with the names of its parameters."""
    names = [str(p.replace(annotation=p.empty, default=p.empty)) for p in inspect.signature(thing).parameters.values()]
    return f"{thing.__name__}({', '.join(name for name in names if name != 'self')})"


def python_page(text: str) -> str:
    """Return docs/python.md with its table of names as the code has them."""
    return _NAMES.sub(lambda _: names_table(), text)


def limits_page(text: str, results: str) -> str:
    """Return docs/limits.md with its figures, ``<!-- table, row @ column -->``, as docs/results.md has them.

    Without a column it is the second one; a figure that the table does not have yet stays as it is.
    """

    def figure(found: re.Match[str]) -> str:
        part, head = results.partition(f"\n## {found[2]}\n")[2].partition("<!-- end -->")[0], list[str]()
        for line in part.splitlines():
            cells = line.strip("|").split("|") if line.startswith("|") else []
            head = (head or cells) if cells else []
            if cells and cells[0] == found[3] and (found[4] or head[1]) in head:
                return found[1] + cells[head.index(found[4] or head[1])]
        return found[0]

    return _FIGURE.sub(figure, text)


def main() -> None:
    """Write the pages."""
    page = HERE / "limits.md"
    results = (HERE / "results.md").read_text(encoding="utf-8")
    page.write_text(limits_page(page.read_text(encoding="utf-8"), results), encoding="utf-8")
    (HERE / "options.md").write_text(options_page(), encoding="utf-8")
    page = HERE / "python.md"
    page.write_text(python_page(page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
