"""``coview-stream help``: the help of a command, or a page of the documentation, which the wheel contains."""

from __future__ import annotations

import argparse
import re
import shutil
import textwrap
from collections.abc import Iterable
from pathlib import Path

from coview_stream.errors import ConfigError, did_you_mean

HELP = "print the help of a command, or a page of the documentation"

_PACKAGE = Path(__file__).resolve().parents[1]


def pages() -> dict[str, Path]:
    """Return the pages by name: from the package in an installed wheel, from docs/ in a checkout."""
    found = sorted((_PACKAGE / "docs").glob("*.md")) or sorted((_PACKAGE.parent / "docs").glob("*.md"))
    return {path.stem: path for path in found}


class _Suggested(list[str]):
    """Names that the shell completes; :func:`run` checks the given name."""

    def __init__(self, known: Iterable[str]) -> None:
        from coview_stream.cli import COMMANDS

        super().__init__(dict.fromkeys([*COMMANDS, *known]))

    def __contains__(self, _: object) -> bool:
        return True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    topic = parser.add_argument("topic", nargs="?", metavar="TOPIC", help="command or page, as listed without one")
    topic.choices = _Suggested(pages())


def run(args: argparse.Namespace) -> int:
    """Print the help or page."""
    from coview_stream.cli import COMMANDS, PROGRAM, main

    known, topic = pages(), args.topic
    if topic is None:
        main(["--help"])
        print(f"\npages: {', '.join(known)}\n`{PROGRAM} help NAME` prints one of either")
    elif topic in COMMANDS:
        main([topic, "--help"])
        if topic in known:
            print(f"\nits page: `{PROGRAM} help {topic}.md`")
    elif topic.removesuffix(".md") in known:
        print(readable(known[topic.removesuffix(".md")].read_text(encoding="utf-8")))
    else:
        remedy = did_you_mean(topic, list(dict.fromkeys([*COMMANDS, *known])))
        if (page := page_titled(topic)) is not None:
            near = f"{remedy} or " if remedy.endswith("?") else ""
            remedy = f"{near}see `{PROGRAM} help {page}.md`"
        raise ConfigError(f"no command or page is called {topic!r}; {remedy}")
    return 0


def readable(page: str) -> str:
    """Return a page for a terminal: links as their text, table rows as paragraphs with one line per cell."""
    lines, names = list[str](), list[str]()
    for line in re.sub(r"!?\[([^\]]*)\]\((?!http)[^)\s]*\)", r"\1", page).splitlines():
        cells = [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if not line.startswith("|"):
            lines, names = [*lines, line], []
        elif not names:
            names = ["", *(f"{cell}: " if cell else "" for cell in cells[1:])]
        elif not set(line) <= set("|-: "):
            width = shutil.get_terminal_size().columns
            for name, cell, first in zip(names, cells, ("", *["    "] * len(cells)), strict=False):
                lines += textwrap.wrap(name + cell, width, initial_indent=first, subsequent_indent="    ")
            lines.append("")
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines))


def page_titled(word: str) -> str | None:
    """Return the first page with a word in a title, ignoring blanks (ros2 is ROS 2); None if there is none."""
    for name, path in pages().items():
        titles = [line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
        if any(word.casefold() in "".join(title.split()).casefold() for title in titles):
            return name
    return None
