"""``coview-stream help``: the help of a command, or a page of the documentation, which a wheel has as well."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from coview_stream.errors import ConfigError, did_you_mean

HELP = "print the help of a command, or a page of the documentation"

_PACKAGE = Path(__file__).resolve().parents[1]


def pages() -> dict[str, Path]:
    """Return the pages by name: of an installed wheel from the package, of a checkout from docs/."""
    found = sorted((_PACKAGE / "docs").glob("*.md")) or sorted((_PACKAGE.parent / "docs").glob("*.md"))
    return {path.stem: path for path in found}


class _Suggested(list[str]):
    """Names that the shell completes; :func:`run` judges what was given."""

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
        remedy = did_you_mean(topic, list(dict.fromkeys([*COMMANDS, *known])))
        if (page := page_about(topic)) is not None:
            near = f"{remedy} or " if remedy.endswith("?") else ""
            remedy = f"{near}see `{PROGRAM} help {page}.md`"
        raise ConfigError(f"no command or page is called {topic!r}; {remedy}")
    return 0


def page_about(word: str) -> str | None:
    """Return the page with a word in a section's title, else the one that has it most often; None if none has."""
    word, found = _squeezed(word), dict[str, tuple[bool, int]]()
    for name, path in pages().items():
        text = path.read_text(encoding="utf-8")
        titles = [line for line in text.splitlines() if line.startswith("##")]
        found[name] = any(word in _squeezed(title) for title in titles), _squeezed(text).count(word)
    best = max(found, key=lambda name: found[name], default=None)
    return None if best is None or found[best] == (False, 0) else best


def _squeezed(text: str) -> str:
    return "".join(text.split()).casefold()  # ros2 is ROS 2
