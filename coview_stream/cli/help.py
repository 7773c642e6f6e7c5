"""``coview-stream help``: the help of a command, or a page of the documentation, which a wheel has as well."""

from __future__ import annotations

import argparse
from pathlib import Path

from coview_stream.errors import ConfigError, did_you_mean

HELP = "print the help of a command, or a page of the documentation"

_PACKAGE = Path(__file__).resolve().parents[1]


def pages() -> dict[str, Path]:
    """Return the pages by name: of an installed wheel from the package, of a checkout from docs/."""
    found = sorted((_PACKAGE / "docs").glob("*.md")) or sorted((_PACKAGE.parent / "docs").glob("*.md"))
    return {path.stem: path for path in found}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("topic", nargs="?", metavar="TOPIC", help="command or page, as listed without one")


def run(args: argparse.Namespace) -> int:
    """Print it."""
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
        print(known[topic.removesuffix(".md")].read_text(encoding="utf-8"), end="")
    else:
        raise ConfigError(
            f"no command or page is called {topic!r}; {did_you_mean(topic, list(dict.fromkeys([*COMMANDS, *known])))}"
        )
    return 0
